"""Where a robot stood still, and from when to when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, mean, median, np
from webots_mcp.store.analysis.creep import is_creep, rest_within
from webots_mcp.store.analysis.track import Track

WIDENED_BY: Final = 5.0  # a place is at least so many deviations of the smoothed position wide
SETTLED_SHARE: Final = 0.2  # of the radius: within it of the place is where a standstill begins
_NEARLY: Final = 0.95  # of the shortest duration: ends are known to a row or two
UNSEEN_SLOPE: Final = 3.0  # deviations: a speed that is less may be noise alone
_LEAST_RAMP_ROWS: Final = 4
_MOST_RAMP_ROWS: Final = 2**14
_AGREEING: Final = 2.5  # standard deviations: ends of one ramp in more and more rows
_RAMP_SHARE: Final = 0.75  # of the smoothed rows: so far a ramp is looked for at first
_CERTAIN_RAMP: Final = 50.0  # variances of the noise: a ramp that explains more is none of it


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
    that it stays within the radius for long is none (see `creep`); of a stretch in which there is
    one the part counts in which the robot rested. The ends are where a ramp that ends in rest fits
    the rows best (least squares).
    """
    radius_m = max(radius_m, WIDENED_BY * track.left_m)
    found: list[Standstill] = []
    stays = list(_stays(track, radius_m, least_s))
    for index, stay in enumerate(stays):
        each = _standstill(track, stay, radius_m, least_s, _touching(stays, index))
        if each and found and _is_same(track, found[-1], each, radius_m):
            found[-1] = replace(found[-1], last=max(each.last, found[-1].last))
        elif each:
            found.append(each)
    return found


def shortest_seen_s(noise_m: float, interval_s: float, radius_m: float, least_s: float) -> float:
    """The shortest standstill that can be distinguished from slow motion despite the noise.

    The slope of a line through n positions within t seconds has a deviation of noise * sqrt(12 / n)
    / t. Three of them are not more than the speed of who just leaves the radius in `least_s`.
    """
    noise = UNSEEN_SLOPE * noise_m * (12 * interval_s) ** 0.5
    return max(least_s, (noise * least_s / radius_m) ** (2 / 3))


def _touching(stays: Sequence[tuple[int, int]], index: int) -> tuple[int, int]:
    """A stay with those right before and after it: between them it can only have crept."""
    start, end = stays[index]
    if index and stays[index - 1][1] == start:
        start = stays[index - 1][0]
    if stays[index + 1 :] and stays[index + 1][0] == end:
        end = stays[index + 1][1]
    return start, end


def _is_same(track: Track, before: Standstill, after: Standstill, radius_m: float) -> bool:
    """Whether it stood on where a stay ended: who creeps up to a place leaves a stay there."""
    way_m = float(np.hypot(after.x_m - before.x_m, after.y_m - before.y_m))
    return (
        after.start - before.last <= track.smoothed_rows + 1
        and way_m <= SETTLED_SHARE * radius_m + 3 * track.left_m
    )


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
    return float(np.hypot(x - mean(x), y - mean(y)).max())


def _extended(track: Track, start: int, end: int, radius_m: float) -> int:
    """How far the positions stay within the radius of their mean, in steps that double."""
    while end < len(track.times):
        x_m, y_m = mean(track.x[start:end]), mean(track.y[start:end])
        more = slice(end, 2 * end - start + 8)
        away = np.hypot(track.x[more] - x_m, track.y[more] - y_m) > radius_m
        if away.any():
            return end + int(away.argmax())
        end = min(len(track.times), more.stop)
    return end


def _standstill(
    track: Track,
    stay: tuple[int, int],
    radius_m: float,
    least_s: float,
    around: tuple[int, int] | None = None,
) -> Standstill | None:
    """That of a stay; of one in which it creeps, that of the rest in it or around it, if any."""
    x_m, y_m = median(track.x[slice(*stay)]), median(track.y[slice(*stay)])
    away_m = np.hypot(track.x[slice(*stay)] - x_m, track.y[slice(*stay)] - y_m)
    settled = np.flatnonzero(away_m <= max(SETTLED_SHARE * radius_m, 3 * track.left_m))
    if len(settled) < 2:
        return None
    first, last = stay[0] + int(settled[0]), stay[0] + int(settled[-1])
    newest = len(track.times) - 1
    # At the ends of the track smoothing leaves more of the noise.
    first = 0 if stay[0] == 0 and first <= track.smoothed_rows // 2 else first
    last = newest if stay[1] > newest and last >= newest - track.smoothed_rows // 2 else last
    if around and is_creep(track, first, last + 1, radius_m):
        rest = rest_within(track, *around) or rest_within(track, *stay)
        return rest and _standstill(track, rest, radius_m, least_s)
    start = _begin_of_rest(track, first, last)
    end = newest - _begin_of_rest(track.reversed, newest - last, newest - first)
    long_enough = track.times[end] - track.times[start] >= _NEARLY * least_s
    return Standstill(start, end, x_m, y_m) if long_enough else None


def _begin_of_rest(track: Track, first: int, last: int) -> int:
    """The row from which on it stands: of a ramp that ends in rest, the best fitting end.

    A slow robot is near its place long before it rests: its ramp is looked for in ever more rows,
    until it stands out from the noise. From then on more rows make its end more exact, as long as
    they are of the same ramp: as long as the end that more rows tell lies where it should.

    Args:
        track: The positions as recorded count: smoothing blurs the bend.
        first: About where rest begins; until `last` it lasts.
        last: Index of a row in rest.
    """
    reach = max(_LEAST_RAMP_ROWS, int(_RAMP_SHARE * track.smoothed_rows))
    latest, rested = (first + last) // 2, last + 1 - (last - first) // 4
    found: _Ramp | None = None
    while first > 0:
        rows = slice(max(0, first - reach), min(latest, first + reach))
        if rows.stop <= rows.start:
            break
        ramp = _end_of_ramp(track, rows, rested)
        widest = rows.start == 0 or reach >= _MOST_RAMP_ROWS
        certain = ramp.explained_m2 > _CERTAIN_RAMP * track.noise_m**2
        if found is None and not certain and not widest:
            reach *= 2
        elif found is None and ramp.end == rows.stop - 1 and rows.stop < latest:
            first = ramp.end
        elif found is not None and not _is_same_ramp(track, found, ramp):
            break
        else:
            found = ramp
            if widest:
                break
            reach *= 2
    return first if found is None else found.end


class _Ramp(NamedTuple):
    """A steady motion that ends in rest.

    Attributes:
        end: The row in which it rests.
        rows: How many it has before that one.
        explained_m2: How many squares it explains.
    """

    end: int
    rows: int
    speed_m_s: float
    explained_m2: float


def _end_of_ramp(track: Track, rows: slice, rested: int) -> _Ramp:
    """Of ramps that end in rest, each in another row, the best, with the place of that rest.

    Args:
        track: Recorded positions.
        rows: Where one may end.
        rested: Until that row it certainly stands.
    """
    whole = slice(rows.start, max(rows.stop, rested))
    off = np.stack([each[rows] - mean(each[whole]) for each in (track.raw_x, track.raw_y)])
    times = track.times[rows] - track.times[rows.start]
    ones = np.ones_like(times)
    sums, of_times, along = (_along_ramps(times, each) for each in (ones, times, off))
    squares = times * sums - of_times - sums**2 / (whole.stop - whole.start)
    explained: Array = (along**2).sum(axis=0)
    gain = np.divide(explained, squares, out=np.zeros_like(squares), where=squares > 0)
    best = int(np.argmax(gain))
    speed_m_s = float(np.sqrt(explained[best])) / squares[best] if squares[best] else 0.0
    return _Ramp(rows.start + best, best, speed_m_s, float(gain[best]))


def _along_ramps(times: Array, values: Array) -> Array:
    """The sum of the values before each row, each times the time that is left until then."""
    sums, moments = (np.cumsum(each, axis=-1) - each for each in (values, times * values))
    return times * sums - moments


def _is_same_ramp(track: Track, found: _Ramp, wider: _Ramp) -> bool:
    """Whether a ramp in more rows ends where it does if all of them are of one motion.

    The end of n rows at a speed is known to twice the noise over the speed and the root of n: the
    bound of Cramer and Rao, where neither speed nor end is known. Where both estimates reach it,
    the variance of their difference is the difference of their variances (J. A. Hausman,
    Specification tests in econometrics, Econometrica 46, 1978).
    """
    if not wider.rows or not wider.speed_m_s:
        return False
    more = 1 / max(found.rows, 1) - 1 / wider.rows
    apart_m = float(track.times[wider.end] - track.times[found.end]) * wider.speed_m_s
    return apart_m**2 <= more * (_AGREEING * 2 * track.noise_m) ** 2
