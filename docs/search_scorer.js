// The scores of Sphinx's search, with pages about problems first: who searches for "stuck" has one.
const FIRST = ["docs/my-robot", "docs/troubleshooting"];

var Scorer = {
  score: ([page, title, anchor, description, score]) => score + (FIRST.includes(page) ? 20 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
