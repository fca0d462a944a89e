"""In which buckets of 10 s a signal may have jumped: all that its rollups do not rule out."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.analysis.jumps import LONGEST_EXCURSION
from webots_mcp.store.analysis.rhythm import GAP_INTERVALS
from webots_mcp.store.rollup.buckets import BUCKET_S, COARSE, COARSE_BUCKETS, bucket_of, by_grain

_OF_SIGNAL: Final = "WHERE run_id = ? AND signal_id = ? AND bucket >= ? AND bucket < ?"
# Older rollups know no largest step; it is no larger than the whole range.
_LARGEST: Final = "coalesce(largest_step, max - min)"
_FINE: Final = (
    f"SELECT bucket, rows, changes, {_LARGEST}, first, first_sim_time_s, first_until_sim_time_s, "
    f"last, last_since_sim_time_s FROM all_rollup {_OF_SIGNAL} AND first IS NOT NULL "
    "ORDER BY bucket"
)
_COARSE: Final = (
    f"SELECT bucket, {_LARGEST}, first, last, last_sim_time_s FROM coarse_rollup {_OF_SIGNAL} "
    "AND first IS NOT NULL ORDER BY bucket"
)
_SELDOM: Final = 2  # changes in a bucket: then its rollup has all of them


@dataclass(frozen=True)
class BucketSteps:
    """How a signal changed in buckets of 10 s, in order; in each with the step into it.

    Attributes:
        rows: State rows.
        changes: Steps that are not 0.
        largest: The largest step.
        before: The number before the first step.
        last: The number after the last one.
        first_s: When the first change was, at the earliest; NaN where that is not known.
        last_s: When the last one was.
    """

    buckets: Indexes
    rows: Indexes
    changes: Indexes
    largest: Array
    before: Array
    last: Array
    first_s: Array
    last_s: Array

    @property
    def seldom(self) -> bool:
        """Whether most changes are in buckets with no more than two of them."""
        often = self.changes[self.changes > _SELDOM]
        return int(often.sum()) <= int(self.changes.sum()) / 2

    def usual(self) -> Array:
        """Numbers before and after each change that was the only one in its bucket."""
        alone = self.changes == 1
        return np.column_stack((self.before[alone], self.last[alone])).ravel()

    def excursions(self, interval_s: float) -> Flags:
        """Where a value may have left and come back within a few rows.

        With two changes it can only have done so if the last number is that from before, and if
        these follow each other soon; of a return in the next bucket that holds for both together.
        """
        longest_s = (LONGEST_EXCURSION + 1) * GAP_INTERVALS * interval_s
        if longest_s > BUCKET_S:
            return self.changes > 0
        soon = ~(self.last_s - self.first_s > longest_s)
        within = (self.changes == _SELDOM) & (self.before == self.last) & soon
        may = within | (self.changes > _SELDOM)
        over = (self.changes[:-1] > 0) & (self.changes[1:] > 0)
        over &= ~(self.first_s[1:] - self.last_s[:-1] > longest_s)
        over &= (self.changes[:-1] + self.changes[1:] > _SELDOM) | (
            self.before[:-1] == self.last[1:]
        )
        may[:-1] |= over
        may[1:] |= over
        return may


def read_steps(
    connection: sqlite3.Connection, run_id: int, signal_id: int, span: range, limit: float
) -> BucketSteps:
    """The buckets of a span in which a signal has a step above a limit, and some others.

    Of 500 s whose rollup has none no finer ones are read.
    """
    asked = (run_id, signal_id)
    rows: list[tuple[Any, ...]] = []
    begins: list[int] = []  # rows whose number before was not read
    end = None
    for part in _parts_above(connection, asked, span, limit):
        begins += [] if part.start == end else [len(rows)]
        end = part.stop
        rows += connection.execute(_FINE, (*asked, part.start, part.stop)).fetchall()
    table: Array = np.reshape(np.array(rows, np.float64), (len(rows), 9))
    columns: list[Array] = [table[:, place] for place in range(2, 9)]
    changes, inside, first, first_s, first_until_s, last, last_since_s = columns
    before: Array = np.concatenate((first[:1], last[:-1]))
    known = [row for row in begins if row < len(rows)]
    before[known] = first[known]
    into: Array = np.abs(first - before)
    return BucketSteps(
        np.array([row[0] for row in rows], np.intp),
        np.array([row[1] for row in rows], np.intp),
        np.asarray(changes + (into > 0), np.intp),
        np.fmax(inside, into),
        before,
        last,
        np.where(into > 0, first_s, first_until_s),
        last_since_s,
    )


def _parts_above(
    connection: sqlite3.Connection, asked: Sequence[int], span: range, limit: float
) -> Iterator[range]:
    """The parts that coarse rollups do not rule out, each from the number before it on."""
    end = span.start
    for part in _parts(connection, asked, span, limit):
        if part.stop > end:
            yield range(max(part.start, end), part.stop)
            end = part.stop


def _parts(
    connection: sqlite3.Connection, asked: Sequence[int], span: range, limit: float
) -> Iterator[range]:
    before: tuple[float, int] | None = None  # the last number, and its bucket of 10 s
    for grain, part in by_grain(connection, asked[0], span):
        if grain is not COARSE:
            yield range(part.start if before is None else before[1], part.stop)
            continue
        found = connection.execute(_COARSE, (*asked, part.start, part.stop))
        for bucket, largest, first, last, last_s in found.fetchall():
            first_bucket = bucket * COARSE_BUCKETS
            since = first_bucket if before is None else before[1]
            into = 0.0 if before is None else abs(first - before[0])
            if before is None or max(largest, into) > limit:
                yield range(since, first_bucket + COARSE_BUCKETS)
            before = last, first_bucket if last_s is None else bucket_of(last_s)
