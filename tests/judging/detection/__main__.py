"""Draws labelled recordings, asks what happened in them, and prints how true the answers are."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from typing import Final

from tests.judging.detection.drawing import KINDS
from tests.judging.detection.goals import missed_goals
from tests.judging.detection.measuring import measure, measure_widened
from tests.judging.detection.table import LEGEND, render, render_agreement, render_widened

_WIDENED: Final = "widened"  # of the kinds that are named beside it, else of all
_ALL: Final = (*KINDS, _WIDENED)


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 1 with `--check` where a goal is not reached, 2 for a kind that does not exist."""
    options = _parser().parse_args(arguments)
    chosen = options.kinds or _ALL
    started_s = time.monotonic()
    done = [told for part in (_judged, _widened) if (told := part(chosen, options)) is not None]
    _show("")
    failed = sum(missed for _, missed in done)
    took_s = time.monotonic() - started_s
    ended = f"seed {options.seed}; {failed} lines are below their goals; {took_s:.0f} s"
    _print("\n\n".join([*(text for text, _ in done), ended]))
    return int(options.check and failed > 0)


def _judged(chosen: Sequence[str], options: argparse.Namespace) -> tuple[str, int] | None:
    kinds = [kind for kind in chosen if kind in KINDS]
    if not kinds:
        return None
    report = measure(kinds, options.cases, options.seed, _show, long=options.long)
    shown = "\n".join([*report.wrong, ""]) if options.wrong else ""
    missed = sum(bool(missed_goals(key, tally)) for key, tally in report.tallies.items())
    missed += sum(map(bool, report.disagreed.values()))
    text = "\n".join([f"{shown}{render(report)}", "", *LEGEND])
    return "\n\n".join([text, render_agreement(report)] if options.long else [text]), missed


def _widened(chosen: Sequence[str], options: argparse.Namespace) -> tuple[str, int] | None:
    if _WIDENED not in chosen or options.long:
        return None
    kinds = [kind for kind in chosen if kind in KINDS] or list(KINDS)
    report = measure_widened(kinds, options.cases, options.seed, _show)
    shown = "\n".join([*report.wrong, ""]) if options.wrong else ""
    lost = sum(alone > both for alone, both in report.widened.values())
    return f"{shown}{render_widened(report)}", lost


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:  # the reader of the pipe has seen enough: Python does not try again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _show(text: str) -> None:
    """Progress in one line of a terminal; nothing in a pipe."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.judging.detection", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="the same draws the same cases (1)")
    parser.add_argument("--cases", type=int, default=20, help="of each kind (20)")
    parser.add_argument(
        "--kinds", nargs="+", choices=_ALL, metavar="KIND", help=f"only these: {', '.join(_ALL)}"
    )
    parser.add_argument(
        "--long",
        action="store_true",
        help="long runs, each asked of its rows, of its chunks, and after its rows were purged",
    )
    parser.add_argument("--wrong", action="store_true", help="name each thing that was wrong")
    parser.add_argument("--check", action="store_true", help="fail below the goals")
    return parser


if __name__ == "__main__":
    sys.exit(main())
