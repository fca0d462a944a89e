"""Where the level of some values changes for good."""

from __future__ import annotations

import math
from typing import Final

from webots_mcp.analysis.arrays import Array, np

FEWEST_VALUES: Final = 5  # on each side of a change


def level_changes(values: Array, false_alarms: float) -> list[int]:
    """Return the places at which the level of values changes, in order.

    At the place where the rank sums of both sides differ most (A. N. Pettitt, A non-parametric
    approach to the change-point problem, Applied Statistics 28, 1979) they are divided, then each
    side again. Single values that stand out, and a skewed distribution, divide nothing.

    Args:
        values: In order of time. They may have any distribution, and should be independent.
        false_alarms: How often at most values of one level are divided.
    """
    found: list[int] = []
    waiting = [(0, len(values))]
    while waiting:
        start, stop = waiting.pop()
        place = _change_in(values[start:stop], false_alarms)
        if place:
            found.append(start + place)
            waiting += [(start, start + place), (start + place, stop)]
    return sorted(found)


def _change_in(values: Array, false_alarms: float) -> int:
    """The place of the one change that shows most; 0 where none is significant."""
    count = len(values)
    if count < 2 * FEWEST_VALUES:
        return 0
    ranks = _ranks(values)
    before = np.arange(1, count)
    sums = np.cumsum(ranks)[:-1] - before * (count + 1) / 2
    variance = float(np.var(ranks)) * before * (count - before) / max(1, count - 1)
    scores = np.abs(sums) / np.sqrt(np.maximum(variance, 1e-12))
    scores[: FEWEST_VALUES - 1] = scores[count - FEWEST_VALUES :] = 0.0
    place = int(scores.argmax())
    chance = math.erfc(float(scores[place]) / math.sqrt(2)) * count  # of any place
    return place + 1 if chance < false_alarms else 0


def _ranks(values: Array) -> Array:
    """Ranks from 1; equal values share the mean of theirs."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return np.asarray((ends - (counts - 1) / 2)[places], np.float64)
