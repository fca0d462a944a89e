"""Whether a signal that holds one value is frozen, or one that rests by nature."""

from __future__ import annotations

from typing import Final

from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.noise import noise_of

FEWEST_ROWS: Final = 50  # with one value: by chance a noisy signal never comes to so many
MOST_REPEATED: Final = 0.02  # of the other rows that repeat the value before: noise hardly does
LEAST_NOISE: Final = 0.3  # of the usual step: the steps of noise alone are as large as it is


def is_noisy(values: Array) -> bool:
    """Whether it changes by noise in about every row: then one that repeats itself is frozen.

    A smooth course, such as the exact position of a simulated robot, rests when the robot does.
    """
    steps = np.abs(np.diff(values))
    if len(steps) < 2 * FEWEST_ROWS or np.mean(steps == 0) > MOST_REPEATED:
        return False
    return noise_of(values) >= LEAST_NOISE * float(np.median(steps))


def may_be_measured(values: Array, held: float) -> bool:
    """Whether a value that is held is one of many that are measured.

    The lowest or the highest of all is where a sensor ends, and 0 is what does nothing gives.
    """
    return bool(held != 0 and values.min() < held < values.max())
