"""Swings on a course that bends now and then, as the heading of a robot that turns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np, sums_of
from webots_mcp.store.analysis.hinges import hinged_courses, hinges_in
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.sines import TRIED_PERIODS, Fit, fit_sines

LOOKED_AT: Final = 2.2  # periods at once, of second differences; they reach over 0.4 more
LAG: Final = 0.2  # of the period: over it differences are taken
CLIPPED: Final = 1.5  # times the median magnitude: a sine has a height of 1.4 times its own
# Mean magnitude of these differences, in deviations of the noise: of noise alone it is
# (12 / pi)**0.5 = 1.95, and where a sine explains as much of it as is LIKELY it is 3.1.
LEAST_LOUD: Final = 2.4
LEAST_TURNS: Final = 2  # of their sign; a sine has four, of which a bend may hide some
LIKELY: Final = 0.6  # of such clipped differences is explained by a sine ...
MOST_LIKELY: Final = 0.8  # ... and so much somewhere in the stretch
SEMITONES: Final = range(-4, 5)  # of the band's period; a band reaches from -3 to 3
PIECE: Final = 2.5  # periods, in which a sine and hinges are fitted
HOP: Final = 0.25  # of a period, from one piece to the next
LEAST_IN_PIECE: Final = 0.85  # explained; and the two for 6 half swings and for 12
LEAST_EXPLAINED: Final = (0.94, 0.85)
BETTER_THAN_ZIGZAG: Final = 10.0  # in the criterion of Schwarz, where 10 is very strong evidence
SINE_PARAMETERS: Final = 3
NEGLIGIBLE: Final = 0.003  # of the amplitude: what is left of squares without any noise
ALIKE: Final = 1.5  # ratio of the amplitudes of pieces
MOST_OFF: Final = 1.09  # ratio of the best period to the one that seemed likely
HIDDEN: Final = 1.0  # of a period, for which bends may hide a swing that goes on
SETTLED: Final = 1.0  # periods after which a piece that was found surely swings
ENDING: Final = 0.04  # of the squares of a sine: a piece of which more is left reaches beyond it


@dataclass(frozen=True)
class BentSwing:
    """Rows [start, end) that swing.

    Attributes:
        period: In rows.
        explained: Share of the squares about the course that sines explain.
    """

    start: int
    end: int
    half_swings: int
    period: float
    amplitude: float
    explained: float


def likely_swings(values: Array, noise: Array, period: float) -> Iterator[tuple[int, int, float]]:
    """Where rows [start, end) seem to swing with about that period, and with which one.

    Looked at are second differences over a fifth of the period: there a course of straight pieces
    is 0 but about its bends, and what stands out from the median at bends is cut off. Where they
    are hardly larger than the noise about each value makes them, or keep their sign, a sine
    explains little of them.
    """
    lag, hop, rows = (max(1, round(share * period)) for share in (LAG, 0.5, LOOKED_AT))
    bends = values[2 * lag :] - 2 * values[lag:-lag] + values[: -2 * lag]
    if len(bends) < rows:
        return
    sizes = sums_of(np.abs(bends), rows)[::hop]
    loud = sizes > LEAST_LOUD * rows * noise[lag + rows // 2 :: hop][: len(sizes)]
    looked_at = np.flatnonzero(loud)
    looked_at = looked_at[_turns(bends, hop * looked_at, rows) >= LEAST_TURNS]
    if not len(looked_at):
        return
    windows = np.lib.stride_tricks.sliding_window_view(bends, rows)[hop * looked_at]
    limits = CLIPPED * np.partition(np.abs(windows), rows // 2, axis=1)[:, rows // 2, None]
    clipped: Array = np.minimum(np.maximum(windows, -limits), limits)
    squares: Array = np.einsum("ij,ij->i", clipped, clipped)
    periods = [period * 2 ** (semitones / 12) for semitones in SEMITONES]
    best = _explained(clipped, *periods[1::3]).max(axis=1)
    likely = looked_at[(best > LIKELY * squares) & (squares > 0)]
    reach = rows + 2 * lag
    for part in _followed(likely, int((reach + HIDDEN * period) / hop)):
        seen = np.searchsorted(looked_at, part)
        if np.any(best[seen] > MOST_LIKELY * squares[seen]):
            place = int(np.argmax(_explained(clipped[seen], *periods).sum(axis=0)))
            if 0 < place < len(periods) - 1:  # else another band sees it better
                yield int(part[0]) * hop, int(part[-1]) * hop + reach, periods[place]


def _turns(values: Array, starts: Indexes, rows: int) -> Indexes:
    """How often the sign changes in so many values from each start."""
    above = values > 0
    turns = np.zeros(len(values), np.intp)
    np.cumsum(above[1:] != above[:-1], out=turns[1:])
    return turns[starts + rows - 1] - turns[starts]


def _explained(windows: Array, *periods: float) -> Array:
    """Of the squares in each window, what a sine of each period explains."""
    squares = (windows @ _waves(windows.shape[1], *periods)) ** 2
    return np.asarray(squares[:, : len(periods)] + squares[:, len(periods) :], np.float64)


@lru_cache(64)  # the same for all signals of a stretch
def _waves(rows: int, *periods: float) -> Array:
    """Cosines and sines of length 1 as columns."""
    places: Array = np.arange(rows, dtype=np.float64) - (rows - 1) / 2
    angles: Array = 2 * np.pi * places[:, None] / np.array(periods)
    waves = np.concatenate((np.cos(angles), np.sin(angles)), axis=1)
    return np.asarray(waves / np.sqrt(np.einsum("ij,ij->j", waves, waves)), np.float64)


def _followed(places: Indexes, most: int) -> list[Indexes]:
    """Places in parts, in each of which the next one is at most so far away."""
    return np.split(places, np.flatnonzero(np.diff(places) > most) + 1) if len(places) else []


def swings_on_bends(
    values: Array, start: int, end: int, period: float, least_half_swings: int
) -> Iterator[BentSwing]:
    """Swings in about these rows that a sine explains on a course of straight pieces.

    Sine and course are fitted together, in pieces that overlap. A piece counts where the sine
    explains most of what the course leaves, and where it is far better than a zigzag without one:
    enough bends make any swing.
    """
    hop, rows = max(1, round(HOP * period)), round(PIECE * period)
    start, end = max(0, start - 2 * hop), min(len(values), end + 2 * hop)
    if end - start < rows:
        return
    pieces = np.lib.stride_tricks.sliding_window_view(values[start:end], rows)[::hop]
    touching = int((rows + HIDDEN * period) / hop)
    for part, fitted in _fitted(pieces, period, noise_of(values[start:end]), touching):
        first, last = start + int(part[0]) * hop, start + int(part[-1]) * hop + rows
        if round(2 * (last - first) / fitted.period) < least_half_swings:
            continue
        found = values[first:last]
        first += _idle_rows(found, fitted.period)
        last -= _idle_rows(found[::-1], fitted.period)
        count = round(2 * (last - first) / fitted.period)
        least = np.interp(count, (6, 12), LEAST_EXPLAINED)
        if count >= least_half_swings and fitted.explained(part) >= least:
            amplitude = float(np.median(fitted.amplitudes[part]))
            yield BentSwing(first, last, count, fitted.period, amplitude, fitted.explained(part))


def _idle_rows(values: Array, period: float) -> int:
    """After how many rows the sine begins that swings from there on: hinges hide what lacks of it.

    Before that row second differences are small as they are, after it without those of the sine.
    """
    lag, settled, rows = (round(share * period) for share in (LAG, SETTLED, LOOKED_AT))
    lag = max(1, lag)
    bends = values[2 * lag :] - 2 * values[lag:-lag] + values[: -2 * lag]
    inside = bends[settled : settled + rows]
    limit = CLIPPED * float(np.median(np.abs(inside)))
    clipped = np.asarray(np.minimum(np.maximum(inside, -limit), limit), np.float64)
    angles: Array = 2 * np.pi * np.arange(len(bends), dtype=np.float64) / period
    waves: Array = np.stack((np.cos(angles), np.sin(angles)))
    of_inside = waves[:, settled : settled + rows]
    squares = of_inside @ np.transpose(of_inside)
    swing: Array = np.linalg.solve(squares, of_inside @ clipped) @ waves
    gains = (np.abs(bends) - np.abs(bends - swing))[: 2 * settled]
    after = np.cumsum(gains[::-1])[::-1]
    begin = int(np.argmax(after))
    return begin + lag if begin else 0


@dataclass(frozen=True)
class _Fitted:
    """Sines of one period on the courses of pieces: squares without and with them, and heights."""

    period: float
    courses: Array
    left: Array
    amplitudes: Array

    def explained(self, part: Indexes) -> float:
        return float(1 - self.left[part].sum() / self.courses[part].sum())


def _fitted(
    pieces: Array, period: float, noise: float, touching: int
) -> Iterator[tuple[Indexes, _Fitted]]:
    """Which pieces that follow each other swing alike, and what was fitted to all pieces."""
    basis, fit, ratio = _of_best_period(pieces, period, noise)
    if fit is None or not 1 / MOST_OFF < ratio < MOST_OFF:
        return
    fitted = _Fitted(period * ratio, fit.of_course[:, 0], fit.of_sines[:, 0], fit.amplitudes[:, 0])
    swings: Flags = fitted.left < (1 - LEAST_IN_PIECE) * fitted.courses
    if swings.any():
        swings &= _beats_zigzag(pieces, fitted, basis, noise)
    if not swings.any():
        return
    middle = float(np.median(fitted.amplitudes[swings]))
    swings &= (fitted.amplitudes < ALIKE * middle) & (fitted.amplitudes > middle / ALIKE)
    if not swings.any():
        return
    whole = pieces.shape[1] * middle**2 / 2
    swings &= fitted.left < np.median(fitted.left[swings]) + ENDING * whole
    for part in _followed(np.flatnonzero(swings), touching):
        yield part, fitted


def _of_best_period(pieces: Array, period: float, noise: float) -> tuple[Array, Fit | None, float]:
    """Courses and sines of the period that explains most in the pieces that seem to swing."""
    places: Array = np.arange(pieces.shape[1], dtype=np.float64)[None]
    tiny = np.finfo(np.float64).tiny
    tried, ratio, passes = np.array(TRIED_PERIODS), 1.0, 2
    while True:  # bends found with a wrong period hide part of its error
        basis, _ = hinged_courses(pieces, period * ratio, noise)
        fit = fit_sines(places, pieces, period * ratio * tried, basis)
        left = fit.of_sines / np.maximum(fit.of_course, tiny)
        good = left.min(axis=1) < 1 - LIKELY
        if not good.any():
            return basis, None, ratio
        best = int(np.argmin(np.median(left[good], axis=0)))
        ratio *= TRIED_PERIODS[best]
        passes -= 1
        if TRIED_PERIODS[best] == 1.0 or not passes:
            return basis, fit.of_period(best), ratio


def _beats_zigzag(pieces: Array, fitted: _Fitted, basis: Array, noise: float) -> Flags:
    """Whether the sine is worth more than the hinges that a course without it takes instead."""
    rows = pieces.shape[1]
    of_zigzag, zigzag = hinged_courses(pieces, None, noise)
    least = rows * (NEGLIGIBLE * fitted.amplitudes) ** 2
    gain = rows * np.log((zigzag + least) / (fitted.left + least))
    more = SINE_PARAMETERS + 2 * (hinges_in(basis) - hinges_in(of_zigzag))
    return gain - more * np.log(rows) > BETTER_THAN_ZIGZAG
