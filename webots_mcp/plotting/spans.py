"""Stretches of time with a meaning: modes, recording gaps, events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.store.questions.series import ChangeColumns, RunHistory
from webots_mcp.store.reading.changes import Point, spelled
from webots_mcp.store.reading.gaps import Gap

MOST_VALUES: Final = 8  # colours that can be told apart
OTHER_VALUES: Final = "others"


@dataclass(frozen=True)
class Span:
    """A value or a kind of event over a stretch of time; an instant has no length."""

    value: str
    start_s: float
    end_s: float

    def moved(self, origin_s: float) -> Span:
        """The same on a clock that begins at `origin_s`."""
        return Span(self.value, self.start_s - origin_s, self.end_s - origin_s)


@dataclass(frozen=True)
class Lane:
    """A row of spans under one name; `values` in the order of their colours."""

    name: str
    spans: Sequence[Span]
    values: Sequence[str]


def lane_of(columns: ChangeColumns, run: RunHistory, end_s: float) -> Lane:
    """A text or boolean signal as spans; the values beyond the eighth share one name.

    Where nothing was recorded there is no span: nobody knows the value.
    """
    values = list(columns.time_by_value_s)
    known = values if len(values) <= MOST_VALUES else values[: MOST_VALUES - 1]
    spans = [
        Span(value if value in known else OTHER_VALUES, *stretch)
        for start, until_s in _stretches(columns.points, end_s)
        for value in [spelled(start.value)]
        for stretch in _recorded(max(start.sim_time_s, run.start_s), until_s, run.gaps)
    ]
    present = {span.value for span in spans}
    return Lane(
        columns.name, spans, [v for v in dict.fromkeys([*known, OTHER_VALUES]) if v in present]
    )


def _stretches(points: Sequence[Point], end_s: float) -> list[tuple[Point, float]]:
    ends = [after.sim_time_s for _, after in pairwise(points)]
    return list(zip(points, [*ends, end_s], strict=True)) if points else []


def _recorded(start_s: float, end_s: float, gaps: Sequence[Gap]) -> list[tuple[float, float]]:
    """The parts of a stretch outside the gaps."""
    inside = [gap for gap in gaps if start_s <= gap.start_s and gap.end_s <= end_s]
    starts = [start_s, *(gap.end_s for gap in inside)]
    ends = [*(gap.start_s for gap in inside), end_s]
    return [(start, end) for start, end in zip(starts, ends, strict=True) if start < end]
