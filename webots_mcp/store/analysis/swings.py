"""Regular swings: where a value goes to and fro, how fast and how far.

The search is local: each stretch without recording gaps is looked at by itself, and in it each
period has a band of its own, in which a swing shows as crossings of zero that come
regularly and reach equally far. Where the course bends by more than noise makes it, swings are
looked for next to its bends (`swings_on_bends`). What happens elsewhere in the stretch changes
nothing, so that asking for more time never finds less.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Final

from webots_mcp.store.analysis.arrays import Array, inner, median, np, sums_of
from webots_mcp.store.analysis.noise import Roughness
from webots_mcp.store.analysis.rhythm import gap_borders
from webots_mcp.store.analysis.sines import TRIED_PERIODS, alike_rows, fit_sines, parabolas
from webots_mcp.store.analysis.swings_on_bends import likely_swings, swings_on_bends

LEAST_HALF_SWINGS: Final = 6  # four are made by a value that fell, rested, and rose again
SLOW_PERIOD_S: Final = 5.0  # beyond, bends of a way come as regularly by chance ...
SLOW_HALF_SWINGS: Final = 12  # ... but hardly ever so many
SHORTEST_PERIOD_ROWS: Final = 8.0  # fewer rows a period do not show its shape
SCALE_RATIO: Final = 2**0.5  # from one band to the next
FINEST_SHARE: Final = 8  # of a band's period: what is shorter is smoothed away
ROWS_PER_PERIOD: Final = 16  # of a band: of more, means are taken
FITTED_PER_PERIOD: Final = 32  # the same where a sine is fitted; it loses 0.2 % of its height
JOINED_PERIODS: Final = 1.5  # so near a gap a swing ends or begins that may go on across it
LEAST_REST: Final = 0.6  # periods: the ends of swings are known to a quarter
RESTING: Final = 0.5  # of the amplitude: while it swings, it is 0.7 away (root mean square)
ALIKE: Final = (1.15, 1.5)  # ratio of periods and of amplitudes on both sides of a gap
HALF_PERIODS: Final = (0.5 / 1.7, 0.5 * 1.5)  # of the band's period, that a half swing may last
MOST_UNEVEN: Final = 1.8  # times as far as those before it may a half swing reach
MOST_IRREGULAR: Final = 0.25  # coefficient of variation of the half periods
MOST_VARIED: Final = 0.4  # and of how far the half swings reach
LEAST_EXPLAINED: Final = (0.85, 0.70)  # of the variance by a sine, for 6 half swings and for 10
PERIODS_FITTED: Final = 2.5  # at once: over more, a swing may change a little
FEW_COLUMNS: Final = 8  # are added up faster one after the other than row by row
PIECES_TRIED: Final = 16  # with each period; the whole with the best of them
LEAST_TRIED: Final = 0.5  # explained of these pieces; less is not looked at further
NOISE_BENDS: Final = 10.0  # deviations of the noise, over the root of the rows; it makes hardly 7
NOISE_AMPLITUDES: Final = 3.0  # a swing is at least so many deviations of the noise high ...
MEAN_AMPLITUDES: Final = 12.0  # ... or so many of their means over half the swing
WALK_CHANCE: Final = 1e-5  # that a random walk swings so far; it is asked thousands of times
_QUARTILE: Final = 0.3186  # what a quarter of the magnitudes of a normal variable is below
SAME_NUMBER: Final = 1e-9  # of the value: what adding up floating-point numbers makes of one
SWITCHED_VALUES: Final = 3
REACHES: Final = 2.0  # times as far as in its band a swing reaches at most
MOST_OVERLAP: Final = 0.2  # of the shorter one


@dataclass(frozen=True)
class Swing:
    """A stretch in which a value went to and fro regularly.

    Attributes:
        half_swings: How many there are between the first and the last crossing of its mean course.
        amplitude: Half of the way from one turning point to the next.
        explained: Share of the variance about a slow course that a sine explains, 0 to 1.
    """

    start_s: float
    end_s: float
    half_swings: int
    period_s: float
    amplitude: float
    explained: float


@dataclass(frozen=True)
class _Crossings:
    """Where a band crosses zero, and how long and how far it goes between two crossings."""

    moments: Array
    halves: Array
    reaches: Array


def find_swings(
    times: Array, values: Array, *, least_half_swings: int, longest_period_s: float
) -> list[Swing]:
    """Swings of one signal, in order; angles have to be unwrapped.

    A swing counts when at least so many half swings follow each other, alike in length and reach,
    when a sine explains most of their variance about a parabola or about straight pieces, and when
    it rises above the noise of its own stretch. Period and amplitude are those of the best sine.
    With a period of more than 5 s at least 12 half swings have to. Each stretch between recording
    gaps is looked at by itself; a swing that reaches a gap and is the same after it is one swing.
    """
    moving = np.diff(times, prepend=-np.inf) > 0
    times, values = times[moving], values[moving]
    if len(times) <= SHORTEST_PERIOD_ROWS:
        return []
    interval_s = float(np.median(np.diff(times)))
    borders = gap_borders(times, interval_s)
    found: list[Swing] = []
    for moments, stretch in zip(np.split(times, borders), np.split(values, borders), strict=True):
        swings = _in_stretch(moments, stretch, least_half_swings, longest_period_s)
        if found and swings and _goes_on(found[-1], swings[0], times):
            swings[0] = _as_one(found.pop(), swings[0])
        found += swings
    return found


def joined_swings(found: Iterable[Swing]) -> list[Swing]:
    """Swings of stretches that overlap, in order: what two stretches tell of one is one."""
    joined: list[Swing] = []
    for swing in sorted(found, key=lambda each: each.start_s):
        before = joined[-1] if joined else None
        if before is None or swing.start_s >= before.end_s or _are_two(before, swing):
            joined.append(swing)
        elif swing.end_s > before.end_s:
            joined[-1] = _together(before, swing)
    return joined


def _are_two(before: Swing, after: Swing) -> bool:
    """Whether a swing of another period follows: the ends of both are known to half a swing."""
    periods = _ratio(before.period_s, after.period_s)
    return periods > ALIKE[0] and _overlap(before, after) < MOST_OVERLAP


def _together(before: Swing, after: Swing) -> Swing:
    """Merge two that overlap; of different periods the one that lasted longer is reported."""
    if _ratio(before.period_s, after.period_s) > ALIKE[0]:
        return max(before, after, key=lambda each: each.half_swings * each.explained)
    return _counted(_as_one(before, after))


def _goes_on(before: Swing, after: Swing, times: Array) -> bool:
    """Whether the next swing begins right after the gap that the one before reached."""
    ended, began = np.searchsorted(times, [before.end_s, after.start_s])
    between = times[max(0, ended - 1) : began + 1]
    gap_s = float(np.max(np.diff(between)))
    recorded_s = after.start_s - before.end_s - gap_s
    if recorded_s > 2 * JOINED_PERIODS * before.period_s:
        return False
    return _is_alike(before, after)


def _ratio(one: float, other: float) -> float:
    return max(one, other) / min(one, other)


def _as_one(before: Swing, after: Swing) -> Swing:
    """Half swings are those that were seen; period, amplitude and share are weighted by them."""
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


def _in_stretch(
    times: Array, values: Array, least_half_swings: int, longest_period_s: float
) -> list[Swing]:
    """Swings in a stretch in which rows come evenly."""
    if len(times) <= SHORTEST_PERIOD_ROWS or not np.ptp(values):
        return []
    whole = _Stretch(times, values)
    interval_s = whole.interval_s
    rounding = len(values) * float(np.spacing(np.abs(values).max()))
    noise = np.maximum(whole.roughness.local_noise(), rounding)
    found: list[Swing] = []
    rows = SHORTEST_PERIOD_ROWS
    while rows * interval_s <= longest_period_s * SCALE_RATIO and rows < len(values):
        step = max(1, int(rows / ROWS_PER_PERIOD))
        moments, means = _means(times, step), _means(values, step)
        of_means = noise[: len(means) * step : step] / step**0.5
        slow = _moving_mean(means, round(rows / step))
        band = _moving_mean(means, round(rows / step) // FINEST_SHARE) - slow
        if max(band.max(), -band.min()) > rounding:
            for crossings in _regular(moments, band, rows * interval_s, least_half_swings):
                if not any(_is_same(crossings, each) for each in found):
                    found += _fitted(whole, crossings)
        # Bends of a way come as often as the turns of a slow swing; a band reaches to both sides.
        is_slow = rows * interval_s > SLOW_PERIOD_S * SCALE_RATIO**0.5
        if not is_slow and _bends(slow, round(rows / step), of_means):
            course = moments, means, of_means
            for swing in _on_bends(*course, rows / step, least_half_swings, found):
                if swing.period_s <= SLOW_PERIOD_S and _stands_out(whole, swing):
                    found.append(swing)
        rows *= SCALE_RATIO
    lasting = [each for each in found if _lasts(each, longest_period_s)]
    return _connected(_best(lasting), whole)


def _lasts(swing: Swing, longest_period_s: float) -> bool:
    """Whether it counts: of slow ones more half swings have to follow each other."""
    is_slow = swing.period_s > SLOW_PERIOD_S
    return swing.period_s <= longest_period_s and (
        not is_slow or swing.half_swings >= SLOW_HALF_SWINGS
    )


def _connected(swings: list[Swing], whole: _Stretch) -> list[Swing]:
    """Two that are alike and follow each other closely as one, unless the value rests between."""
    connected: list[Swing] = []
    for swing in swings:
        before = connected[-1] if connected else None
        joined = before and _follows(before, swing) and _is_alike(before, swing)
        if before and joined and not _rests_between(before, swing, whole):
            connected[-1] = _counted(_as_one(before, swing))
        else:
            connected.append(swing)
    return connected


def _rests_between(before: Swing, after: Swing, whole: _Stretch) -> bool:
    """Whether the value stays near the straight way from one swing's level to the other's."""
    if after.start_s - before.end_s < LEAST_REST * before.period_s:
        return False
    times, values = whole.times, whole.values
    last = (times > before.end_s - before.period_s) & (times <= before.end_s)
    first = (times >= after.start_s) & (times < after.start_s + after.period_s)
    between = (times > before.end_s) & (times < after.start_s)
    moments = [float(times[part].mean()) for part in (last, first)]
    levels = [float(values[part].mean()) for part in (last, first)]
    away = values[between] - np.interp(times[between], moments, levels)
    reach = RESTING * before.amplitude
    return len(away) > 0 and inner(away, away) < len(away) * reach**2


def _follows(before: Swing, after: Swing) -> bool:
    return after.start_s - before.end_s < JOINED_PERIODS * before.period_s


def _is_alike(before: Swing, after: Swing) -> bool:
    periods = _ratio(before.period_s, after.period_s)
    return periods <= ALIKE[0] and _ratio(before.amplitude, after.amplitude) <= ALIKE[1]


def _counted(swing: Swing) -> Swing:
    """With as many half swings as its time holds."""
    count = round(2 * (swing.end_s - swing.start_s) / swing.period_s)
    return replace(swing, half_swings=count)


def _is_same(crossings: _Crossings, swing: Swing) -> bool:
    """Whether the swing was found there already, in the band of a shorter period."""
    first_s, last_s = crossings.moments[0], crossings.moments[-1]
    near_s = swing.period_s / 4
    return bool(
        len(crossings.halves) == swing.half_swings
        and abs(first_s - swing.start_s) < near_s
        and abs(last_s - swing.end_s) < near_s
    )


def _means(values: Array, step: int) -> Array:
    """Of so many values each; a rest at the end that is less is left out."""
    if step == 1:
        return values
    count = len(values) // step
    parts: Array = np.reshape(values[: count * step], (count, step))
    if step < FEW_COLUMNS:
        return np.asarray(sum(parts[:, at] for at in range(step)) / step, np.float64)
    return np.einsum("ij->i", parts) / step


def _on_bends(
    moments: Array, means: Array, noise: Array, period: float, least: int, found: list[Swing]
) -> Iterator[Swing]:
    """Swings on a course that bends, where they were not found without."""
    interval_s = float(moments[-1] - moments[0]) / (len(moments) - 1)
    for start, end, rows in likely_swings(means, noise, period):
        ends_s = float(moments[start]), float(moments[end - 1])
        if not _are_covering(found, *ends_s, rows * interval_s, least):
            for bent in swings_on_bends(means, start, end, rows, least):
                yield Swing(
                    float(moments[bent.start]),
                    float(moments[bent.end - 1]),
                    bent.half_swings,
                    bent.period * interval_s,
                    bent.amplitude,
                    bent.explained,
                )


def _are_covering(
    swings: list[Swing], start_s: float, end_s: float, period_s: float, least: int
) -> bool:
    """Whether what seems to swing there is such swings, with what surrounds them.

    What lies between two of them is too short for another one.
    """
    near_s = JOINED_PERIODS * period_s
    alike = [each for each in swings if _ratio(each.period_s, period_s) < SCALE_RATIO]
    reached_s = -math.inf
    for swing in sorted(alike, key=lambda each: each.start_s):
        if swing.start_s - near_s <= start_s or swing.start_s - reached_s < least * period_s / 2:
            reached_s = max(reached_s, swing.end_s)
    return reached_s >= end_s - near_s


def _bends(slow: Array, rows: int, noise: Array) -> bool:
    """Whether a course of means over so many rows bends anywhere by more than noise makes it."""
    bends = slow[2 * rows :] - 2 * slow[rows:-rows]
    bends += slow[: -2 * rows]
    limits = noise[rows:-rows] * (NOISE_BENDS / rows**0.5)
    return not len(bends) or bool(np.any(np.abs(bends, out=bends) > limits))


def _moving_mean(values: Array, rows: int) -> Array:
    """Twice the mean over about so many rows; beyond the ends the values go on point-mirrored."""
    reach = min(rows // 2, len(values) - 1)
    if reach < 1:
        return values
    for _ in range(2):
        before = 2 * values[0] - values[reach:0:-1]
        after = 2 * values[-1] - values[-2 : -reach - 2 : -1]
        values = sums_of(np.concatenate((before, values, after)), 2 * reach + 1)
        values /= 2 * reach + 1
    return values


def _regular(times: Array, band: Array, period_s: float, least: int) -> Iterator[_Crossings]:
    """Stretches of at least so many half swings of about that period that reach equally far.

    Between two rows the band is taken to be straight. At both ends it is 0, because values go on
    point-mirrored there: a stretch that reaches an end is tried with that half swing and without.
    """
    above = band >= 0
    above[0], above[-1] = above[1], above[-2]
    (before,) = (above[1:] != above[:-1]).nonzero()
    if len(before) + 1 < least:
        return
    share = band[before] / (band[before] - band[before + 1])
    crossed = times[before] + share * (times[before + 1] - times[before])
    moments = np.concatenate((times[:1], crossed, times[-1:]))
    rows = np.concatenate(([0], before + 1, [len(band)]))
    halves = np.diff(moments)
    for first, last in _fitting(halves, period_s, least):
        borders = rows[first : last + 1]
        sizes = np.abs(band[borders[0] : borders[-1]])
        reaches = np.maximum.reduceat(sizes, borders[:-1] - borders[0])
        for even in pairwise(_uneven(reaches.tolist())):
            for start, end in _without_ends(first + even[0], first + even[1], len(halves)):
                if end - start >= least:
                    of_part = reaches[start - first : end - first]
                    yield _Crossings(moments[start : end + 1], halves[start:end], of_part)


def _without_ends(start: int, end: int, count: int) -> Iterator[tuple[int, int]]:
    """Some of so many half swings, and the same without the first one of all, or the last one."""
    starts = (0, 1) if start == 0 else (start,)
    ends = (count, count - 1) if end == count else (end,)
    return product(starts, ends)


def _fitting(halves: Array, period_s: float, least: int) -> list[tuple[int, int]]:
    """Where [start, end) at least so many half periods that follow each other are as long."""
    low, high = (share * period_s for share in HALF_PERIODS)
    fitting = np.zeros(len(halves) + 2, np.bool_)
    fitting[1:-1] = (halves > low) & (halves < high)
    edges = np.flatnonzero(fitting[1:] != fitting[:-1])
    starts, ends = edges[::2], edges[1::2]
    long = ends - starts >= least
    return list(zip(starts[long].tolist(), ends[long].tolist(), strict=True))


def _uneven(reaches: list[float]) -> list[int]:
    """Where a half swing reaches much less or much farther than the few before it; and both ends.

    Compared is with the (upper) median of up to five since the last such place.
    """
    places = [0]
    for index in range(1, len(reaches)):
        usual = sorted(reaches[max(places[-1], index - 5) : index])
        middle = usual[len(usual) // 2]
        if not middle / MOST_UNEVEN < reaches[index] < middle * MOST_UNEVEN:
            places.append(index)
    return [*places, len(reaches)]


class _Stretch:
    """Rows that come evenly, and what is asked of many parts of them."""

    def __init__(self, times: Array, values: Array) -> None:
        self.times, self.values = times, values
        self.interval_s = float(np.median(np.diff(times)))
        self.roughness = Roughness(values)
        steps: Array = np.abs(np.diff(values))
        self._steps = np.where(steps > SAME_NUMBER * np.abs(values).max(), steps, np.inf)

    def rows_of(self, start_s: float, end_s: float) -> slice:
        """The rows between two moments, with one before and one after."""
        start, end = np.searchsorted(self.times, [start_s, end_s])
        return slice(max(0, int(start) - 1), min(len(self.times), int(end) + 1))

    def is_resolved(self, amplitude: float, rows: slice) -> bool:
        """Whether it is more than the smallest step between two values, which most often shows.

        Most often two rows that follow each other show one that is as small.
        """
        if amplitude > self._steps[rows.start : rows.stop - 1].min(initial=np.inf):
            return True
        return amplitude > _resolution(self.values[rows])

    def least_amplitude(self, period_s: float, half_swings: int, rows: slice) -> float:
        """How high so many half swings have to be, to rise above the noise."""
        noise = self.roughness.noise(rows.start, rows.stop)
        of_means = noise / (period_s / self.interval_s * half_swings / 2) ** 0.5
        return min(NOISE_AMPLITUDES * noise, MEAN_AMPLITUDES * of_means)


def _fitted(whole: _Stretch, crossings: _Crossings) -> Iterator[Swing]:
    """The swing of such a stretch, if a sine explains it."""
    count = len(crossings.halves)
    if _varies(crossings.halves) > MOST_IRREGULAR or _varies(crossings.reaches) > MOST_VARIED:
        return
    start_s, end_s = float(crossings.moments[0]), float(crossings.moments[-1])
    period_s = 2 * (end_s - start_s) / count
    rows = whole.rows_of(start_s, end_s)
    farthest = REACHES * float(crossings.reaches.mean())
    if farthest < whole.least_amplitude(period_s, count, rows):
        return
    if not whole.is_resolved(farthest, rows):
        return
    parts = whole.times[rows], whole.values[rows]
    swing = Swing(start_s, end_s, count, *_best_sine(*parts, period_s, whole.interval_s))
    if swing.explained >= _least_explained(count) and _stands_out(whole, swing):
        yield swing


def _stands_out(whole: _Stretch, swing: Swing) -> bool:
    """Whether neither noise, nor rounding, nor a random walk makes such a swing."""
    rows, count = whole.rows_of(swing.start_s, swing.end_s), swing.half_swings
    if swing.amplitude < whole.least_amplitude(swing.period_s, count, rows):
        return False
    if not whole.is_resolved(swing.amplitude, rows):
        return False
    surroundings = whole.values[_surroundings(rows, len(whole.values))]
    walked = _walked(surroundings, swing.period_s / whole.interval_s)
    return not _is_as_of_walk(swing.amplitude, count, walked)


def _resolution(values: Array) -> float:
    """The smallest step between two values: a slow course that is rounded goes in steps.

    Such a staircase swings about its course by half a step. 0 for up to three values, between
    which something is switched to and fro.
    """
    apart = np.diff(np.unique(values))
    told_apart = apart[apart > SAME_NUMBER * float(np.abs(values).max())]
    return float(told_apart.min()) if len(told_apart) >= SWITCHED_VALUES else 0.0


def _varies(sizes: Array) -> float:
    """The coefficient of variation."""
    mean = float(sizes.sum()) / len(sizes)
    return math.sqrt(inner(sizes - mean, sizes - mean) / len(sizes)) / mean


def _least_explained(half_swings: int) -> float:
    """The fewer there are, the more has to be explained: chance makes a few now and then."""
    return float(np.interp(half_swings, (6, 10), LEAST_EXPLAINED))


def _surroundings(rows: slice, count: int) -> slice:
    """The rows with thrice as many before and after them."""
    length = 3 * (rows.stop - rows.start)
    return slice(max(0, rows.start - length), min(count, rows.stop + length))


def _walked(course: Array, rows: float) -> float:
    """How far a random walk beneath a swing of so many rows goes in one of its periods.

    In the difference to one period later the swing is gone. How much more that bends over an
    eighth of a period than over a sixteenth shows a random walk: noise bends both alike.
    """
    step = max(1, int(rows / ROWS_PER_PERIOD))
    means, period = _means(course, step), round(rows / step)
    apart = means[period:] - means[:-period]
    lag = max(1, period // ROWS_PER_PERIOD)
    grown = _bending(apart, 2 * lag) - _bending(apart, lag)
    return math.sqrt(max(0.0, grown) / 4 * period / lag)


def _bending(values: Array, lag: int) -> float:
    """The variance of second differences; what happens now and then does not move a quartile."""
    bends = np.abs(values[2 * lag :] - 2 * values[lag:-lag] + values[: -2 * lag])
    quarter = len(bends) // 4
    return float(np.partition(bends, quarter)[quarter] / _QUARTILE) ** 2 if len(bends) else 0.0


def _is_as_of_walk(amplitude: float, half_swings: int, walked: float) -> bool:
    """Whether a random walk swings as far now and then, as red noise does in climate series.

    Its power spectrum falls with the square of the frequency: where it goes `walked` in a period
    (standard deviation), a sine fitted to half swings of that period has the mean square amplitude
    2 walked**2 / (pi**2 half_swings), and exceeds k times that with the chance exp(-k) (D. L.
    Gilman, F. J. Fuglister, J. M. Mitchell, On the power spectrum of "red noise", Journal of the
    Atmospheric Sciences 20, 1963).
    """
    return amplitude**2 < -math.log(WALK_CHANCE) * 2 * walked**2 / (np.pi**2 * half_swings)


def _best_sine(
    times: Array, values: Array, period_s: float, interval_s: float
) -> tuple[float, float, float]:
    """Period, amplitude and share of the variance of the best sine of about that period.

    Sines and parabolas of least squares, in pieces of two to three periods.
    """
    step = max(1, int(period_s / interval_s / FITTED_PER_PERIOD))
    times, values = _means(times, step), _means(values, step)
    pieces = max(1, round((times[-1] - times[0]) / (PERIODS_FITTED * period_s)))
    rows = len(values) // pieces
    if rows < SHORTEST_PERIOD_ROWS:
        return period_s, 0.0, 0.0
    shape = pieces, rows
    moments: Array = np.reshape(times[: pieces * rows], shape)
    parts: Array = np.reshape(values[: pieces * rows], shape)
    moments = alike_rows(moments)
    basis = parabolas(moments)
    periods = period_s * np.array(TRIED_PERIODS)
    some = slice(None, None, -(-pieces // PIECES_TRIED))
    tried = fit_sines(moments[some], parts[some], periods, basis[some]).explained
    best = int(np.argmax(tried))
    if tried[best] < LEAST_TRIED:
        return period_s, 0.0, float(tried[best])
    periods = periods[best : best + 1] + _vertex(tried, best) * (periods[1] - periods[0])
    fit = fit_sines(moments, parts, periods, basis)
    # Of a clipped one the sine is higher; the rows next to a turn are as far from it as the angle.
    between = math.pi * step * interval_s / period_s
    highest = median(np.ptp(parts, axis=1)) / 2 / math.cos(min(between, math.pi / 4))
    amplitude = min(median(fit.amplitudes[:, 0]), highest)
    return float(periods[0]), amplitude, float(fit.explained[0])


def _vertex(heights: Array, highest: int) -> float:
    """How far from the highest one that of the parabola through it and its neighbours lies."""
    if not 0 < highest < len(heights) - 1:
        return 0.0
    before, most, after = heights[highest - 1 : highest + 2].tolist()
    return (
        (after - before) / (4 * most - 2 * before - 2 * after) if 2 * most > before + after else 0.0
    )


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
