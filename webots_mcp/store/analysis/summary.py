"""What a stretch of one signal comes to, and how two such stretches become one.

The same numbers stand in a row of the `rollup` table, in a bucket of `query_history` and in the
line of a signal list, so that a question over any stretch is a merge of parts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import compress, count, pairwise
from operator import attrgetter, mul, ne, sub
from typing import Any, Final, NamedTuple, cast

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, inner, np

_NUMBERS: Final = frozenset({int, float, bool})
LARGEST: Final = 1e100  # beyond it (a stray infinity, a huge integer) squares would overflow
COUNTS: Final = 3  # fields, the first ones of a summary, which are never None
NO_LENGTH: Final = 1e-9  # of a resultant vector that means no direction
LENGTH_DUST: Final = 1e-14  # what adding unit vectors leaves; less than 1.5e-7 rad
_INTEGERS: Final = 2**63  # SQLite takes no larger ones: they become floats


class Summary(NamedTuple):
    """Fields in the order of the rollup's columns; the numbers are None where there are none.

    Attributes:
        rows: State rows that held the signal; where rows were read as columns, all of them.
        present: Of them with a value; where there are usable numbers, with one of these.
        changes: Values unlike the one before, within the stretch.
        squares: Sum of squared deviations from the mean.
        sines: Sum of sines, of an angle in whatever unit.
        cosines: Sum of cosines, of an angle in whatever unit.
        largest_step: Largest difference between values that follow each other; None also where it
            is not known: in rollups of older versions.
        first_until_sim_time_s: Up to then it had its first value; not known as the largest step.
        last_since_sim_time_s: From then on it had its last value.
    """

    rows: int = 0
    present: int = 0
    changes: int = 0
    first: float | None = None
    first_sim_time_s: float | None = None
    last: float | None = None
    last_sim_time_s: float | None = None
    min: float | None = None
    min_sim_time_s: float | None = None
    max: float | None = None
    max_sim_time_s: float | None = None
    sum: float | None = None
    squares: float | None = None
    sines: float | None = None
    cosines: float | None = None
    largest_step: float | None = None
    first_until_sim_time_s: float | None = None
    last_since_sim_time_s: float | None = None

    @property
    def mean(self) -> float | None:
        """The arithmetic mean."""
        return None if self.sum is None else self.sum / self.present

    @property
    def direction(self) -> float | None:
        """The circular mean, of an angle, in radians."""
        if self.sines is None or self.cosines is None:
            return None
        return circular_mean(self.sines, self.cosines, self.present)

    def turn_of(self, turn: float | None) -> float | None:
        """A whole turn of the angle, if its circular figures are known; they are of newer rows."""
        return None if self.sines is None else turn

    def centre(self, turn: float | None) -> float | None:
        """The mean; of an angle the circular one, in its unit: below 0 only where its values are.

        Args:
            turn: A whole turn in its unit; None of what is no angle.
        """
        if turn is None or self.sines is None:
            return self.mean
        if (direction := self.direction) is None:
            return None
        centre = direction * turn / math.tau
        return centre + turn if centre < 0 <= (self.min or 0.0) else centre

    @property
    def deviation(self) -> float | None:
        """The standard deviation of the sample, with n - 1."""
        if self.squares is None or self.present < 2:
            return None
        return 0.0 if self.min == self.max else math.sqrt(self.squares / (self.present - 1))

    @property
    def circular_deviation(self) -> float | None:
        """Of an angle sqrt(-2 ln R) with the mean resultant length R, in radians.

        K. V. Mardia, P. E. Jupp, Directional Statistics (2000), section 2.3.1.
        """
        if self.sines is None or self.cosines is None or self.present < 2:
            return None
        length = math.hypot(self.sines, self.cosines) / self.present
        if length > 1 - LENGTH_DUST:
            return 0.0
        return math.sqrt(-2 * math.log(length)) if length > 0 else None

    def deviation_in(self, turn: float | None) -> float | None:
        """The standard deviation; of an angle the circular one, in its unit (see `centre`)."""
        if turn is None or self.sines is None:
            return self.deviation
        deviation = self.circular_deviation
        return None if deviation is None else deviation * turn / math.tau


def circular_mean(sines: float, cosines: float, count: int) -> float | None:
    """The direction of the resultant vector: atan2(sum of sines, sum of cosines).

    K. V. Mardia, P. E. Jupp, Directional Statistics (2000), section 2.2.1. None where the vectors
    cancel out, because then no direction is meant.
    """
    if count == 0 or math.hypot(sines, cosines) < NO_LENGTH * count:
        return None
    return math.atan2(sines, cosines)


def summarise(times: Sequence[float], values: Sequence[Value], *, angle: bool = False) -> Summary:
    """Summarise the values of one signal, given in order with their simulation times.

    The squares are summed in a second pass over the deviations from the mean (T. F. Chan, G. H.
    Golub, R. J. LeVeque, "Algorithms for computing the sample variance", The American
    Statistician 37, 1983): no cancellation where the mean is large. Of text, and of numbers that
    are all too large, only how many there are and the times.
    """
    rows = len(values)
    number_times, numbers = usable_numbers(times, values)
    if not numbers:
        return _without_numbers(times, values)
    total = math.fsum(numbers)
    mean = total / len(numbers)
    deviations = [number - mean for number in numbers]
    low, high = min(numbers), max(numbers)
    return Summary(
        rows,
        len(numbers),
        sum(map(ne, numbers, numbers[1:])),
        numbers[0],
        number_times[0],
        numbers[-1],
        number_times[-1],
        low,
        number_times[numbers.index(low)],
        high,
        number_times[numbers.index(high)],
        total,
        math.fsum(map(mul, deviations, deviations)),
        math.fsum(map(math.sin, numbers)) if angle else None,
        math.fsum(map(math.cos, numbers)) if angle else None,
        _largest_step(numbers) if low < high else 0.0,
        number_times[_rest(numbers) - 1],
        number_times[-_rest(numbers[::-1])],
    )


def _largest_step(numbers: Sequence[float]) -> float:
    steps = list(map(sub, numbers[1:], numbers))
    return float(max(max(steps), -min(steps)))


def _rest(numbers: Sequence[float]) -> int:
    """How many of the first ones are the same."""
    return next(compress(count(1), map(ne, numbers, numbers[1:])), len(numbers))


def summarise_numbers(
    times: Array, numbers: Array, *, rows: int | None = None, turn: float | None = None
) -> Summary:
    """The same of usable numbers in arrays, as `usable_part` gives them: faster where many.

    Args:
        times: Of the numbers.
        numbers: In order.
        rows: Of which so many held one; None for as many.
        turn: A whole turn of what is an angle, in its unit.
    """
    present = len(numbers)
    if not present:
        return Summary(rows or 0)
    angles = numbers * (math.tau / turn) if turn else None
    low, high = int(numbers.argmin()), int(numbers.argmax())
    total = float(numbers.sum())
    deviations, steps = numbers - total / present, np.diff(numbers)
    changes = np.flatnonzero(steps)
    return Summary(
        present if rows is None else rows,
        present,
        len(changes),
        *_at(times, numbers, 0),
        *_at(times, numbers, -1),
        *_at(times, numbers, low),
        *_at(times, numbers, high),
        total,
        inner(deviations, deviations),
        None if angles is None else float(np.sin(angles).sum()),
        None if angles is None else float(np.cos(angles).sum()),
        float(np.abs(steps).max(initial=0.0)),
        float(times[changes[0] if len(changes) else -1]),
        float(times[changes[-1] + 1 if len(changes) else 0]),
    )


def _at(times: Array, numbers: Array, index: int) -> tuple[float, float]:
    return float(numbers[index]), float(times[index])


def _without_numbers(times: Sequence[float], values: Sequence[Value]) -> Summary:
    held = [time for time, value in zip(times, values, strict=True) if _is_there(value)]
    if not held:
        return Summary(len(values))
    return Summary(len(values), len(held), first_sim_time_s=held[0], last_sim_time_s=held[-1])


def _is_there(value: Value) -> bool:
    """Whether it is a value, be it one that is not reckoned with; NaN is none."""
    return value is not None and value == value


def usable_numbers(
    times: Sequence[float], values: Sequence[Value]
) -> tuple[Sequence[float], Sequence[float]]:
    """The usable numbers among the values, with their times; not copied where all are usable.

    Not usable are null, text, NaN, and what is larger than 1e100.
    """
    if _NUMBERS.issuperset(map(type, values)) and _usable(cast("Sequence[float]", values)):
        return times, cast("Sequence[float]", values)
    pairs = [
        (time, float(cast("float", value)))
        for time, value in zip(times, values, strict=True)
        if type(value) in _NUMBERS and -LARGEST <= cast("float", value) <= LARGEST
    ]
    return [time for time, _ in pairs], [value for _, value in pairs]


def usable_part(times: Array, numbers: Array) -> tuple[Array, Array]:
    """The usable ones of numbers that may be NaN, with their times."""
    usable = np.abs(numbers) <= LARGEST
    return (times, numbers) if usable.all() else (times[usable], numbers[usable])


def aligned_numbers(values: Sequence[Value]) -> Array:
    """One number per value; NaN where it is none, infinite where it is too large for one."""
    try:
        return np.array(values, np.float64)  # null becomes NaN
    except (OverflowError, TypeError, ValueError):
        return np.array([_number(value) for value in values], np.float64)


def _number(value: Value) -> float:
    if type(value) not in _NUMBERS:
        return math.nan
    try:
        return float(cast("float", value))
    except OverflowError:
        return math.inf


def _usable(numbers: Sequence[float]) -> bool:
    """All at once: a NaN would show in the sum, and hide in the extremes."""
    if not numbers or not min(numbers) > -_INTEGERS or not max(numbers) < _INTEGERS:
        return False
    return math.isfinite(sum(numbers))


def merge(parts: Sequence[Summary]) -> Summary:
    """One summary of stretches that follow each other, in order.

    Counts, extremes, first and last are exact; the squares are combined by the formula of Chan,
    Golub and LeVeque (see `summarise`): each part's own plus count * (its mean - the mean) ** 2.
    """
    if len(parts) == 1:
        return parts[0]
    rows = sum(part.rows for part in parts)
    filled = [part for part in parts if part.sum is not None]
    if not filled:
        return _merged_without_numbers(rows, [part for part in parts if part.present])
    present = sum(part.present for part in filled)
    total = math.fsum(_column(filled, "sum"))
    low = min(filled, key=attrgetter("min"))
    high = max(filled, key=attrgetter("max"))
    first, last = filled[0], filled[-1]
    return Summary(
        rows,
        present,
        sum(part.changes for part in filled) + sum(a.last != b.first for a, b in pairwise(filled)),
        first.first,
        first.first_sim_time_s,
        last.last,
        last.last_sim_time_s,
        low.min,
        low.min_sim_time_s,
        high.max,
        high.max_sim_time_s,
        total,
        _merged_squares(filled, total / present),
        _sum_where_angle(filled, "sines"),
        _sum_where_angle(filled, "cosines"),
        *_merged_steps(filled),
    )


def with_extremes(whole: Summary, recorded: Summary) -> Summary:
    """A summary whose extremes are also those of values that it does not count.

    Where it has no value of its own, those are all there is.
    """
    if recorded.min is None or recorded.max is None:
        return whole
    if whole.min is None or whole.max is None:
        return recorded._replace(rows=max(whole.rows, recorded.rows))
    low, high = (
        min(whole, recorded, key=attrgetter("min")),
        max(whole, recorded, key=attrgetter("max")),
    )
    return whole._replace(
        min=low.min,
        min_sim_time_s=low.min_sim_time_s,
        max=high.max,
        max_sim_time_s=high.max_sim_time_s,
    )


def _merged_without_numbers(rows: int, held: Sequence[Summary]) -> Summary:
    if not held:
        return Summary(rows)
    first_s, last_s = held[0].first_sim_time_s, held[-1].last_sim_time_s
    present = sum(part.present for part in held)
    return Summary(rows, present, first_sim_time_s=first_s, last_sim_time_s=last_s)


def _merged_squares(parts: Sequence[Any], mean: float) -> float:
    shifts = [part.sum / part.present - mean for part in parts]
    return math.fsum(
        part.squares + part.present * shift * shift
        for part, shift in zip(parts, shifts, strict=True)
    )


def _merged_steps(parts: Sequence[Any]) -> tuple[float | None, float | None, float | None]:
    """The largest step, and until and since when the first and the last value were there.

    Not known where they are not of a part, or where values of one part lie within another.
    """
    borders = list(pairwise(parts))
    largest: list[Any] = _column(parts, "largest_step")
    if None in largest or any(a.last_sim_time_s > b.first_sim_time_s for a, b in borders):
        return None, None, None
    largest += [abs(b.first - a.last) for a, b in borders]
    if parts[0].first_until_sim_time_s is None or None in _column(parts, "last_since_sim_time_s"):
        return max(largest), None, None
    until_s, since_s = parts[0].first_until_sim_time_s, parts[-1].last_since_sim_time_s
    for before, after in borders:
        if before.min != before.max or before.last != after.first:
            break
        until_s = after.first_until_sim_time_s
    for before, after in reversed(borders):
        if after.min != after.max or before.last != after.first:
            break
        since_s = before.last_since_sim_time_s
    return max(largest), until_s, since_s


def _sum_where_angle(parts: Sequence[Summary], field: str) -> float | None:
    sums = _column(parts, field)
    return None if None in sums else math.fsum(sums)


def _column(parts: Sequence[Summary], field: str) -> list[Any]:
    return list(map(attrgetter(field), parts))
