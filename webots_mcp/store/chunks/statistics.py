"""What the numbers of one signal in one chunk come to, so that a reader can leave it closed."""

from __future__ import annotations

from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import inner, np
from webots_mcp.store.chunks.codec import FIRST_LABEL, IS_ABSENT, Decoded

LARGEST: Final = 1e100  # beyond it (a stray infinity, a huge integer) squares would overflow


class Statistics(NamedTuple):
    """Columns of the table `chunk`; None where there is no number, as of texts.

    Attributes:
        row_count: Rows whose state has the signal.
        value_count: Of them with a value that is not null; of numbers, with a usable one: not NaN,
            and not beyond 1e100.
        change_count: Values unlike the one before.
        squared_deviations: Sum of squared deviations from the mean.
        largest_step: Largest difference of values that follow each other; 0 of a single one.
    """

    row_count: int
    value_count: int
    change_count: int = 0
    first: float | None = None
    last: float | None = None
    min: float | None = None
    max: float | None = None
    sum: float | None = None
    squared_deviations: float | None = None
    largest_step: float | None = None


def statistics_of(values: Decoded) -> Statistics:
    """What the values of one signal in some rows come to."""
    rows = len(values.numbers)
    if values.codes is not None:
        rows -= int(np.count_nonzero(values.codes == IS_ABSENT))
    usable = np.abs(values.numbers) <= LARGEST
    numbers = values.numbers if usable.all() else values.numbers[usable]
    if not len(numbers):
        return _without_numbers(values, rows)
    mean = float(numbers.sum()) / len(numbers)
    deviations, steps = numbers - mean, np.diff(numbers)
    return Statistics(
        rows,
        len(numbers),
        int(np.count_nonzero(steps)),
        float(numbers[0]),
        float(numbers[-1]),
        float(numbers.min()),
        float(numbers.max()),
        float(numbers.sum()),
        inner(deviations, deviations),
        float(np.abs(steps).max(initial=0.0)),
    )


def _without_numbers(values: Decoded, rows: int) -> Statistics:
    """Of texts: how many there are, and how often they change."""
    if values.codes is None:
        return Statistics(rows, 0)
    texts = [
        code for code, label in enumerate(values.labels, FIRST_LABEL) if isinstance(label, str)
    ]
    codes = values.codes[np.isin(values.codes, texts)]
    return Statistics(rows, len(codes), int(np.count_nonzero(np.diff(codes))))
