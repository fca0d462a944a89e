"""One search in a stretch of a run: what a detector may read, and events with their true ends."""

from __future__ import annotations

import copy
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

from webots_mcp.naming import listed
from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.analysis.summary import LARGEST
from webots_mcp.store.detection.kinds import (
    Event,
    EventKind,
    EventOptions,
    Ledger,
    NotAskedError,
    NotSearchableError,
)
from webots_mcp.store.detection.motion import Motion, motion_in
from webots_mcp.store.reading.catalogue import resolve_signals
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import frame_of_purged, recorded_bounds
from webots_mcp.store.reading.segment import Deadline, Segment, just_after
from webots_mcp.store.signals import Signal

FARTHER: Final = 8.0  # times as far is looked for the ends of what reaches out of a segment
MOST_NAMED: Final = 5
NO_TIME: Final = "time limit reached: ask for this kind alone"
_ROW: Final = "SELECT wall_time_s FROM state WHERE run_id = ?"
_LAST_ROW: Final = f"{_ROW} AND sim_time_s <= ? ORDER BY sim_time_s DESC, id DESC LIMIT 1"
_FIRST_ROW: Final = f"{_ROW} ORDER BY sim_time_s, id LIMIT 1"
_OF_SEGMENT: Final = ("recorded", "frame")


@dataclass
class Search:
    """What is looked for in a segment of one run.

    Attributes:
        known: The signals of the robot.
        kinds: All that are looked for in it.
        asked: The part of the segment that was asked about, where that was widened to find ends.
        ledger: What could not be looked at, and what came near to an event.
        shared: What a detector found that others of its module, and later looks, need as well.
    """

    connection: sqlite3.Connection
    segment: Segment
    known: dict[str, Signal]
    kinds: Sequence[EventKind]
    options: EventOptions
    deadline: Deadline
    ledger: Ledger = field(default_factory=Ledger)
    asked: Segment | None = None
    shared: dict[type, Any] = field(default_factory=dict[type, Any])

    def of(self, segment: Segment, **changes: Any) -> Search:
        """The same in another segment of the run, of which it is known what is known of this."""
        other = copy.copy(self)
        for name in _OF_SEGMENT:
            other.__dict__.pop(name, None)
        other.__dict__.update(changes, segment=segment)
        return other

    @cached_property
    def bounds(self) -> tuple[float, float] | None:
        """First and last simulation time of the run's rows; None where it has none."""
        return recorded_bounds(self.connection, self.segment.run_id)

    @property
    def began_s(self) -> float:
        """The run's first row."""
        return self.bounds[0] if self.bounds else self.segment.start_s

    @property
    def ended_s(self) -> float:
        """The run's newest row."""
        return self.bounds[1] if self.bounds else self.segment.end_s

    @property
    def length_s(self) -> float:
        """From the run's first row to its newest one."""
        return self.ended_s - self.began_s

    @cached_property
    def recorded(self) -> Segment | None:
        """The part of the segment that was recorded; None where nothing was."""
        here = self.segment
        if not self.bounds or self.ended_s < here.start_s or self.began_s >= here.end_s:
            return None
        ends = max(here.start_s, self.began_s), min(here.end_s, just_after(self.ended_s))
        return replace(here, start_s=ends[0], end_s=ends[1])

    @cached_property
    def motion(self) -> Motion:
        """The signals that tell how the robot moves in this run."""
        return motion_in(self.whole, self.known, self.options)

    @cached_property
    def signals(self) -> list[Signal]:
        """Those that are looked at."""
        return resolve_signals(self.known, self.options.signals) if self.known else []

    @cached_property
    def numbers(self) -> list[Signal]:
        """Of the signals the numeric ones."""
        return [signal for signal in self.signals if signal.is_number]

    def required_numbers(self) -> list[Signal]:
        """The numeric signals.

        Raises:
            NotSearchableError: There are none.
        """
        if not self.numbers:
            raise NotSearchableError("no number was published, or none with these names")
        return self.numbers

    def required_quantities(self) -> list[Signal]:
        """The numeric signals that are no index of an array.

        Raises:
            NotSearchableError: There are none.
        """
        quantities = [signal for signal in self.required_numbers() if not signal.is_index]
        if not quantities:
            raise NotSearchableError(
                "the index of an array's smallest item normally jumps and stays constant"
            )
        return quantities

    @cached_property
    def frame(self) -> Frame:
        """The rows of the segment.

        Raises:
            NotSearchableError: None of them is left, or could be read in time.
        """
        frame = read_frame(self.connection, self.segment, self.deadline)
        if not len(frame) and frame.unread:
            raise NotSearchableError("; ".join(map(str, frame.unread)))
        return frame

    @cached_property
    def whole(self) -> Frame:
        """The rows of the whole run."""
        part = Segment(self.segment.run_id, self.began_s, just_after(self.ended_s))
        is_all = replace(self.segment, open_start=False, open_end=False) == part
        return self.frame if is_all else read_frame(self.connection, part, self.deadline)

    def event(
        self, kind: str, start_s: float, end_s: float, name: str | None, **details: Any
    ) -> Event:
        """An event of this run; what has a duration and reaches the newest row goes on."""
        ongoing = end_s >= self.ended_s > start_s
        place = (self.segment.run_id, start_s, end_s, self.wall_time_at(start_s))
        return Event(kind, *place, name, details, ongoing)

    @cached_property
    def _purged(self) -> Frame | None:
        return frame_of_purged(self.connection, self.segment.run_id)

    def wall_time_at(self, time_s: float) -> float:
        """Of the last row at or before a simulation time; else of the first one, or 0."""
        if self._purged is not None and len(self._purged):
            place = int(np.searchsorted(self._purged.times, time_s, "right")) - 1
            return float(self._purged.wall_times[max(place, 0)])
        run_id = self.segment.run_id
        row = self.connection.execute(_LAST_ROW, (run_id, time_s)).fetchone()
        row = row or self.connection.execute(_FIRST_ROW, (run_id,)).fetchone()
        return float(row[0]) if row else 0.0

    def not_searched(self, kind: str, *reasons: str) -> None:
        """Note why a kind was not looked for, or where it was not."""
        self.ledger.not_searched(kind, *reasons)

    def in_time(
        self, kind: str, signals: Sequence[Signal], *, judged: bool = True
    ) -> Iterator[Signal]:
        """The signals as long as there is time; which of them are not looked at is noted.

        Args:
            kind: What is looked for.
            signals: In this order.
            judged: Numbers that are too large cannot be.

        Raises:
            NotSearchableError: There is no time for any.
        """
        large: list[str] = []
        for index, signal in enumerate(signals):
            if self.deadline.passed:
                if not index:
                    raise NotSearchableError(NO_TIME)
                names = listed([each.name for each in signals[index:]], 3)
                why = f"time limit reached, {len(signals) - index} signals left: ask for {names}"
                self.not_searched(kind, why)
                break
            large += [signal.name] if judged and self._is_large(signal) else []
            yield signal
        if large:
            why = f"not in {listed(large, MOST_NAMED)}: numbers beyond {LARGEST:g}"
            self.not_searched(kind, why)

    def _is_large(self, signal: Signal) -> bool:
        zones = self.frame.zones(signal.name)
        spans = zones.spans(zones.value_count < zones.held_count)
        parts = (self.frame.rows(*span).numbers(signal.name) for span in spans)
        return any((np.abs(part) > LARGEST).any() for part in parts)

    def note_nearest(self, kind: str, share: float, what: str) -> None:
        """Note what came near to an event, as a share of what would be one."""
        where = f" (run {self.segment.run_id})" if self.ledger.of_several_runs else ""
        self.ledger.note_nearest(kind, share, what + where)


def events_touching(search: Search) -> list[Event]:
    """The events that lie in the segment of a search, or reach into it.

    What has no begin or no end where was looked is followed out of it: at first as far as the
    shortest time that counts, then each time 8 times as far.
    """
    if search.deadline.passed:
        for kind in search.kinds:
            search.not_searched(kind.name, NO_TIME)
        return []
    segment = search.recorded
    kinds = [kind for kind in search.kinds if kind.lasts or not kind.stored]
    found = _found(search.of(search.segment, kinds=[e for e in search.kinds if e not in kinds]))
    if segment is None:
        for kind in kinds:
            why = f"run {search.segment.run_id} has no row in that range"
            search.not_searched(kind.name, why)
        return found
    reaches_s = ((each.least_s, each.around_s) for each in kinds)
    reach_s = max((of(search.options) for both in reaches_s for of in both), default=0.0)
    looked, cut, waiting = search.of(segment, asked=segment), list[Event](), list[Event]()
    while kinds and not (cut and search.deadline.passed):
        looked = looked.of(_around(search, segment, reach_s), kinds=kinds)
        touching = (e for e in _found(looked) if e.start_s < segment.end_s)
        events = [each for each in touching if each.end_s >= segment.start_s]
        if cut and search.deadline.passed:
            break  # some may be lacking
        by_name = {kind.name: kind for kind in kinds}
        cut = [each for each in events if _is_cut(each, by_name[each.kind], looked)]
        names = {each.kind for each in cut}
        kinds = [kind for kind in kinds if kind.name in names]
        found += [each for each in events if each.kind not in names]
        waiting = [each for each in events if each.kind in names]
        reach_s = FARTHER * max(reach_s, 1.0)
        looked.ledger = Ledger()  # what the longer one lacks is known
    for each in cut:
        why = f"the one at {each.start_s:.3f} s may last longer: time limit reached"
        search.not_searched(each.kind, why)
    return found + waiting


def _found(search: Search) -> list[Event]:
    """The events in the segment of a search, cut off at its ends."""
    return [event for kind in search.kinds for event in _found_of(kind, search)]


def _found_of(kind: EventKind, search: Search) -> list[Event]:
    try:
        found = list(kind.find(search))
    except NotAskedError:
        return []
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


def _is_cut(event: Event, kind: EventKind, looked: Search) -> bool:
    """Whether it reaches the first or last row that was looked at, and others follow there."""
    if not kind.lasts:
        return False
    segment = looked.segment
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
