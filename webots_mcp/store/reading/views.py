"""How detectors see a segment: all of its rows, or, if it is long, rollups and the rows they name.

Both views answer the same questions, so that a detector is written once.
"""

from __future__ import annotations

import functools
import math
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Final, Protocol

from webots_mcp.store.analysis.arrays import Array, Flags, np
from webots_mcp.store.analysis.jumps import least_jump
from webots_mcp.store.analysis.rhythm import usual_interval_s
from webots_mcp.store.analysis.summary import Summary, summarise_numbers
from webots_mcp.store.analysis.swings import SLOW_HALF_SWINGS, Swing
from webots_mcp.store.reading.coverage import less_time
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.gaps import rows_by_bucket
from webots_mcp.store.reading.intervals import (
    Condition,
    Span,
    joined,
    spans_in_pieces,
    spans_in_rows,
)
from webots_mcp.store.reading.ranges import Segment, just_after
from webots_mcp.store.reading.rollups import Pieces, read_pieces, rows_after
from webots_mcp.store.reading.rows import (
    Columns,
    Numbers,
    exceeds,
    numbers_of,
    read_columns,
    read_numbers,
)
from webots_mcp.store.reading.sampling import MOST_SAMPLES, newest_part, read_sampled
from webots_mcp.store.reading.steps import BucketSteps, read_steps
from webots_mcp.store.rollup.buckets import BUCKET_S, FINE, bucket_of, totals
from webots_mcp.store.rollup.swings import (
    ACROSS_S,
    LONGEST_PERIOD_S,
    STRETCH_ROWS,
    stored_swings,
)
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.registry import Signal

READING_SHARE: Final = 0.5  # of the time: what is read has to be searched as well
JUMP_ROWS: Final = 40_000  # of each signal of a long segment that are read, about as of a short one
BACK_INTERVALS: Final = 8  # before and after a jump: an excursion of five rows, and what rested
SAMPLES_PER_STAY: Final = 5
SAMPLE_ROWS: Final = 3000  # newest rows that tell the usual interval and the usual steps
MOST_KEPT: Final = 10_000_000  # numbers of 8 bytes, of stretches that are asked for again
LATE_S: Final = 60.0  # the rollups are usually a few seconds behind
_NOTHING: Final = range(0)

_OF_SIGNAL: Final = (
    "FROM all_rollup WHERE run_id = ? AND signal_id = ? AND bucket >= ? AND bucket < ?"
)
_COUNTS: Final = {"rows": "sum", "present": "sum", "changes": "sum"}
_STEPS: Final = (
    f"SELECT bucket, present, largest_step, first, last {_OF_SIGNAL} AND first IS NOT NULL "
    "ORDER BY bucket"
)
_ROWS_IN: Final = (
    "SELECT count(*) FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s < ?"
)
_LAST_BEFORE: Final = "SELECT max(sim_time_s) FROM state WHERE run_id = ? AND sim_time_s < ?"
_FIRST_ROW: Final = "SELECT min(sim_time_s) FROM state WHERE run_id = ?"
_RESTING: Final = (
    "SELECT s.id FROM run r CROSS JOIN signal s ON s.robot_id = r.robot_id WHERE r.id = ? "
    "AND EXISTS (SELECT 1 FROM all_rollup WHERE run_id = r.id AND signal_id = s.id "
    "AND bucket >= ? AND bucket < ? AND min = max AND present = rows)"
)


@dataclass(frozen=True)
class Course:
    """Numbers of a signal in which jumps are looked for.

    Attributes:
        usual: Numbers one after the other to compare with; None for the same.
    """

    times: Array
    numbers: Array
    usual: Array | None = None


class View(Protocol):
    """What a detector may ask."""

    notes: list[str]  # what could not be looked at, of what was asked since they were taken
    shortest_rest_s: float  # a shorter one may be missed
    sampled_s: float  # between the rows of `places`; 0 where these are all
    longest_period_s: float  # of swings that show in it
    is_long: bool  # not all of its rows are read
    inside: range  # buckets of 10 s of which what was found is stored; none where all rows are read

    def taken_notes(self) -> list[str]:
        """What could not be looked at since the notes were last taken; and what never can."""
        ...

    def places(
        self, signals: Sequence[Signal], stay_s: float, outside: range = _NOTHING
    ) -> Columns:
        """Rows close enough to see a stay of that length, of the time outside of some buckets."""
        ...

    def sample(self, signals: Sequence[Signal]) -> Columns:
        """Enough rows one after the other to tell the noise of signals."""
        ...

    def rows_between(self, start_s: float, end_s: float, signals: Sequence[Signal]) -> Columns:
        """All rows of the segment in [start_s, end_s)."""
        ...

    def summary(self, signal: Signal) -> Summary:
        """Of the whole segment."""
        ...

    def spans(self, signal: Signal, condition: Condition) -> list[Span]:
        """Where the condition holds in every row; across a recording gap it is taken to go on."""
        ...

    def courses(
        self, signals: Sequence[Signal], score: float
    ) -> Iterator[tuple[Signal, Iterator[Course]]]:
        """Where a jump of each signal may be."""
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

    shortest_rest_s = 0.0
    sampled_s = 0.0
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
        self._summaries: dict[str, Summary] = {}

    def taken_notes(self) -> list[str]:
        """Of rows only that not all were read."""
        return self._lasting

    def places(
        self, signals: Sequence[Signal], stay_s: float, outside: range = _NOTHING
    ) -> Columns:
        """All rows."""
        return self._columns

    def sample(self, signals: Sequence[Signal]) -> Columns:
        """All rows."""
        return self._columns

    def rows_between(self, start_s: float, end_s: float, signals: Sequence[Signal]) -> Columns:
        """All rows, also those outside."""
        return self._columns

    def summary(self, signal: Signal) -> Summary:
        """Of all rows."""
        if signal.name not in self._summaries:
            rows = len(self._columns.times)
            numbers = self._columns.numbers(signal.name)
            self._summaries[signal.name] = summarise_numbers(*numbers, rows=rows)
        return self._summaries[signal.name]

    def spans(self, signal: Signal, condition: Condition) -> list[Span]:
        """From all rows."""
        values = self._columns.values[signal.name]
        return list(spans_in_rows(self._columns.times, values, condition))

    def courses(
        self, signals: Sequence[Signal], score: float
    ) -> Iterator[tuple[Signal, Iterator[Course]]]:
        """All of each."""
        for signal in signals:
            yield signal, iter([Course(*self._columns.numbers(signal.name))])

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

    shortest_rest_s = 2 * BUCKET_S  # a shorter one need not fill a bucket
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
        self._read: dict[Segment, Columns] = {}
        self._samples: dict[tuple[str, ...], Columns] = {}
        self._connection = connection
        self._segment = segment
        self._deadline = deadline
        self.sampled_s = 0.0
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

    def places(
        self, signals: Sequence[Signal], stay_s: float, outside: range = _NOTHING
    ) -> Columns:
        """A row every fifth of the stay; fewer where that would be too many."""
        parts = _around(self._segment, outside)[::-1]
        if parts[0].start_s < outside.start * BUCKET_S or not outside:
            self._note_purged()
        span_s = sum(part.end_s - part.start_s for part in parts)
        every_s = max(stay_s / SAMPLES_PER_STAY, span_s / MOST_SAMPLES)
        self.sampled_s = every_s
        if every_s > stay_s / 2:
            advice = less_time(self._connection, self._segment)
            self.notes.append(f"not those under {2 * every_s:.3g} s: {advice}")
        plain = [signal for signal in signals if signal.is_plain]
        found = Columns(self._segment.run_id, values={signal.name: [] for signal in plain})
        for part in parts:
            sampled = read_sampled(self._connection, part, plain, every_s, self._deadline)
            found.add(sampled)
            if sampled.cut:
                reached_s = sampled.times[-1] if sampled.times else part.start_s
                self.notes.append(
                    f"not after {reached_s:.3f} s: time limit reached, ask start_s={reached_s:.3f}"
                )
                return found
        self._add_newest(found, plain, every_s)
        return found

    def sample(self, signals: Sequence[Signal]) -> Columns:
        """The newest rows, read once of all numbers that were asked for."""
        own = {signal.name for signal in self._signals}
        wanted = self._signals if own.issuperset(each.name for each in signals) else signals
        names = tuple(signal.name for signal in wanted)
        if names not in self._samples:
            part = newest_part(self._connection, self._segment, SAMPLE_ROWS)
            self._samples[names] = read_columns(self._connection, part, wanted, self._deadline)
        return self._samples[names]

    def rows_between(self, start_s: float, end_s: float, signals: Sequence[Signal]) -> Columns:
        """Read from the segment."""
        start_s, end_s = max(start_s, self._segment.start_s), min(end_s, self._segment.end_s)
        part = replace(self._segment, start_s=start_s, end_s=end_s)
        return read_columns(self._connection, part, signals, self._deadline)

    def summary(self, signal: Signal) -> Summary:
        """Counts from the rollups."""
        self._note_late()
        return self._totals.get(signal.id or 0, Summary(self._rows))

    def spans(self, signal: Signal, condition: Condition) -> list[Span]:
        """From rollups, and rows where they leave it open."""
        self._note_late()
        if self._purged_until_s is not None:
            self.notes.append(
                f"not those under {self.shortest_rest_s:g} s before "
                f"{self._purged_until_s:.3f} s, whose rows were purged"
            )
        if condition.lasting and signal not in self._resting:
            return []
        if self._deadline.passed:
            self._cut()
            return []
        shared = condition.lasting and signal in self._changing
        pieces = self._pieces if shared else self._pieces_of([signal])
        read = functools.partial(self._rows_of, signal)
        spans = joined(spans_in_pieces(self._segment, signal, pieces, condition, read))
        if self._deadline.passed or pieces.cut_at_s is not None:
            self._cut()
        return spans

    def _pieces_of(self, signals: Sequence[Signal]) -> Pieces:
        return read_pieces(self._connection, self._segment, signals, self._deadline)

    @functools.cached_property
    def _pieces(self) -> Pieces:
        """Of all signals that rest at times, which are read together."""
        return self._pieces_of(self._changing)

    @functools.cached_property
    def _changing(self) -> list[Signal]:
        """Those that rest at times only."""
        changing = {signal_id for signal_id, total in self._totals.items() if total.changes}
        return [signal for signal in self._resting if signal.id in changing]

    def _rows_of(self, signal: Signal, part: Segment) -> Columns:
        """Read with the other signals that rest at times, which are likely to ask for the same."""
        kept = self._read.get(part)
        if kept is None or signal.name not in kept.values:
            wanted = {each.name: each for each in (*self._resting, signal)}
            kept = read_columns(self._connection, part, list(wanted.values()), self._deadline)
            if not kept.cut:
                self._read[part] = kept
        return kept

    def courses(
        self, signals: Sequence[Signal], score: float
    ) -> Iterator[tuple[Signal, Iterator[Course]]]:
        """The buckets with a step that may be a jump, each with the rows before and after it."""
        self._note_late()
        self._note_purged()
        suspects = [
            [] if self._deadline.passed else list(self._suspects(signal, score))
            for signal in signals
        ]
        alike: dict[range, list[Signal]] = {}  # what is asked of several signals is read at once
        for signal, found in zip(signals, suspects, strict=True):
            for _, stretches in found:
                for buckets in stretches:
                    alike.setdefault(buckets, []).append(signal)
        for signal, found in zip(signals, suspects, strict=True):
            yield signal, self._courses_in(signal, found, alike, score)

    def _suspects(self, signal: Signal, score: float) -> Iterator[tuple[Array, list[range]]]:
        """What the steps of a signal are compared with, and the buckets that may hold a jump."""
        times, usual = self._sample.numbers(signal.name)
        limit, span = least_jump(usual, score), range(*self._span[1:])
        steps = read_steps(self._connection, self._span[0], signal.id or 0, span, limit)
        if limit:
            yield usual, self._largest(signal, steps, steps.largest > limit)
            return
        # It rests in the sample: what leaves and comes back at once is looked for everywhere.
        interval_s = usual_interval_s(times) or math.inf
        yield usual, self._largest(signal, steps, steps.excursions(interval_s))
        seldom = steps.usual() if steps.seldom else usual
        if limit := least_jump(seldom, score):
            yield seldom, self._largest(signal, steps, steps.largest > limit)

    def _largest(self, signal: Signal, steps: BucketSteps, wide: Flags) -> list[range]:
        """Some of the buckets; where they are too many those with the largest steps."""
        places = np.flatnonzero(wide)
        largest = places[np.argsort(-steps.largest[places], kind="stable")]
        rows = np.cumsum(steps.rows[largest])
        taken = largest[: max(1, int(np.searchsorted(rows, JUMP_ROWS, "right")))]
        if len(taken) < len(places):
            self.notes.append(
                f"of {signal.name} only in {len(taken)} of {len(places)} stretches of 10 s, those "
                f"with the largest steps: {less_time(self._connection, self._segment)}"
            )
        return list(_runs_of(sorted(steps.buckets[taken].tolist())))

    def _courses_in(
        self,
        signal: Signal,
        suspects: Sequence[tuple[Array, list[range]]],
        alike: dict[range, list[Signal]],
        score: float,
    ) -> Iterator[Course]:
        for usual, stretches in suspects:
            limit = least_jump(usual, score)
            for buckets in stretches:
                if self._deadline.passed:
                    self._cut()
                    return
                times, numbers = self._numbers(buckets, alike[buckets]).of(signal.name)
                livelier = least_jump(numbers, score) > limit
                yield Course(times, numbers, None if livelier else usual)

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
    def _totals(self) -> dict[int, Summary]:
        """Rows count also where they lack the signal: as many as of the one that is in most."""
        run_id, first, end = self._span
        found = totals(self._connection, run_id, range(first, end), _COUNTS)
        rows = max((counted for counted, *_ in found.values()), default=0)
        return {signal_id: Summary(rows, *counts) for signal_id, (_, *counts) in found.items()}

    @functools.cached_property
    def _rows(self) -> int:
        """Of the whole segment."""
        return max((each.rows for each in self._totals.values()), default=0)

    @functools.cached_property
    def _sample(self) -> Columns:
        return self.sample(self._signals)

    @functools.cached_property
    def _interval_s(self) -> float | None:
        """The usual one between the newest rows."""
        return usual_interval_s(self._sample.moments)

    @functools.cached_property
    def _resting(self) -> list[Signal]:
        """Those that have the same value throughout a bucket."""
        resting = {signal_id for (signal_id,) in self._connection.execute(_RESTING, self._span)}
        return [signal for signal in self._signals if signal.id in resting]

    def _add_newest(self, found: Columns, signals: Sequence[Signal], every_s: float) -> None:
        """The rows after the last sample: who is stuck may be so up to the newest one."""
        after_s = found.times[-1] if found.times else math.inf
        part = replace(
            self._segment, start_s=just_after(max(after_s, self._segment.end_s - 2 * every_s))
        )
        found.add(read_columns(self._connection, part, signals, self._deadline))

    def _note_late(self) -> None:
        if self._segment.end_s - self._rolled_until_s > LATE_S:
            self.notes.append(f"not after {self._rolled_until_s:.3f} s, which is not rolled up yet")

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

    def _numbers(self, buckets: range, signals: Sequence[Signal]) -> Numbers:
        """The rows of some buckets, and a few before and after them."""
        before_s = BACK_INTERVALS * (self._interval_s or 0.0)
        start_s = max(self._segment.start_s, buckets.start * BUCKET_S - before_s)
        end_s = min(self._segment.end_s, buckets.stop * BUCKET_S + before_s)
        return self._read_once(replace(self._segment, start_s=start_s, end_s=end_s), signals)


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


def _runs_of(buckets: Sequence[int]) -> Iterator[range]:
    """Those that follow each other as one."""
    for _, group in groupby(enumerate(buckets), lambda each: each[1] - each[0]):
        numbers = [bucket for _, bucket in group]
        yield range(numbers[0], numbers[-1] + 1)
