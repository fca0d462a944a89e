"""The figures as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from tests.judging.detection.goals import MEDIAN_ERROR, missed_goals
from tests.judging.detection.judging import Tally, median, nine_in_ten
from tests.judging.detection.measuring import Key, Report

_COLUMNS: Final = (
    "recording", "judged", "condition", "runs", "truth", "recall", "precision", "begin", "best",
    "end", "period %", "amplitude %", "false/min", "said", "slowest s", "below the goal",
)  # fmt: skip
LEGEND: Final = (
    "recording: the kind that was drawn; judged: what was looked for; truth: how often it happened",
    "precision: where it never happened, the share of runs without a false claim",
    "begin, end: error in rows, of a swing in periods: median/nine in ten",
    "best: of a begin, the median error in rows that no unbiased estimate falls below",
    "period, amplitude: error that nine in ten do not exceed",
    "said: of what was missed, the share whose answer said that it may have missed some",
)


def render(report: Report) -> str:
    """A line for each kind of recording and each thing that was judged in it."""
    lines = [_line(key, tally) for key, tally in _told(report)]
    return _aligned([_COLUMNS, *lines])


def render_agreement(report: Report) -> str:
    """How many long runs were told otherwise of chunks or after a purge than of rows."""
    head = ("recording", "judged", "told otherwise when stored otherwise")
    return _aligned([head, *((*key, str(count)) for key, count in report.disagreed.items())])


def render_widened(report: Report) -> str:
    """What is told of a stretch, and how much of that of the whole run."""
    head = ("recording", "judged", "told of its time", "also of the whole run", "below the goal")
    counted = (
        (*key, str(alone), str(both), "" if alone == both else "lost")
        for key, (alone, both) in report.widened.items()
    )
    return _aligned([head, *counted])


def _told(report: Report) -> Iterator[tuple[Key, Tally]]:
    """Not those in which nothing happened and nothing was told, beside some that did."""
    eventful = {key[0] for key, tally in report.tallies.items() if tally.incidents}
    for key, tally in report.tallies.items():
        if tally.incidents or tally.false or key[0] not in eventful:
            yield key, tally


def _line(key: Key, tally: Tally) -> tuple[str, ...]:
    return (
        *key,
        str(tally.runs),
        str(tally.incidents),
        _share(tally.recall),
        _share(tally.precision),
        _both(tally.begin_errors),
        _best(tally),
        _both(tally.end_errors),
        _percent(tally.period_errors),
        _percent(tally.amplitude_errors),
        f"{tally.false / tally.minutes:.2f}",
        _share(tally.said_share),
        f"{tally.slowest_s:.2f}",
        ", ".join(missed_goals(key, tally)),
    )


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _both(values: Sequence[float]) -> str:
    middle, most = median(values), nine_in_ten(values)
    return "-" if middle is None or most is None else f"{middle:.1f}/{most:.1f}"


def _best(tally: Tally) -> str:
    least = median(tally.least_begin_errors)
    return f"{MEDIAN_ERROR * least:.1f}" if least else "-"


def _percent(values: Sequence[float]) -> str:
    most = nine_in_ten(values)
    return "-" if most is None else f"{100 * most:.1f}"


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    cells = ([c.ljust(w) for c, w in zip(row, widths, strict=True)] for row in rows)
    return "\n".join("  ".join(row).rstrip() for row in cells)
