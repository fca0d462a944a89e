"""Numeric signals over a segment as a table of buckets, from rows or from rollups."""

from __future__ import annotations

import math
import sqlite3
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, groupby, pairwise
from typing import Final, Literal

from webots_mcp.store.analysis.rhythm import Rhythm, rhythm_of
from webots_mcp.store.analysis.summary import Summary, merge, with_extremes
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.gaps import rhythm_in
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rollups import piece_length_s, read_pieces
from webots_mcp.store.reading.rows import Columns, exceeds, kept_columns, read_columns
from webots_mcp.store.signals.registry import Signal

Tier = Literal["rows", "raw", "rollup"]

_NICE: Final = (1, 1.5, 2, 3, 4, 5, 6, 8)


@dataclass(frozen=True)
class Table:
    """Buckets of equal length that begin at multiples of it; in the tier "rows" one per row.

    Attributes:
        tier: "rows" (a bucket is a row), "raw" (made from rows), "rollup" (from rollups, and from
            rows at both ends).
        step_s: Length of a bucket; None in the tier "rows".
        starts: Begin of each bucket.
        cells: Per signal one summary per bucket.
        rows: Rows of the segment that were read, be it as rollups.
        replaced: Per signal, how often each value that JSON cannot hold; None if long.
        cut_at_s: Where the deadline stopped the reading: nothing behind it is in the table. None
            if it did not.
    """

    tier: Tier
    step_s: float | None
    starts: list[float]
    cells: dict[str, list[Summary]]
    rows: int
    rhythm: Rhythm
    replaced: dict[str, Counter[str]] | None
    cut_at_s: float | None


def tabulate(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    max_points: int,
    deadline: Deadline,
    least_step_s: float = 0.0,
) -> Table:
    """Put a segment into at most `max_points` buckets: from rows up to 30,000 of them.

    Args:
        connection: Any.
        segment: The part of one run.
        signals: Numeric ones.
        max_points: The most buckets.
        deadline: When to stop reading.
        least_step_s: No bucket is shorter; above 0 no row is a bucket of its own.
    """
    if exceeds(connection, segment):
        table = _from_rollups(connection, segment, signals, max_points, deadline, least_step_s)
    else:
        columns = read_columns(connection, segment, signals, deadline)
        table = _from_rows(columns, signals, max_points, least_step_s)
    if table.starts and not segment.full_rate:
        cut_at_s = _take_in_kept(connection, segment, signals, deadline, table)
        cuts_s = [each for each in (table.cut_at_s, cut_at_s) if each is not None]
        table = replace(table, cut_at_s=min(cuts_s, default=None))
    return table


def _take_in_kept(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    deadline: Deadline,
    table: Table,
) -> float | None:
    """Put the extremes of what only kept stretches have into its buckets.

    A row that is a bucket of its own reaches up to the next one. Gives where the deadline stopped
    the reading, if it did.
    """
    columns = kept_columns(connection, segment, signals, deadline)
    if columns is None:
        return None
    places = [max(0, bisect_right(table.starts, time_s + 1e-9) - 1) for time_s in columns.times]
    start = 0
    for place, group in groupby(places):
        end = start + len(list(group))
        for signal in signals:
            values = columns.values[signal.name][start:end]
            of_rows = signal.summarise(columns.times[start:end], values)
            if cells := table.cells.get(signal.name):
                cells[place] = with_extremes(cells[place], of_rows)
        start = end
    return columns.cut_at_s


def _from_rows(
    columns: Columns, signals: Sequence[Signal], max_points: int, least_step_s: float
) -> Table:
    times = columns.times
    step_s = None
    if times and (least_step_s > 0 or len(times) > max_points):
        step_s = _step(times[0], times[-1], max_points, least_s=least_step_s)
    starts, edges = (times, list(range(len(times) + 1)))
    if step_s is not None:
        starts, edges = _edges(times, step_s)
    spans = list(pairwise(edges))
    cells = {
        signal.name: [
            signal.summarise(times[a:b], columns.values[signal.name][a:b]) for a, b in spans
        ]
        for signal in signals
    }
    tier = "rows" if step_s is None else "raw"
    rhythm = rhythm_of(times)
    return Table(
        tier, step_s, starts, cells, len(times), rhythm, columns.replaced, columns.cut_at_s
    )


def _edges(times: Sequence[float], step_s: float) -> tuple[list[float], list[int]]:
    """The begin of each bucket, also of empty ones, and the index of the first row of each."""
    numbers = [_number(time, step_s) for time in times]
    starts: list[float] = []
    edges = [0]
    index = 0
    for number in range(numbers[0], numbers[-1] + 1):
        starts.append(round(number * step_s, 9))
        while index < len(numbers) and numbers[index] <= number:
            index += 1
        edges.append(index)
    return starts, edges


def _number(time_s: float, step_s: float) -> int:
    """Which bucket holds a time; what a float's rounding puts just before a border is behind it."""
    return math.floor(time_s / step_s + 1e-9)


def _step(
    first_s: float, last_s: float, max_points: int, *, unit_s: float = 0.0, least_s: float = 0.0
) -> float:
    """The shortest round bucket length (a multiple of `unit_s`) that needs no more buckets."""
    for step_s in _round_steps(max(unit_s, least_s, (last_s - first_s) / max_points / 10, 1e-9)):
        fits = step_s >= least_s and (unit_s == 0 or step_s % unit_s == 0)
        if fits and _number(last_s, step_s) - _number(first_s, step_s) < max_points:
            return step_s
    raise AssertionError("the steps never end")


def _round_steps(at_least_s: float) -> Iterator[float]:
    for exponent in count(math.floor(math.log10(at_least_s))):
        for nice in _NICE:
            yield nice * 10**exponent if exponent >= 0 else nice / 10**-exponent


def _from_rollups(
    connection: sqlite3.Connection,
    segment: Segment,
    signals: Sequence[Signal],
    max_points: int,
    deadline: Deadline,
    least_step_s: float,
) -> Table:
    unit_s = piece_length_s(connection, segment, max_points, least_step_s)
    pieces = read_pieces(connection, segment, signals, deadline, unit_s)
    found = {signal.name: pieces.of(signal.name) for signal in signals}
    numbers = [piece for of_signal in found.values() for piece, _ in of_signal]
    rhythm = rhythm_in(connection, segment)
    if not numbers:
        return Table("rollup", unit_s, [], {}, pieces.rows, rhythm, None, pieces.cut_at_s)
    first, last = min(numbers), max(numbers)
    bounds = (first * unit_s, last * unit_s)
    step_s = _step(*bounds, max_points, unit_s=unit_s, least_s=least_step_s)
    width = round(step_s / unit_s)
    indexes = range(first // width, last // width + 1)
    starts = [index * step_s for index in indexes]
    cells = {name: _widened(pieces, width, indexes) for name, pieces in found.items()}
    cut_at_s = pieces.cut_at_s
    return Table("rollup", step_s, starts, cells, pieces.rows, rhythm, None, cut_at_s)


def _widened(pieces: list[tuple[int, Summary]], width: int, indexes: range) -> list[Summary]:
    """Pieces merged into buckets of `width` times their length, with the empty ones."""
    merged = {
        index: merge([summary for _, summary in group])
        for index, group in groupby(pieces, lambda piece: piece[0] // width)
    }
    return [merged.get(index, Summary()) for index in indexes]
