"""Regular swings: where a value goes to and fro, how fast and how far.

Looked at are second differences, x(t + lag) - 2 x(t) + x(t - lag) with a lag of about a quarter of
a period: a sine stays a sine in them, a straight course is 0, and a bend of the course is short, so
that swings are found over ramps, turns and slow drifts alike. Each octave of periods is searched in
means of twice as many rows. Windows in which the signs are those of a sine are put together; few of
these stretches stand out of their surroundings, and to those sines are fitted. What is well
explained by them, loud and long enough is a swing, unless it never turns back and is made of
straight pieces.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple, cast

from webots_mcp.analysis.arrays import (
    Array,
    Flags,
    Indexes,
    gap_borders,
    in_order,
    median,
    noise_of,
    np,
    rounding_of,
    sums_of,
    with_lost_rows,
)

LEAST_HALF_SWINGS: Final = 6  # four are made by a value that fell, rested, and rose again
# Of a period above `SEARCH.slow_period_s`.
SLOW_HALF_SWINGS: Final = 12
SHORTEST_PERIOD_ROWS: Final = 8.0  # fewer rows a period do not show its shape


class _SearchSettings(NamedTuple):
    """How windows are searched for the signs of a sine, in means of rows."""

    # Beyond, bends of a path come as regularly by chance, but hardly ever `SLOW_HALF_SWINGS` times.
    slow_period_s: float = 5.0
    # Of a level, in means. What the first or the last one explains best is seen by another level.
    periods: tuple[float, ...] = (7.1, 8.0, 8.8, 9.8, 11.0, 12.4, 14.2, 16.2, 18.4)
    shift: int = 3  # means: about a quarter of these periods
    block: int = 8  # means from one window to the next
    window: int = 4  # blocks: two to four periods
    sign_changes: tuple[int, int] = (3, 12)  # in a window: a sine has 4 to 8, noise of the rows 16
    likely: float = 0.58  # of the signs a sine explains 0.83, and of white noise 0.58 once in 500
    linked: float = 0.45  # the same, of a window next to a likely one
    signs_of_sine: float = 0.83
    at_once: int = 16_384  # means, which stay in the cache of a processor
    unthreaded: int = 400  # windows in a product that BLAS does not share between threads
    surrounding: int = 16  # blocks of which the lower quartile is taken
    same_period: float = 1.25  # ratio of the periods of two windows of one oscillation ...
    as_loud: float = 3.0  # ... and of their sizes
    hidden: float = 2.0  # periods for which bends may hide an oscillation that goes on
    promising: float = 90.0  # as `DECIDE.enough`, by what the signs tell


SEARCH: Final = _SearchSettings()


class _FitSettings(NamedTuple):
    """How the period and the ends of an oscillation are fitted."""

    fitted_rows: int = 16  # means a period where ends and shape are measured
    lag: float = 0.25  # of the period
    clipped: float = 1.5  # times the median magnitude: a sine has a height of 1.4 times its own
    rests: float = 0.75  # of a period, in which the value ...
    quiet: float = 0.3  # ... bends by less than that share of what is usual
    settled: int = 2  # periods, from which the sine is continued to find its ends
    edge: float = 0.13  # of the period by which a sine that begins at 0 shows earlier
    # Of the period: an end this near to the end of the recording counts as reaching it.
    at_end: float = 0.5
    piece: float = 5.0  # periods of one phase: over more, an oscillation may change
    tried: tuple[float, float, float] = (0.94, 1.0, 1.06)  # of the period
    farthest: float = 1.4  # times as far from the middle one the best may be
    unsure: float = 1.1  # times as short the period may be as it seems before it is fitted
    rounds: int = 2  # of fitting; after them bends do not count
    outlying: float = 2.5  # median residuals beyond which a value is a bend
    most_noise: float = 0.12  # of the squares of second differences, that is taken for noise


FIT: Final = _FitSettings()


class _DecisionSettings(NamedTuple):
    """When what was fitted counts as an oscillation."""

    reach: float = 30.0  # periods before and after are the surroundings
    few_periods: float = 1.5  # of surroundings say nothing
    loudest: float = 6.0  # times its surroundings: more is not more certain
    unknown_loudness: float = 3.5  # where nothing surrounds it
    # Median magnitude of a normal variable, and that over its lower quartile.
    median: float = 0.6745
    median_to_quartile: float = median / 0.3186
    enough: float = 850.0  # of `evidence`: random courses reach it less than once an hour
    turns_back: float = 0.08  # of the way there a value comes back that does not only go one way
    many_periods: int = 12  # of which some may belong to an oscillation within a staircase
    straight: float = 0.085  # of the sine its harmonics reach where straight pieces make it ...
    doubt: float = 4.7  # ... after subtracting this multiple of the variance due to noise
    noise_amplitudes: float = 3.0  # minimum amplitude in standard deviations of the noise ...
    mean_amplitudes: float = 12.0  # ... or in those of a mean over half an oscillation
    same_number: float = 1e-9  # of the value: what adding up floating-point numbers makes of one
    switched_values: int = 3
    most_overlap: float = 0.2  # of the shorter one ...
    much_slower: float = 4.0  # ... and ratio of periods above which two are not one oscillation
    # Ratios of periods and of amplitudes on both sides of a gap.
    alike: tuple[float, float] = (1.15, 1.5)


DECIDE: Final = _DecisionSettings()
_LEAST_SQUARES: Final = 1e-12  # of a sine in rows that do not show it


@dataclass(frozen=True)
class Swing:
    """A stretch in which a value went to and fro regularly.

    Attributes:
        half_swings: How many there are in the time that was recorded of it.
        amplitude: Half of the way from one turning point to the next.
        explained: Share of the second differences that sines explain, 0 to 1.
    """

    start_s: float
    end_s: float
    half_swings: int
    period_s: float
    amplitude: float
    explained: float


@dataclass(frozen=True)
class EvenRows:
    """The rows of several signals: where time moved on, in stretches without recording gaps.

    Attributes:
        recorded: Times at which time moved on; `moving` is in which rows, None for all.
        times: The same and those of single lost rows, so that they come evenly.
        borders: Where a stretch begins in `times`.
    """

    recorded: Array
    moving: Flags | None
    times: Array
    borders: Indexes
    interval_s: float

    @classmethod
    def of(cls, times: Array) -> EvenRows:
        """Rows of a paused simulation count once."""
        intervals = np.diff(times)
        moving = None
        if len(intervals) and not intervals.min() > 0:
            moving = np.concatenate(([True], intervals > 0))
            times = times[moving]
            intervals = np.diff(times)
        interval_s = median(intervals) if len(intervals) else 0.0
        even = with_lost_rows(times, interval_s)
        return cls(times, moving, even, gap_borders(even, interval_s), interval_s)

    def even(self, values: Array) -> Array:
        """Return the value at each of `times`, of the values in all rows."""
        values = values if self.moving is None else values[self.moving]
        if len(self.times) == len(self.recorded):
            return values
        return np.interp(self.times, self.recorded, values)

    def stretches(self, values: Array) -> Iterator[tuple[Array, Array]]:
        """Yield times and values of each stretch, of values at `times`."""
        edges = [0, *self.borders.tolist(), len(self.times)]
        for start, stop in itertools.pairwise(edges):
            yield self.times[start:stop], values[start:stop]


def find_swings(
    times: Array, values: Array, *, least_half_swings: int, longest_period_s: float
) -> list[Swing]:
    """Swings of one signal, in order; angles have to be unwrapped.

    A swing has at least so many half swings that are alike, with a period of more than 5 s at
    least 12, and rises above noise, rounding and what the value does around it anyway. A swing
    that reaches a recording gap and is the same after it is one swing.
    """
    return swings_in(EvenRows.of(times), values, least_half_swings, longest_period_s)


def swings_in(
    rows: EvenRows, values: Array, least_half_swings: int, longest_period_s: float
) -> list[Swing]:
    """As `find_swings`, of one of several signals."""
    found: list[Swing] = []
    values = rows.even(values)
    for times, part in rows.stretches(values):
        if len(part) > 3 * SHORTEST_PERIOD_ROWS and part.min() < part.max():
            stretch = _Stretch(times, part, least_half_swings, longest_period_s)
            found += _best(list(stretch.swings()))
    return _joined(found, rows, values)


class _Stretch:
    """Rows that come evenly, in which swings are looked for."""

    def __init__(self, times: Array, values: Array, least: int, longest_s: float) -> None:
        self.times, self.values = times, values
        self.interval_s = float(times[-1] - times[0]) / (len(times) - 1)
        self.least, self.longest_s = least, longest_s

    def swings(self) -> Iterator[Swing]:
        """Those of each octave of periods; what two of them see is found twice."""
        means, rows, resolution = self.values, 1, _resolution(self.values)
        while (
            rows * SHORTEST_PERIOD_ROWS * self.interval_s < self.longest_s
            and len(means) > 3 * SHORTEST_PERIOD_ROWS
        ):
            for start, stop, period in _likely(means, resolution):
                most = (stop - start) / period + SEARCH.hidden
                if self._is_enough(2 * most, period * rows / SEARCH.same_period):
                    yield from self._measured(start * rows, stop * rows, period * rows)
            means, rows = _means(means, 2), 2 * rows

    def _is_enough(self, half_swings: float, period: float) -> bool:
        is_slow = period * self.interval_s > SEARCH.slow_period_s
        return half_swings >= max(self.least, SLOW_HALF_SWINGS * is_slow)

    def _measured(self, start: int, stop: int, period: float) -> Iterator[Swing]:
        """The swings of about these rows and that period: the value may rest between them."""
        margin = math.ceil(SEARCH.hidden * period)
        low = max(0, start - margin)
        step = max(1, int(period / FIT.fitted_rows))
        period /= step
        lag = math.ceil(FIT.lag * period)
        bends = _bends(_means(self.values[low : stop + margin], step), lag)
        first, last = (start - low) // step, (stop - low) // step - 2 * lag
        for begin, end in _busy(np.abs(bends), first, last, round(FIT.rests * period)):
            part, inside = bends[begin:end], (max(first, begin) - begin, min(last, end) - begin)
            if inside[1] - inside[0] >= 1.5 * period:
                ends = _ends(part, *inside, period)
                offset = low + (begin + lag) * step
                yield from self._judged(offset, part[ends], ends, (step, lag, period))

    def _judged(
        self, offset: int, bends: Array, ends: slice, scale: tuple[int, int, float]
    ) -> Iterator[Swing]:
        """The swing from one place to another of second differences, if it is one.

        Args:
            offset: Row of the first of which `ends` counts from.
            bends: Second differences between the ends.
            ends: Their places.
            scale: Rows of the means of which they are made; lag and period, in means.
        """
        step, lag, period = scale
        edge = FIT.edge * period
        start, stop = (round(offset + at * step) for at in (ends.start + edge, ends.stop - edge))
        last = len(self.values) - 1
        start = 0 if start < FIT.at_end * period * step else start
        stop = last if stop > last - FIT.at_end * period * step else stop
        most = 2 * (stop - start) / (period * step) * FIT.unsure
        if not self._is_enough(most, period * step / FIT.unsure):
            return
        rows = slice(start, stop + 1)
        loudness = self._loudness(rows, period * step)
        fit = Fit.of(bends, period)
        if evidence(loudness, 1.0, fit.explained, most) < DECIDE.enough:
            return
        values = self.values[rows]
        noise = noise_of(values)
        robustly, amplitude, period = fit.refined(6 * noise**2 / step)
        gain = 2 - 2 * math.cos(2 * math.pi * lag / period)
        period *= step
        count = round(2 * (stop - start) / period)
        if not self._is_enough(count, period) or period * self.interval_s > self.longest_s:
            return
        if evidence(loudness, robustly, fit.explained, count) < DECIDE.enough:
            return
        amplitude = min(amplitude / gain / float(np.sinc(step / period)), _highest(values, period))
        least = (
            min(DECIDE.noise_amplitudes, DECIDE.mean_amplitudes / (period * count / 2) ** 0.5)
            * noise
        )
        if amplitude < max(least, _resolution(values), rounding_of(values)):
            return
        if _turns_back(values, period) < DECIDE.turns_back and _is_straight(values, period, noise):
            return
        ends_s = float(self.times[start]), float(self.times[stop])
        yield Swing(*ends_s, count, period * self.interval_s, amplitude, fit.explained)

    def _loudness(self, rows: slice, period: float) -> float:
        """How much larger its second differences are than the lower quartile around it."""
        step = max(1, int(period / FIT.fitted_rows))
        lag, far = math.ceil(FIT.lag * period / step), int(DECIDE.reach * period)
        parts = rows, slice(max(0, rows.start - far), rows.start), slice(rows.stop, rows.stop + far)
        sizes = [np.abs(_bends(_means(self.values[part], step), lag)) for part in parts]
        around = np.concatenate(sizes[1:])
        if len(around) < DECIDE.few_periods * period / step:
            return DECIDE.unknown_loudness
        inside, usual = median(sizes[0]), _quartile(around) * DECIDE.median_to_quartile
        return inside / usual if usual * DECIDE.loudest > inside else DECIDE.loudest


def evidence(loudness: float, robustly: float, explained: float, count: float) -> float:
    """How much speaks for a swing: it grows with each of loudness, length and regularity.

    Args:
        loudness: How many times larger than its surroundings.
        robustly: Share of the median square that sines explain; bends do not lower it.
        explained: Share of all squares, of values clipped at what a sine reaches.
        count: Half swings.
    """
    unexplained = (1.01 - max(0.0, robustly)) ** (2 / 3) * (1.05 - min(explained, 1.0)) ** (1 / 3)
    return loudness**1.5 * count / unexplained


def _bends(values: Array, lag: int) -> Array:
    """Second differences; the first one is about value `lag`."""
    if len(values) <= 2 * lag:
        return values[:0]
    bends = values[lag:-lag] * -2
    bends += values[2 * lag :]
    bends += values[: -2 * lag]
    return bends


def _means(values: Array, step: int) -> Array:
    """Of so many values each; a rest at the end that is less is left out."""
    if step == 1:
        return values
    count = len(values) // step
    if step == 2:
        return (values[: 2 * count : 2] + values[1 : 2 * count : 2]) / 2
    return np.einsum("ij->i", np.reshape(values[: count * step], (count, step))) / step


def _clipped(values: Array, limit: float | Array) -> Array:
    return np.asarray(np.minimum(np.maximum(values, -limit), limit), np.float64)


def _quartile(sizes: Array) -> float:
    """The lower one."""
    return in_order(sizes, len(sizes) // 4)


def _resolution(values: Array) -> float:
    """The smallest step of values; 0 of so few that something is switched."""
    steps: Array = np.abs(np.diff(values))
    low, high = float(values.min()), float(values.max())
    same = DECIDE.same_number * max(high, -low)
    least = float(steps.min(initial=np.inf))
    if least <= same:
        least = float(np.where(steps > same, steps, np.inf).min(initial=np.inf))
    return least if high - low >= DECIDE.switched_values * least else 0.0


def _likely(means: Array, resolution: float) -> Iterator[tuple[int, int, float]]:
    """Where means [start, stop) seem to swing, and with about which period."""
    share, which, sizes = _windows(means)
    good = np.flatnonzero((share > SEARCH.linked) & (which > 0) & (which < len(SEARCH.periods) - 1))
    if not len(good) or share[good].max() < SEARCH.likely:
        return
    blocks = sizes[good[:, None] + np.arange(SEARCH.window)]
    loud = np.partition(blocks, SEARCH.window // 4, axis=1)[:, SEARCH.window // 4]
    good, loud = good[loud > resolution / 2], loud[loud > resolution / 2]
    usual = _usual(sizes)
    for group in _groups(good, share[good], which[good], loud):
        at = good[group]
        start, stop = (
            int(at[0]) * SEARCH.block,
            (int(at[-1]) + SEARCH.window) * SEARCH.block + 2 * SEARCH.shift,
        )
        period = _period(which[at])
        loudness = median(loud[group]) / max(float(usual[at].min()), 1e-100)
        unexplained = 1.05 - float(share[at].mean()) / SEARCH.signs_of_sine
        if min(loudness, 1e9) ** 1.5 * 2 * (stop - start) / period / unexplained > SEARCH.promising:
            yield start, min(stop, len(means)), period


def _period(which: Indexes) -> float:
    """The most frequent one."""
    return SEARCH.periods[int(np.argmax(np.bincount(which)))]


def _groups(good: Indexes, share: Array, which: Indexes, loud: Array) -> Iterator[Indexes]:
    """Places of windows that are alike, though for a while something may hide the swing."""
    apart = (np.diff(good) > SEARCH.window // 2) | (np.abs(np.diff(which)) > 1)
    apart |= np.abs(np.diff(np.log(loud))) > math.log(SEARCH.as_loud) / 2
    waiting: list[tuple[float, float, Indexes]] = []
    edges = [0, *(np.flatnonzero(apart) + 1).tolist(), len(good)]
    likely: list[int] = []
    if len(good):
        likely = np.flatnonzero(np.maximum.reduceat(share, edges[:-1]) >= SEARCH.likely).tolist()
    for at in likely:
        group: Indexes = np.arange(edges[at], edges[at + 1])
        period, size = _period(which[group]), median(loud[group])
        beside, waiting = waiting, []
        for other in beside:
            between = (good[group[0]] - good[other[2][-1]] - SEARCH.window) * SEARCH.block
            if between > SEARCH.hidden * period:
                yield other[2]
            elif (
                _ratio(period, other[0]) < SEARCH.same_period
                and _ratio(size, other[1]) < SEARCH.as_loud
            ):
                group = np.concatenate((other[2], group))
            else:
                waiting.append(other)
        waiting.append((period, size, group))
    yield from (each[2] for each in waiting)


def _windows(means: Array) -> tuple[Array, Indexes, Array]:
    """Of each window the share of signs that a sine explains, and which one; sizes of blocks.

    0 of those in which the sign changes much less or more often than a sine's.
    """
    rows, beyond = (
        SEARCH.window * SEARCH.block,
        (SEARCH.window - 1) * SEARCH.block + 2 * SEARCH.shift,
    )
    span = float(np.ptp(means)) or 1.0  # to which short floats are reduced, which reach 1e38
    found: list[tuple[Array, Indexes, Array]] = []
    for begin in range(0, max(1, len(means) - beyond), SEARCH.at_once):
        part = means[begin : begin + SEARCH.at_once + beyond]
        bends = _bends(((part - part[0]) / span).astype(np.float32), SEARCH.shift)
        if len(bends) < rows:
            bends = np.pad(bends, (0, rows - len(bends)))
        blocks: Array = np.reshape(
            bends[: len(bends) // SEARCH.block * SEARCH.block], (-1, SEARCH.block)
        )
        above = np.ravel(blocks) > 0
        changed = above != np.append(above[:1], above[:-1])
        changes = sums_of(np.bitwise_count(changed.view(np.uint64)), SEARCH.window)
        share, which = np.zeros(len(changes)), np.zeros(len(changes), np.intp)
        some = np.flatnonzero(
            (changes >= SEARCH.sign_changes[0]) & (changes <= SEARCH.sign_changes[1])
        )
        for at in range(0, len(some), SEARCH.unthreaded):
            these = some[at : at + SEARCH.unthreaded]
            signs = np.reshape(
                np.sign(blocks[these[:, None] + np.arange(SEARCH.window)]), (-1, rows)
            )
            squares = (_waves() @ np.transpose(signs)) ** 2
            squares = squares[: len(SEARCH.periods)] + squares[len(SEARCH.periods) :]
            share[these], which[these] = squares.max(axis=0) / rows, squares.argmax(axis=0)
        found.append((share, which, np.einsum("ij->i", np.abs(blocks)) / SEARCH.block))
    shares, periods, blocks_of = zip(*found, strict=True)
    sizes = [each[: len(share)] for share, _, each in found[:-1]]
    of_blocks = np.concatenate([*sizes, blocks_of[-1]]).astype(np.float64) * span
    return np.concatenate(shares), np.concatenate(periods), of_blocks


@lru_cache(1)  # the same for all
def _waves() -> Array:
    """Cosines and sines of length 1 as rows."""
    places: Array = (
        np.arange(SEARCH.window * SEARCH.block, dtype=np.float64)
        - (SEARCH.window * SEARCH.block - 1) / 2
    )
    angles: Array = 2 * np.pi * places[:, None] / np.array(SEARCH.periods)
    waves = np.concatenate((np.cos(angles), np.sin(angles)), axis=1)
    waves /= np.sqrt(np.einsum("ij,ij->j", waves, waves))
    return cast("Array", np.ascontiguousarray(np.transpose(waves), np.float32))  # half as slow


def _usual(sizes: Array) -> Array:
    """The lower quartile about each size, the least of three such stretches."""
    count, quarter = len(sizes) // SEARCH.surrounding, SEARCH.surrounding // 4
    if count < 2:
        return np.full(len(sizes), _quartile(sizes))
    parts: Array = np.reshape(sizes[: count * SEARCH.surrounding], (count, SEARCH.surrounding))
    usual = np.partition(parts, quarter, axis=1)[:, quarter]
    padded: Array = np.concatenate((usual[:1], usual, usual[-1:]))
    least = np.minimum(np.minimum(padded[:-2], usual), padded[2:])
    return least[np.minimum(np.arange(len(sizes)) // SEARCH.surrounding, count - 1)]


def _busy(sizes: Array, first: int, last: int, rows: int) -> Iterator[tuple[int, int]]:
    """Where [start, stop) no stretch of so many is quiet, within and around [first, last)."""
    if last - first < rows:
        return
    sums = sums_of(sizes, rows)
    loud = sums >= FIT.quiet * median(sums[first : last - rows + 1])
    edges = np.flatnonzero(np.diff(loud, prepend=False, append=False)).tolist()
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        yield start, stop - 1 + rows


def _ends(bends: Array, first: int, last: int, period: float) -> slice:
    """Where the swing that [first, last) is part of begins and ends."""
    clipped = _clipped(bends, FIT.clipped * median(np.abs(bends[first:last])))
    period = _best_period(_pieces(clipped[first:last], period), None, period)
    begin = _begin(clipped, first, period)
    return slice(begin, len(bends) - _begin(clipped[::-1], len(bends) - last, period))


def _begin(bends: Array, inside: int, period: float) -> int:
    """Where the sine begins that swings from there on: before, it explains nothing."""
    settled = inside + int(period / 2)
    part = slice(settled, settled + round(FIT.settled * period))
    angles: Array = np.arange(min(part.stop, len(bends)), dtype=np.float64) * (2 * np.pi / period)
    waves = np.empty((2, len(angles)))
    np.cos(angles, out=waves[0])
    np.sin(angles, out=waves[1])
    end, rows = inside + int(period), len(bends[part])
    swing = (waves[:, part] @ bends[part]) @ waves[:, :end] * (2 / max(1, rows))
    gains = np.abs(bends[:end]) - np.abs(bends[:end] - swing)
    return int(gains[::-1].cumsum()[::-1].argmax())


@dataclass(frozen=True)
class Fit:
    """Sines of one period in second differences that are clipped at what a sine reaches.

    Attributes:
        pieces: Of second differences, which each have a phase and a height of their own.
        explained: Share of the squares.
    """

    pieces: Array
    clipped: Array
    model: Array
    period: float
    explained: float

    @classmethod
    def of(cls, bends: Array, period: float) -> Fit:
        """Of about that period."""
        pieces = _pieces(bends, period)
        middle = pieces.shape[1] // 2
        usual = np.partition(np.abs(pieces), middle, axis=1)[:, middle, None]
        clipped = _clipped(pieces, FIT.clipped * usual)
        period, _, model = _sines(clipped, None, period)
        left = float(np.square(clipped - model).sum())
        squares = float(np.square(clipped).sum())
        return cls(pieces, clipped, model, period, 1 - left / squares if squares else 0.0)

    def refined(self, noise: float) -> tuple[float, float, float]:
        """What sines explain of the squared median, their median amplitude and their period.

        Fitted to all to which the fit before is near, so that bends do not count.

        Args:
            noise: Variance of the noise in second differences, which nothing explains.
        """
        usual = median(np.abs(self.clipped).ravel())
        period, model, amplitudes = self.period, self.model, self.pieces
        for _ in range(FIT.rounds):
            sizes: Array = np.abs(self.pieces - model)
            near = sizes <= FIT.outlying * median(sizes.ravel()) + usual / 20
            period, amplitudes, model = _sines(self.pieces, near.astype(np.float64), period)
        rest = median(np.abs(self.clipped - model).ravel()) ** 2
        rest -= min(FIT.most_noise * usual**2, DECIDE.median**2 * noise)
        robustly = 1 - max(0.0, rest) / usual**2 if usual else 0.0
        return robustly, median(amplitudes[:, 0]), period


def _pieces(values: Array, period: float) -> Array:
    """Parts of a few periods, one in each row."""
    count = max(1, round(len(values) / period / FIT.piece))
    rows = len(values) // count
    return np.reshape(values[: count * rows], (count, rows))


def _best_period(pieces: Array, weights: Array | None, period: float) -> float:
    """The period about the given one whose sines explain most."""
    gains = _fits(pieces, weights, period * np.array(FIT.tried)).gains
    low, middle, high = gains.sum(axis=0).tolist()
    bend = 2 * middle - low - high  # of the parabola through them: its vertex is the best
    most = FIT.tried[2] - 1
    aside = (high - low) / (2 * bend) if bend > 0 else math.copysign(1.0, high - low)
    return period * (1 + most * max(-FIT.farthest, min(FIT.farthest, aside)))


def _sines(pieces: Array, weights: Array | None, period: float) -> tuple[float, Array, Array]:
    """The best period about the given one, and the heights and values of its sines."""
    period = _best_period(pieces, weights, period)
    fits = _fits(pieces, weights, np.array([period]))
    model = fits.of_sine * np.transpose(fits.sine)
    model += fits.of_cosine * np.transpose(fits.cosine)
    return period, np.hypot(fits.of_sine, fits.of_cosine), model


class _SineFits(NamedTuple):
    """Sines of some periods that are fitted to pieces.

    Attributes:
        of_sine: Coefficients, pieces by periods; `of_cosine` likewise.
        gains: The squares that they explain.
        sine: Rows by periods; `cosine` likewise.
    """

    of_sine: Array
    of_cosine: Array
    gains: Array
    sine: Array
    cosine: Array


def _fits(pieces: Array, weights: Array | None, periods: Array) -> _SineFits:
    """Fit sines of some periods; without weights all values count alike."""
    rows = pieces.shape[1]
    places: Array = np.arange(rows, dtype=np.float64) - (rows - 1) / 2
    frequencies: Array = 2 * np.pi / periods
    angles: Array = places[:, None] * frequencies
    sine, cosine = np.sin(angles), np.cos(angles)
    if weights is None:  # about the middle, sine and cosine are orthogonal: Dirichlet's kernel
        even = np.sin(rows * frequencies) / np.sin(frequencies)
        sy, cy = pieces @ sine, pieces @ cosine
        of_sine = sy / np.maximum((rows - even) / 2, _LEAST_SQUARES)
        of_cosine = cy / np.maximum((rows + even) / 2, _LEAST_SQUARES)
    else:
        weighted = weights * pieces
        ss, cc = weights @ (sine * sine), weights @ (cosine * cosine)
        sc = weights @ (sine * cosine)
        sy, cy = weighted @ sine, weighted @ cosine
        determinant: Array = np.maximum(ss * cc - sc * sc, _LEAST_SQUARES)
        of_sine, of_cosine = (sy * cc - cy * sc) / determinant, (cy * ss - sy * sc) / determinant
    return _SineFits(of_sine, of_cosine, of_sine * sy + of_cosine * cy, sine, cosine)


def _highest(values: Array, period: float) -> float:
    """Half of what the values usually reach in a period: of a clipped one the sine is higher."""
    rows = round(period)
    count = len(values) // rows
    slope = median(values[rows:] - values[:-rows]) / rows
    level = values - slope * np.arange(len(values))
    heights = np.ptp(np.reshape(level[: count * rows], (count, rows)), axis=1)
    # The rows next to a turn are as far from it as the angle.
    return median(heights) / 2 / math.cos(min(math.pi / period, math.pi / 4))


def _turns_back(values: Array, period: float) -> float:
    """The share of its way there that a value comes back; of many periods in most of them."""
    step = max(1, int(period / 8))
    steps = np.diff(_means(values, step))
    rows = round(period / step) if len(values) > DECIDE.many_periods * period else len(steps)
    parts: Array = np.reshape(steps[: len(steps) // rows * rows], (-1, rows))
    up, down = np.maximum(parts, 0).sum(axis=1), np.maximum(-parts, 0).sum(axis=1)
    return median(np.minimum(up, down) / np.maximum(np.maximum(up, down), 1e-300))


def _is_straight(values: Array, period: float, noise: float) -> bool:
    """Whether it is a staircase of straight pieces: a sine on a ramp has no harmonics.

    About its slope, a staircase of ramps that last half of its period is a triangle, of which the
    third harmonic reaches a ninth of the first; of all others the second one reaches more. The
    medians over all periods are taken, since bends of the course have harmonics too.
    """
    step = max(1, int(period / FIT.fitted_rows))
    period /= step
    lag, rows = math.ceil(FIT.lag * period), math.ceil(period)
    bends = _bends(_means(values, step), lag)
    parts = np.lib.stride_tricks.sliding_window_view(bends, rows)[:: max(1, rows // 4)]
    orders: Array = np.arange(1.0, 4.0)
    angles: Array = np.arange(rows)[:, None] * orders * (2 * np.pi / period)
    inverse = np.linalg.pinv(np.concatenate((np.cos(angles), np.sin(angles)), axis=1))
    cosines, sines = np.split(parts @ np.transpose(inverse), 2, axis=1)
    gains: Array = 2 - 2 * np.cos(orders * (2 * np.pi * lag / period))
    heights: Array = np.hypot(cosines, sines) / gains
    phases: Array = np.arctan2(sines, cosines)
    apart = phases[:, 1:] - orders[1:] * phases[:, :1]
    shares: Array = heights[:, 1:] / heights[:, :1]
    turned: Array = np.concatenate((shares * np.cos(apart), shares * np.sin(apart)), axis=1)
    squares = float(np.square(np.median(turned, axis=0)).sum())
    of_noise = np.square(inverse).sum(axis=1).reshape(2, 3).sum(axis=0)[1:] / gains[1:] ** 2
    of_one = 6 * noise**2 / step / median(heights[:, 0]) ** 2 * period / len(bends)
    return squares - DECIDE.doubt * float(of_noise.sum()) * of_one > DECIDE.straight**2


def _best(found: list[Swing]) -> list[Swing]:
    """Of swings that overlap, the one with most half swings that are best explained.

    One that is much slower goes on beneath the others.
    """
    kept: list[Swing] = []
    for swing in sorted(found, key=lambda each: -each.explained * each.half_swings):
        if not any(_is_same(swing, other) for other in kept):
            kept.append(swing)
    return sorted(kept, key=lambda each: each.start_s)


def _is_same(one: Swing, other: Swing) -> bool:
    """Whether both show one swing: means of a fast one may seem to swing slowly, but not as far."""
    common_s = min(one.end_s, other.end_s) - max(one.start_s, other.start_s)
    overlap = common_s / min(one.end_s - one.start_s, other.end_s - other.start_s)
    fast, slow = sorted((one, other), key=lambda each: each.period_s)
    is_beneath = (
        slow.period_s > DECIDE.much_slower * fast.period_s and slow.amplitude > fast.amplitude
    )
    return overlap > DECIDE.most_overlap and not is_beneath


def _joined(found: Sequence[Swing], rows: EvenRows, values: Array) -> list[Swing]:
    """Those that are alike and follow each other closely, or across a gap, as one."""
    joined: list[Swing] = []
    for swing in found:
        newest = range(max(0, len(joined) - 3), len(joined))  # much slower ones among them
        places = (at for at in newest if _goes_on(joined[at], swing, rows, values))
        if (at := next(places, None)) is None:
            joined.append(swing)
        else:
            joined[at] = _as_one(joined[at], swing)
    return joined


def _goes_on(before: Swing, after: Swing, rows: EvenRows, values: Array) -> bool:
    ratios = _ratio(before.period_s, after.period_s), _ratio(before.amplitude, after.amplitude)
    if ratios[0] > DECIDE.alike[0] or ratios[1] > DECIDE.alike[1]:
        return False
    ended, began = np.searchsorted(rows.times, [before.end_s, after.start_s]).tolist()
    period = before.period_s / rows.interval_s
    has_gap = bool(np.any((rows.borders > ended) & (rows.borders <= began)))
    if began - ended < period * (1 + has_gap):
        return True
    lag = math.ceil(FIT.lag * period)
    bends = _bends(values[max(0, ended - lag) : began + lag], lag)
    is_hidden = not has_gap and began - ended < SEARCH.hidden * period
    return is_hidden and median(np.abs(bends)) > FIT.quiet * before.amplitude


def _ratio(one: float, other: float) -> float:
    return max(one, other) / max(min(one, other), 1e-300)


def _as_one(before: Swing, after: Swing) -> Swing:
    """Period, amplitude and share are weighted by the half swings."""
    count = before.half_swings + after.half_swings
    mixed = {
        name: (
            before.half_swings * getattr(before, name) + after.half_swings * getattr(after, name)
        )
        / count
        for name in ("period_s", "amplitude", "explained")
    }
    return replace(before, end_s=after.end_s, half_swings=count, **mixed)
