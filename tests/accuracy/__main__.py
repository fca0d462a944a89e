"""Measures what docs/accuracy.md says, and writes it there: `python -m tests.accuracy [PART...]`.

A part that is not named stays as it was measured last. The README has the headlines of four.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.accuracy import cases, comparing, costs, events
from tests.accuracy.page import FIGURES, PAGE, README, Part, headline, sections
from tests.benchmarks import recorders
from tests.benchmarks.core import Bench

PARTS: Final = (
    Part("cases", "Situations that people met", cases.cases),
    Part("events", "Events", events.events),
    Part("checks", "Checks", events.checks),
    Part("comparisons", "Comparisons of runs", comparing.comparisons),
    Part("trials", "Trials", comparing.trials),
    Part("kills", "What a kill costs", costs.kills),
    Part("survival", "What a kill leaves of other recordings", recorders.survival),
    Part("loop", "What recording costs", recorders.loop),
    Part("answers", "Tokens", costs.answers),
)
# The parts whose figure is in the README, each with the question that it answers.
SHOWN: Final = {
    "events": "Can you trust what it finds?",
    "kills": "Does a crash lose data?",
    "loop": "Does it slow the controller?",
    "answers": "Does it fill the assistant's context?",
}
_INTRODUCTION: Final = """\
# How accurate, at what cost

What is said of a recording is found by rules, and rules err. This page says how often, and what
recording costs. `python -m tests.accuracy` measures all of it and writes this page (an hour or
two; `python -m tests.accuracy loop` only that part, `--effort 0.1` a tenth); no figure is
written by hand. Durations are of one busy machine: compare ratios. Shares have the interval in
parentheses that holds the true one nineteen times of twenty.

The first part is about robots and faults that other people reported. In the others the recordings
are drawn, since only then is it known exactly what happened in them: their robots, noise and faults
are the authors' idea of real ones, and the rules were made with other draws of the same kinds.
`python -m tests.cases`, `python -m tests.judging.detection --wrong` and `python -m
tests.judging.checks` show the single cases."""


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
            section = measured(part, options.effort)
            known = sections(PAGE.read_text("utf-8")) if PAGE.exists() else {}
            page = page_of(known | {part.title: section})
            PAGE.write_text(page, "utf-8")
            readme = README.read_text("utf-8")
            README.write_text(FIGURES.sub(lambda _: figures(page), readme), "utf-8")  # noqa: B023
    return 0


def measured(part: Part, effort: float) -> str:
    """The section of a part, as it comes out today."""
    with tempfile.TemporaryDirectory() as folder:
        return part.measured(Bench(Path(folder), effort, _show))


def page_of(known: dict[str, str]) -> str:
    """The page of all sections that there are."""
    parts = [known[part.title] for part in PARTS if part.title in known]
    return "\n\n".join([_INTRODUCTION, *parts]) + "\n"


def figures(page: str) -> str:
    """What the README shows: a question for each of four parts, and the figure that answers it."""
    known = sections(page)
    titles = {part.name: part.title for part in PARTS}
    return "\n".join(
        f"- **{question}** {headline(known[titles[name]])}"
        for name, question in SHOWN.items()
        if titles[name] in known
    )


def _show(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
