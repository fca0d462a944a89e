"""Measures how accurate answers are and writes docs/accuracy.md and the pages in docs/accuracy.

`python -m tests.accuracy [PART...]`: a part that is not named stays as it was measured last. The
README has the headlines of four.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.accuracy import cases, comparing, costs, events
from tests.accuracy.page import FIGURES, PAGE, README, Part, headline, table
from tests.benchmarks import recorders
from tests.benchmarks.core import Bench

PARTS: Final = (
    Part("cases", "Public situations", "Does it work for other people's robots?", cases.cases),
    Part("events", "Events", "Are events found, and are they true?", events.events),
    Part("checks", "Checks", "Do checks find faults?", events.checks),
    Part("comparisons", "Comparisons of runs", "Are differences real?", comparing.comparisons),
    Part("trials", "Trials", "Is the best really better?", comparing.trials),
    Part("kills", "Kills and interrupts", "Does a crash lose data?", costs.kills),
    Part(
        "survival",
        "Kills of other recorders",
        "Compared with other recorders?",
        recorders.survival,
    ),
    Part("loop", "Cost of recording", "Does it slow the controller?", recorders.loop),
    Part("answers", "Tokens", "Does it fill the assistant's context?", costs.answers),
)
# The parts whose figure is in the README, each with the question that it answers.
SHOWN: Final = {
    "events": "Can you trust what it finds?",
    "kills": "Does a crash lose data?",
    "loop": "Does it slow the controller?",
    "answers": "Does it fill the assistant's context?",
}
_INTRODUCTION: Final = """\
# Accuracy and cost

Events, checks and verdicts come from rules, and rules err. This page says how often they do, and
what recording costs.

## Public situations

`tests/cases` rebuilds situations from public reports as recordings, with the answer that an expert
would give. The rules were made with the first two groups in view. For the other groups, the
right answers were written down before webots-mcp was first asked; then some rules were improved. In
the third group, a right answer earns 2 points, a helpful one 1, a false one -1. That gave
{first} of {most} points at first, {now}
today."""
_SIMULATED: Final = """\
## All figures

The other recordings are simulated, because only then is the truth known exactly. The rules were
made with other recordings of the same kinds. Each figure links to its conditions and tables."""
_METHOD: Final = """\
## How it is measured

`python -m tests.accuracy` measures everything and writes these pages in an hour or two; no figure
is written by hand. `python -m tests.accuracy loop` measures one part. Durations are those of one
busy machine, so compare ratios. On the linked pages, a share has its 95 % interval in
parentheses."""
_RIGHT: Final = 2  # points of a situation that is answered rightly


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and write the page and the README's figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.accuracy", description=__doc__)
    names = [part.name for part in PARTS]
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(names)} (all)")
    parser.add_argument("--effort", type=float, default=1.0, help="less is faster and rougher (1)")
    options = parser.parse_args(arguments)
    logging.disable(
        logging.WARNING
    )  # the questions of the golden answers are refused here and there
    if unknown := set(options.parts) - set(names):
        parser.error(f"no part {', '.join(unknown)}: there is {', '.join(names)}")
    for part in PARTS:
        if part.name in (options.parts or names):
            details = measured(part, options.effort)
            part.file.write_text(details, "utf-8")
            write_summaries()
    return 0


def write_summaries() -> None:
    """Write the page and the README's figures from the pages of the parts."""
    known = stored()
    PAGE.write_text(page_of(known), "utf-8")
    readme = README.read_text("utf-8")
    README.write_text(FIGURES.sub(lambda _: figures(known), readme), "utf-8")


def stored() -> dict[str, str]:
    """The page of each part as it was measured last, by the part's name."""
    return {each.name: each.file.read_text("utf-8") for each in PARTS if each.file.exists()}


def measured(part: Part, effort: float) -> str:
    """The page of a part, as it comes out today."""
    with tempfile.TemporaryDirectory() as folder:
        return part.measured(Bench(Path(folder), effort, _show))


def page_of(known: dict[str, str]) -> str:
    """The page: the public situations first, then the figure of each part with its page."""
    shown = [part for part in PARTS if part.name in known]
    rows = [
        (
            part.question,
            f"{_first_sentence(headline(known[part.name]))} [Details](accuracy/{part.name}.md)",
        )
        for part in shown
    ]
    texts = situations(known["cases"]) if "cases" in known else []
    return (
        "\n\n".join([*texts, _SIMULATED, _in_words(("question", "answer"), rows), _METHOD]) + "\n"
    )


def situations(details: str) -> list[str]:
    """Say how many public situations are answered, and list those that are not.

    Args:
        details: The page of the part.
    """
    counts = re.search(
        r"(\d+) of (\d+) healthy robots get no alarm, (\d+) of (\d+) problems are answered; "
        r"(\d+)\s+situations that were labelled first earn (\d+) of (\d+) points",
        headline(details),
    )
    assert counts is not None, headline(details)
    quiet, healthy, answered, problems, labelled, _, most = counts.groups()
    found = re.findall(r"(?m)^\| (.+\(\[report\].+) \| (-?\d+) \| (-?\d+) \|$", details)
    points = {name: (int(first), int(now)) for name, first, now in found}
    right = [str(sum(each[at] == _RIGHT for each in points.values())) for at in (0, 1)]
    rows = [
        ("healthy robots of public reports: no alarm", healthy, "", quiet),
        ("problems of public reports: found, or reported as not searched", problems, "", answered),
        ("public reports whose right answers were written down first", labelled, *right),
        *_unfamiliar(details),
    ]
    sums = [sum(each[at] for each in points.values()) for at in (0, 1)]
    texts = [
        _INTRODUCTION.format(first=sums[0], now=sums[1], most=most),
        table(("situations", "number", "right at first", "right now"), rows),
    ]
    wrong = re.search(r"(?ms)^Answered wrongly:\n\n(.*?)\n\n", details)
    texts += [f"Answered wrongly in the first two groups:\n\n{wrong[1]}"] if wrong else []
    missed = [f"- {name}: {now}" for name, (_, now) in points.items() if now < _RIGHT]
    if missed:
        head = "Incomplete answers in the third group, with their points:"
        texts.append("\n".join([f"{head}\n", *missed]))
    return texts


def _unfamiliar(details: str) -> list[tuple[str, ...]]:
    """Rows about robots of unfamiliar kinds, once they were measured."""
    found = re.findall(r"(?m)^\| ([a-z ]+) \| (\d+) \| (\d+) \|$", details)
    counts = {kind: (int(first), int(now)) for kind, first, now in found}
    if not counts.keys() >= {"quiet", "false alarm", "right"}:
        return []
    healthy = sum(counts[kind][1] for kind in ("quiet", "false alarm"))
    faulty = sum(now for _, now in counts.values()) - healthy
    return [
        ("recordings of healthy robots of unfamiliar kinds: no alarm", str(healthy),
         *map(str, counts["quiet"])),
        ("faults of such robots: found, named and timed", str(faulty),
         *map(str, counts["right"])),
    ]  # fmt: skip


def _in_words(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of sentences."""
    return table(head, rows).replace("---:", "---")


def figures(known: dict[str, str]) -> str:
    """What the README shows: four questions, each with the sentence that answers it."""
    return "\n".join(
        f"- **{question}** {_first_sentence(headline(known[name]))}"
        for name, question in SHOWN.items()
        if name in known
    )


def _first_sentence(text: str) -> str:
    return text.partition(". ")[0].removesuffix(".") + "."


def _show(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
