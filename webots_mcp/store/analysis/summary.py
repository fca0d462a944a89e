"""What a stretch of one signal comes to: the line of a list, the whole of a history or a trend."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, inner, np

LARGEST: Final = 1e100  # beyond it (a stray infinity, a huge integer) squares would overflow
NO_LENGTH: Final = 1e-9  # of a resultant vector that means no direction
_LENGTH_DUST: Final = 1e-14  # what adding unit vectors leaves; less than 1.5e-7 rad


class Summary(NamedTuple):
    """Counts of the values, and figures of the numbers, which are None where there are none.

    Attributes:
        rows: State rows that were looked at.
        present: Of them with a usable number.
        changes: Values unlike the one before.
        squares: Sum of squared deviations from the mean.
        sines: Sum of sines, of an angle in whatever unit.
        cosines: Sum of cosines, of an angle in whatever unit.
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

    @property
    def mean(self) -> float | None:
        """The arithmetic mean."""
        return None if self.sum is None else self.sum / self.present

    def centre(self, turn: float | None) -> float | None:
        """The mean; of an angle the circular one, in its unit: below 0 only where its values are.

        It is the direction of the resultant vector (K. V. Mardia, P. E. Jupp, Directional
        Statistics, 2000, section 2.2.1); None where the vectors cancel out.

        Args:
            turn: A whole turn in its unit; None of what is no angle.
        """
        if turn is None or self.sines is None or self.cosines is None:
            return self.mean
        if math.hypot(self.sines, self.cosines) < NO_LENGTH * self.present:
            return None
        centre = math.atan2(self.sines, self.cosines) * turn / math.tau
        return centre + turn if centre < 0 <= (self.min or 0.0) else centre

    @property
    def deviation(self) -> float | None:
        """The standard deviation of the sample, with n - 1."""
        if self.squares is None or self.present < 2:
            return None
        return 0.0 if self.min == self.max else math.sqrt(self.squares / (self.present - 1))

    def deviation_in(self, turn: float | None) -> float | None:
        """The standard deviation; of an angle the circular one, in its unit (see `centre`).

        That is sqrt(-2 ln R) with the mean resultant length R (Mardia and Jupp, section 2.3.1).
        """
        if turn is None or self.sines is None or self.cosines is None:
            return self.deviation
        length = math.hypot(self.sines, self.cosines) / max(1, self.present)
        if self.present < 2 or not length:
            return None
        return (
            0.0 if length > 1 - _LENGTH_DUST else math.sqrt(-2 * math.log(length)) * turn / math.tau
        )


def summarise_numbers(
    times: Array, numbers: Array, *, rows: int | None = None, turn: float | None = None
) -> Summary:
    """Summarise usable numbers, as `usable_part` gives them, in order.

    The squares are summed in a second pass over the deviations from the mean (T. F. Chan, G. H.
    Golub, R. J. LeVeque, "Algorithms for computing the sample variance", The American
    Statistician 37, 1983): no cancellation where the mean is large.

    Args:
        times: Of the numbers.
        numbers: In order.
        rows: Of which so many held one; None for as many.
        turn: A whole turn of what is an angle, in its unit.
    """
    present = len(numbers)
    if not present:
        return Summary(rows or 0)
    total = float(numbers.sum())
    deviations = numbers - total / present
    angles = numbers * (math.tau / turn) if turn else None
    ends = {"first": 0, "last": -1, "min": numbers.argmin(), "max": numbers.argmax()}
    figures = {name: float(numbers[at]) for name, at in ends.items()}
    figures |= {f"{name}_sim_time_s": float(times[at]) for name, at in ends.items()}
    return Summary(
        present if rows is None else rows,
        present,
        int(np.count_nonzero(np.diff(numbers))),
        sum=total,
        squares=inner(deviations, deviations),
        sines=None if angles is None else float(np.sin(angles).sum()),
        cosines=None if angles is None else float(np.cos(angles).sum()),
        **figures,
    )


def with_extremes(whole: Summary, recorded: Summary) -> Summary:
    """A summary whose extremes are also those of values that it does not count.

    Where it has no value of its own, those are all there is.
    """
    if recorded.min is None or recorded.max is None:
        return whole
    if whole.min is None or whole.max is None:
        return recorded._replace(rows=max(whole.rows, recorded.rows))
    low = recorded if recorded.min < whole.min else whole
    high = recorded if recorded.max > whole.max else whole
    return with_extremes_of(with_extremes_of(whole, low, high=False), high, low=False)


def with_extremes_of(
    whole: Summary, other: Summary, *, low: bool = True, high: bool = True
) -> Summary:
    """With the least, the greatest or both values of another."""
    if low:
        whole = whole._replace(min=other.min, min_sim_time_s=other.min_sim_time_s)
    if high:
        whole = whole._replace(max=other.max, max_sim_time_s=other.max_sim_time_s)
    return whole


def usable_part(times: Array, numbers: Array) -> tuple[Array, Array]:
    """The usable ones of numbers that may be NaN, with their times."""
    usable = np.abs(numbers) <= LARGEST
    return (times, numbers) if usable.all() else (times[usable], numbers[usable])
