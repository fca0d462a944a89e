"""How detectors see a segment: all of its rows, or, if it is long, rollups and the rows they name.

Both views answer the same questions, so that a detector is written once.
"""

from __future__ import annotations

import functools
import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, Protocol

from webots_mcp.store.analysis.swings import SLOW_HALF_SWINGS, Swing
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rollups import rows_after, rows_by_bucket
from webots_mcp.store.reading.rows import (
    Columns,
    Numbers,
    exceeds,
    numbers_of,
    read_columns,
    read_numbers,
)
from webots_mcp.store.reading.sampling import newest_part
from webots_mcp.store.rollup.buckets import BUCKET_S, FINE, bucket_of
from webots_mcp.store.rollup.swings import (
    ACROSS_S,
    MOST_SAMPLES,
    STRETCH_ROWS,
    newest_part,
    read_sampled,
)
from webots_mcp.store.reading.steps import BucketSteps, read_steps
from webots_mcp.store.rollup.buckets import BUCKET_S, FINE, bucket_of, totals
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.registry import Signal

READING_SHARE: Final = 0.5  # of the time: what is read has to be searched as well
SAMPLE_ROWS: Final = 3000  # newest rows that tell the usual interval and the usual steps
MOST_KEPT: Final = 10_000_000  # numbers of 8 bytes, of stretches that are asked for again
_NOTHING: Final = range(0)

_OF_SIGNAL: Final = (
    "FROM all_rollup WHERE run_id = ? AND signal_id = ? AND bucket >= ? AND bucket < ?"
)
_STEPS: Final = (
    f"SELECT bucket, present, largest_step, first, last {_OF_SIGNAL} AND first IS NOT NULL "
    "ORDER BY bucket"
)
_ROWS_IN: Final = (
    "SELECT count(*) FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
)
_LAST_BEFORE: Final = "SELECT max(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s < ?"
_FIRST_ROW: Final = "SELECT min(sim_time_s) FROM state WHERE run_id = ?"


class View(Protocol):
    """What a detector may ask."""

    notes: list[str]  # what could not be looked at, of what was asked since they were taken
    longest_period_s: float  # of swings that show in it
    is_long: bool  # not all of its rows are read
    inside: range  # buckets of 10 s of which what was found is stored; none where all rows are read

    def taken_notes(self) -> list[str]:
        """What could not be looked at since the notes were last taken; and what never can."""
        ...

    def sample(self, signals: Sequence[Signal]) -> Columns:
        """Enough rows one after the other to tell the noise of signals."""
        ...

    def stored_swings(self, signals: Sequence[Signal]) -> tuple[range, dict[str, list[Swing]]]:
        """Swings that were found before; and of which buckets, where all of a signal's are."""
        ...

    def stretches(
        self,
        signals: Sequence[Signal],
        least_steps: Sequence[float] | None = None,
        outside: range = _NOTHING,
        apart: float = 0.0,
    ) -> Iterator[Numbers]:
        """All rows in stretches, the newest first, as many as the time allows.

        Each reaches so far into the one after it that what lies across the border is whole in one.

        Args:
            signals: Which numbers.
            least_steps: Of each signal: a stretch may be left out in which none of them changes by
                more than that from one row to the next. None for all stretches.
            outside: Buckets that are not read, but for what lies across their borders.
            apart: Only the part of a stretch is given in which one of them changes by more than
                that, if all changes in the rest are so many times smaller; 0: the whole.
        """
        ...


def view_of(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    through: Sequence[Signal] = (),
) -> View:
    """The view that suits the length of the segment.

    Args:
        connection: Any.
        segment: What is looked at.
        signals: That are looked at.
        deadline: For all reading.
        through: Those of which `stretches` will be asked, to be read together.
    """
    if exceeds(connection, segment):
        return LongView(connection, segment, signals, deadline, through)
    return RowView(read_columns(connection, segment, signals, deadline.part(READING_SHARE)))


class RowView:
    """All rows of a segment."""

    is_long = False
    inside = _NOTHING

    def __init__(self, columns: Columns) -> None:
        self.notes: list[str] = []
        self._lasting: list[str] = []
        if columns.cut:
            after = f"after {columns.cut_at_s:.3f} s" if columns.times else "at all"
            self._lasting.append(f"time limit reached: not read {after}; ask for less time")
        self._columns = columns
        length_s = columns.times[-1] - columns.times[0] if columns.times else 0.0
        self.longest_period_s = max(LONGEST_PERIOD_S, 2 * length_s / SLOW_HALF_SWINGS)

    def taken_notes(self) -> list[str]:
        """Of rows only that not all were read."""
        return self._lasting

    def sample(self, signals: Sequence[Signal]) -> Columns:
        """All rows."""
        return self._columns

    def stored_swings(self, signals: Sequence[Signal]) -> tuple[range, dict[str, list[Swing]]]:
        """None: all rows are there to look in."""
        return _NOTHING, {}

    def stretches(
        self,
        signals: Sequence[Signal],
        least_steps: Sequence[float] | None = None,
        outside: range = _NOTHING,
        apart: float = 0.0,
    ) -> Iterator[Numbers]:
        """All rows at once."""
        yield numbers_of(self._columns, signals)


class LongView:
    """The rollups of a long segment, and what has to be read besides."""

    longest_period_s = LONGEST_PERIOD_S
    is_long = True

    def __init__(
        self,
        connection: sqlite3.Connection,
        segment: Segment,
        signals: Sequence[Signal],
        deadline: Deadline,
        through: Sequence[Signal] = (),
    ) -> None:
        self.notes: list[str] = []
        self._through = through
        self._kept: dict[Segment, Numbers] = {}
        self._samples: dict[tuple[str, ...], Columns] = {}
        self._connection = connection
        self._segment = segment
        self._deadline = deadline
        self._signals = [signal for signal in signals if signal.is_number]
        start, end = -(-segment.start_s // BUCKET_S), segment.end_s // BUCKET_S
        self.inside = range(int(start), int(end))
        self._span = (segment.run_id, bucket_of(segment.start_s), bucket_of(segment.end_s) + 1)
        late = rows_after(connection, segment, watermark(connection, segment.run_id))
        self._rolled_until_s = math.inf if late is None else late.start_s

    def taken_notes(self) -> list[str]:
        """Each is reported once."""
        taken, self.notes = list(dict.fromkeys(self.notes)), []
        return taken

    def sample(self, signals: Sequence[Signal]) -> Columns:
        """The newest rows, read once of all numbers that were asked for."""
        own = {signal.name for signal in self._signals}
        wanted = self._signals if own.issuperset(each.name for each in signals) else signals
        names = tuple(signal.name for signal in wanted)
        if names not in self._samples:
            part = newest_part(self._connection, self._segment, SAMPLE_ROWS)
            self._samples[names] = read_columns(self._connection, part, wanted, self._deadline)
        return self._samples[names]

    def stored_swings(self, signals: Sequence[Signal]) -> tuple[range, dict[str, list[Swing]]]:
        """Those of the coarse rollups that lie inside."""
        return stored_swings(self._connection, self._segment, self.inside, signals)

    def stretches(
        self,
        signals: Sequence[Signal],
        least_steps: Sequence[float] | None = None,
        outside: range = _NOTHING,
        apart: float = 0.0,
    ) -> Iterator[Numbers]:
        """What there is no time for is noted."""
        first_s = max(self._segment.start_s, self._purged_until_s or -math.inf)
        for part in _around(self._segment, outside):
            if part.start_s < first_s:
                self._note_purged()
            steps = [] if least_steps is None else self._largest_steps(part, signals)
            if least_steps is not None and self._is_ruled_out(part, steps, least_steps):
                continue
            for whole in self._stretches(part, first_s):
                if least_steps is None or (here := self._steps_in(whole, steps)) is None:
                    yield self._stretch(whole, signals)
                elif large := _above(here, least_steps):
                    if apart and not _above(here, [each / apart for each in least_steps], large):
                        yield self._part(whole, large, signals)
                    else:
                        yield self._stretch(whole, signals)

    def _stretches(self, left: Segment, first_s: float) -> Iterator[Segment]:
        """The newest first, each with what reaches out of it, until the time is over."""
        end_of_all_s, first_s = left.end_s, max(first_s, left.start_s)
        while left.end_s > first_s:
            part = newest_part(self._connection, left, STRETCH_ROWS)
            if self._deadline.passed:
                reached_s = left.end_s
                self.notes.append(
                    f"not before {reached_s:.3f} s: time limit reached, ask end_s={reached_s:.3f}"
                )
                return
            yield replace(part, end_s=min(end_of_all_s, part.end_s + ACROSS_S))
            if part.start_s <= first_s:
                return
            left = replace(left, end_s=part.start_s)

    def _largest_steps(self, part: Segment, signals: Sequence[Signal]) -> list[dict[int, float]]:
        """By bucket the largest step of each signal, and the one into it; infinite: not known.

        It is known where all rows of the bucket are in the rollups, each with a number.
        """
        run_id, span = part.run_id, range(bucket_of(part.start_s), bucket_of(part.end_s) + 1)
        rows = rows_by_bucket(self._connection, run_id, FINE, span)
        steps: list[dict[int, float]] = []
        for signal in signals:
            asked = (run_id, signal.id, span.start, span.stop)
            found = self._connection.execute(_STEPS, asked).fetchall()
            own = dict.fromkeys(rows, math.inf)
            for bucket, present, step, *_ in found:
                known = present == rows.get(bucket) and (step is not None or present < 2)
                own[bucket] = (step or 0.0) if known else math.inf
            for (*_, last), (bucket, _, _, first, _) in pairwise(found):
                own[bucket] = max(own[bucket], abs(first - last))
            steps.append(own)
        return steps

    def _steps_in(
        self, part: Segment, steps: Sequence[dict[int, float]]
    ) -> list[dict[int, float]] | None:
        """Those of the buckets of a part; None where not all are known."""
        span = range(bucket_of(part.start_s), bucket_of(part.end_s) + 1)
        here = [{bucket: own.get(bucket, 0.0) for bucket in span} for own in steps]
        is_late = self._rolled_until_s < part.end_s
        return None if is_late or any(math.inf in own.values() for own in here) else here

    def _is_ruled_out(
        self, part: Segment, steps: Sequence[dict[int, float]], least_steps: Sequence[float]
    ) -> bool:
        """Whether no step of a part is as large, as is known of all its buckets."""
        here = self._steps_in(part, steps)
        return here is not None and not _above(here, least_steps)

    def _part(self, whole: Segment, large: range, signals: Sequence[Signal]) -> Numbers:
        """The rows of some buckets of a stretch, and the one before them."""
        bounds = (whole.run_id, whole.start_s, whole.end_s)
        (rows,) = self._connection.execute(_ROWS_IN, bounds).fetchone()
        large_s = large.start * BUCKET_S, large.stop * BUCKET_S
        (before_s,) = self._connection.execute(_LAST_BEFORE, (whole.run_id, large_s[0])).fetchone()
        start_s = whole.start_s if before_s is None else max(whole.start_s, before_s)
        part = replace(whole, start_s=start_s, end_s=min(whole.end_s, large_s[1]))
        return replace(self._read_once(part, signals), stretch_rows=rows)

    def _stretch(self, part: Segment, signals: Sequence[Signal]) -> Numbers:
        """Read with what other kinds will ask of the same rows."""
        return self._read_once(part, [*signals, *self._through])

    def _read_once(self, part: Segment, signals: Sequence[Signal]) -> Numbers:
        """Read, and kept for who asks for the same."""
        kept = self._kept.get(part)
        if kept is not None and all(signal.name in kept.values for signal in signals):
            return kept
        wanted = list({each.name: each for each in signals}.values())
        numbers = read_numbers(self._connection, part, wanted, self._deadline)
        if (reached_s := numbers.cut_at_s) is not None:
            span = f"start_s={reached_s:.3f}, end_s={part.end_s:.3f}"
            self.notes.append(f"not from {reached_s:.3f} s on: time limit reached, ask {span}")
        held = sum(len(each.times) * len(each.values) for each in self._kept.values())
        if reached_s is None and held < MOST_KEPT:
            self._kept[part] = numbers
        return numbers

    @functools.cached_property
    def _purged_until_s(self) -> float | None:
        """When the first row is that is left, where older ones of the segment were purged."""
        first_s = self._connection.execute(_FIRST_ROW, self._span[:1]).fetchone()[0]
        if first_s is None:
            return self._segment.end_s
        return first_s if first_s > self._segment.start_s else None

    def _note_purged(self) -> None:
        if self._purged_until_s is not None:
            self.notes.append(f"not before {self._purged_until_s:.3f} s, whose rows were purged")

    def _cut(self) -> None:
        self.notes.append("time limit reached before all was searched: ask for less time or kinds")


def _around(segment: Segment, buckets: range) -> list[Segment]:
    """What of a segment is not in some buckets inside of it, the newest first."""
    if not buckets:
        return [segment]
    start_s, end_s = buckets.start * BUCKET_S, buckets.stop * BUCKET_S
    after = replace(segment, start_s=max(segment.start_s, end_s - ACROSS_S))
    before = replace(segment, end_s=min(segment.end_s, start_s + ACROSS_S))
    return [after, before] if segment.start_s < start_s else [after]


def _above(
    steps: Sequence[dict[int, float]], limits: Sequence[float], outside: range = _NOTHING
) -> range:
    """From the first to the last bucket in which a signal has a step above its limit."""
    large = [
        bucket
        for own, limit in zip(steps, limits, strict=True)
        for bucket, step in own.items()
        if step > limit and bucket not in outside
    ]
    return range(min(large), max(large) + 1) if large else _NOTHING
