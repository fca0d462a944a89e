"""Regular swings: where a value goes to and fro, how fast and how far.

Looked at are second differences of means: x(t + lag) - 2 x(t) + x(t - lag) with a lag of about a
quarter of a period. A sine stays a sine in them, a straight course is 0, and a bend of the course
is short, so that swings are found over ramps, turns and slow drifts alike. Each octave of periods
is searched in means of twice as many rows. Windows of two periods in which the sign changes as in
a sine are fitted; what remains is judged by how well sines explain it, by how far it stands out of
its surroundings, and by whether straight pieces that never turn back explain it as well.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, median, np, sums_of
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.rhythm import gap_borders

LEAST_HALF_SWINGS: Final = 6  # four are made by a value that fell, rested, and rose again
SLOW_PERIOD_S: Final = 5.0  # beyond, bends of a way come as regularly by chance ...
SLOW_HALF_SWINGS: Final = 12  # ... but hardly ever so many
SHORTEST_PERIOD_ROWS: Final = 8.0  # fewer rows a period do not show its shape

PERIODS: Final = (8.0, 8.8, 9.8, 11.0, 12.4, 14.2, 16.5)
SHIFT: Final = 3
BLOCK: Final = 4
WINDOW: Final = 8  # blocks
AT_ONCE: Final = 32_768  # means, which stay in the cache of a processor
SURROUNDING: Final = 32  # windows, every fourth, of which the quartile is taken
LOUD: Final = 2.0
REGULAR: Final = 0.6  # of the means have another sign half a period later ...
VERY_REGULAR: Final = 0.8  # ... and so many over four periods, where nothing is louder
SETTLED: Final = 2.2  # periods
CLIPPED: Final = 1.5  # times the median magnitude: a sine has a height of 1.4 times its own
LINKED: Final = 0.45
LIKELY: Final = 0.58  # of a clipped window is explained by a sine ...
MOST_LIKELY: Final = 0.7  # ... and so much somewhere in the stretch
SEMITONES: Final = range(-5, 6)  # about the period of a level, which reaches from -3 to 3
BETWEEN: Final = 2.0
MARGIN: Final = 2.5
HIDDEN: Final = 1.0  # of a period, for which bends may hide a swing that goes on

FITTED_ROWS: Final = 24  # means a period where ends and shape are measured
LAG: Final = 0.25  # of the period
EDGE: Final = 0.13  # of the period: a sine that begins at 0 shows so much earlier
AT_END: Final = 0.5  # of the period: so near the end of what was recorded it reaches up to there
PIECE: Final = 5.0  # periods of one phase: over more, a swing may change a little
TRIED: Final = (0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08)
OUTLYING: Final = (2.0, 2.5)  # median residuals: what is farther off is a bend
MOST_NOISE: Final = 0.12  # of the squares of second differences, that is taken for noise
QUIET: Final = 0.4  # of the usual magnitude for half a period: the value rests there
REACH: Final = 30.0  # periods before and after are the surroundings
FEW_PERIODS: Final = 1.5  # of surroundings say nothing
LOUDEST: Final = 6.0  # times its surroundings: more is not more certain
UNKNOWN_LOUDNESS: Final = 3.5  # where nothing surrounds it
LEAST_LOUDNESS: Final = 0.5
LOUDER: Final = 1.25  # times as loud a swing may be as it seems at first
# Median magnitude of a normal variable over its lower quartile.
_MEDIAN_TO_QUARTILE: Final = 0.6745 / 0.3186
# Weight of evidence: a logistic regression on the labelled recordings of tests/detection.
OF_LOUDNESS: Final = 5.9  # per logarithm of how much louder than its surroundings it is
OF_ROBUST_FIT: Final = -2.4  # per logarithm of what sines leave of the median square
OF_FIT: Final = -1.9  # ... and of all squares of clipped second differences
OF_COUNT: Final = 4.1  # per logarithm of the half swings
PROMISING: Final = 90.0
ENOUGH: Final = 1000.0
TURNS_BACK: Final = 0.08  # of the way there a value comes back that does not only go one way
DOUBT: Final = 3.0
STRAIGHT: Final = 0.085  # of the sine its harmonics reach where straight pieces make it
NOISE_AMPLITUDES: Final = 3.0  # a swing is at least so many deviations of the noise high ...
MEAN_AMPLITUDES: Final = 12.0  # ... or so many of their means over half the swing
SAME_NUMBER: Final = 1e-9  # of the value: what adding up floating-point numbers makes of one
SWITCHED_VALUES: Final = 3
MOST_OVERLAP: Final = 0.2  # of the shorter one
ALIKE: Final = (1.15, 1.5)  # ratio of periods and of amplitudes of parts of one swing


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
    """The rows of several signals: where time moved on, in stretches without recording gaps."""

    times: Array
    moving: Flags | None
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
        return cls(times, moving, gap_borders(times, interval_s), interval_s)

    def stretches(self, values: Array) -> Iterator[tuple[Array, Array]]:
        """Times and values of each stretch."""
        if self.moving is not None:
            values = values[self.moving]
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
    rows: EvenRows,
    values: Array,
    least_half_swings: int,
    longest_period_s: float,
    is_over: Callable[[], bool] = lambda: False,
) -> list[Swing]:
    """As `find_swings`, of one of several signals; less where it is over before the end."""
    found: list[Swing] = []
    for times, part in rows.stretches(values):
        if len(part) > 3 * SHORTEST_PERIOD_ROWS and part.min() < part.max():
            stretch = _Stretch(times, part, least_half_swings, longest_period_s)
            found += _best(list(stretch.swings(is_over)))
    return _joined(found, rows)


class _Stretch:
    """Rows that come evenly, in which swings are looked for."""

    def __init__(self, times: Array, values: Array, least: int, longest_s: float) -> None:
        self.times, self.values = times, values
        self.interval_s = float(times[-1] - times[0]) / (len(times) - 1)
        self.least, self.longest_s = least, longest_s
        self.resolution = _resolution(values)

    def swings(self, is_over: Callable[[], bool]) -> Iterator[Swing]:
        """Those of each octave of periods; what two of them see is found twice."""
        means, rows = self.values, 1
        while rows * PERIODS[0] * self.interval_s < self.longest_s and not is_over():
            for start, stop, period, size, usual, share in _likely(means, self.least, self.resolution):
                ratio = min(size / max(usual, 1e-300), 1e9)
                self.hint = (2 * (stop - start) / period, ratio, share)
                if ratio**1.5 * self.hint[0] / (1.05 - share / 0.83) < PROMISING:
                    continue
                yield from self._measured(
                    start * rows, stop * rows, period * rows, (0, len(self.values))
                )
            means, rows = _means(means, 2), 2 * rows
            if len(means) <= 3 * SHORTEST_PERIOD_ROWS:
                return

    def _measured(
        self, start: int, stop: int, period: float, within: tuple[int, int]
    ) -> Iterator[Swing]:
        """The swing of about these rows and that period; two where the value rests between."""
        low, high = max(within[0], int(start - MARGIN * period)), min(within[1], int(stop + MARGIN * period))
        step = max(1, int(period / FITTED_ROWS))
        lag = math.ceil(LAG * period / step)
        bends = _bends(_means(self.values[low:high], step), lag)
        first, last = max(0, (start - low) // step), (stop - low) // step - 2 * lag
        core = bends[first:last]
        if len(core) < 2 * period / step:
            return
        clipped = _clipped(bends, CLIPPED * median(np.abs(core)))
        pieces = _pieces(clipped[first:last], period / step)
        shown, _, _ = _sines(pieces, np.ones_like(pieces), period / step)
        begin = _begin(clipped, first, shown)
        end = len(bends) - _begin(clipped[::-1], len(bends) - last, shown)
        quiet = _quiet(bends[begin:end], shown)
        if quiet is not None:
            ends = low + (begin + lag) * step, low + (end + lag) * step
            middle = low + (begin + quiet + lag) * step
            if min(middle - ends[0], ends[1] - middle) > period:
                yield from self._measured(ends[0], middle, period, (low, middle))
                yield from self._measured(middle, ends[1], period, (middle, high))
                return
        if end - begin < 2 * shown:
            return
        edge = EDGE * shown * step
        from_row = round(low + (begin + lag) * step + edge)
        to_row = round(low + (end + lag) * step - edge)
        if from_row < AT_END * period:
            from_row = 0
        if to_row > len(self.values) - 1 - AT_END * period:
            to_row = len(self.values) - 1
        rows = slice(from_row, to_row + 1)
        count = round(2 * (rows.stop - 1 - rows.start) / (shown * step))
        if count >= self.least:
            yield from self._judged(rows, bends[begin:end], lag, step, shown)

    def _judged(
        self, rows: slice, bends: Array, lag: int, step: int, period: float
    ) -> Iterator[Swing]:
        values = self.values[rows]
        noise = noise_of(values)
        fit = fit_sines(bends, period, 6 * noise**2 / step)
        period = fit.period * step
        count = round(2 * (len(values) - 1) / period)
        length_s = period * self.interval_s
        if length_s > self.longest_s or count < self.least:
            return
        if length_s > SLOW_PERIOD_S and count < SLOW_HALF_SWINGS:
            return
        loudness = self._loudness(rows, period)
        if evidence(loudness, fit.robustly, fit.explained, count) < ENOUGH:
            return
        amplitude = fit.amplitude / (2 - 2 * math.cos(2 * math.pi * lag / fit.period))
        amplitude /= float(np.sinc(step / period)) if step > 1 else 1.0
        amplitude = min(amplitude, _highest(values, period))
        least = min(NOISE_AMPLITUDES, MEAN_AMPLITUDES / (period * count / 2) ** 0.5) * noise
        if amplitude < least or not _is_resolved(values, amplitude):
            return
        if _turns_back(values, period) < TURNS_BACK and _is_straight(values, period, noise):
            return
        start_s, end_s = float(self.times[rows.start]), float(self.times[rows.stop - 1])
        yield Swing(start_s, end_s, count, length_s, amplitude, fit.explained)

    def _loudness(self, rows: slice, period: float) -> float:
        """How much larger its second differences are than the lower quartile around it."""
        step = max(1, int(period / 16))
        lag, far = math.ceil(LAG * period / step), int(REACH * period)
        parts = slice(max(0, rows.start - far), rows.start), slice(rows.stop, rows.stop + far)
        around = [_bends(_means(self.values[part], step), lag) for part in parts]
        inside = median(np.abs(_bends(_means(self.values[rows], step), lag)))
        return _loudness(inside, np.abs(np.concatenate(around)), period / step)


def _loudness(inside: float, around: Array, period: float) -> float:
    """How much larger a median magnitude is than the lower quartile around it."""
    if len(around) < FEW_PERIODS * period:
        return UNKNOWN_LOUDNESS
    quarter = len(around) // 4
    usual = float(np.partition(around, quarter)[quarter]) * _MEDIAN_TO_QUARTILE
    return inside / usual if usual * LOUDEST > inside else LOUDEST


def evidence(loudness: float, robustly: float, explained: float, count: float) -> float:
    """The weight of evidence for a swing."""
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
    return np.einsum("ij->i", np.reshape(values[: count * step], (count, step))) / step


def _clipped(values: Array, limit: float | Array) -> Array:
    return np.asarray(np.minimum(np.maximum(values, -limit), limit), np.float64)


def _likely(means: Array, least: int, resolution: float) -> Iterator[tuple[int, int, float, float, float, float]]:
    """Where means [start, stop) seem to swing, and with about which period.

    Looked at are signs, of which what is loud and short spoils few.
    """
    share, which, sizes = _screened(means)
    good = np.flatnonzero(share > LINKED)
    if not len(good):
        return
    windows: Array = np.lib.stride_tricks.sliding_window_view(sizes, WINDOW)
    loud = np.partition(windows[good], 2, axis=1)[:, 2]
    keep = loud > 0.6 * BLOCK * resolution
    good, loud = good[keep], loud[keep]
    apart = (np.diff(good) > WINDOW // 2) | (np.abs(np.diff(which[good])) > 1)
    apart |= np.abs(np.diff(np.log(loud))) > math.log(LOUD)
    edges = [0, *(np.flatnonzero(apart) + 1).tolist(), len(good)] if len(good) else [0]
    usual = _usual(sizes)
    open_groups: list[tuple[int, int, float, float, float, float]] = []
    for start, stop in itertools.pairwise(edges):
        part = good[start:stop]
        if share[part].max() < LIKELY:
            continue
        period = PERIODS[int(np.median(which[part]))]
        size = float(np.median(loud[start:stop]))
        first, last = int(part[0]) * BLOCK, min(len(means), (int(part[-1]) + WINDOW) * BLOCK + 2 * SHIFT)
        least_usual, shown = float(usual[part].min()), float(share[part].mean())
        left: list[tuple[int, int, float, float, float, float]] = []
        for each in open_groups:
            if first - each[1] > BETWEEN * period:
                yield each
            elif _ratio(each[2], period) < 1.25 and _ratio(each[3], size) < 3:
                share_of = (each[1] - each[0]) / (each[1] - each[0] + last - first)
                period = share_of * each[2] + (1 - share_of) * period
                size = share_of * each[3] + (1 - share_of) * size
                shown = share_of * each[5] + (1 - share_of) * shown
                least_usual = min(least_usual, each[4])
                first, last = each[0], max(last, each[1])
            else:
                left.append(each)
        open_groups = [*left, (first, last, period, size, least_usual, shown)]
    yield from open_groups


def _screened(means: Array) -> tuple[Array, Indexes, Array]:
    """Of each window how much of the signs a sine explains and which one; sizes of blocks."""
    waves = _waves()
    shares: list[Array] = []
    whiches: list[Indexes] = []
    sizes: list[Array] = []
    beyond = (WINDOW - 1) * BLOCK
    for begin in range(0, max(1, len(means) - beyond - 2 * SHIFT), AT_ONCE):
        part = means[begin : begin + AT_ONCE + beyond + 2 * SHIFT]
        bends = _bends((part - part[0]).astype(np.float32), SHIFT)
        if len(bends) < WINDOW * BLOCK:
            bends = np.pad(bends, (0, WINDOW * BLOCK - len(bends)))
        blocks = np.reshape(bends[: len(bends) // BLOCK * BLOCK], (-1, BLOCK))
        signs = np.sign(blocks)
        count = len(blocks) - WINDOW + 1
        heights = signs[:count] @ waves[0]
        for at in range(1, WINDOW):
            heights += signs[at : at + count] @ waves[at]
        heights *= heights
        squares = heights[:, : len(PERIODS)] + heights[:, len(PERIODS) :]
        which = np.argmax(squares, axis=1)
        shares.append(squares[np.arange(count), which] / (WINDOW * BLOCK))
        whiches.append(which)
        sizes.append(np.einsum("ij->i", np.abs(blocks)))
        if begin + AT_ONCE < len(means) - beyond - 2 * SHIFT:
            sizes[-1] = sizes[-1][:count]
    return np.concatenate(shares), np.concatenate(whiches), np.concatenate(sizes)


def _usual(sizes: Array) -> Array:
    """The lower quartile about each size, the least of three such stretches."""
    count, quarter = len(sizes) // SURROUNDING, SURROUNDING // 4
    if count < 2:
        return np.full(len(sizes), np.partition(sizes, len(sizes) // 4)[len(sizes) // 4])
    parts: Array = np.reshape(sizes[: count * SURROUNDING], (count, SURROUNDING))
    padded: Array = np.pad(np.partition(parts, quarter, axis=1)[:, quarter], 1, mode="edge")
    least = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    usual = np.repeat(least, SURROUNDING)
    return np.pad(usual, (0, len(sizes) - len(usual)), mode="edge")


@lru_cache(1)
def _waves() -> Array:
    """Cosines and sines of length 1 as columns, for each block of a window."""
    places: Array = np.arange(WINDOW * BLOCK, dtype=np.float64) - (WINDOW * BLOCK - 1) / 2
    angles: Array = 2 * np.pi * places[:, None] / np.array(PERIODS)
    waves = np.concatenate((np.cos(angles), np.sin(angles)), axis=1)
    waves /= np.sqrt(np.einsum("ij,ij->j", waves, waves))
    return np.reshape(waves, (WINDOW, BLOCK, -1)).astype(np.float32)


def _resolution(values: Array) -> float:
    """The smallest step; 0 where the values are so few that something is switched."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > SAME_NUMBER * max(float(values.max()), -float(values.min()))]
    least = float(steps.min()) if len(steps) else 0.0
    return least if float(np.ptp(values)) > 2.5 * least else 0.0


@dataclass(frozen=True)
class Fit:
    """Sines of one period, in pieces that each have a phase and a height of their own.

    Attributes:
        period: In values.
        amplitude: The median of the pieces.
        explained: Share of the squares, of values clipped at what a sine reaches.
        robustly: Share of the squared median magnitude, without noise: bends do not lower it.
    """

    period: float
    amplitude: float
    explained: float
    robustly: float


def fit_sines(values: Array, period: float, noise: float) -> Fit:
    """Fitted to clipped values, then to those that the first fit is near to, of all values.

    Args:
        values: Second differences.
        period: About which.
        noise: Variance of the noise in them.
    """
    pieces = _pieces(values, period)
    magnitudes: Array = np.abs(pieces)
    clipped = _clipped(pieces, CLIPPED * np.median(magnitudes, axis=1, keepdims=True))
    usual = float(np.median(np.abs(clipped)))
    everything = np.ones_like(clipped)
    period, _, model = _sines(clipped, everything, period)
    left = clipped - model
    squares = float(np.einsum("ij,ij->", clipped, clipped))
    explained = 1 - float(np.einsum("ij,ij->", left, left)) / squares if squares else 0.0
    near = _near(pieces - model, OUTLYING[0], usual)
    period, _, model = _sines(clipped, near, period)
    rest = float(np.median(np.abs(clipped - model))) ** 2
    rest -= min(MOST_NOISE * usual**2, 0.6745**2 * noise)
    robustly = 1 - max(0.0, rest) / usual**2 if usual else 0.0
    near = _near(pieces - model, OUTLYING[1], usual)
    period, amplitudes, _ = _sines(pieces, near, period)
    return Fit(period, float(np.median(amplitudes)), explained, robustly)


def _pieces(values: Array, period: float) -> Array:
    """Parts of a few periods, one in each row."""
    count = max(1, round(len(values) / period / PIECE))
    rows = len(values) // count
    return np.reshape(values[: count * rows], (count, rows))


def _near(residuals: Array, times: float, usual: float) -> Array:
    """1 where a residual is not much larger than most."""
    sizes: Array = np.abs(residuals)
    return np.asarray(sizes <= times * np.median(sizes) + usual / 20, np.float64)


def _sines(pieces: Array, weights: Array, period: float) -> tuple[float, Array, Array]:
    """The best period about the given one, and the heights and values of its sines."""
    _, _, gains = _fits(pieces, weights, period * np.array(TRIED))
    total: Array = gains.sum(axis=0)
    best = int(np.argmax(total))
    share = TRIED[best] + _vertex(total, best) * (TRIED[1] - TRIED[0])
    sines, cosines, _ = _fits(pieces, weights, np.array([period * share]))
    places: Array = np.arange(pieces.shape[1], dtype=np.float64) - (pieces.shape[1] - 1) / 2
    angles: Array = 2 * np.pi * places / (period * share)
    model = sines * np.sin(angles) + cosines * np.cos(angles)
    return period * share, np.hypot(sines, cosines), np.asarray(model, np.float64)


def _fits(pieces: Array, weights: Array, periods: Array) -> tuple[Array, Array, Array]:
    """Coefficients of sine and cosine and the squares they explain: pieces by periods."""
    places: Array = np.arange(pieces.shape[1], dtype=np.float64) - (pieces.shape[1] - 1) / 2
    angles: Array = 2 * np.pi * places[:, None] / periods
    sine, cosine = np.sin(angles), np.cos(angles)
    weighted = weights * pieces
    ss, cc, sc = weights @ (sine * sine), weights @ (cosine * cosine), weights @ (sine * cosine)
    sy, cy = weighted @ sine, weighted @ cosine
    determinant: Array = np.maximum(ss * cc - sc * sc, 1e-12)
    of_sine, of_cosine = (sy * cc - cy * sc) / determinant, (cy * ss - sy * sc) / determinant
    return of_sine, of_cosine, of_sine * sy + of_cosine * cy


def _vertex(heights: Array, highest: int) -> float:
    """How far from the highest one that of the parabola through it and its neighbours lies."""
    if not 0 < highest < len(heights) - 1:
        return 0.0
    before, most, after = heights[highest - 1 : highest + 2].tolist()
    return (
        (after - before) / (4 * most - 2 * before - 2 * after) if 2 * most > before + after else 0.0
    )


def _begin(bends: Array, inside: int, period: float) -> int:
    """Where the sine begins that swings from there on: before, it explains nothing."""
    settled = inside + int(period / 2)
    part = slice(settled, settled + round(SETTLED * period))
    angles: Array = 2 * np.pi * np.arange(len(bends), dtype=np.float64) / period
    waves: Array = np.stack((np.cos(angles), np.sin(angles)))
    squares = waves[:, part] @ np.transpose(waves[:, part])
    end = inside + int(period)
    swing: Array = np.linalg.solve(squares, waves[:, part] @ bends[part]) @ waves[:, :end]
    gains = np.abs(bends[:end]) - np.abs(bends[:end] - swing)
    return int(np.argmax(np.cumsum(gains[::-1])[::-1]))


def _quiet(bends: Array, period: float) -> int | None:
    """The middle of half a period in which hardly anything bends; None if there is none."""
    half = max(1, round(period / 2))
    if len(bends) < 2 * half:
        return None
    sizes = sums_of(np.abs(bends), half)
    least = int(np.argmin(sizes))
    return least + half // 2 if sizes[least] < QUIET * median(sizes) else None


def _highest(values: Array, period: float) -> float:
    """Half of what the values usually reach in a period: of a clipped one the sine is higher."""
    rows = round(period)
    count = len(values) // rows
    slope = median(values[rows:] - values[:-rows]) / rows
    level = values - slope * np.arange(len(values))
    heights = np.ptp(np.reshape(level[: count * rows], (count, rows)), axis=1)
    # The rows next to a turn are as far from it as the angle.
    return median(heights) / 2 / math.cos(min(math.pi / period, math.pi / 4))


def _is_resolved(values: Array, amplitude: float) -> bool:
    """Whether it is more than the smallest step between two values: a course that is rounded.

    Up to three values are switched to and fro.
    """
    apart = np.diff(np.unique(values))
    apart = apart[apart > SAME_NUMBER * float(np.abs(values).max())]
    return len(apart) < SWITCHED_VALUES or amplitude > float(apart.min())


def _turns_back(values: Array, period: float) -> float:
    """The share of its way there that a value comes back."""
    steps = np.diff(_means(values, max(1, int(period / 8))))
    up, down = float(steps[steps > 0].sum()), -float(steps[steps < 0].sum())
    return min(up, down) / max(up, down) if max(up, down) > 0 else 0.0


def _is_straight(values: Array, period: float, noise: float) -> bool:
    """Whether it is a staircase of straight pieces: a sine on a ramp has no harmonics.

    About its slope, a staircase of ramps that last half of its period is a triangle, of which the
    third harmonic reaches a ninth of the first; of all others the second one reaches more.
    """
    step = max(1, int(period / FITTED_ROWS))
    lag = math.ceil(LAG * period / step)
    bends = _bends(_means(values, step), lag)
    period /= step
    rows = math.ceil(period)
    if len(bends) < rows:
        return False
    parts = np.lib.stride_tricks.sliding_window_view(bends, rows)[:: max(1, rows // 4)]
    angles: Array = 2 * np.pi * np.arange(rows) / period
    waves = np.stack([np.exp(-1j * k * angles) for k in (1, 2, 3)], axis=1)
    basis = np.concatenate((waves.real, waves.imag), axis=1)
    inverse = np.linalg.pinv(basis)
    fitted = parts @ np.transpose(inverse)
    gains = np.array([2 - 2 * math.cos(2 * math.pi * k * lag / period) for k in (1, 2, 3)])
    first, second, third = np.transpose((fitted[:, :3] + 1j * fitted[:, 3:]) / gains)
    height = np.abs(first)
    excess = 0.0
    independent = max(1.0, len(bends) / period)
    for each, order, at in ((second, 2, 1), (third, 3, 2)):
        turned = each * np.conj(first) ** order / height ** (order + 1)
        of_noise = 6 * noise**2 / step * float(np.sum(inverse[at] ** 2 + inverse[at + 3] ** 2))
        of_noise *= 1.6 / independent / gains[at] ** 2 / float(np.median(height)) ** 2
        excess += float(np.median(turned.real)) ** 2 + float(np.median(turned.imag)) ** 2 - DOUBT * of_noise
    return excess > STRAIGHT**2


def _best(found: list[Swing]) -> list[Swing]:
    """Of swings that overlap, the one with most half swings that are best explained."""
    kept: list[Swing] = []
    for swing in sorted(found, key=lambda each: -each.explained * each.half_swings):
        if all(_overlap(swing, other) < MOST_OVERLAP for other in kept):
            kept.append(swing)
    return sorted(kept, key=lambda each: each.start_s)


def _overlap(one: Swing, other: Swing) -> float:
    common_s = min(one.end_s, other.end_s) - max(one.start_s, other.start_s)
    return common_s / min(one.end_s - one.start_s, other.end_s - other.start_s)


def _joined(found: Sequence[Swing], rows: EvenRows) -> list[Swing]:
    """Those that are alike and follow each other closely, or across a gap, as one."""
    joined: list[Swing] = []
    for swing in found:
        if joined and _goes_on(joined[-1], swing, rows):
            joined[-1] = _as_one(joined[-1], swing)
        else:
            joined.append(swing)
    return joined


def _goes_on(before: Swing, after: Swing, rows: EvenRows) -> bool:
    if _ratio(before.period_s, after.period_s) > ALIKE[0]:
        return False
    if _ratio(before.amplitude, after.amplitude) > ALIKE[1]:
        return False
    ended, began = np.searchsorted(rows.times, [before.end_s, after.start_s])
    recorded_s = max(0, int(began - ended)) * rows.interval_s
    return recorded_s < HIDDEN * before.period_s * (2 if _has_gap(rows, ended, began) else 1)


def _has_gap(rows: EvenRows, start: int, stop: int) -> bool:
    return bool(np.any((rows.borders > start) & (rows.borders <= stop)))


def _ratio(one: float, other: float) -> float:
    return max(one, other) / min(one, other)


def _as_one(before: Swing, after: Swing) -> Swing:
    """Period, amplitude and share are weighted by the half swings."""
    count = before.half_swings + after.half_swings
    share = before.half_swings / count
    return replace(
        before,
        end_s=after.end_s,
        half_swings=count,
        period_s=share * before.period_s + (1 - share) * after.period_s,
        amplitude=share * before.amplitude + (1 - share) * after.amplitude,
        explained=share * before.explained + (1 - share) * after.explained,
    )
