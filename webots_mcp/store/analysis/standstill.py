"""Where a robot stood still, and from when to when: all standstills of a track at once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, median, np
from webots_mcp.store.analysis.creep import Rows, is_creep, rest_within
from webots_mcp.store.analysis.track import Track

WIDENED_BY: Final = 5.0  # a place is at least so many deviations of the smoothed position wide
SETTLED_SHARE: Final = 0.2  # of the radius: within it of the place is where a standstill begins
NEARLY: Final = 0.95  # of the shortest duration: ends are known to a row or two
UNSEEN_SLOPE: Final = 3.0  # deviations: a speed that is less may be noise alone
_SAMPLES: Final = 12  # of the shortest standstill: so finely places are compared at first
_NEAR_SHARE: Final = 0.9  # of the shortest standstill that it has to stay within the radius
_LEAST_RAMP_ROWS: Final = 4
_MOST_RAMP_ROWS: Final = 2**12
_AGREEING: Final = 3.0  # standard deviations: ends of one ramp in more and more rows
_RAMP_SHARE: Final = 0.75  # of the smoothed rows: so far a ramp is looked for at first
_REST_SHARE: Final = 4  # times as many rows as the ramp's tell the place of the rest after it
_CERTAIN_RAMP: Final = 50.0  # variances of the noise: a ramp that explains more is none of it
_EXACT_ROWS: Final = 0.25  # an end whose deviation is less is exact enough
_ROUNDING_M: Final = 1e-6
_MOST_AT_ONCE: Final = 2**20  # positions


class Standstill(NamedTuple):
    """A robot stayed about one place.

    Attributes:
        start: Index of the first row in which it stood; `last` of the last one.
        x_m: Where: the mean of its positions.
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
    one the part counts in which the robot rested. Who twitches within the radius rests in between.
    The ends are where a ramp that ends in rest fits the rows best (least squares).
    """
    if len(track.times) < 2:
        return []
    radius_m = max(radius_m, WIDENED_BY * track.left_m)
    grid = _grid_of(track, least_s)
    stays = _pairs(list(_stays(grid, radius_m)))
    if not len(stays):
        return []
    rows = Rows(track)
    firsts, lasts = _resting(track, rows, grid, stays, radius_m)
    starts = _begins_of_rest(track, firsts, lasts, grid.rows)
    newest = len(track.times) - 1
    ends = newest - _begins_of_rest(track.reversed, newest - lasts, newest - firsts, grid.rows)
    long = track.times[ends] - track.times[starts] >= NEARLY * least_s
    near_m = SETTLED_SHARE * radius_m + 3 * track.left_m
    return _joined(track, rows, starts[long], ends[long], grid.rows, near_m)


def shortest_seen_s(noise_m: float, interval_s: float, radius_m: float, least_s: float) -> float:
    """The shortest standstill that can be distinguished from slow motion despite the noise.

    The slope of a line through n positions within t seconds has a deviation of noise * sqrt(12 / n)
    / t. Three of them are not more than the speed of who just leaves the radius in `least_s`.
    """
    noise = UNSEEN_SLOPE * noise_m * (12 * interval_s) ** 0.5
    return max(least_s, (noise * least_s / radius_m) ** (2 / 3))


class _Grid(NamedTuple):
    """Smoothed positions at even times, which are multiples of the step in any part of a way.

    Attributes:
        window: How many of them a standstill lasts at least.
        rows: How many rows lie between two of them, one at least.
    """

    times: Array
    x: Array
    y: Array
    window: int
    rows: int


def _grid_of(track: Track, least_s: float) -> _Grid:
    interval_s = median(np.diff(track.times))
    step_s = max(least_s / _SAMPLES, interval_s)
    first, last = track.times[[0, -1]] / step_s
    steps = np.arange(math.ceil(first * (1 - 1e-9)), int(last * (1 + 1e-9)) + 1, dtype=np.float64)
    times: Array = step_s * steps
    x, y = (np.interp(times, track.times, each) for each in (track.x, track.y))
    window = max(2, math.ceil(_NEAR_SHARE * least_s / step_s))
    return _Grid(times, x, y, window, math.ceil(step_s / interval_s) if interval_s else 1)


def _stays(grid: _Grid, radius_m: float) -> Iterator[tuple[int, int]]:
    """Index ranges in which every position is within the radius of their mean, one by one."""
    if len(grid.times) < grid.window:
        return
    away_m2 = np.zeros((len(grid.times) - grid.window + 1, grid.window))
    for each in (grid.x, grid.y):
        windows = np.lib.stride_tricks.sliding_window_view(each, grid.window)
        away_m2 += (windows - windows.mean(axis=1, keepdims=True)) ** 2
    starts = np.flatnonzero(away_m2.max(axis=1) <= radius_m**2)
    sums = [np.concatenate(([0.0], np.cumsum(each))) for each in (grid.x, grid.y)]
    at = 0
    while at < len(starts):
        start = int(starts[at])
        end = start + grid.window
        while end < len(grid.times):  # as far as they stay near, in steps that double
            x_m, y_m = ((each[end] - each[start]) / (end - start) for each in sums)
            more = slice(end, 2 * end - start + 8)
            away = np.hypot(grid.x[more] - x_m, grid.y[more] - y_m) > radius_m
            if away.any():
                end += int(away.argmax())
                break
            end = min(len(grid.times), more.stop)
        yield start, end
        at = int(np.searchsorted(starts, end))


def _resting(
    track: Track, rows: Rows, grid: _Grid, stays: Indexes, radius_m: float
) -> tuple[Indexes, Indexes]:
    """About the first and the last row of the rest in each stay in which it does not only creep.

    It begins near the place of the first seconds and ends near that of the last: a robot that
    twitched in between stands elsewhere.
    """
    limit_m = max(SETTLED_SHARE * radius_m, 3 * track.left_m)
    first = stays[:, 0] + _settled(grid, stays[:, :1] + np.arange(grid.window), limit_m)
    last = stays[:, 1] - 1 - _settled(grid, stays[:, 1:] - 1 - np.arange(grid.window), limit_m)
    firsts = np.searchsorted(track.times, grid.times[first])
    lasts = np.searchsorted(track.times, grid.times[last], "right") - 1
    # At the ends of the track smoothing leaves more of the noise.
    newest, slack = len(track.times) - 1, track.smoothed_rows // 2 + grid.rows
    firsts[(stays[:, 0] == 0) & (firsts <= slack)] = 0
    lasts[(stays[:, 1] == len(grid.times)) & (lasts >= newest - slack)] = newest
    creeps = is_creep(rows, firsts, lasts + 1, radius_m)
    edges = np.searchsorted(track.times, np.append(grid.times, np.inf)[stays])
    touching = np.append(edges[1:, 0] == edges[:-1, 1], False)
    for at in np.flatnonzero(creeps).tolist():
        # With those right before and after it: between them it can only have crept.
        start, end = (
            edges[at - 1 if at and touching[at - 1] else at, 0],
            edges[at + touching[at], 1],
        )
        if rest := rest_within(rows, start, end) or rest_within(rows, *edges[at].tolist()):
            firsts[at], lasts[at], creeps[at] = rest[0], rest[1] - 1, False
    return firsts[~creeps], lasts[~creeps]


def _pairs(ranges: Sequence[tuple[int, int]]) -> Indexes:
    return np.asarray(np.reshape(np.array(ranges, np.intp), (-1, 2)))


def _settled(grid: _Grid, window: Indexes, limit_m: float) -> Indexes:
    """In each window the first position that is near their median."""
    away_m2 = np.zeros(window.shape)
    for each in (grid.x, grid.y):
        away_m2 += (each[window] - np.median(each[window], axis=1, keepdims=True)) ** 2
    return np.argmax(away_m2 <= limit_m**2, axis=1)


def _joined(
    track: Track,
    rows: Rows,
    starts: Indexes,
    ends: Indexes,
    slack: int,
    far_m: float,
) -> list[Standstill]:
    """Each standstill once: who creeps up to a place leaves a stay there, and stands on."""
    found: list[Standstill] = []
    _, _, x, y = (each[:, 0] for each in rows.means(starts, ends + 1, 1))
    columns = (starts, ends, np.round(x, 6), np.round(y, 6))
    new = sorted(map(Standstill, *(each.tolist() for each in columns)))
    for each in new:
        was = found[-1] if found else each
        apart_m = math.hypot(was.x_m - each.x_m, was.y_m - each.y_m) * (each.start > was.last)
        if not found or apart_m > far_m or each.start - was.last > track.smoothed_rows + slack:
            found.append(each)
            continue
        found[-1] = was._replace(last=max(each.last, was.last))
    return found


def _begins_of_rest(track: Track, firsts: Indexes, lasts: Indexes, coarse_rows: int) -> Indexes:
    """The rows from which on it stands: of a ramp that ends in rest, the best fitting end.

    A slow robot is near its place long before it rests: its ramp is looked for in ever more rows,
    until it stands out from the noise. From then on more rows make its end more exact, as long as
    they are of the same ramp: as long as the end that more rows tell lies where it should.

    Args:
        track: The positions as recorded count: smoothing blurs the bend.
        firsts: About where rest begins; until `lasts` it lasts.
        lasts: Indexes of rows in rest.
        coarse_rows: How exactly these are known.
    """
    least = max(_LEAST_RAMP_ROWS, int(_RAMP_SHARE * track.smoothed_rows), coarse_rows)
    interval_s = median(np.diff(track.times))
    begins: Indexes = np.array(firsts)
    centre, reach = np.array(begins), np.full(len(firsts), least)
    latest, rested = (firsts + lasts) // 2, lasts + 1 - (lasts - firsts) // 4
    known = np.zeros(len(firsts), np.bool_)
    rows, left = np.zeros(len(firsts), np.intp), np.arange(len(firsts))
    while True:
        start, stop = np.maximum(0, centre - reach), np.minimum(latest, centre + reach)
        left = left[(centre[left] > 0) & (stop[left] > start[left])]
        if not len(left):
            return begins
        some = left[: max(1, _MOST_AT_ONCE // int(2 * reach[left].max()))]
        start, stop = start[some], stop[some]
        rest_until = np.maximum(stop, np.minimum(rested[some], stop + _REST_SHARE * reach[some]))
        ramp = _ends_of_ramps(track, start, stop, rest_until)
        widest = (start == 0) | (reach[some] >= _MOST_RAMP_ROWS)
        certain = ramp.explained_m2 > _CERTAIN_RAMP * max(track.noise_m, _ROUNDING_M) ** 2
        new = ~known[some]
        unseen = new & ~certain & ~widest
        moves_on = new & ~unseen & (ramp.end == stop - 1) & (stop < latest[some])
        same = new | _is_same_ramp(track, begins[some], rows[some], ramp)
        taken = same & ~unseen & ~moves_on
        here = some[taken]
        begins[here], rows[here], known[here] = ramp.end[taken], ramp.rows[taken], True
        centre[some[moves_on]] = begins[some[moves_on]] = ramp.end[moves_on]
        with np.errstate(divide="ignore", invalid="ignore"):
            error_s = 2 * track.noise_m / (ramp.speed_m_s * np.sqrt(ramp.rows))
        exact = error_s <= _EXACT_ROWS * interval_s
        goes_on = taken & ~widest & ~exact
        reach[some[unseen | goes_on]] *= 2
        done = some[~(unseen | moves_on | goes_on)]
        left = left[~np.isin(left, done)]


class _Ramps(NamedTuple):
    """Steady motions that end in rest.

    Attributes:
        end: The row in which it rests.
        rows: How many it has before that one.
        explained_m2: How many squares it explains.
    """

    end: Indexes
    rows: Indexes
    speed_m_s: Array
    explained_m2: Array


def _ends_of_ramps(track: Track, start: Indexes, stop: Indexes, rest_until: Indexes) -> _Ramps:
    """Of ramps that end in rest, each in another row [start, stop), the best, with that rest."""
    at = start[:, None] + np.arange(int((stop - start).max()))
    inside = at < stop[:, None]
    at = np.minimum(at, len(track.times) - 1)
    times = track.times[at] - track.times[start][:, None]
    ones = inside.astype(np.float64)
    count = (rest_until - start)[:, None]
    explained = np.zeros(at.shape)
    for each in (track.raw_x, track.raw_y):
        off = each[at] - each[start][:, None]
        ends = np.stack((start, rest_until), axis=1).ravel()
        # The sum of each stretch [start, rest_until): those in between are left out.
        sums = np.add.reduceat(np.append(each, 0.0), ends)[::2]
        off -= (sums / count[:, 0] - each[start])[:, None]
        explained += _along_ramps(times, off * ones) ** 2
    sums, of_times = _along_ramps(times, ones), _along_ramps(times, times * ones)
    squares = np.where(inside, times * sums - of_times - sums**2 / count, 0.0)
    gain = np.divide(explained, squares, out=np.zeros_like(squares), where=squares > 0)
    best = np.argmax(gain, axis=1)
    picked = np.arange(len(start)), best
    with np.errstate(divide="ignore", invalid="ignore"):
        speed_m_s = np.nan_to_num(np.sqrt(explained[picked]) / squares[picked])
    return _Ramps(start + best, best, speed_m_s, gain[picked])


def _along_ramps(times: Array, values: Array) -> Array:
    """The sum of the values before each row, each times the time that is left until then."""
    sums, moments = (np.cumsum(each, axis=-1) - each for each in (values, times * values))
    return times * sums - moments


def _is_same_ramp(track: Track, end: Indexes, rows: Indexes, wider: _Ramps) -> Flags:
    """Whether a ramp in more rows ends where it does if all of them are of one motion.

    The end of n rows at a speed is known to twice the noise over the speed and the root of n: the
    bound of Cramer and Rao, where neither speed nor end is known. Where both estimates reach it,
    the variance of their difference is the difference of their variances (J. A. Hausman,
    Specification tests in econometrics, Econometrica 46, 1978).
    """
    more = 1 / np.maximum(rows, 1) - 1 / np.maximum(wider.rows, 1)
    apart_m = (track.times[wider.end] - track.times[end]) * wider.speed_m_s
    moves = (wider.rows > 0) & (wider.speed_m_s > 0)
    return moves & (apart_m**2 <= more * (_AGREEING * 2 * track.noise_m) ** 2)
