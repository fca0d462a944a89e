"""Finding the events of each kind in a range, each with its true begin and end."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import EventKind, NotSearchableError
from webots_mcp.store.detection.registry import kind_named
from webots_mcp.store.detection.search import Search
from webots_mcp.store.detection.verdict import Ledger
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.signals.registry import Signal

FARTHER: Final = 8.0  # times as far is looked for the ends of what reaches out of a segment


@dataclass(frozen=True)
class Detection:
    """What is looked for, in one segment after the other."""

    connection: sqlite3.Connection
    known: dict[str, Signal]
    kinds: Sequence[EventKind]
    options: EventOptions
    deadline: Deadline
    ledger: Ledger

    def events_touching(self, segment: Segment) -> list[Event]:
        """The events that lie in the segment, or reach into it.

        What has no begin or no end where was looked is followed out of it: at first as far as the
        shortest time that counts, then each time 8 times as far.
        """
        judged = [kind for kind in self.kinds if not kind.stored]
        search = Search(
            self.connection, segment, self.known, judged, self.options, self.deadline, self.ledger
        )
        stored = [kind for kind in self.kinds if kind.stored]
        found = _found(search.of(segment, kinds=stored))
        if search.recorded is not None:
            return found + self._with_ends(search, search.recorded)
        for kind in judged:
            self.ledger.not_searched(kind.name, f"run {segment.run_id} has no row in that range")
        return found

    def _with_ends(self, search: Search, segment: Segment) -> list[Event]:
        """The judged events that touch a recorded segment, as long as they are."""
        reaches_s = ((each.least_s, each.around_s) for each in search.kinds)
        reach_s = max((of(self.options) for both in reaches_s for of in both), default=0.0)
        looked = search.of(_around(search, segment, reach_s), asked=segment)
        events = _touching(_found(looked), segment)
        while cut := [each for each in events if _is_cut(each, looked)]:
            if self.deadline.passed:
                for each in cut:
                    why = f"the one at {each.start_s:.3f} s may last longer: time limit reached"
                    self.ledger.not_searched(each.kind, why)
                break
            reach_s = FARTHER * max(reach_s, 1.0)
            subjects = {(each.kind, each.name) for each in cut}
            looked = search.of(
                _around(search, segment, reach_s),
                kinds=[kind_named(name) for name in dict.fromkeys(each.kind for each in cut)],
                only=frozenset(each.name for each in cut if each.name is not None) or None,
                asked=segment,
                ledger=Ledger(),  # what the longer one lacks is known
            )
            again = _touching(_found(looked), segment)
            events = [each for each in events if (each.kind, each.name) not in subjects]
            events += [each for each in again if (each.kind, each.name) in subjects]
        return events


def _found(search: Search) -> list[Event]:
    """The events in the segment of a search, cut off at its ends.

    What costs least is searched first: each rank gets an equal part of the time that those before
    it have left.
    """
    found: dict[str, list[Event]] = {}
    efforts = sorted({kind.effort for kind in search.kinds})
    for index, effort in enumerate(efforts):
        with search.deadline.narrowed(1 / (len(efforts) - index)):
            over = search.deadline.passed
            for kind in [kind for kind in search.kinds if kind.effort == effort]:
                found[kind.name] = [] if over else _found_of(kind, search)
                if over:
                    why = "time limit reached: ask for this kind alone"
                    search.not_searched(kind.name, why)
    return [event for kind in search.kinds for event in found[kind.name]]


def _found_of(kind: EventKind, search: Search) -> list[Event]:
    try:
        found = list(kind.find(search))
    except NotSearchableError as error:
        search.not_searched(kind.name, str(error))
        return []
    if not found and kind.lasts and search.length_s < (least_s := kind.least_s(search.options)):
        run = f"run {search.segment.run_id} lasted only {search.length_s:.3g} s"
        search.not_searched(kind.name, f"{run}; this kind needs at least {least_s:g} s")
        return []
    search.ledger.searched.add(kind.name)
    if not kind.stored:
        search.not_searched(kind.name, *map(str, search.frame.unread))
    return found


def _is_cut(event: Event, looked: Search) -> bool:
    """Whether it reaches the first or last row that was looked at, and others follow there."""
    kind, segment = kind_named(event.kind), looked.segment
    if not kind.lasts:
        return False
    within_s, (first_s, last_s) = kind.ends_within_s(event), looked.frame.bounds_s
    at_begin = segment.start_s > looked.began_s and event.start_s - within_s <= first_s
    return at_begin or (segment.end_s <= looked.ended_s and event.end_s + within_s >= last_s)


def _around(search: Search, segment: Segment, reach_s: float) -> Segment:
    """The segment with so much before and after it, as far as there is something."""
    start_s = max(search.began_s, segment.start_s - reach_s)
    end_s = min(just_after(search.ended_s), segment.end_s + reach_s)
    if (start_s, end_s) == (segment.start_s, segment.end_s):
        return segment
    return Segment(segment.run_id, start_s, end_s)


def _touching(events: Iterable[Event], segment: Segment) -> list[Event]:
    return [e for e in events if e.start_s < segment.end_s and e.end_s >= segment.start_s]
