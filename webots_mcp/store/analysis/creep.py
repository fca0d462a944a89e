"""Whether a robot that stays about a place for long goes on slowly, and where it rests then."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, mean, np
from webots_mcp.store.analysis.track import Track

DRIFT_SHARE: Final = 0.15  # of the radius: who came farther between its first and last third moves
CERTAIN: Final = 4.0  # standard errors
SAME_COURSE: Final = 1.25  # times the noise: the residual of a motion that explains all rows
REST_SHARE: Final = 0.5  # of the speed next to it: a part that is certainly slower is a rest
CERTAINLY_SLOWER: Final = 3.0  # standard errors: the ramps next to it are certain already
# So many times its own length before and after a stretch is looked for the same motion.
_AROUND: Final = ((1.0, 1.0), (0.5, 0.5), (0.0, 2.0), (2.0, 0.0), (3.0, 3.0))
_MEANS: Final = 240  # of neighbouring rows, that stand for all of a stretch
_NUMERIC: Final = 1e-9  # of a sum of squares: less is a rounding error
_BORDERS: Final = 25  # at which a rest between two ramps may begin and end


def is_creep(track: Track, start: int, end: int, radius_m: float) -> bool:
    """Whether rows within a place are of a motion, be it that it only shows around them."""
    return _drifts(track, start, end, radius_m) or _goes_on(track, start, end, radius_m)


def _drifts(track: Track, start: int, end: int, radius_m: float) -> bool:
    """Whether the mean place of the last third is another one than that of the first."""
    third = max(1, (end - start) // 3)
    first, last = slice(start, start + third), slice(end - third, end)
    way_m = np.hypot(
        mean(track.raw_x[last]) - mean(track.raw_x[first]),
        mean(track.raw_y[last]) - mean(track.raw_y[first]),
    )
    error_m = track.noise_m * np.sqrt(2 / third)
    return bool(way_m > max(DRIFT_SHARE * radius_m, CERTAIN * error_m))


def _goes_on(track: Track, start: int, end: int, radius_m: float) -> bool:
    """Whether one steady motion explains the stretch and what lies before and after it."""
    own = _line_through(track, slice(start, end))
    for before, after in _AROUND:
        from_row, to_row = start - int(before * (end - start)), end + int(after * (end - start))
        wide = slice(max(0, from_row), min(len(track.times), to_row))
        line = _line_through(track, wide)
        longer = wide.stop - wide.start > end - start
        if longer and _is_one_motion(track, line, radius_m) and not _is_slower(own, line):
            return True
    return False


def _is_one_motion(track: Track, line: _Line, radius_m: float) -> bool:
    """A straight line in time explains all but the noise, and leads out of the place."""
    explained = line.left_m < max(SAME_COURSE * track.noise_m, 0.02 * radius_m)
    certain = line.speed_m_s > CERTAIN * line.error_m_s
    return explained and certain and line.speed_m_s * line.lasts_s > 0.5 * radius_m


@dataclass(frozen=True)
class _Line:
    """The steady motion that fits some rows best.

    Attributes:
        error_m_s: Standard error of its speed in each coordinate; infinite for a single moment.
        left_m: Standard deviation of the places from it.
    """

    speed_m_s: float
    error_m_s: float
    left_m: float
    lasts_s: float


def _line_through(track: Track, rows: slice) -> _Line:
    times = track.times[rows] - mean(track.times[rows])
    squares = float(times @ times)
    if squares == 0:
        return _Line(0.0, np.inf, 0.0, 0.0)
    places = np.array([each[rows] - mean(each[rows]) for each in (track.raw_x, track.raw_y)])
    speeds = places @ times / squares
    left_m = math.sqrt(mean((places - np.outer(speeds, times)) ** 2))
    error_m_s = track.noise_m / math.sqrt(squares)
    return _Line(float(np.hypot(*speeds)), error_m_s, left_m, float(times[-1] - times[0]))


def rest_within(track: Track, start: int, end: int) -> tuple[int, int] | None:
    """The rows of a stretch in which it rested, if it crept up to there, on from there, or both.

    Of all motions that are a ramp, a rest and a ramp that with the least squares; each ramp has to
    explain more than noise does. The robot has to be certainly slower in the rest than on either
    side of it: a bend of a creep is no rest.
    """
    edges = np.unique(np.linspace(start, end, _MEANS + 1).astype(np.intp))
    counts = np.diff(edges)
    times, x, y = (
        np.add.reduceat(each[:end], edges[:-1]) / counts
        for each in (track.times, track.raw_x, track.raw_y)
    )
    first, last = _best_rest(times, x, y, CERTAIN * track.noise_m / np.sqrt(counts.mean()))
    rest = int(edges[first]), int(edges[last])
    sides = [slice(start, rest[0]), slice(rest[1], end)]
    neighbours = [_line_through(track, side) for side in sides if side.stop > side.start]
    line = _line_through(track, slice(*rest))
    return rest if all(_is_slower(line, each) for each in neighbours) else None


def _is_slower(rest: _Line, neighbours: _Line) -> bool:
    error_m_s = np.hypot(rest.error_m_s, REST_SHARE * neighbours.error_m_s)
    return bool(REST_SHARE * neighbours.speed_m_s - rest.speed_m_s > CERTAINLY_SLOWER * error_m_s)


def _best_rest(times: Array, x: Array, y: Array, certain_m: float) -> tuple[int, int]:
    """From and to which of the places it rests; a ramp explains at least the square of that."""
    places = np.stack((x - x.mean(), y - y.mean()), axis=1)
    times = (times - times[0]) / (times[-1] - times[0])
    firsts, lasts = _rests_among(len(times))
    ramps = (
        np.minimum(times - times[firsts, None], 0.0),
        np.maximum(times - times[lasts - 1, None], 0.0),
    )
    explained = _explained(np.stack((np.ones_like(ramps[0]), *ramps), axis=-1), places)
    least = max(certain_m**2, _NUMERIC * float((places**2).sum()))
    best = int(np.argmax(explained - least * ((firsts > 0) + 1.0 * (lasts < len(times)))))
    return int(firsts[best]), int(lasts[best])


def _rests_among(count: int) -> tuple[Indexes, Indexes]:
    """From and to which of so many places a robot may rest; with one ramp at every place."""
    inner = np.arange(1, count)
    borders = np.unique(np.linspace(0, count, _BORDERS).astype(np.intp))
    firsts, lasts = (borders[each] for each in np.triu_indices(len(borders), 1))
    nothing, all_of_it = np.zeros_like(inner), np.full_like(inner, count)
    return np.concatenate((firsts, inner, nothing)), np.concatenate((lasts, all_of_it, inner))


def _explained(bases: Array, places: Array) -> Array:
    """The sum of squares that the best fit of each basis makes of the places."""
    sides = np.einsum("knp,nc->kpc", bases, places)
    squares: Array = np.einsum("knp,knq->kpq", bases, bases)
    inverse = np.asarray(np.linalg.pinv(squares, hermitian=True), np.float64)
    return np.asarray(np.einsum("kpc,kpq,kqc->k", sides, inverse, sides))
