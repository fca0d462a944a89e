"""Whether a robot that stays about a place for long goes on slowly, and where it rests then."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.analysis.track import Track

DRIFT_SHARE: Final = 0.15  # of the radius: who came farther between its first and last third moves
CERTAIN: Final = 4.0  # standard errors
SAME_COURSE: Final = 1.25  # times the noise: the residual of a motion that explains all rows
REST_SHARE: Final = 0.5  # of the speed next to it: a part that is certainly slower is a rest
CERTAINLY_SLOWER: Final = 3.0  # standard errors: the ramps next to it are certain already
# So many times its own length before and after a stretch is looked for the same motion.
_AROUND: Final = ((1, 1), (0, 2), (2, 0), (0, 5), (5, 0))
MOST_AROUND: Final = 5
_MEANS: Final = 30  # of neighbouring rows, that a line is laid through
_FINE_MEANS: Final = 120  # in which a rest is looked for
_BORDERS: Final = 25  # at which a rest between two ramps may begin and end
_MOST_TWITCHES: Final = 12


class Rows:
    """The positions of a track as recorded, and means of any of its stretches at once."""

    def __init__(self, track: Track) -> None:
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


def is_creep(rows: Rows, starts: Indexes, ends: Indexes, radius_m: float) -> Flags:
    """Whether stretches within a place are of a motion, be it that it only shows around them."""
    own, lengths = _lines_through(rows, starts, ends), ends - starts
    creeps = np.zeros(len(starts), np.bool_)
    for before, after in ((0, 0), *_AROUND):
        from_row = np.maximum(0, starts - before * lengths)
        to_row = np.minimum(rows.count, ends + after * lengths)
        line, moves = own, _drifts(rows, starts, ends, radius_m)
        if before or after:
            line = _lines_through(rows, from_row, to_row)
            moves = (to_row - from_row > lengths) & _is_one_motion(rows, line, radius_m)
            moves &= ~_is_slower(own, line)
        leaves = line.speed_m_s * line.lasts_s > radius_m
        for at in np.flatnonzero(moves & ~creeps).tolist():
            place = int(from_row[at]), int(to_row[at])
            creeps[at] = bool(leaves[at]) or not _only_twitches(rows, *place)
    return creeps


def _drifts(rows: Rows, starts: Indexes, ends: Indexes, radius_m: float) -> Flags:
    """Whether the mean place of the last third is another one than that of the first."""
    _, _, x, y = rows.means(starts, ends, 3)
    third = np.maximum(1, (ends - starts) // 3)
    error_m = rows.noise_m * np.sqrt(2 / third)
    way_m = np.hypot(x[:, 2] - x[:, 0], y[:, 2] - y[:, 0])
    return way_m > np.maximum(DRIFT_SHARE * radius_m, CERTAIN * error_m)


def _is_one_motion(rows: Rows, line: _Lines, radius_m: float) -> Flags:
    """A straight line in time explains all but the noise, and leads out of the place."""
    explained = line.left_m < max(SAME_COURSE * rows.noise_m, 0.02 * radius_m)
    certain = line.speed_m_s > CERTAIN * line.error_m_s
    return explained & certain & (line.speed_m_s * line.lasts_s > 0.5 * radius_m)


def _is_slower(rest: _Lines, neighbours: _Lines) -> Flags:
    error_m_s = np.hypot(rest.error_m_s, REST_SHARE * neighbours.error_m_s)
    return REST_SHARE * neighbours.speed_m_s - rest.speed_m_s > CERTAINLY_SLOWER * error_m_s


def _lines_through(rows: Rows, starts: Indexes, ends: Indexes) -> _Lines:
    counts, times, x, y = rows.means(starts, ends, _MEANS)
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
    parts = min(_FINE_MEANS, end - start)
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
    return places, CERTAIN**2 * (rows.noise_m**2 / float(counts.mean()) + apart_m**2)


def _best_rest(places: Array, least_m2: float) -> tuple[int, int, float]:
    """From and to which of the places it rests, and how many squares that explains."""
    firsts, lasts, bases = _rests_among(len(places))
    explained = (np.einsum("knp,nc->kpc", bases, places) ** 2).sum(axis=(1, 2))
    explained -= least_m2 * ((firsts > 0) + 1.0 * (lasts < len(places)))
    best = int(np.argmax(explained))
    return int(firsts[best]), int(lasts[best]), float(explained[best])


@lru_cache(maxsize=8)
def _rests_among(count: int) -> tuple[Indexes, Indexes, Array]:
    """From and to which of so many places a robot may rest, and what each motion can explain.

    A rest with one ramp may end at every place. The bases are orthonormal.
    """
    inner = np.arange(1, count)
    borders = np.unique(np.linspace(0, count, _BORDERS).astype(np.intp))
    firsts, lasts = (borders[each] for each in np.triu_indices(len(borders), 1))
    nothing, all_of_it = np.zeros_like(inner), np.full_like(inner, count)
    firsts = np.concatenate((firsts, inner, nothing))
    lasts = np.concatenate((lasts, all_of_it, inner))
    times = np.arange(count, dtype=np.float64)
    ramps = (np.minimum(times - firsts[:, None], 0.0), np.maximum(times - lasts[:, None] + 1, 0.0))
    left, sizes, _ = np.linalg.svd(
        np.stack((np.ones_like(ramps[0]), *ramps), axis=-1), full_matrices=False
    )
    bases = left * (sizes > 1e-9 * sizes[:, :1])[:, None, :]
    return firsts, lasts, bases


def _only_twitches(rows: Rows, start: int, end: int) -> bool:
    """Whether a few steps explain a stretch better than a slow motion does.

    The steps are found one by one, each where it explains most.
    """
    parts = min(_FINE_MEANS, end - start)
    places, least_m2 = _fine_places(rows, start, end, parts)
    steps_m2, edges = 0.0, [0, parts]
    for _ in range(_MOST_TWITCHES):
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
