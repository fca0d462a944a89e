// How the search of the site orders its results: pages that say what to do about a symptom come
// first; the list of changes and what is generated from the code come last.
const FIRST = /^docs\/(my-robot|troubleshooting)$/;
const NEXT = /^docs\/(faq|events|check|first-steps)$/;
const LAST = /^(CHANGELOG|CONTRIBUTING|docs\/(tools|command-line)\/.*|docs\/(fields|python|database))$/;

var Scorer = {
  score: ([page, title, anchor, description, score, file]) =>
    score + (FIRST.test(page) ? 200 : NEXT.test(page) ? 50 : LAST.test(page) ? -50 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
