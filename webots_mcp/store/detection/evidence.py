"""Whether a robot that stood still should have moved: what shows it, row by row.

No verdict hangs on what a mode is called. What it was told (commanded speeds), what its wheels did,
and that it moved in the same mode before is evidence; a measured speed of 0 is none against it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Indexes, median
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.habits import MovedIn
from webots_mcp.store.detection.motion import Motion, tracks_in
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.signals.flatten import shown
from webots_mcp.store.signals.registry import Signal

Flags = NDArray[np.bool_]

WHEELS_TURN: Final = 0.1  # rad/s, or in whatever unit they are published
ON_THE_SPOT: Final = 0.2  # of the fastest wheel: where the mean of all is less, none drives ahead
TURNED_RAD: Final = 0.1  # from a second before to a second after
HEADING_NOISE: Final = 6.0  # standard deviations
SWAY_S: Final = 2.0
SWAY_M: Final = 0.0035  # of 1 cm to and fro; less is how a robot trembles at a wall
SWAY_NOISE: Final = 3.5  # deviations in each coordinate: noise alone comes to 1.4 of them
MOSTLY: Final = 0.5
TOLD_SHARE: Final = 0.1  # of the rows: what holds in fewer, at the ends, shows nothing


@dataclass(frozen=True)
class Evidence:
    """What is known of whether a robot that stood should have moved.

    Attributes:
        should_move: Per row, whether it should have.
        shown_by: What shows it.
        against: What speaks against it, or that nothing is published that could show it.
    """

    should_move: Flags
    shown_by: list[str] = field(default_factory=list[str])
    against: list[str] = field(default_factory=list[str])


def weigh(
    columns: Columns, motion: Motion, options: EventOptions, moved_in: MovedIn, noise_m: float
) -> Evidence:
    """Weigh what the rows of one standstill tell; the noise is that of its way's positions."""
    told, told_why, stop, stop_why = _by_command(columns, motion, options)
    ahead, ahead_why, spot, rest_why = _by_wheels(columns, motion)
    mode, mode_why, mode_against = _by_mode(columns, motion, options, moved_in)
    turning = turns(columns, motion.heading)
    # Wheels that turn it on the spot move it nowhere; where it looks tells whether they do.
    turning |= spot if motion.heading is None else False
    swaying, reach_m = sways(columns, motion, noise_m)
    should_move = (told | ahead | mode) & ~stop & ~turning & ~swaying
    against = [*stop_why, *rest_why, *mode_against]
    against += ["it turned in place"] if _mostly(turning) else []
    against += [f"it went to and fro within {reach_m:.2g} m"] if _mostly(swaying) else []
    if not should_move.any() and not against:
        modeless = "" if motion.mode else "; a signal that holds a mode can be named: mode=NAME"
        against = [f"nothing that is published shows that it should have moved{modeless}"]
    return Evidence(should_move, [*mode_why, *told_why, *ahead_why], against)


def _by_command(
    columns: Columns, motion: Motion, options: EventOptions
) -> tuple[Flags, list[str], Flags, list[str]]:
    """Rows in which it was told to move, and in which it was told not to, each with the reason.

    A speed whose name leaves open whether it is commanded or measured is a command where it is
    not 0: it stands.
    """
    signal = motion.commanded or motion.speed
    if signal is None or signal.name not in columns.values:
        none = np.zeros(len(columns.times), np.bool_)
        return none, [], none, []
    speeds = np.abs(numbers(columns, signal))
    told = speeds >= options.min_commanded
    stop = (speeds < options.min_commanded) & (motion.commanded is not None)
    said = f"{signal.name} {{:.3g}}"
    shown = np.count_nonzero(told) > TOLD_SHARE * len(told)
    why = [said.format(median(numbers(columns, signal)[told]))] if shown else []
    against = [said.format(median(numbers(columns, signal)[stop]))] if _mostly(stop) else []
    return told, why, stop, against


def _by_wheels(columns: Columns, motion: Motion) -> tuple[Flags, list[str], Flags, list[str]]:
    """Rows in which the wheels drive it ahead or back, and in which they turn it on the spot.

    Each with the reason; the last one is that they mostly rest.
    """
    wheels = [wheel for wheel in motion.wheels if wheel.name in columns.values]
    if not wheels:
        none = np.zeros(len(columns.times), np.bool_)
        return none, [], none, []
    speeds = np.nan_to_num(np.stack([numbers(columns, wheel) for wheel in wheels]))
    fastest, mean = np.abs(speeds).max(axis=0), np.abs(speeds.mean(axis=0))
    turn = fastest >= WHEELS_TURN
    ahead = turn & (mean >= ON_THE_SPOT * fastest)
    spot = turn & ~ahead
    unit = " rad/s" if all(wheel.unit == "rad/s" for wheel in wheels) else ""
    driving = ahead if ahead.any() else spot
    why = [f"wheels at {median(fastest[driving]):.3g}{unit}"] if driving.any() else []
    against = ["wheels rest"] if _mostly(~turn) else []
    return (ahead | spot) if motion.heading else ahead, why, spot, against


def _by_mode(
    columns: Columns, motion: Motion, options: EventOptions, moved_in: MovedIn
) -> tuple[Flags, list[str], list[str]]:
    """Rows whose mode is one in which this robot moves."""
    if motion.mode is None or motion.mode.name not in columns.values:
        return np.zeros(len(columns.times), np.bool_), [], []
    modes = [shown(mode) for mode in columns.values[motion.mode.name]]
    reasons = {mode: _moves_in(mode, options, moved_in) for mode in dict.fromkeys(modes)}
    why = [reason for reason in reasons.values() if reason]
    against = [
        f"not seen moving in mode {mode}"
        for mode, reason in reasons.items()
        if reason is None and isinstance(mode, str)
    ]
    return np.array([reasons[mode] is not None for mode in modes], np.bool_), why, against


def _moves_in(mode: Value, options: EventOptions, moved_in: MovedIn) -> str | None:
    """Why a robot in that mode should move; None where nothing shows it."""
    if options.moving_modes is not None:
        return f"mode {mode} is one of moving_modes" if mode in options.moving_modes else None
    seen = moved_in.seen(mode)
    if seen is None:
        return None
    where = "" if seen.run_id == moved_in.run_id else f" in run {seen.run_id}"
    return f"in mode {mode}, in which it moved at {seen.speed_m_s:.2g} m/s{where}"


def sways(columns: Columns, motion: Motion, noise_m: float) -> tuple[Flags, float]:
    """Per row whether it went about within two seconds, and how far apart its places were.

    Who does so within a place moves in it, and is not stuck. What counts is how far its places are
    from their mean (root mean square): of many rows some few are always far away.
    """
    flags = np.zeros(len(columns.times), np.bool_)
    times = columns.moments
    reach_m = 0.0
    for track in tracks_in(columns, motion.position, noise_m) if motion.position else []:
        seconds = np.arange(track.times[0] + SWAY_S, track.times[-1], SWAY_S)
        edges = np.unique(np.searchsorted(track.times, [track.times[0], *seconds]))
        away_m = np.sqrt(sum(_variances(each, edges) for each in (track.x, track.y)))
        moved = away_m > max(SWAY_M, SWAY_NOISE * track.left_m)
        reach_m = max(reach_m, math.hypot(np.ptp(track.x), np.ptp(track.y)))
        here = np.searchsorted(track.times[edges], times, side="right") - 1
        within = (times >= track.times[0]) & (times <= track.times[-1])
        flags |= within & moved[np.maximum(here, 0)]
    return flags, reach_m


def _variances(values: Array, edges: Indexes) -> Array:
    """The variance of the values in each of the parts that begin at the edges."""
    counts = np.diff(edges, append=len(values))
    off = values - np.repeat(np.add.reduceat(values, edges) / counts, counts)
    return np.add.reduceat(off**2, edges) / counts


def turns(columns: Columns, heading: Signal | None) -> Flags:
    """Per row whether it looks elsewhere a second later than a second before."""
    none = np.zeros(len(columns.times), np.bool_)
    if heading is None or heading.name not in columns.values:
        return none
    angles = _radians(columns, heading)
    present = np.flatnonzero(~np.isnan(angles))
    if len(present) < 2:
        return none
    course = np.interp(np.arange(len(angles)), present, np.unwrap(angles[present]))
    times = columns.moments
    later = np.minimum(np.searchsorted(times, times + 1.0), len(times) - 1)
    earlier = np.maximum(np.searchsorted(times, times - 1.0, side="right") - 1, 0)
    limit = max(TURNED_RAD, HEADING_NOISE * noise_of(course))
    return np.asarray(np.abs(course[later] - course[earlier]) > limit)


def turned_rad(columns: Columns, heading: Signal | None) -> float | None:
    """How far it turned from the first rows to the last; None where that is not known."""
    if heading is None or heading.name not in columns.values:
        return None
    angles = _radians(columns, heading)
    course = np.unwrap(angles[~np.isnan(angles)])
    if not len(course):
        return None
    rows = max(1, min(5, len(course) // 2))
    return median(course[-rows:]) - median(course[:rows])


def _radians(columns: Columns, angle: Signal) -> Array:
    return numbers(columns, angle) * (math.tau / (angle.turn or math.tau))


def numbers(columns: Columns, signal: Signal) -> Array:
    """One number per row, NaN where it has none."""
    return columns.aligned(signal.name)


def _mostly(flags: Flags) -> bool:
    return bool(np.count_nonzero(flags) > MOSTLY * len(flags))


def usual(values: Sequence[Value]) -> Value:
    """The value that most rows have."""
    return max(dict.fromkeys(values), key=list(values).count) if values else None
