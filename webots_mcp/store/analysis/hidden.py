"""Motion that the noise of a position hides: bends narrower than a leg of its track."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, median, np

_BLOCK_S: Final = 0.5  # positions are averaged over this long
_FAR: Final = 3  # blocks between the places of a long step
_BRAKING_BLOCKS: Final = 2  # at the end of a leg, in which a robot that stood may have left
_FEWEST_BLOCKS: Final = _FAR + _BRAKING_BLOCKS + 1
# A turn of 1.5 rad/s, which steps of 0.5 to 1.5 s cut by about so much.
_CUT: Final = 1.1
# Standard errors of the mean square speed. It is positive without motion in one of 15 cases where
# 1.5 are taken off; 1 of them makes up for a speed that varies, whose root mean square is more
# than its mean. Beyond 2 it is in one of 44.
_SHOWN: Final = 1.5
_TAKEN_OFF: Final = 1.0
_MOST: Final = 2.0


class HiddenMotion(NamedTuple):
    """How far a robot went within legs that take long.

    Attributes:
        legs: Which of the legs take long.
        least_m: Metres that the steps within them show; 0 where they could be noise.
        most_m: Metres that can hardly be exceeded.
    """

    legs: list[int]
    least_m: float
    most_m: float


def hidden_motion(times: Array, x: Array, y: Array, ends: Sequence[int]) -> HiddenMotion:
    """Tell from the mean square of steps how far a robot went within slow legs.

    Whether it stood, crept or circled there does not show in single places. But noise makes long
    steps no longer than short ones, and motion does: the difference of their mean squares is that
    of the speed, whatever the noise is (A. N. Kolmogorov's structure function).

    Args:
        times: Seconds, without a gap.
        x: Metres as recorded, not smoothed; and so is `y`.
        y: As many.
        ends: The rows in which legs begin, and the end of the last one.
    """
    interval_s = median(np.diff(times))
    rows = max(1, round(_BLOCK_S / interval_s))
    blocks = np.diff(ends) // rows
    slow: list[int] = np.flatnonzero(blocks >= _FEWEST_BLOCKS).tolist()
    if not slow:
        return HiddenMotion([], 0.0, 0.0)
    cuts = [slice(ends[leg], ends[leg] + (blocks[leg] - _BRAKING_BLOCKS) * rows) for leg in slow]
    square, error = _mean_square_step([_means(x[cut], y[cut], rows) for cut in cuts])
    took_s = sum(ends[leg + 1] - ends[leg] for leg in slow) * interval_s
    per_step = _CUT * took_s / (rows * interval_s)
    least = square - _TAKEN_OFF * error if square > _SHOWN * error else 0.0
    most = max(0.0, square + _MOST * error)
    return HiddenMotion(slow, per_step * sqrt(least), per_step * sqrt(most))


def _means(x: Array, y: Array, rows: int) -> Array:
    """X and y, averaged over so many rows each."""
    return np.mean(np.reshape(np.stack((x, y)), (2, -1, rows)), axis=2)


def _mean_square_step(legs: Sequence[Array]) -> tuple[float, float]:
    """Of a step from block to block without the noise, and its standard error.

    Steps of k blocks share k of them with their neighbours.
    """
    near, far = (
        np.concatenate([np.sum((leg[:, k:] - leg[:, :-k]) ** 2, axis=0) for leg in legs])
        for k in (1, _FAR)
    )
    square = float(far.mean() - near.mean()) / (_FAR**2 - 1)
    error = sqrt(_FAR * far.var() / len(far) + 2 * near.var() / len(near)) / (_FAR**2 - 1)
    return square, error
