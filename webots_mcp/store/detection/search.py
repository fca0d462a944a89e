"""One search in a stretch of a run: what a detector may read, and what it reports."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.naming import flatten, listed
from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.analysis.summary import LARGEST
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import EventKind, NotSearchableError
from webots_mcp.store.detection.mode_use import ModeUses, frames_of_runs
from webots_mcp.store.detection.motion import Motion, find_motion
from webots_mcp.store.detection.verdict import Ledger
from webots_mcp.store.reading.coverage import less_time, purged_until_s
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import Segment, just_after, recorded_bounds
from webots_mcp.store.reading.wall_time import UP_TO, RunClock
from webots_mcp.store.signals.catalogue import resolve_signals
from webots_mcp.store.signals.flatten import parse
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.detection.standstill import Findings

    Habits = dict[tuple[int, Motion], ModeUses]

MOST_NAMED: Final = 5

_ENDS: Final = (
    "SELECT data FROM state WHERE id IN ("
    "(SELECT id FROM state WHERE run_id = :run AND sim_time_s >= :start "
    "ORDER BY sim_time_s, id LIMIT 1), "
    "(SELECT id FROM state WHERE run_id = :run AND sim_time_s < :end "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1))"
)


@dataclass
class Search:
    """What is looked for in a segment of one run.

    Attributes:
        known: The signals of the robot.
        kinds: All that are looked for in it.
        only: Names of the signals that matter, where it is about the ends of some events; else
            None.
        asked: The part of the segment that was asked about, where that was widened to find ends.
        ledger: What could not be looked at, and what came near to an event.
        habits: By run and motion, in which modes the robot moves: searches of one question share
            what they have seen of that.
    """

    connection: sqlite3.Connection
    segment: Segment
    known: dict[str, Signal]
    kinds: Sequence[EventKind]
    options: EventOptions
    deadline: Deadline
    ledger: Ledger = field(default_factory=Ledger)
    only: frozenset[str] | None = None
    asked: Segment | None = None
    habits: Habits = field(default_factory=dict[Any, Any])

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
        if self.bounds is None:
            return None
        (first_s, newest_s), here = self.bounds, self.segment
        if newest_s < here.start_s or first_s >= here.end_s:
            return None
        start_s, end_s = max(here.start_s, first_s), min(here.end_s, just_after(newest_s))
        return replace(here, start_s=start_s, end_s=end_s)

    @cached_property
    def is_purged(self) -> bool:
        """Whether no row of the segment is left, of which there are rollups."""
        run_id, start_s = self.segment.run_id, self.segment.start_s
        until_s = purged_until_s(self.connection, run_id, start_s)
        return until_s is not None and until_s >= self.segment.end_s

    @cached_property
    def less_time(self) -> str:
        """What shows more of the segment than its summaries do."""
        return less_time(self.connection, self.segment)

    def require_rows(self) -> None:
        """For what shows in single rows only.

        Raises:
            NotSearchableError: They were purged.
        """
        if self.is_purged:
            raise NotSearchableError("the rows of that time were purged for good")

    @cached_property
    def motion(self) -> Motion:
        """The signals that tell how the robot moves; other runs may have had others."""
        return find_motion(self.known, self.options, self._here)

    @cached_property
    def _here(self) -> set[str]:
        """Names that the first or the newest row of the segment has."""
        run_id, start_s, end_s = self.segment.run_id, self.segment.start_s, self.segment.end_s
        rows = self.connection.execute(_ENDS, {"run": run_id, "start": start_s, "end": end_s})
        return {name for (data,) in rows.fetchall() for name in flatten(parse(data))}

    @cached_property
    def signals(self) -> list[Signal]:
        """Those that are looked at."""
        matching = resolve_signals(self.known, self.options.signals) if self.known else []
        return [each for each in matching if self.only is None or each.name in self.only]

    @cached_property
    def numbers(self) -> list[Signal]:
        """Of the signals the numeric ones, where any of the kinds looks at them."""
        wanted = any(kind.of_numbers for kind in self.kinds)
        return [signal for signal in self.signals if signal.is_number and wanted]

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
            NotSearchableError: They were purged.
        """
        frame = read_frame(self.connection, self.segment, self.deadline)
        self.require_read(frame)
        return frame

    def require_read(self, frame: Frame) -> None:
        """See that something is left of what was recorded.

        Raises:
            NotSearchableError: It was purged.
        """
        if not len(frame):
            self.require_rows()

    def unread(self) -> list[str]:
        """What of the segment is not in its frame."""
        run_id, start_s = self.segment.run_id, self.segment.start_s
        notes = [str(each) for each in self.frame.unread]
        until_s = purged_until_s(self.connection, run_id, start_s)
        if until_s is not None and len(self.frame) and self.frame.times[0] >= until_s:
            notes.append(f"not before {until_s:.3f} s, whose rows were purged")
        return notes

    @cached_property
    def whole(self) -> Frame:
        """The rows of the whole run."""
        part = Segment(self.segment.run_id, self.began_s, just_after(self.ended_s))
        if replace(self.segment, open_start=False, open_end=False) == part:
            return self.frame
        return read_frame(self.connection, part, self.deadline)

    @cached_property
    def standstills(self) -> Findings:
        """Found once for both kinds that tell of them; how the other kinds look is not imported."""
        from webots_mcp.store.detection.standstill import judge_standstills

        asked = (self.segment.run_id, self.motion)
        if asked not in self.habits:
            frames = frames_of_runs(self.connection, self.segment.run_id, self.deadline)
            self.habits[asked] = ModeUses(*asked, frames, self.options)
        return judge_standstills(self.frame, self.motion, self.options, self.habits[asked])

    def event(
        self, kind: str, start_s: float, end_s: float, name: str | None, **details: Any
    ) -> Event:
        """An event of this run; what has a duration and reaches the newest row goes on."""
        run_id = self.segment.run_id
        ongoing = end_s >= self.ended_s > start_s
        wall_s = self.wall_time_at(start_s)
        return Event(kind, run_id, start_s, end_s, wall_s, name, details, ongoing)

    @cached_property
    def wall_time_at(self) -> Callable[[float], float]:
        """Of the last row at or before a time; looked up once of events that begin together."""
        return cache(partial(RunClock(self.connection, self.segment.run_id).wall_s, UP_TO))

    def not_searched(self, kind: str, *reasons: str) -> None:
        """Note why a kind was not looked for, or where it was not."""
        self.ledger.not_searched(kind, *reasons)

    def note_too_large(self, kind: str) -> None:
        """Note which signals have numbers that are too large to be judged."""
        if self.only is None and (names := listed(self._too_large, MOST_NAMED)):
            self.not_searched(kind, f"not in {names}: numbers beyond {LARGEST:g}")

    @cached_property
    def _too_large(self) -> list[str]:
        """Those with such numbers."""
        return [each.name for each in self.numbers if self._is_too_large(each.name)]

    def _is_too_large(self, name: str) -> bool:
        zones = self.frame.zones(name)
        spans = zones.spans(zones.value_count < zones.held_count)
        parts = (self.frame.rows(*span).numbers(name) for span in spans)
        return any((np.abs(part) > LARGEST).any() for part in parts)

    def came_near(self, kind: str, share: float, what: str) -> None:
        """Note what came near to an event, as a share of what would be one."""
        where = f" (run {self.segment.run_id})" if self.ledger.of_several_runs else ""
        self.ledger.came_near(kind, share, what + where)

    def is_over(self, kind: str, left: Sequence[Signal]) -> bool:
        """Whether the time is over; then it is noted which signals were not searched."""
        if not self.deadline.passed:
            return False
        names = ", ".join(signal.name for signal in left[:3]) + (", ..." if left[3:] else "")
        self.not_searched(kind, f"time limit reached, {len(left)} signals left: ask for {names}")
        return True
