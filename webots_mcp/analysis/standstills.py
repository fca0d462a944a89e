"""Where a robot stood still, and from when to when: all standstills of a track at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Flags, Indexes, median, np
from webots_mcp.analysis.path_length import SmoothedTrack

NEARLY: Final = 0.95  # of the shortest duration: ends are known to a row or two
MOST_AROUND: Final = 5


class _StandstillSettings(NamedTuple):
    """When a robot counts as standing still, and how closely positions are compared."""

    widened_by: float = 5.0  # minimum width of a place, in deviations of the smoothed position
    settled_share: float = 0.2  # of the radius: within it of the place is where a standstill begins
    unseen_slope: float = 3.0  # deviations: a speed that is less may be noise alone
    samples: int = 12  # of the shortest standstill: so finely places are compared at first
    near_share: float = 0.9  # of the shortest standstill that it has to stay within the radius
    rounding_m: float = 1e-6
    most_at_once: int = 2**20  # positions
    longest_creep: float = 100.0  # shortest standstills: who takes longer to leave a place drifts
    drift_share: float = (
        0.15  # of the radius: who came farther between its first and last third moves
    )
    certain: float = 4.0  # standard errors
    same_course: float = 1.25  # times the noise: the residual of a motion that explains all rows
    rest_share: float = 0.5  # of the speed next to it: a part that is certainly slower is a rest
    certainly_slower: float = 3.0  # standard errors: the ramps next to it are certain already
    # So many times its own length before and after a stretch is looked for the same motion.
    around: tuple[tuple[int, int], ...] = ((1, 1), (0, 2), (2, 0), (0, 5), (5, 0))
    means: int = 30  # of neighbouring rows, that a line is laid through
    fine_means: int = 120  # in which a rest is looked for
    borders: int = 25  # at which a rest between two ramps may begin and end
    most_twitches: int = 12


STANDSTILL: Final = _StandstillSettings()


@dataclass(frozen=True)
class _RampLimits:
    """How the ends of a motion next to a standstill are found.

    Attributes:
        fewest_rows: Rows of the shortest motion that a ramp is fitted to.
        most_rows: Rows of the longest one.
        agreeing: Standard deviations within which the ends of one ramp, fitted to more
            and more rows, count as equal.
        first_share: Share of the smoothed rows in which a ramp is searched for at first.
        rest_share: Rows of the rest after a ramp that locate it, in rows of the ramp.
        certain: Variances of the noise that a ramp must explain, since noise explains less.
        exact_rows: Deviation of an end, in rows, below which no other fit is tried.
    """

    fewest_rows: int = 4
    most_rows: int = 2**12
    agreeing: float = 3.0
    first_share: float = 0.75
    rest_share: int = 4
    certain: float = 50.0
    exact_rows: float = 0.25


_RAMP: Final = _RampLimits()


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


def find_standstills(
    track: SmoothedTrack,
    radius_m: float,
    least_s: float,
    is_over: Callable[[], bool] = lambda: False,
) -> list[Standstill]:
    """Stretches of at least `least_s` in which the position stayed within a radius.

    The radius is widened to five times what is left of the noise. A steady motion that is so slow
    that it stays within the radius for long is none (see `creep`); of a stretch in which there is
    one the part counts in which the robot rested. Who twitches within the radius rests in between.
    The ends are where a ramp that ends in rest fits the rows best (least squares). Once there is
    no time any more (`is_over`), rests are no longer looked for in slow motion, and lack.
    """
    if len(track.times) < 2:
        return []
    radius_m = max(radius_m, STANDSTILL.widened_by * track.left_m)
    grid = _grid_of(track, least_s)
    stays = _pairs(list(_stays(grid, radius_m)))
    if not len(stays):
        return []
    rows = Rows(track)
    firsts, lasts = _resting(track, rows, grid, stays, radius_m, is_over)
    newest = len(track.times) - 1
    starts = _near_coarse(track, firsts, _begins_of_rest(track, firsts, lasts, grid.rows), least_s)
    ends = newest - _begins_of_rest(track.reversed, newest - lasts, newest - firsts, grid.rows)
    ends = _near_coarse(track, lasts, ends, least_s)
    long = track.times[ends] - track.times[starts] >= NEARLY * least_s
    near_m = STANDSTILL.settled_share * radius_m + 3 * track.left_m
    return _joined(track, rows, starts[long], ends[long], grid.rows, near_m)


def _near_coarse(track: SmoothedTrack, coarse: Indexes, fine: Indexes, least_s: float) -> Indexes:
    """The fine ends of standstills, but the coarse ones where these are far away.

    A robot that turns in place, or sways, moves within its place: no ramp fits there, and its best
    end may lie anywhere.
    """
    far = np.abs(track.times[fine] - track.times[coarse]) > least_s
    return np.where(far, coarse, fine)


def shortest_seen_s(noise_m: float, interval_s: float, radius_m: float, least_s: float) -> float:
    """The shortest standstill that can be distinguished from slow motion despite the noise.

    The slope of a line through n positions within t seconds has a deviation of noise * sqrt(12 / n)
    / t. Three of them are not more than the speed of who just leaves the radius in `least_s`.
    """
    noise = STANDSTILL.unseen_slope * noise_m * (12 * interval_s) ** 0.5
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
    least_s: float


def _grid_of(track: SmoothedTrack, least_s: float) -> _Grid:
    interval_s = median(np.diff(track.times))
    step_s = max(least_s / STANDSTILL.samples, interval_s)
    first, last = track.times[[0, -1]] / step_s
    steps = np.arange(math.ceil(first * (1 - 1e-9)), int(last * (1 + 1e-9)) + 1, dtype=np.float64)
    times: Array = step_s * steps
    x, y = (np.interp(times, track.times, each) for each in (track.x, track.y))
    window = max(2, math.ceil(STANDSTILL.near_share * least_s / step_s))
    return _Grid(times, x, y, window, math.ceil(step_s / interval_s) if interval_s else 1, least_s)


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
    track: SmoothedTrack,
    rows: Rows,
    grid: _Grid,
    stays: Indexes,
    radius_m: float,
    is_over: Callable[[], bool],
) -> tuple[Indexes, Indexes]:
    """About the first and the last row of the rest in each stay in which it does not only creep.

    It begins near the place of the first seconds and ends near that of the last: a robot that
    twitched in between stands elsewhere.
    """
    limit_m = max(STANDSTILL.settled_share * radius_m, 3 * track.left_m)
    first = stays[:, 0] + _settled(grid, stays[:, :1] + np.arange(grid.window), limit_m)
    last = stays[:, 1] - 1 - _settled(grid, stays[:, 1:] - 1 - np.arange(grid.window), limit_m)
    firsts = np.searchsorted(track.times, grid.times[first])
    lasts = np.searchsorted(track.times, grid.times[last], "right") - 1
    seen = lasts >= firsts  # else it is between two rows
    firsts, lasts, stays = firsts[seen], lasts[seen], stays[seen]
    # At the ends of the track smoothing leaves more of the noise.
    newest, slack = len(track.times) - 1, track.smoothed_rows // 2 + grid.rows
    firsts[(stays[:, 0] == 0) & (firsts <= slack)] = 0
    lasts[(stays[:, 1] == len(grid.times)) & (lasts >= newest - slack)] = newest
    slowest_m_s = radius_m / (STANDSTILL.longest_creep * grid.least_s)
    creeps = is_creep(rows, firsts, lasts + 1, radius_m, slowest_m_s, is_over)
    edges = np.searchsorted(track.times, np.append(grid.times, np.inf)[stays])
    touching = np.append(edges[1:, 0] == edges[:-1, 1], False)
    for at in np.flatnonzero(creeps).tolist():
        if is_over():
            break
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
    track: SmoothedTrack,
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


def _begins_of_rest(
    track: SmoothedTrack, firsts: Indexes, lasts: Indexes, coarse_rows: int
) -> Indexes:
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
    least = max(_RAMP.fewest_rows, int(_RAMP.first_share * track.smoothed_rows), coarse_rows)
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
        some = left[: max(1, STANDSTILL.most_at_once // int(2 * reach[left].max()))]
        start, stop = start[some], stop[some]
        rest_until = np.maximum(
            stop, np.minimum(rested[some], stop + _RAMP.rest_share * reach[some])
        )
        ramp = _ends_of_ramps(track, start, stop, rest_until)
        widest = (start == 0) | (reach[some] >= _RAMP.most_rows)
        certain = ramp.explained_m2 > _RAMP.certain * max(track.noise_m, STANDSTILL.rounding_m) ** 2
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
        exact = error_s <= _RAMP.exact_rows * interval_s
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


def _ends_of_ramps(
    track: SmoothedTrack, start: Indexes, stop: Indexes, rest_until: Indexes
) -> _Ramps:
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


def _is_same_ramp(track: SmoothedTrack, end: Indexes, rows: Indexes, wider: _Ramps) -> Flags:
    """Whether a ramp in more rows ends where it does if all of them are of one motion.

    The end of n rows at a speed is known to twice the noise over the speed and the root of n: the
    bound of Cramer and Rao, where neither speed nor end is known. Where both estimates reach it,
    the variance of their difference is the difference of their variances (J. A. Hausman,
    Specification tests in econometrics, Econometrica 46, 1978).
    """
    more = 1 / np.maximum(rows, 1) - 1 / np.maximum(wider.rows, 1)
    apart_m = (track.times[wider.end] - track.times[end]) * wider.speed_m_s
    moves = (wider.rows > 0) & (wider.speed_m_s > 0)
    return moves & (apart_m**2 <= more * (_RAMP.agreeing * 2 * track.noise_m) ** 2)


# -- whether it goes on slowly while it stays about a place, and where it rests then ---------------


class Rows:
    """The positions of a track as recorded, and means of any of its stretches at once."""

    def __init__(self, track: SmoothedTrack) -> None:
        self.noise_m = track.noise_m
        self.count = len(track.times)
        columns = (track.times, track.raw_x, track.raw_y)
        self._origins = [float(each[0]) for each in columns]
        self._sums = [
            np.concatenate(([0.0], np.cumsum(each - origin)))
            for each, origin in zip(columns, self._origins, strict=True)
        ]

    def means(self, starts: Indexes, ends: Indexes, parts: int) -> tuple[Array, ...]:
        """Rows and mean time, x and y of so many equal parts of each stretch [start, end)."""
        edges = starts[:, None] + (ends - starts)[:, None] * np.arange(parts + 1) // parts
        counts = np.diff(edges)
        some = np.maximum(counts, 1)
        means = (
            np.diff(sums[edges]) / some + origin
            for sums, origin in zip(self._sums, self._origins, strict=True)
        )
        return counts.astype(np.float64), *means


class _Lines(NamedTuple):
    """The steady motions that fit some stretches best.

    Attributes:
        error_m_s: Standard error of its speed in each coordinate; infinite for a single moment.
        left_m: Standard deviation of the places from it.
    """

    speed_m_s: Array
    error_m_s: Array
    left_m: Array
    lasts_s: Array


def is_creep(
    rows: Rows,
    starts: Indexes,
    ends: Indexes,
    radius_m: float,
    slowest_m_s: float,
    is_over: Callable[[], bool],
) -> Flags:
    """Whether stretches within a place are of a motion, be it that it only shows around them.

    What is slower than `slowest_m_s` is drift, not motion.
    """
    own, lengths = _lines_through(rows, starts, ends), ends - starts
    creeps = np.zeros(len(starts), np.bool_)
    for before, after in ((0, 0), *STANDSTILL.around):
        from_row = np.maximum(0, starts - before * lengths)
        to_row = np.minimum(rows.count, ends + after * lengths)
        line, moves = own, _drifts(rows, starts, ends, radius_m)
        if before or after:
            line = _lines_through(rows, from_row, to_row)
            moves = (to_row - from_row > lengths) & _is_one_motion(rows, line, radius_m)
            moves &= ~_is_slower(own, line)
        moves &= line.speed_m_s >= slowest_m_s
        leaves = line.speed_m_s * line.lasts_s > radius_m
        for at in np.flatnonzero(moves & ~creeps).tolist():
            place = int(from_row[at]), int(to_row[at])
            creeps[at] = bool(leaves[at]) or is_over() or not _only_twitches(rows, *place)
    return creeps


def _drifts(rows: Rows, starts: Indexes, ends: Indexes, radius_m: float) -> Flags:
    """Whether the mean place of the last third is another one than that of the first."""
    _, _, x, y = rows.means(starts, ends, 3)
    third = np.maximum(1, (ends - starts) // 3)
    error_m = rows.noise_m * np.sqrt(2 / third)
    way_m = np.hypot(x[:, 2] - x[:, 0], y[:, 2] - y[:, 0])
    return way_m > np.maximum(STANDSTILL.drift_share * radius_m, STANDSTILL.certain * error_m)


def _is_one_motion(rows: Rows, line: _Lines, radius_m: float) -> Flags:
    """A straight line in time explains all but the noise, and leads out of the place."""
    explained = line.left_m < max(STANDSTILL.same_course * rows.noise_m, 0.02 * radius_m)
    certain = line.speed_m_s > STANDSTILL.certain * line.error_m_s
    return explained & certain & (line.speed_m_s * line.lasts_s > 0.5 * radius_m)


def _is_slower(rest: _Lines, neighbours: _Lines) -> Flags:
    error_m_s = np.hypot(rest.error_m_s, STANDSTILL.rest_share * neighbours.error_m_s)
    return (
        STANDSTILL.rest_share * neighbours.speed_m_s - rest.speed_m_s
        > STANDSTILL.certainly_slower * error_m_s
    )


def _lines_through(rows: Rows, starts: Indexes, ends: Indexes) -> _Lines:
    counts, times, x, y = rows.means(starts, ends, STANDSTILL.means)
    total = np.maximum(counts.sum(axis=1), 1)
    times, x, y = (each - ((counts * each).sum(axis=1) / total)[:, None] for each in (times, x, y))
    squares = (counts * times**2).sum(axis=1)
    some = np.where(squares > 0, squares, np.inf)
    off_m2 = np.zeros(len(starts))
    speeds: list[Array] = []
    for each in (x, y):
        speeds.append((counts * times * each).sum(axis=1) / some)
        off_m2 += (counts * (each - speeds[-1][:, None] * times) ** 2).sum(axis=1) / total / 2
    # The means lack most of the noise that the rows have.
    off_m2 += rows.noise_m**2 * np.maximum(0, 1 - (counts > 0).sum(axis=1) / total)
    with np.errstate(divide="ignore"):
        error_m_s = np.where(squares > 0, rows.noise_m / np.sqrt(some), np.inf)
    lasts_s = times[:, -1] - times[:, 0]
    return _Lines(np.hypot(*speeds), error_m_s, np.sqrt(off_m2), lasts_s)


def rest_within(rows: Rows, start: int, end: int) -> tuple[int, int] | None:
    """The rows of a stretch in which it rested, if it crept up to there, on from there, or both.

    Of all motions that are a ramp, a rest and a ramp that with the least squares; each ramp has to
    explain more than noise does. The robot has to be certainly slower in the rest than on either
    side of it: a bend of a creep is no rest.
    """
    if end - start < 2:
        return None
    parts = min(STANDSTILL.fine_means, end - start)
    first, last, _ = _best_rest(*_fine_places(rows, start, end, parts))
    rest = (start + (end - start) * first // parts, start + (end - start) * last // parts)
    edges = [(start, rest[0]), rest, (rest[1], end)]
    lines = _lines_through(rows, *np.transpose(np.array(edges, np.intp)))
    slower = _is_slower(_Lines(*(each[1:2] for each in lines)), lines)
    beside = [slower[at] for at in (0, 2) if edges[at][1] > edges[at][0]]
    return rest if beside and all(beside) else None


def _fine_places(rows: Rows, start: int, end: int, parts: int) -> tuple[Array, float]:
    """Places of the parts of a stretch about their mean, and what noise explains of them."""
    edges = np.array([start]), np.array([end])
    counts, _, x, y = rows.means(*edges, parts)
    places = np.stack((x[0] - x.mean(), y[0] - y.mean()), axis=1)
    apart_m = float(np.hypot(*np.ptp(places, axis=0))) / parts  # motion may end within a part
    return places, STANDSTILL.certain**2 * (rows.noise_m**2 / float(counts.mean()) + apart_m**2)


def _best_rest(places: Array, least_m2: float) -> tuple[int, int, float]:
    """From and to which of the places it rests, and how many squares that explains."""
    firsts, lasts, bases = _rests_among(len(places))
    explained: Array = np.sum((bases @ places) ** 2, axis=1).reshape(len(firsts), -1).sum(axis=1)
    explained -= least_m2 * ((firsts > 0) + 1.0 * (lasts < len(places)))
    best = int(np.argmax(explained))
    return int(firsts[best]), int(lasts[best]), float(explained[best])


@lru_cache(maxsize=32)
def _rests_among(count: int) -> tuple[Indexes, Indexes, Array]:
    """From and to which of so many places a robot may rest, and what each motion can explain.

    A rest with one ramp may end at every place. The bases are orthonormal, as many rows for each.
    """
    inner = np.arange(1, count)
    borders = np.unique(np.linspace(0, count, STANDSTILL.borders).astype(np.intp))
    firsts, lasts = (borders[each] for each in np.triu_indices(len(borders), 1))
    nothing, all_of_it = np.zeros_like(inner), np.full_like(inner, count)
    firsts = np.concatenate((firsts, inner, nothing))
    lasts = np.concatenate((lasts, all_of_it, inner))
    times = np.arange(count, dtype=np.float64)
    ramps = (np.minimum(times - firsts[:, None], 0.0), np.maximum(times - lasts[:, None] + 1, 0.0))
    left, sizes, _ = np.linalg.svd(
        np.stack((np.ones_like(ramps[0]), *ramps), axis=-1), full_matrices=False
    )
    bases: Array = left * (sizes > 1e-9 * sizes[:, :1])[:, None, :]
    return firsts, lasts, np.ascontiguousarray(np.concatenate(np.swapaxes(bases, 1, 2)))


def _only_twitches(rows: Rows, start: int, end: int) -> bool:
    """Whether a few steps explain a stretch better than a slow motion does.

    The steps are found one by one, each where it explains most.
    """
    parts = min(STANDSTILL.fine_means, end - start)
    places, least_m2 = _fine_places(rows, start, end, parts)
    steps_m2, edges = 0.0, [0, parts]
    for _ in range(STANDSTILL.most_twitches):
        gain_m2, at = max(_best_step(places, *pair) for pair in pairwise(edges))
        if gain_m2 <= least_m2:
            break
        steps_m2 += gain_m2 - least_m2
        edges = sorted([*edges, at])
    return steps_m2 > _best_rest(places, least_m2)[2]


def _best_step(places: Array, start: int, end: int) -> tuple[float, int]:
    """How many squares a step within [start, end) explains at most, and before which place."""
    if end - start < 2:
        return 0.0, start
    part = places[start:end] - places[start:end].mean(axis=0)
    before = np.arange(1, end - start)
    sums_m2 = (np.cumsum(part, axis=0)[:-1] ** 2).sum(axis=1)
    gains_m2 = sums_m2 * (end - start) / (before * (end - start - before))
    best = int(np.argmax(gains_m2))
    return float(gains_m2[best]), start + best + 1
