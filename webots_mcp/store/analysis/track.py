"""The way of a robot: its positions without most of their noise, and how long that way is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import log, sqrt
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, median, np
from webots_mcp.store.analysis.hidden import hidden_motion
from webots_mcp.store.analysis.noise import (
    FEWEST_SMOOTHED,
    kept_alike,
    noise_of,
    smooth,
    variance_along,
)
from webots_mcp.store.analysis.rhythm import rhythm_of

FALSE_LEGS: Final = 0.003  # so many may noise alone make of a robot at rest, on average
GAP_NOISE: Final = 7.0  # deviations of the position: so far it went at least during a gap
FINEST_LEG_M: Final = 0.02  # smoothing that makes legs so short is enough
SHARPEST_ARC_RAD: Final = 2.7  # from leg to leg; who turns farther went back
LONGEST_SMOOTHING_S: Final = 1.2  # a turn of 1.5 rad/s is cut by 0.7 % then, by 5 % in 2 s
_PLACES: Final = ("x", "y", "raw_x", "raw_y")
_PARABOLA_GAIN: Final = 2.25  # the variance that a parabola over n rows leaves is 2.25 / n of it


@dataclass(frozen=True)
class Track:
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
    def reversed(self) -> Track:
        """The same way, gone backwards in time."""
        places = {name: getattr(self, name)[::-1] for name in _PLACES}
        return replace(self, times=-self.times[::-1], **places)

    def part(self, start: int, stop: int) -> Track:
        """Some of its rows."""
        columns = {name: getattr(self, name)[start:stop] for name in ("times", *_PLACES)}
        return replace(self, **columns)


def track_of(
    times: Array, x: Array, y: Array, noise_m: float | None = None, of_rows: int | None = None
) -> Track:
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
    return Track(times, smooth_x, smooth_y, x, y, noise_m, noise_m * gain, rows)


def position_noise_m(x: Array, y: Array) -> float:
    """Standard deviation of the noise in each coordinate."""
    return float(np.hypot(noise_of(x), noise_of(y)) / np.sqrt(2))


def tracks_of(
    times: Array, x: Array, y: Array, noise_m: float | None = None, of_rows: int | None = None
) -> list[Track]:
    """One track per stretch without a gap.

    A gap is an interval of more than three median ones: what happened in it is unknown. The
    noise is that of the longest stretch, unless it is given.
    """
    ends_s = [gap.end_s for gap in rhythm_of(times).gaps]
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
    wanted = _PARABOLA_GAIN * (_leg_noise(of_rows, 1) * noise_m / FINEST_LEG_M) ** 2
    most = max(FEWEST_SMOOTHED, LONGEST_SMOOTHING_S / interval_s)
    return 2 * int(min(wanted, most) / 2) + 1


def _leg_noise(rows: int, smoothed_rows: int) -> float:
    """How many deviations of the smoothed position a leg is longer than.

    Of two places that differ by noise alone the distance is above d deviations with a probability
    of exp(-d**2 / 4) (Rayleigh); the more independent places there are, the more pairs are.
    """
    places = rows * min(1.0, _PARABOLA_GAIN / smoothed_rows)
    return sqrt(4 * log(max(places, 2.0) / FALSE_LEGS))


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


def path_length(track: Track) -> PathLength:
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
    within = hidden_motion(track.times, track.raw_x, track.raw_y, ends)
    counted_m = float(legs_m[within.legs].sum())
    least_m, most_m = (max(0.0, each - counted_m) for each in (within.least_m, within.most_m))
    return PathLength(length_m + least_m, max(shortest_m, most_m - least_m), track.noise_m)


def _leg_lengths(track: Track, corners: Indexes) -> Array:
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
    turns[np.abs(turns) > SHARPEST_ARC_RAD] = 0.0
    arcs = (turns[:-1] + turns[1:]) / 2
    return legs_m / np.sinc(arcs / (2 * np.pi))


def _corners(track: Track) -> Indexes:
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


def travelled(tracks: list[Track]) -> PathLength:
    """Metres travelled along stretches one after the other, with the straight ways between them.

    How far it went in a recording gap is not known; it is at least the straight way.
    """
    across_m = [
        float(np.hypot(after.x[0] - before.x[-1], after.y[0] - before.y[-1]))
        for before, after in pairwise(tracks)
    ]
    noise_m = max((track.noise_m for track in tracks), default=0.0)
    parts = [path_length(track) for track in tracks]
    between_m = sum(way_m for way_m in across_m if way_m > GAP_NOISE * noise_m)
    length_m = between_m + sum(part.length_m for part in parts)
    return PathLength(length_m, sum(part.longer_m for part in parts), noise_m)
