"""`flat`: a signal that otherwise mostly changes had exactly the same value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.store.analysis.arrays import median, np
from webots_mcp.store.analysis.frozen import FEWEST_ROWS, is_noisy, may_be_measured
from webots_mcp.store.analysis.summary import Summary
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, EventKind
from webots_mcp.store.detection.resting import Resting
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.intervals import MOSTLY, Flat, Span
from webots_mcp.store.signals.registry import Signal

LEAST_CHANGES: Final = 10  # of who mostly changes
FROZEN_SHARE: Final = 0.15  # of `flat_s`: who is noisy otherwise counts from so long on

# Whether it changed in most rows of a stretch of 10 s that the run has rollups of.
_LIVELY: Final = (
    "SELECT EXISTS (SELECT 1 FROM all_rollup WHERE run_id = ? AND signal_id = ? "
    "AND present >= 10 AND changes >= ? * present)"
)


def flat_events(search: Search) -> Iterator[Event]:
    """Of a long segment only rests that fill a stretch of the rollups.

    One of a signal that is noisy otherwise counts much sooner, unless others rest at that time; and
    so does one that a target left behind.
    """
    least_s = max(search.options.flat_s, search.view.shortest_rest_s)
    signals = search.required_quantities()
    search.note_too_large("flat")
    if (shortest_s := search.view.shortest_rest_s) and search.only is None:
        why = f"noisy signals: those under {shortest_s:g} s may be missed: {search.less_time}"
        search.not_searched("flat", why)
    resting: dict[str, list[Span]] = {}
    sooner: list[tuple[Resting, Span]] = []
    for index, signal in enumerate(signals):
        here = search.view.summary(signal)
        if here.changes >= here.present - 1:
            continue
        if shortest_s and here.changes < LEAST_CHANGES and not _is_lively(search, signal):
            continue
        if search.is_over("flat", signals[index:]):
            break
        spans, rests = search.view.spans(signal, Flat()), Resting(search, signal)
        if _changes_otherwise(search, here, spans):
            resting[signal.name] = spans
        flat = [span for span in spans if _length_s(span) >= least_s]
        if flat and (_changes_otherwise(search, here, flat) or _is_lively(search, signal)):
            yield from (_event(search, rests, span) for span in flat)
        elif spans and not flat:
            left_behind = _left_behind(search, rests, spans)
            yield from (_event(search, rests, span) for span in left_behind)
            frozen = _frozen(search, signal, [each for each in spans if each not in left_behind])
            sooner += [(rests, span) for span in frozen]
            if not frozen and not left_behind and not search.view.shortest_rest_s:
                _note_longest(search, signal, here, max(spans, key=_length_s))
    for rests, span in sooner:
        if not _rests_with_others(rests.signal, span, resting):
            yield _event(search, rests, span)
        else:
            _note_longest(search, rests.signal, search.view.summary(rests.signal), span)


def _event(search: Search, rests: Resting, span: Span) -> Event:
    says = rests.shows(span)
    details = {"value": span.key} | ({"says": says} if says else {})
    return search.event("flat", span.start_s, span.end_s, rests.signal.name, **details)


def _left_behind(search: Search, rests: Resting, spans: Sequence[Span]) -> list[Span]:
    """The rests in which its target moved, or in which it was commanded to move."""
    least_s = FROZEN_SHARE * search.options.flat_s
    if not _changes_otherwise(search, search.view.summary(rests.signal), spans):
        return []
    return [
        span
        for span in spans
        if _length_s(span) >= least_s and rests.target_went_on(span)
        if not rests.is_limit(span)
    ]


def _frozen(search: Search, signal: Signal, spans: Sequence[Span]) -> list[Span]:
    """Of the rests of a signal those that noise never makes, if it is noisy but for them."""
    moved_with = (search.motion.commanded, search.motion.speed, *search.motion.wheels)
    times, values = search.view.sample([signal]).numbers(signal.name)
    if signal in moved_with or len(times) < 2:
        return []
    least_s = max(FROZEN_SHARE * search.options.flat_s, FEWEST_ROWS * median(np.diff(times)))
    held = [span for span in spans if _length_s(span) >= least_s]
    outside = np.ones(len(times), np.bool_)
    for span in held:
        outside &= (times < span.start_s) | (times > span.end_s)
    keys = [span.key for span in held]
    others = values[outside]
    if not is_noisy(others):
        return []
    return [
        span
        for span in held
        if keys.count(span.key) == 1  # what it comes back to is a value by nature
        and isinstance(span.key, (int, float))
        and may_be_measured(others, span.key)
    ]


def _rests_with_others(signal: Signal, span: Span, resting: dict[str, list[Span]]) -> bool:
    """Whether something else holds one value for most of that time: then the robot rests.

    What never changes is no sign of that; and the items of an array freeze together.
    """
    branch = signal.name.partition(".")[0]
    return any(
        min(span.end_s, other.end_s) - max(span.start_s, other.start_s) > MOSTLY * _length_s(span)
        for name, others in resting.items()
        if name.partition(".")[0] != branch
        for other in others
    )


def _note_longest(search: Search, signal: Signal, here: Summary, span: Span) -> None:
    """What came nearest, where all rests are known and it is not how the signal is."""
    if _changes_otherwise(search, here, [span]):
        lasted_s = _length_s(span)
        at = f"{span.key:.4g}" if isinstance(span.key, float) else span.key
        what = f"{signal.name} stayed at {at} for {lasted_s:.3g} s from {span.start_s:.6g} s"
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
    said = {event.details.get("says") for event in events}
    what = said.pop() if len(said) == 1 else None
    return f"times {what}" if what else "flat stretches"


FLAT: Final = EventKind(
    "flat",
    "frozen, or at a limit",
    flat_events,
    lasts=True,
    least_s=lambda options: options.flat_s,
    of_numbers=True,
    drawn=7,
    alike=Alike(_alike, of_arrays=True),
)
