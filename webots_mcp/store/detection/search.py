"""Events that values tell: those that a segment touches, each with its true begin and end."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Final

from webots_mcp.store.analysis.motion import find_motion
from webots_mcp.store.detection.detectors import DETECTED, DETECTORS, OF_NUMBERS, Search
from webots_mcp.store.detection.event import Event, EventOptions, Kind, Threshold
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.reading.views import view_of
from webots_mcp.store.signals.catalogue import resolve_signals
from webots_mcp.store.signals.registry import Signal

LASTING: Final = frozenset[Kind]({"still", "stuck", "threshold", "silent", "flat"})
FARTHER: Final = 8.0  # times as far is looked for the ends of what reaches out of a segment
JUMP_REACH_S: Final = 2.0  # before and after a segment: whether a value comes back shows there

_ROWS_BEFORE_AND_AFTER: Final = (
    "SELECT EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?), "
    "EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s > ? AND sim_time_s < ?)"
)


@dataclass(frozen=True)
class Detection:
    """What is looked for in a run that was recorded from `first_s` to `newest_s`."""

    connection: sqlite3.Connection
    known: dict[str, Signal]
    options: EventOptions
    deadline: Deadline
    first_s: float
    newest_s: float

    def events_touching(self, segment: Segment, notes: list[str]) -> list[Event]:
        """The events that lie in the segment, or reach into it.

        What has no begin or no end where was looked is followed out of it: at first as far as the
        shortest time that counts, then each time 8 times as far.
        """
        kinds: list[Kind] = [kind for kind in DETECTED if kind in self.options.kinds]
        reach_s = self._least_s(kinds)
        looked_at = self._around(segment, reach_s)
        found = self._events_in(looked_at, kinds, notes)
        events = [each for each in found if _reaches_into(each, segment)]
        while cut := [each for each in events if self._is_cut(each, looked_at)]:
            if self.deadline.passed:
                notes.append("the time was over: what touches an end of the range may be longer")
                break
            reach_s = FARTHER * max(reach_s, 1.0)
            looked_at = self._around(segment, reach_s)
            of_cut = self._only_for(cut)
            whole = of_cut._events_in(looked_at, list({each.kind for each in cut}), [])
            events = [_longer(each, whole) if each in cut else each for each in events]
        return list({(*_subject(each), each.start_s): each for each in events}.values())

    def _only_for(self, events: Sequence[Event]) -> Detection:
        """The same for nothing but what these events are about."""
        names = tuple({event.name for event in events if event.name is not None})
        thresholds = tuple(
            Threshold(event.name or "", event.details.get("above"), event.details.get("below"))
            for event in events
            if event.kind == "threshold"
        )
        options = replace(self.options, signals=names or ("*",), thresholds=thresholds)
        return replace(self, options=options)

    def _least_s(self, kinds: Sequence[Kind]) -> float:
        """How long something of these kinds has to last; a shorter segment holds none."""
        options = self.options
        for_s = max((threshold.for_s for threshold in options.thresholds), default=0.0)
        least_s: dict[Kind, float] = {
            "still": options.stuck_s,
            "stuck": options.stuck_s,
            "silent": options.silent_s,
            "flat": options.flat_s,
            "jump": JUMP_REACH_S,
            "threshold": for_s,
        }
        return max((least_s.get(kind, 0.0) for kind in kinds), default=0.0)

    def _around(self, segment: Segment, reach_s: float) -> Segment:
        """The segment with so much before and after it, as far as there is something."""
        start_s = max(self.first_s, segment.start_s - reach_s)
        end_s = min(just_after(self.newest_s), segment.end_s + reach_s)
        if (start_s, end_s) == (segment.start_s, segment.end_s):
            return segment
        return Segment(segment.run_id, start_s, end_s)

    def _events_in(self, segment: Segment, kinds: Sequence[Kind], notes: list[str]) -> list[Event]:
        """The events in a segment, cut off at its ends."""
        if not kinds:
            return []
        motion = find_motion(self.known, self.options)
        matching = resolve_signals(self.known, self.options.signals) if self.known else []
        numbers = [signal for signal in matching if signal.is_number and set(kinds) & OF_NUMBERS]
        limits = [
            signal
            for threshold in self.options.thresholds
            for signal in resolve_signals(self.known, [threshold.signal])
        ]
        needed = {signal.name: signal for signal in (*numbers, *motion.evidence, *limits)}
        view = view_of(self.connection, segment, list(needed.values()), self.deadline)
        common = (self.known, numbers, motion, self.options, view, self.newest_s, self.deadline)
        search = Search(self.connection, segment, *common)
        found: list[Event] = []
        missed: list[Kind] = []
        for kind in kinds:
            if self.deadline.passed:
                missed.append(kind)
            else:
                found += DETECTORS[kind](search)
        notes += view.notes
        notes += [not_looked_for(missed)] if missed else []
        return found

    def _is_cut(self, event: Event, looked_at: Segment) -> bool:
        """Whether it reaches the first or last row that was looked at, and others follow there."""
        if event.kind not in LASTING:
            return False
        before = (event.run_id, looked_at.start_s, event.start_s)
        after = (event.run_id, event.end_s, looked_at.end_s)
        has_begin, has_end = self.connection.execute(
            _ROWS_BEFORE_AND_AFTER, (*before, *after)
        ).fetchone()
        began_before = looked_at.start_s > self.first_s and not has_begin
        goes_on = looked_at.end_s <= self.newest_s and not has_end
        return began_before or goes_on


def not_looked_for(what: Iterable[str]) -> str:
    """The note on what there was no time for."""
    asked = "ask for fewer kinds, signals or seconds"
    return f"the time was over, not looked for: {', '.join(what)}; {asked}"


def _reaches_into(event: Event, segment: Segment) -> bool:
    return event.start_s < segment.end_s and event.end_s >= segment.start_s


def _subject(event: Event) -> tuple[object, ...]:
    """What it is about: two of one subject that overlap are the same."""
    return event.kind, event.name, event.details.get("above"), event.details.get("below")


def _longer(event: Event, others: Sequence[Event]) -> Event:
    """Together with the one of the others that it is a part of; itself where there is none."""
    for other in others:
        alike = _subject(other) == _subject(event)
        if alike and other.start_s <= event.end_s and event.start_s <= other.end_s:
            first = min(event, other, key=attrgetter("start_s"))
            last = max(other, event, key=attrgetter("end_s"))
            return replace(first, end_s=last.end_s, ongoing=last.ongoing, details=other.details)
    return event
