"""What is aimed at, and which figures miss it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from tests.judging.detection.judging import Tally, median, nine_in_ten
from tests.judging.detection.measuring import Key

LEAST_SHARE: Final = 0.98  # recall and precision
LEAST_SHARE_NOISY: Final = 0.95  # beyond 10 mm of noise
MOST_FALSE_PER_HOUR: Final = 1.0  # where nothing happened
# The median, of standstills, up to 10 mm of noise. Who comes slowly to a place has no begin that
# any estimate tells to two rows: then it is 1.5 times the median error of the best one, since the
# median of a dozen errors scatters by a third.
MOST_BEGIN_ROWS: Final = 2.0
MOST_OF_BEST: Final = 1.5
MEDIAN_ERROR: Final = 0.6745  # of a normal variable, as a share of its standard deviation
MOST_PERIOD_ERROR: Final = 0.05  # nine in ten
MOST_AMPLITUDE_ERROR: Final = 0.1


def missed_goals(key: Key, tally: Tally) -> list[str]:
    """The names of the figures that do not reach their goals."""
    return list(_missed(key, tally))


def _missed(key: Key, tally: Tally) -> Iterator[str]:
    _, measure, condition = key
    is_noisy = "to 30 mm" in condition
    least = LEAST_SHARE_NOISY if is_noisy else LEAST_SHARE
    if (tally.recall if tally.recall is not None else 1.0) < least:
        yield "recall"
    if not tally.incidents:
        if tally.false > MOST_FALSE_PER_HOUR * tally.minutes / 60:
            yield "precision"
    elif (tally.precision if tally.precision is not None else 1.0) < least:
        yield "precision"
    is_exact = measure == "standstill" and not is_noisy
    if is_exact and (median(tally.begin_errors) or 0.0) > _begin_rows(tally):
        yield "begin"
    if (nine_in_ten(tally.period_errors) or 0.0) > MOST_PERIOD_ERROR:
        yield "period"
    if (nine_in_ten(tally.amplitude_errors) or 0.0) > MOST_AMPLITUDE_ERROR:
        yield "amplitude"


def _begin_rows(tally: Tally) -> float:
    """How many rows a begin may be off: two, or what the noise allows."""
    best = MEDIAN_ERROR * (median(tally.least_begin_errors) or 0.0)
    return max(MOST_BEGIN_ROWS, MOST_OF_BEST * best)
