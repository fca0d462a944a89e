"""Stretches in which something holds of one signal: beyond a threshold, without a value, flat.

Short segments are read row by row. Of a long one the rollups tell for most buckets whether it
holds throughout or not at all; only the buckets in between are read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress, count, islice, pairwise
from operator import ne
from typing import Final, Protocol

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.analysis.summaries import Summaries
from webots_mcp.store.analysis.summary import Summary, usable_numbers
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rollups import Pieces
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.rollup.buckets import BUCKET_S
from webots_mcp.store.signals.flatten import shown
from webots_mcp.store.signals.registry import Signal

MOSTLY: Final = 0.5  # of the rows
NO_VALUE: Final = ""  # no number has this text


@dataclass(frozen=True)
class Span:
    """From the first to the last of rows, one after the other, in all of which it held.

    Attributes:
        key: What held: spans that touch are one only if it is the same.
        from_first: It held in the first row that was read: it may have begun before.
        to_last: It held in the last row that was read: it may go on.
        within_s: How exactly begin and end are known, where the rows there were purged.
    """

    start_s: float
    end_s: float
    key: Value
    low: float | None = None
    high: float | None = None
    from_first: bool = False
    to_last: bool = False
    within_s: float = 0.0

    @property
    def how_exact(self) -> dict[str, float]:
        """`within_s` as a detail of an event, where its ends are not known to the row."""
        return {"within_s": self.within_s} if self.within_s else {}


class Condition(Protocol):
    """What is looked for."""

    @property
    def lasting(self) -> bool:
        """Whether it takes more than one row."""
        ...

    def of_rows(self, values: Sequence[Value]) -> Sequence[Value]:
        """Per row None if it does not hold; else what holds, as a key."""
        ...

    def of_buckets(self, summaries: Summaries) -> tuple[Flags, Flags]:
        """In which buckets it holds in all rows, and in which others it may hold in some."""
        ...


@dataclass(frozen=True)
class Beyond:
    """Above or below a limit, as `holds` decides for a number."""

    holds: Callable[[float], bool]
    lasting: bool = False

    def of_rows(self, values: Sequence[Value]) -> Sequence[Value]:
        """True or None."""
        return [
            True if value is not None and not isinstance(value, str) and self.holds(value) else None
            for value in values
        ]

    def of_buckets(self, summaries: Summaries) -> tuple[Flags, Flags]:
        """From the extremes; numbers that are too large for those stand in the rows."""
        low, high = (self._of_numbers(summaries[name]) for name in ("min", "max"))
        whole = low & high & (summaries["present"] == summaries["rows"])
        too_large = np.isnan(summaries["min"]) & (summaries["present"] > 0)
        return whole, (low | high | too_large) & ~whole

    def _of_numbers(self, numbers: Array) -> Flags:
        return np.array([self.holds(number) for number in numbers.tolist()], np.bool_)


class Silent:
    """Without a value."""

    lasting = False

    def of_rows(self, values: Sequence[Value]) -> Sequence[Value]:
        """True or None."""
        return [True if value is None else None for value in values]

    def of_buckets(self, summaries: Summaries) -> tuple[Flags, Flags]:
        """From the counts."""
        lacking, never = summaries["present"] < summaries["rows"], summaries["present"] == 0
        return lacking & never, lacking & ~never


class Flat:
    """Exactly the same number as before."""

    lasting = True

    def of_rows(self, values: Sequence[Value]) -> Sequence[Value]:
        """The numbers."""
        return values

    def of_buckets(self, summaries: Summaries) -> tuple[Flags, Flags]:
        """From the extremes; where it changed, its ends may still be flat."""
        whole = summaries["min"] == summaries["max"]
        whole &= summaries["present"] == summaries["rows"]
        return whole, ~whole


class OneValue:
    """The same value as before, also where that is none: of numbers that name what a robot does."""

    lasting = False

    def of_rows(self, values: Sequence[Value]) -> Sequence[Value]:
        """The values as texts; `NO_VALUE` where there is none."""
        texts = {value: _text(value) for value in set(values)}  # there are mostly few
        return [texts[value] for value in values]

    def of_buckets(self, summaries: Summaries) -> tuple[Flags, Flags]:
        """From the extremes."""
        whole = summaries["min"] == summaries["max"]
        whole &= summaries["present"] == summaries["rows"]
        return whole, ~whole


def _text(value: Value) -> str:
    """A whole number is one however it was stored."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return shown(value) or NO_VALUE


def spans_in_rows(
    times: Sequence[float], values: Sequence[Value], condition: Condition
) -> Iterator[Span]:
    """The spans in rows that were read."""
    keys = condition.of_rows(values)
    changes = compress(count(1), map(ne, keys, islice(keys, 1, None)))
    for start, end in pairwise([0, *changes, len(keys)] if keys else ()):
        ends = (start == 0, end == len(keys))
        alone = end - start == 1 and not any(ends)  # else the row before or after may be the same
        if keys[start] is not None and not (condition.lasting and alone):
            _, held = usable_numbers(times[start:end], values[start:end])
            low, high = min(held, default=None), max(held, default=None)
            yield Span(times[start], times[end - 1], keys[start], low, high, *ends)


def spans_in_pieces(
    segment: Segment,
    signal: Signal,
    pieces: Pieces,
    condition: Condition,
    read: Callable[[Segment], Columns],
) -> Iterator[list[Span] | None]:
    """The spans in a long segment, bucket by bucket; the rows of one in between are read.

    Flat buckets are looked for whole; of the others only those next to one are looked at, and read
    where older rollups do not tell up to when the first value lasted, and since when the last one.
    Of a bucket in between whose rows were purged nothing more is known than that; None where that
    is nothing.
    """
    numbers, summaries = pieces.numbered(signal.name)
    whole, some = condition.of_buckets(summaries)
    if condition.lasting:
        some &= np.append(whole[1:], False) | np.append(False, whole[:-1])
    starts = _groups(whole, some, summaries["last"])
    groups = summaries.of_groups(starts)
    for place, (start, end) in enumerate(pairwise([*starts.tolist(), len(numbers)])):
        if whole[start]:
            buckets = range(int(numbers[start]), int(numbers[end - 1]) + 1)
            yield [_whole(segment, buckets, groups.one(place), condition)]
        elif not some[start]:
            yield []
        elif condition.lasting and (rests := rests_at_ends(groups.one(place))) is not None:
            yield rests
        else:
            columns = read(_bucket_of(segment, int(numbers[start])))
            found = list(spans_in_rows(columns.times, columns.values[signal.name], condition))
            purged = not columns.times and not columns.cut
            yield _at_ends(groups.one(place), condition) if purged else found


def _at_ends(summary: Summary, condition: Condition) -> list[Span] | None:
    """What its first and its last value tell of a bucket without rows; None: not enough."""
    rests = rests_at_ends(summary)
    keys = condition.of_rows([rest.key for rest in rests or ()])
    known = rests is not None and summary.changes == 1
    return (
        [replace(e, key=key) for e, key in zip(rests or (), keys, strict=True)] if known else None
    )


def _groups(whole: Flags, some: Flags, last: Array) -> Indexes:
    """Where those begin that are one span, or in which it does not hold; any other is alone."""
    alike = whole[1:] & whole[:-1] & (last[1:] == last[:-1])
    alike |= ~(whole | some)[1:] & ~(whole | some)[:-1]
    return np.flatnonzero(np.append(True, ~alike)[: len(whole)])


def rests_at_ends(summary: Summary) -> list[Span] | None:
    """Where a number that changed has its first value, and where its last; None: not known."""
    if summary.present < summary.rows:
        return None
    first_s, until_s = summary.first_sim_time_s, summary.first_until_sim_time_s
    since_s, last_s = summary.last_since_sim_time_s, summary.last_sim_time_s
    first, last = summary.first, summary.last
    if first_s is None or until_s is None or since_s is None or last_s is None:
        return None
    return [
        Span(first_s, until_s, first, first, first, from_first=True),
        Span(since_s, last_s, last, last, last, to_last=True),
    ]


def _whole(segment: Segment, buckets: range, summary: Summary, condition: Condition) -> Span:
    """Of buckets in all rows of which it held; without a value, rows are known by bucket only."""
    first_s, last_s = summary.first_sim_time_s, summary.last_sim_time_s
    start_s = max(segment.start_s, buckets.start * BUCKET_S) if first_s is None else first_s
    end_s = min(segment.end_s, buckets.stop * BUCKET_S) if last_s is None else last_s
    (key,) = condition.of_rows([summary.last])
    return Span(start_s, end_s, key, summary.min, summary.max, from_first=True, to_last=True)


def _bucket_of(segment: Segment, bucket: int) -> Segment:
    start_s = max(segment.start_s, bucket * BUCKET_S)
    return replace(segment, start_s=start_s, end_s=min(segment.end_s, (bucket + 1) * BUCKET_S))


def joined(pieces: Iterable[Sequence[Span] | None]) -> list[Span]:
    """The spans of pieces whose rows follow each other: what goes on across a border is one.

    What reaches a piece of which nothing is known ends, or begins, somewhere in it.
    """
    found: list[Span] = []
    goes_on = unknown = False
    for spans in pieces:
        more = list(spans or ())
        if spans is None and goes_on:
            found[-1] = replace(found[-1], within_s=BUCKET_S)
        elif unknown and more and more[0].from_first:
            more[0] = replace(more[0], within_s=BUCKET_S)
        elif goes_on and more and more[0].from_first and more[0].key == found[-1].key:
            more[0] = _as_one(found.pop(), more[0])
        found += more
        unknown, goes_on = spans is None, bool(more) and more[-1].to_last
    return found


def _as_one(before: Span, after: Span) -> Span:
    lows = [each for each in (before.low, after.low) if each is not None]
    highs = [each for each in (before.high, after.high) if each is not None]
    low, high = min(lows, default=None), max(highs, default=None)
    ends = (before.from_first, after.to_last)
    within_s = max(before.within_s, after.within_s)
    return Span(before.start_s, after.end_s, before.key, low, high, *ends, within_s)


def common(spans: Sequence[Span], others: Sequence[Span]) -> Iterator[Span]:
    """Where both hold."""
    for span in spans:
        for other in others:
            start, end = max(span, other, key=_start_of), min(span, other, key=_end_of)
            if start.start_s <= end.end_s:
                ends = (start.from_first, end.to_last)
                within_s = max(start.within_s, end.within_s)
                yield Span(start.start_s, end.end_s, span.key, span.low, span.high, *ends, within_s)


def _start_of(span: Span) -> float:
    return span.start_s


def _end_of(span: Span) -> float:
    return span.end_s
