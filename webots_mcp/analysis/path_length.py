"""The way of a robot: its positions without most of their noise, and how long that way is.

Bends narrower than a leg of it are hidden by the noise: how far they went shows in long steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from math import log, sqrt
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import (
    LONGEST_DROPOUT_S,
    Array,
    Indexes,
    find_gaps,
    median,
    noise_of,
    np,
)

_PLACES: Final = ("x", "y", "raw_x", "raw_y")


class _SmoothingSettings(NamedTuple):
    """How positions are smoothed, and when a leg of the path is one."""

    false_legs: float = 0.003  # mean number that noise alone makes for a robot at rest
    gap_noise: float = 7.0  # standard deviations of the position that count as motion during a gap
    finest_leg_m: float = 0.02  # no more smoothing is needed once legs are this short
    sharpest_arc_rad: float = 2.7  # from leg to leg; who turns farther went back
    longest_smoothing_s: float = 1.2  # a turn of 1.5 rad/s is cut by 0.7 % then, by 5 % in 2 s
    parabola_gain: float = 2.25  # the variance that a parabola over n rows leaves is 2.25 / n of it
    fewest_smoothed: int = 5  # rows: through fewer a parabola leaves the noise


SMOOTHING: Final = _SmoothingSettings()


class _LongStepSettings(NamedTuple):
    """How long steps show what narrow bends hide."""

    block_s: float = 0.5  # positions are averaged over this long
    far: int = 3  # blocks between the places of a long step
    braking_blocks: int = 2  # at the end of a leg, in which a robot that stood may have left
    fewest_blocks: int = far + braking_blocks + 1
    # A turn of 1.5 rad/s, which steps of 0.5 to 1.5 s cut by about so much.
    cut: float = 1.1
    # Standard errors of the mean square speed. It is positive without motion in one of 15 cases
    # where 1.5 are taken off; 1 of them makes up for a speed that varies, whose root mean square
    # is more than its mean. Beyond 2 it is in one of 44.
    shown: float = 1.5
    taken_off: float = 1.0
    most: float = 2.0


LONG_STEPS: Final = _LongStepSettings()


@dataclass(frozen=True)
class SmoothedTrack:
    """Positions in one stretch without recording gaps, in metres.

    Attributes:
        x: Smoothed; `raw_x` as recorded, and so for y.
        noise_m: Standard deviation of the noise in each of x and y, estimated from the positions.
        left_m: What smoothing left of it.
        smoothed_rows: Over how many rows was smoothed; 1 where there was nothing to smooth.
    """

    times: Array
    x: Array
    y: Array
    raw_x: Array
    raw_y: Array
    noise_m: float
    left_m: float
    smoothed_rows: int

    @property
    def reversed(self) -> SmoothedTrack:
        """The same way, gone backwards in time."""
        places = {name: getattr(self, name)[::-1] for name in _PLACES}
        return replace(self, times=-self.times[::-1], **places)

    def part(self, start: int, stop: int) -> SmoothedTrack:
        """Some of its rows."""
        columns = {name: getattr(self, name)[start:stop] for name in ("times", *_PLACES)}
        return replace(self, **columns)


def track_of(
    times: Array, x: Array, y: Array, noise_m: float | None = None, of_rows: int | None = None
) -> SmoothedTrack:
    """Estimate the noise of a position and smooth it by no more than that asks for.

    Args:
        times: Seconds; they do not fall.
        x: Metres, finite, and so is `y`.
        y: As many.
        noise_m: Where it is known from other rows.
        of_rows: How many rows there are in all, where these are some of them: with both, a part of
            a way is smoothed as the whole is.
    """
    noise_m = position_noise_m(x, y) if noise_m is None else noise_m
    rows = _smoothing_rows(times, noise_m, of_rows or len(times))
    (smooth_x, gain), (smooth_y, _) = smooth(x, rows), smooth(y, rows)
    return SmoothedTrack(times, smooth_x, smooth_y, x, y, noise_m, noise_m * gain, rows)


def position_noise_m(x: Array, y: Array) -> float:
    """Standard deviation of the noise in each coordinate."""
    return float(np.hypot(noise_of(x), noise_of(y)) / np.sqrt(2))


def tracks_of(
    times: Array, x: Array, y: Array, noise_m: float | None = None, of_rows: int | None = None
) -> list[SmoothedTrack]:
    """One track per stretch without a gap.

    A gap is an interval in which rows are missing (see `find_gaps`) and that is longer than a short
    dropout: what happened in it is unknown. The noise is that of the longest stretch, unless it is
    given.
    """
    gaps = find_gaps(times)
    ends_s = [gap.end_s for gap in gaps if gap.end_s - gap.start_s > LONGEST_DROPOUT_S]
    cuts = np.unique(np.searchsorted(times, ends_s))
    edges = [0, *cuts.tolist(), len(times)]
    parts = [slice(start, end) for start, end in pairwise(edges) if end > start]
    if noise_m is None and parts:
        longest = max(parts, key=lambda part: part.stop - part.start)
        noise_m = position_noise_m(x[longest], y[longest])
    return [track_of(times[part], x[part], y[part], noise_m, of_rows) for part in parts]


def _smoothing_rows(times: Array, noise_m: float, of_rows: int) -> int:
    interval_s = median(np.diff(times)) if len(times) > 1 else 0.0
    if noise_m == 0 or interval_s <= 0:
        return 1
    wanted = (
        SMOOTHING.parabola_gain * (_leg_noise(of_rows, 1) * noise_m / SMOOTHING.finest_leg_m) ** 2
    )
    most = max(SMOOTHING.fewest_smoothed, SMOOTHING.longest_smoothing_s / interval_s)
    return 2 * int(min(wanted, most) / 2) + 1


def _leg_noise(rows: int, smoothed_rows: int) -> float:
    """How many deviations of the smoothed position a leg is longer than.

    Of two places that differ by noise alone the distance is above d deviations with a probability
    of exp(-d**2 / 4) (Rayleigh); the more independent places there are, the more pairs are.
    """
    places = rows * min(1.0, SMOOTHING.parabola_gain / smoothed_rows)
    return sqrt(4 * log(max(places, 2.0) / SMOOTHING.false_legs))


@dataclass(frozen=True)
class PathLength:
    """How long a way is.

    Attributes:
        longer_m: By how much the way may be longer, because of bends that its noise hides and of
            where it ended.
        noise_m: Standard deviation of the noise in each coordinate.
    """

    length_m: float
    longer_m: float
    noise_m: float


def path_length(track: SmoothedTrack) -> PathLength:
    """Metres travelled: the sum of legs that are longer than noise makes them.

    From row to row a noise of 1 cm would add up to metres while the robot stands still. A leg ends
    where the smoothed position is 6.6 (of 200 independent places) to 8.9 (of a million) standard
    deviations of what is left of the noise away from where it began; within half a window of an
    end, where more is left, of that. What is shorter at the end is left out. Bends that are
    narrower than a leg are in none: what the steps within legs that take long tell of them is
    added, and how much more they may be is said. Of a robot that made no leg nothing is reported.
    """
    corners = _corners(track)
    shortest_m = _leg_noise(len(track.times), track.smoothed_rows) * track.left_m
    legs_m = np.append(_leg_lengths(track, corners), 0.0)  # the last one, which is left out
    length_m = float(legs_m.sum())
    if len(corners) < 2 or track.noise_m == 0:
        return PathLength(length_m, shortest_m, track.noise_m)
    ends = [*corners.tolist(), len(track.times)]
    slow, *hidden_m = hidden_motion(track.times, track.raw_x, track.raw_y, ends)
    counted_m = float(legs_m[slow].sum())
    least_m, most_m = (max(0.0, each - counted_m) for each in hidden_m)
    return PathLength(length_m + least_m, max(shortest_m, most_m - least_m), track.noise_m)


def _leg_lengths(track: SmoothedTrack, corners: Indexes) -> Array:
    """How long the ways from corner to corner are.

    Across its direction what is left of the noise makes a leg longer (along it the next one makes
    up for it), which is taken off again; and the way is longer than a leg by as much as an arc is,
    that turns from one leg to the next as they do.
    """
    along, across = np.diff(track.x[corners]), np.diff(track.y[corners])
    alike = kept_alike(track.smoothed_rows)
    alike = alike[np.minimum(np.diff(corners), len(alike) - 1)]
    legs_m = np.sqrt(along**2 + across**2 - 2 * (1 - alike) * track.left_m**2)
    if len(legs_m) < 2:
        return legs_m
    turns = np.pad(np.angle(np.exp(1j * np.diff(np.arctan2(across, along)))), 1)
    turns[np.abs(turns) > SMOOTHING.sharpest_arc_rad] = 0.0
    arcs = (turns[:-1] + turns[1:]) / 2
    return legs_m / np.sinc(arcs / (2 * np.pi))


def _corners(track: SmoothedTrack) -> Indexes:
    """The rows in which one leg ends and the next begins."""
    variance = variance_along(len(track.times), track.smoothed_rows)
    shortest_m2 = (_leg_noise(len(variance), track.smoothed_rows) * track.left_m) ** 2 / 2
    away_m2 = (track.x - track.x[:1]) ** 2 + (track.y - track.y[:1]) ** 2
    first = np.flatnonzero(away_m2 > shortest_m2 * (variance + variance[:1]))[:1]
    corners: list[int] = [0] if len(variance) else []
    from_x = from_y = np.inf
    going = slice(int(first[0]), None) if len(first) else slice(0, 0)
    limits = shortest_m2 * (variance + 1)
    places = zip(*(each[going].tolist() for each in (track.x, track.y, limits)), strict=True)
    for row, (x, y, limit) in enumerate(places, going.start):
        if (x - from_x) ** 2 + (y - from_y) ** 2 > limit:
            corners.append(row)
            from_x, from_y = x, y
    return np.array(corners, np.intp)


def travelled(tracks: list[SmoothedTrack]) -> PathLength:
    """Metres travelled along stretches one after the other, with the straight ways between them.

    How far it went in a recording gap is not known; it is at least the straight way.
    """
    across_m = [
        float(np.hypot(after.x[0] - before.x[-1], after.y[0] - before.y[-1]))
        for before, after in pairwise(tracks)
    ]
    noise_m = max((track.noise_m for track in tracks), default=0.0)
    parts = [path_length(track) for track in tracks]
    between_m = sum(way_m for way_m in across_m if way_m > SMOOTHING.gap_noise * noise_m)
    length_m = between_m + sum(part.length_m for part in parts)
    return PathLength(length_m, sum(part.longer_m for part in parts), noise_m)


def hidden_motion(
    times: Array, x: Array, y: Array, ends: Sequence[int]
) -> tuple[list[int], float, float]:
    """Tell from the mean square of steps how far a robot went within legs that take long.

    Which legs these are; metres that the steps within them show, 0 where they could be noise; and
    metres that can hardly be exceeded.

    Whether it stood, crept or circled there does not show in single places. But noise makes long
    steps no longer than short ones, and motion does: the difference of their mean squares is that
    of the speed, whatever the noise is (A. N. Kolmogorov's structure function).

    Args:
        times: Seconds, without a gap.
        x: Metres as recorded, not smoothed; and so is `y`.
        y: As many.
        ends: The rows in which legs begin, and the end of the last one.
    """
    interval_s = median(np.diff(times)) or float(times[-1] - times[0]) / (len(times) - 1)
    if interval_s <= 0:  # no time passed in which it could have moved
        return [], 0.0, 0.0
    rows = max(1, round(LONG_STEPS.block_s / interval_s))
    blocks = np.diff(ends) // rows
    slow: list[int] = np.flatnonzero(blocks >= LONG_STEPS.fewest_blocks).tolist()
    if not slow:
        return [], 0.0, 0.0
    cuts = [
        slice(ends[leg], ends[leg] + (blocks[leg] - LONG_STEPS.braking_blocks) * rows)
        for leg in slow
    ]
    square, error = _mean_square_step([_means(x[cut], y[cut], rows) for cut in cuts])
    took_s = sum(ends[leg + 1] - ends[leg] for leg in slow) * interval_s
    per_step = LONG_STEPS.cut * took_s / (rows * interval_s)
    least = square - LONG_STEPS.taken_off * error if square > LONG_STEPS.shown * error else 0.0
    most = max(0.0, square + LONG_STEPS.most * error)
    return slow, per_step * sqrt(least), per_step * sqrt(most)


def _means(x: Array, y: Array, rows: int) -> Array:
    """X and y, averaged over so many rows each."""
    return np.mean(np.reshape(np.stack((x, y)), (2, -1, rows)), axis=2)


def _mean_square_step(legs: Sequence[Array]) -> tuple[float, float]:
    """Of a step from block to block without the noise, and its standard error.

    Steps of k blocks share k of them with their neighbours.
    """
    near, far = (
        np.concatenate([np.sum((leg[:, k:] - leg[:, :-k]) ** 2, axis=0) for leg in legs])
        for k in (1, LONG_STEPS.far)
    )
    square = float(far.mean() - near.mean()) / (LONG_STEPS.far**2 - 1)
    error = sqrt(LONG_STEPS.far * far.var() / len(far) + 2 * near.var() / len(near)) / (
        LONG_STEPS.far**2 - 1
    )
    return square, error


def smooth(values: Array, rows: int) -> tuple[Array, float]:
    """Values without most of their noise, and the share of its standard deviation that is left.

    A parabola of least squares through an odd number of rows about each (A. Savitzky, M. Golay,
    Smoothing and differentiation of data by simplified least squares procedures, Analytical
    Chemistry 36, 1964): a bend that is long compared to the window is kept. At the ends the
    parabola through the first or last window is taken.
    """
    rows = min(rows, len(values) - 1 + len(values) % 2)
    if rows < SMOOTHING.fewest_smoothed:
        return values, 1.0
    fit, half = _parabola(rows), rows // 2
    smoothed = np.asarray(np.convolve(values, fit[half, ::-1], "same"), np.float64)
    smoothed[:half] = (fit @ values[:rows])[:half]
    smoothed[-half:] = (fit @ values[-rows:])[-half:]
    return smoothed, float(np.sqrt(fit[half] @ fit[half]))


def variance_along(count: int, rows: int) -> Array:
    """Of the noise in each of so many smoothed values, as a ratio to that of those in the middle.

    The parabola is less certain at the ends: there it is up to four times as much.
    """
    variance, rows = np.ones(count), min(rows, count - 1 + count % 2)
    if rows >= SMOOTHING.fewest_smoothed:
        fit, half = _parabola(rows), rows // 2
        ratios = np.einsum("ij,ij->i", fit, fit) / (fit[half] @ fit[half])
        variance[:half], variance[-half:] = ratios[:half], ratios[-half:]
    return variance


def kept_alike(rows: int) -> Array:
    """Correlation of the noise in two smoothed values that lie 0, 1, 2, ... rows apart.

    The last one, 0, holds for all that lie farther apart.
    """
    if rows < SMOOTHING.fewest_smoothed:
        return np.array([1.0, 0.0])
    middle = _parabola(rows)[rows // 2]
    alike = np.correlate(middle, middle, "full")[rows - 1 :]
    return np.append(alike / alike[0], 0.0)


@lru_cache(8)  # the runs of a robot mostly have the same rate of rows
def _parabola(rows: int) -> Array:
    """The matrix that turns so many values into those of the parabola of least squares."""
    place = np.arange(rows, dtype=np.float64) - rows // 2
    basis: Array = np.stack((place**2, place, np.ones(rows)), axis=1)
    return np.asarray(basis @ np.linalg.pinv(basis), np.float64)
