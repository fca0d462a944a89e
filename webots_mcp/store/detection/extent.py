"""Finding the events of each kind in a range, each with its true begin and end."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import EventKind, NotSearchableError
from webots_mcp.store.detection.registry import kind_named
from webots_mcp.store.detection.search import Search
from webots_mcp.store.detection.verdict import Ledger
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.detection.search import Habits

FARTHER: Final = 8.0  # times as far is looked for the ends of what reaches out of a segment

_ROWS_BEFORE_AND_AFTER: Final = (
    "SELECT EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?), "
    "EXISTS (SELECT 1 FROM state WHERE run_id = ? AND sim_time_s > ? AND sim_time_s < ?)"
)


@dataclass(frozen=True)
class Detection:
    """What is looked for, in one segment after the other."""

    connection: sqlite3.Connection
    known: dict[str, Signal]
    kinds: Sequence[EventKind]
    options: EventOptions
    deadline: Deadline
    ledger: Ledger
    habits: Habits = field(default_factory=dict[Any, Any])

    def events_touching(self, segment: Segment) -> list[Event]:
        """The events that lie in the segment, or reach into it.

        What has no begin or no end where was looked is followed out of it: at first as far as the
        shortest time that counts, then each time 8 times as far.
        """
        stored = [kind for kind in self.kinds if kind.stored]
        judged = [kind for kind in self.kinds if not kind.stored]
        found = self._found(self._search(segment, stored))
        here = self._search(segment, judged)
        if here.recorded is not None:
            return found + self._with_ends(here, here.recorded)
        for kind in judged:
            why = f"run {segment.run_id} has no row in that range"
            self.ledger.not_searched(kind.name, why)
        return found

    def _with_ends(self, search: Search, segment: Segment) -> list[Event]:
        """The judged events that touch a recorded segment, as long as they are."""
        reaches_s = ((each.least_s, each.around_s) for each in search.kinds)
        reach_s = max((of(self.options) for both in reaches_s for of in both), default=0.0)
        looked_at = _around(search, segment, reach_s)
        looked = replace(search, segment=looked_at, asked=segment)
        found = self._found(looked)
        events = [each for each in found if _reaches_into(each, segment)]
        lost: list[Event] = []
        while cut := [e for e in events if e not in lost and self._is_cut(e, looked)]:
            if self.deadline.passed:
                self._note_longer(cut, "time limit reached")
                break
            reach_s = FARTHER * max(reach_s, 1.0)
            looked_at = _around(search, segment, reach_s)
            looked = self._search_of(cut, looked_at)
            whole = self._found(looked)
            longer = {id(each): _longer(each, whole) for each in cut}
            lost += [each for each in cut if longer[id(each)] is each]
            events = [longer.get(id(each), each) for each in events]
        self._note_longer(lost, "it was not found again in a longer range")
        return list({(*_subject(each), each.start_s): each for each in events}.values())

    def _note_longer(self, events: Sequence[Event], why: str) -> None:
        for each in events:
            said = f"the one at {each.start_s:.3f} s may last longer: {why}"
            self.ledger.not_searched(each.kind, said)

    def _search(self, segment: Segment, kinds: Sequence[EventKind]) -> Search:
        return Search(
            self.connection, segment, self.known, kinds, self.options, self.deadline, self.ledger,
            habits=self.habits,
        )  # fmt: skip

    def _search_of(self, cut: Sequence[Event], segment: Segment) -> Search:
        """For events of the same kinds and signals in a longer segment; what it lacks is known."""
        kinds = [kind_named(name) for name in dict.fromkeys(each.kind for each in cut)]
        names = frozenset(each.name for each in cut if each.name is not None)
        return replace(self._search(segment, kinds), ledger=Ledger(), only=names or None)

    def _found(self, search: Search) -> list[Event]:
        """The events in the segment of a search, cut off at its ends.

        What costs least is searched first: each rank gets an equal part of the time that those
        before it have left.
        """
        efforts = sorted({kind.effort for kind in search.kinds})
        found: dict[str, list[Event]] = {}
        for index, effort in enumerate(efforts):
            with self.deadline.narrowed(1 / (len(efforts) - index)):
                same = [kind for kind in search.kinds if kind.effort == effort]
                found |= self._found_of_rank(same, search)
        return [event for kind in search.kinds for event in found[kind.name]]

    def _found_of_rank(self, kinds: Sequence[EventKind], search: Search) -> dict[str, list[Event]]:
        """Kinds of one rank find things together: what the first has read serves the others."""
        if not self.deadline.passed:
            return {kind.name: self._found_of(kind, search) for kind in kinds}
        for kind in kinds:
            search.not_searched(kind.name, "time limit reached: ask for this kind alone")
        return {kind.name: [] for kind in kinds}

    def _found_of(self, kind: EventKind, search: Search) -> list[Event]:
        try:
            found = list(kind.find(search))
        except NotSearchableError as error:
            search.not_searched(kind.name, str(error))
            return []
        if not found and search.length_s < kind.least_s(self.options) and kind.lasts:
            search.not_searched(kind.name, _too_short(kind, search))
            return []
        search.ledger.searched.add(kind.name)
        if not kind.stored:
            search.not_searched(kind.name, *search.unread())
        return found

    def _is_cut(self, event: Event, looked: Search) -> bool:
        """Whether it reaches the first or last row that was looked at, and others follow there."""
        kind, looked_at = kind_named(event.kind), looked.segment
        before_it, after_it = looked_at.start_s > looked.began_s, looked_at.end_s <= looked.ended_s
        if not kind.lasts or not (before_it or after_it):
            return False
        within_s = kind.ends_within_s(event)
        start_s, end_s = event.start_s - within_s, event.end_s + within_s
        if kind.of_frame:
            times = looked.frame.times
            has_begin, has_end = bool(times[0] < start_s), bool(times[-1] > end_s)
        else:
            before = (event.run_id, looked_at.start_s, start_s)
            after = (event.run_id, end_s, looked_at.end_s)
            has_begin, has_end = self.connection.execute(
                _ROWS_BEFORE_AND_AFTER, (*before, *after)
            ).fetchone()
        return (before_it and not has_begin) or (after_it and not has_end)


def _too_short(kind: EventKind, search: Search) -> str:
    run = f"run {search.segment.run_id} lasted only {search.length_s:.3g} s"
    return f"{run}; this kind needs at least {kind.least_s(search.options):g} s"


def _around(search: Search, segment: Segment, reach_s: float) -> Segment:
    """The segment with so much before and after it, as far as there is something."""
    start_s = max(search.began_s, segment.start_s - reach_s)
    end_s = min(just_after(search.ended_s), segment.end_s + reach_s)
    if (start_s, end_s) == (segment.start_s, segment.end_s):
        return segment
    return Segment(segment.run_id, start_s, end_s)


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
            ends = {"end_s": last.end_s, "ongoing": last.ongoing}
            return replace(first, **ends, details=other.details)
    return event
