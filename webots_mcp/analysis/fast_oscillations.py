"""Oscillations of two to eight rows a period, and how the amplitude of any oscillation goes on.

Fast ones are the peaks of a periodogram that Fisher's test of the largest ordinate (R. A. Fisher,
Tests of significance in harmonic analysis, 1929) does not take for noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Flags, Indexes, np, rounding_of, runs_of
from webots_mcp.analysis.oscillations import EvenRows, Swing

LONGEST_FAST_ROWS: Final = 7.0  # of a period; longer ones are found by their bends
FALSE_ALARMS: Final = 1e-6  # of a window without an oscillation
_WINDOW: Final = 64  # rows
_HOP: Final = 32
_FIRST_ORDINATE: Final = math.ceil(_WINDOW / LONGEST_FAST_ROWS)
_AT_ONCE: Final = 256  # windows, which stay in the cache of a processor
_LOCAL: Final = 14  # rows over which an amplitude is local
_LEAST_WINDOWS: Final = 3  # that follow each other: filtered noise seldom makes two
LEAST_FAST_ROWS: Final = _WINDOW + (_LEAST_WINDOWS - 1) * _HOP  # of a fast one that is found
_MOST_PERIODS: Final = 10_000


@dataclass(frozen=True)
class _Certainty:
    """When an oscillation with a short period is more than noise.

    Attributes:
        degree: Degree of the polynomial that removes slow motion from a window.
        certain: Standard errors that the amplitude must exceed.
        same_phase_rad: Largest change of the phase from one period to the next.
        goes_on: Smallest amplitude of a period, as a share of the next one's; with less, the
            oscillation only reaches into that period.
    """

    degree: int = 3
    certain: float = 4.0
    same_phase_rad: float = 1.0
    goes_on: float = 0.6


_SURE: Final = _Certainty()


def find_fast_swings(rows: EvenRows, values: Array, least_half_swings: int) -> Iterator[Swing]:
    """Yield the oscillations with a period of 2 to 8 rows, in order.

    Args:
        rows: Whose values they are.
        values: Angles have to be unwrapped.
        least_half_swings: Shorter ones are none.
    """
    for times, part in rows.stretches(rows.even(values)):
        if len(part) >= _WINDOW and part.min() < part.max():
            yield from _in_stretch(times, part, least_half_swings)


def _in_stretch(times: Array, values: Array, least: int) -> Iterator[Swing]:
    starts = np.arange(0, len(values) - _WINDOW + 1, _HOP)
    swings, peak, share, amplitude = _peaks_in(values, starts)
    for run in runs_of(swings, times[starts]).spans():
        if run.stop - run.start < _LEAST_WINDOWS or np.ptp(peak[run.start : run.stop]) > 2:
            continue
        ordinate = _FIRST_ORDINATE + int(np.bincount(peak[run.start : run.stop]).argmax())
        begin, end = int(starts[run.start]), int(starts[run.stop - 1]) + _WINDOW - 1
        begin, end = _ends_of(values[begin : end + 1], ordinate, begin)
        interval_s = float(times[end] - times[begin]) / (end - begin)
        period_s = _WINDOW / ordinate * interval_s
        half_swings = int(2 * float(times[end] - times[begin]) / period_s)
        if half_swings >= least:
            size = float(np.median(amplitude[run.start : run.stop]))
            if size < rounding_of(values[begin : end + 1]):
                continue
            explained = float(np.median(share[run.start : run.stop]))
            yield Swing(
                float(times[begin]), float(times[end]), half_swings, period_s, size, explained
            )


def _peaks_in(values: Array, starts: Indexes) -> tuple[Flags, Indexes, Array, Array]:
    """Return what `_peaks_of` does of the windows that may be among enough that oscillate.

    So many windows that follow each other include one of which the place is a multiple of their
    number, and all of them lie near such a one. The others are not examined, and count as quiet.
    """
    swings = np.zeros(len(starts), np.bool_)
    peak = np.zeros(len(starts), np.intp)
    share, amplitude = np.zeros(len(starts)), np.zeros(len(starts))
    first = np.arange(0, len(starts), _LEAST_WINDOWS)
    for wanted in (first, None):
        if wanted is None:
            near = np.zeros(len(starts), np.bool_)
            for shift in range(1, _LEAST_WINDOWS):
                near[shift:] |= swings[:-shift]
                near[:-shift] |= swings[shift:]
            near[first] = False
            wanted = np.flatnonzero(near)
        for begin in range(0, len(wanted), _AT_ONCE):
            some = wanted[begin : begin + _AT_ONCE]
            swings[some], peak[some], share[some], amplitude[some] = _peaks_of(values, starts[some])
    return swings, peak, share, amplitude


def _peaks_of(values: Array, starts: Indexes) -> tuple[Flags, Indexes, Array, Array]:
    """Of the windows that begin in these rows: whether they oscillate, and their largest ordinate.

    Returns:
        For each window whether Fisher's test finds an oscillation, which ordinate of the band is
        the largest one, its share of the band, and its amplitude.
    """
    windows: Array = np.lib.stride_tricks.sliding_window_view(values, _WINDOW)[starts]
    orthogonal = _slow_motion()
    rest: Array = windows - (windows @ orthogonal) @ np.transpose(orthogonal)
    found = np.fft.rfft(rest, axis=1)
    band: Array = np.square(found.real[:, _FIRST_ORDINATE:])
    band += np.square(found.imag[:, _FIRST_ORDINATE:])
    band[:, -1] /= 2  # the last ordinate has one degree of freedom, the others two
    count = band.shape[1]
    total: Array = band.sum(axis=1)
    share = band.max(axis=1) / np.where(total > 0, total, 1.0)
    swings: Flags = count * (1 - share) ** (count - 1) < FALSE_ALARMS
    # What remains of a step or a bend is spread over the band; rounding is no oscillation.
    some = np.flatnonzero(swings)
    slow = np.square(np.abs(found[some, :_FIRST_ORDINATE])).sum(axis=1)
    swings[some] = total[some] > 1e-12 * np.maximum(slow + total[some], 1e-300)
    amplitude = np.sqrt(2 * total * share) / (_WINDOW / math.sqrt(2))
    return swings, band.argmax(axis=1), share, amplitude


@lru_cache(1)
def _slow_motion() -> Array:
    """Polynomials over a window as orthogonal columns."""
    return np.linalg.qr(np.vander(np.linspace(-1, 1, _WINDOW), _SURE.degree + 1))[0]


def _ends_of(values: Array, ordinate: int, first: int) -> tuple[int, int]:
    """The first and last row where the oscillation has half of its usual amplitude."""
    wave = np.exp(-2j * math.pi * ordinate / _WINDOW * np.arange(len(values)))
    steps = values - np.convolve(values, np.ones(_LOCAL) / _LOCAL, "same")
    local = np.abs(np.convolve(steps * wave, np.ones(_LOCAL) / _LOCAL, "same"))
    loud = np.flatnonzero(local >= np.median(local) / 2)
    return first + int(loud[0]), first + int(loud[-1])


class SwingCourse(NamedTuple):
    """An oscillation with all periods that belong to it.

    Attributes:
        start_amplitude: Of its first periods; `end_amplitude` of its last ones.
    """

    swing: Swing
    start_amplitude: float
    end_amplitude: float


def course_of(swing: Swing, times: Array, values: Array, noise: float) -> SwingCourse:
    """Follow an oscillation to where its amplitude is lost in the noise, on both sides.

    A growing oscillation stands out late, though its first periods have the same period and phase.

    Args:
        swing: As it was found.
        times: Of the rows around it, without recording gaps.
        values: Of the same rows.
        noise: Standard deviation of the noise in them.
    """
    period_s = swing.period_s
    amplitudes: list[float] = []
    first_s, last_s = swing.start_s, swing.end_s
    for step_s in (-period_s, period_s):
        edge_s = swing.start_s if step_s < 0 else swing.end_s
        inner = _sine_at(times, values, edge_s - max(step_s, 0.0), period_s)
        phase = inner[1] if inner else None
        size = inner[0] if inner else swing.amplitude
        for _ in range(_MOST_PERIODS):
            begin_s = edge_s + min(step_s, 0.0)
            found = _sine_at(times, values, begin_s, period_s)
            if found is None or phase is None:
                break
            amplitude, here, rows = found
            error = noise * math.sqrt(2 / rows)
            drift = abs(math.remainder(here - phase, 2 * math.pi))
            is_lost = amplitude < max(_SURE.certain * error, _SURE.goes_on * size) or amplitude <= 0
            if is_lost or drift > _SURE.same_phase_rad:
                break
            edge_s, phase, size = edge_s + step_s, here, amplitude
        amplitudes.append(size)
        if step_s < 0:
            first_s = max(edge_s, float(times[0]))
        else:
            last_s = min(edge_s, float(times[-1]))
    half_swings = max(swing.half_swings, int(2 * (last_s - first_s) / period_s))
    longer = replace(swing, start_s=first_s, end_s=last_s, half_swings=half_swings)
    return SwingCourse(longer, *amplitudes)


def _sine_at(
    times: Array, values: Array, start_s: float, period_s: float
) -> tuple[float, float, int] | None:
    """The amplitude and phase of the sine in one period, and its rows; None where it has few."""
    first, stop = np.searchsorted(times, (start_s - 1e-9, start_s + period_s + 1e-9)).tolist()
    if stop - first < 5 or times[stop - 1] - times[first] < 0.7 * period_s:
        return None
    angle = 2 * math.pi * times[first:stop] / period_s
    clock = (times[first:stop] - times[first]) / period_s
    base = np.stack((np.cos(angle), np.sin(angle), np.ones(stop - first), clock), axis=1)
    (cosine, sine, _, _), _, _, _ = np.linalg.lstsq(base, values[first:stop], rcond=None)
    return math.hypot(cosine, sine), math.atan2(sine, cosine), stop - first
