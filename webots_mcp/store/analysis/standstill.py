"""Where a robot stood still, and from when to when."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.analysis.track import Track

WIDENED_BY: Final = 5.0  # a place is at least so many deviations of the smoothed position wide
SETTLED_SHARE: Final = 0.2  # of the radius: within it of the place is where a standstill begins
DRIFT_SHARE: Final = 0.15  # of the radius: who came farther between its first and last third moves
CERTAIN: Final = 4.0  # standard errors
SAME_COURSE: Final = 1.25  # times the noise: the residual of a motion that explains all rows
_NEARLY: Final = 0.95  # of the shortest duration: ends are known to a row or two
_LEAST_RAMP_ROWS: Final = 6
# So many times its own length before and after a stretch is looked for the same motion.
_AROUND: Final = ((1.0, 1.0), (0.5, 0.5), (0.0, 2.0), (2.0, 0.0), (3.0, 3.0))


@dataclass(frozen=True)
class Standstill:
    """A robot stayed about one place.

    Attributes:
        start: Index of the first row in which it stood; `last` of the last one.
        x_m: Where: the median of its positions.
        y_m: As well.
    """

    start: int
    last: int
    x_m: float
    y_m: float


def find_standstills(track: Track, radius_m: float, least_s: float) -> list[Standstill]:
    """Stretches of at least `least_s` in which the position stayed within a radius.

    The radius is widened to five times what is left of the noise. A steady motion that is so slow
    that it stays within the radius for long is none: what came farther between the first and the
    last third than the noise explains, or goes on as before and after, moves. The ends are where
    a ramp that ends in rest fits the rows best (least squares).
    """
    radius_m = max(radius_m, WIDENED_BY * track.left_m)
    found = (
        _standstill(track, stay, radius_m, least_s) for stay in _stays(track, radius_m, least_s)
    )
    return [each for each in found if each is not None]


def _stays(track: Track, radius_m: float, least_s: float) -> Iterator[tuple[int, int]]:
    """Index ranges in which every position is within the radius of their mean, one by one."""
    later = np.searchsorted(track.times, track.times + 0.9 * least_s)
    place = np.minimum(later, len(track.times) - 1)
    near = np.hypot(track.x[place] - track.x, track.y[place] - track.y) <= radius_m
    starts = np.flatnonzero(near & (later < len(track.times)))
    reached = 0
    for start in starts.tolist():
        if start < reached:
            continue
        end = int(later[start])
        if _farthest_m(track, start, end) <= radius_m:
            reached = _extended(track, start, end, radius_m)
            yield start, reached


def _farthest_m(track: Track, start: int, end: int) -> float:
    x, y = track.x[start:end], track.y[start:end]
    return float(np.hypot(x - x.mean(), y - y.mean()).max())


def _extended(track: Track, start: int, end: int, radius_m: float) -> int:
    """How far the positions stay within the radius of their mean, in steps that double."""
    while end < len(track.times):
        x_m, y_m = track.x[start:end].mean(), track.y[start:end].mean()
        more = slice(end, 2 * end - start + 8)
        away = np.hypot(track.x[more] - x_m, track.y[more] - y_m) > radius_m
        if away.any():
            return end + int(away.argmax())
        end = min(len(track.times), more.stop)
    return end


def _standstill(
    track: Track, stay: tuple[int, int], radius_m: float, least_s: float
) -> Standstill | None:
    place = np.median(track.x[slice(*stay)]), np.median(track.y[slice(*stay)])
    x_m, y_m = map(float, place)
    away_m = np.hypot(track.x[slice(*stay)] - x_m, track.y[slice(*stay)] - y_m)
    settled = np.flatnonzero(away_m <= max(SETTLED_SHARE * radius_m, 3 * track.left_m))
    if len(settled) < 2:
        return None
    first, last = stay[0] + int(settled[0]), stay[0] + int(settled[-1])
    newest = len(track.times) - 1
    # At the ends of the track smoothing leaves more of the noise.
    first = 0 if stay[0] == 0 and first <= track.smoothed_rows // 2 else first
    last = newest if stay[1] > newest and last >= newest - track.smoothed_rows // 2 else last
    if _drifts(track, first, last + 1, radius_m) or _creeps(track, first, last + 1, radius_m):
        return None
    start = _begin_of_rest(track, first, last, x_m, y_m)
    end = newest - _begin_of_rest(track.reversed, newest - last, newest - first, x_m, y_m)
    long_enough = track.times[end] - track.times[start] >= _NEARLY * least_s
    return Standstill(start, end, x_m, y_m) if long_enough else None


def _drifts(track: Track, start: int, end: int, radius_m: float) -> bool:
    """Whether the mean place of the last third is another one than that of the first."""
    third = max(1, (end - start) // 3)
    first, last = slice(start, start + third), slice(end - third, end)
    way_m = np.hypot(
        track.raw_x[last].mean() - track.raw_x[first].mean(),
        track.raw_y[last].mean() - track.raw_y[first].mean(),
    )
    error_m = track.noise_m * np.sqrt(2 / third)
    return bool(way_m > max(DRIFT_SHARE * radius_m, CERTAIN * error_m))


def _creeps(track: Track, start: int, end: int, radius_m: float) -> bool:
    """Whether one steady motion explains the stretch and what lies before and after it."""
    for before, after in _AROUND:
        rows = (start - int(before * (end - start)), end + int(after * (end - start)))
        wide = slice(max(0, rows[0]), min(len(track.times), rows[1]))
        if wide.stop - wide.start > end - start and _is_one_motion(track, wide, radius_m):
            return True
    return False


def _is_one_motion(track: Track, rows: slice, radius_m: float) -> bool:
    """A straight line in time explains all but the noise, and leads out of the place."""
    times = track.times[rows] - track.times[rows].mean()
    x, y = (each[rows] - each[rows].mean() for each in (track.raw_x, track.raw_y))
    squares = float(times @ times)
    if squares == 0:
        return False
    speed_x, speed_y = float(times @ x) / squares, float(times @ y) / squares
    left = np.concatenate((x - speed_x * times, y - speed_y * times))
    speed = float(np.hypot(speed_x, speed_y))
    explained = np.sqrt(np.mean(left**2)) < max(SAME_COURSE * track.noise_m, 0.02 * radius_m)
    certain = speed > CERTAIN * track.noise_m / np.sqrt(squares)
    return bool(explained and certain and speed * (times[-1] - times[0]) > 0.5 * radius_m)


def _begin_of_rest(track: Track, first: int, last: int, x_m: float, y_m: float) -> int:
    """The row from which on it stands: of a ramp that ends in rest, the best fitting end.

    Args:
        track: The positions as recorded count: smoothing blurs the bend.
        first: About where rest begins; until `last` it lasts.
        last: Index of a row in rest.
        x_m: Where it rests.
        y_m: As well.
    """
    reach = max(_LEAST_RAMP_ROWS, track.smoothed_rows)
    latest = (first + last) // 2
    while first > 0:
        rows = slice(max(0, first - reach), min(latest, first + reach))
        if rows.stop <= rows.start:
            break
        best = rows.start + _end_of_ramp(track, rows, x_m, y_m)
        if best < rows.stop - 1 or rows.stop == latest:
            return best
        first = best  # a slow robot is near its place long before it rests
    return first


def _end_of_ramp(track: Track, rows: slice, x_m: float, y_m: float) -> int:
    """Of ramps that end in rest, each in another of the rows, the one that explains them best."""
    off = np.stack((track.raw_x[rows] - x_m, track.raw_y[rows] - y_m), axis=1)
    times = track.times[rows]
    ramps = np.minimum(times[None, :] - times[:, None], 0.0)  # one a row, for each end
    squares = np.einsum("ij,ij->i", ramps, ramps)
    explained = ((ramps @ off) ** 2).sum(axis=1)
    gain = np.divide(explained, squares, out=np.zeros_like(squares), where=squares > 0)
    return int(np.argmax(gain))
