"""`flat`: a signal that otherwise mostly changes had exactly the same value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.store.analysis.summary import Summary
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import EventKind
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.intervals import MOSTLY, Flat, Span
from webots_mcp.store.signals.registry import Signal

LEAST_CHANGES: Final = 10  # of who mostly changes

# Whether it changed in most rows of a stretch of 10 s that the run has rollups of.
_LIVELY: Final = (
    "SELECT EXISTS (SELECT 1 FROM all_rollup WHERE run_id = ? AND signal_id = ? "
    "AND present >= 10 AND changes >= ? * present)"
)


def flat_events(search: Search) -> Iterator[Event]:
    """Of a long segment only rests that fill a stretch of the rollups."""
    least_s = max(search.options.flat_s, search.view.shortest_rest_s)
    signals = search.required_quantities()
    for index, signal in enumerate(signals):
        here = search.view.summary(signal)
        if here.changes >= here.present - 1:
            continue
        if search.is_over("flat", signals[index:]):
            return
        spans = search.view.spans(signal, Flat())
        flat = [span for span in spans if _length_s(span) >= least_s]
        if flat and (_changes_otherwise(search, here, flat) or _is_lively(search, signal)):
            for span in flat:
                yield search.event("flat", span.start_s, span.end_s, signal.name, value=span.key)
        elif spans and not flat and not search.view.shortest_rest_s:
            _note_longest(search, signal, here, max(spans, key=_length_s))


def _note_longest(search: Search, signal: Signal, here: Summary, span: Span) -> None:
    """What came nearest, where all rests are known and it is not how the signal is."""
    if _changes_otherwise(search, here, [span]):
        lasted_s = _length_s(span)
        what = f"{signal.name} stayed at {span.key} for {lasted_s:.3g} s from {span.start_s:.6g} s"
        search.came_near("flat", lasted_s / search.options.flat_s, what)


def _length_s(span: Span) -> float:
    return span.end_s - span.start_s


def _changes_otherwise(search: Search, here: Summary, flat: Sequence[Span]) -> bool:
    """Whether it changed in most of the rows outside of those spans, and in ten at least."""
    whole_s = min(search.segment.end_s, search.ended_s) - search.segment.start_s
    flat_s = sum(map(_length_s, flat))
    rows = here.present * max(0.0, 1 - flat_s / whole_s) if whole_s > 0 else 0.0
    return here.changes >= max(LEAST_CHANGES, MOSTLY * rows)


def _is_lively(search: Search, signal: Signal) -> bool:
    """Whether it mostly changed for 10 s somewhere in the run, as far as rolled up."""
    asked = (search.segment.run_id, signal.id, MOSTLY)
    return bool(search.connection.execute(_LIVELY, asked).fetchone()[0])


def _alike(events: Sequence[Event], unit: str) -> str:
    return "times flat"


FLAT: Final = EventKind(
    "flat",
    "frozen",
    flat_events,
    lasts=True,
    least_s=lambda options: options.flat_s,
    of_numbers=True,
    drawn=7,
    says_alike=_alike,
    of_arrays=True,
)
