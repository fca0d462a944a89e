"""Whether a robot that stood still should have moved: what shows it, part by part.

No verdict depends on the name of a mode. What was commanded (speeds), what its wheels did,
and that it moved in the same mode before is evidence; a measured speed of 0 is none against it.

The evidence in its rows is collected first. It can be stored, and is weighed at each question,
since the modes in which the robot moves may become known later.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, median, np
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.motion import Motion, tracks_in
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.signals.flatten import shown
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.detection.habits import MovedIn

WHEELS_TURN: Final = 0.1  # rad/s, or in whatever unit they are published
ON_THE_SPOT: Final = 0.2  # of the fastest wheel: where the mean of all is less, none drives ahead
TURN_S: Final = 2.0
TURNED_RAD: Final = 0.1  # from the mean of so many seconds before to that of as many after
HEADING_NOISE: Final = 6.0  # standard deviations of such a mean
SWAY_S: Final = 2.0
SWAY_M: Final = 0.0035  # of 1 cm to and fro; less is how a robot trembles at a wall
SWAY_NOISE: Final = 3.5  # deviations in each coordinate: noise alone comes to 1.4 of them
MOSTLY: Final = 0.5
TOLD_SHARE: Final = 0.1  # of the rows: what holds in fewer, at the ends, shows nothing
_HEADING_ROWS: Final = 5  # at each end, whose median is its heading


class Part(NamedTuple):
    """Rows one after the other that show the same.

    Attributes:
        drives: It was commanded to move, or its wheels drove it.
        hindered: It was commanded not to move, turned in place, or moved to and fro.
        commanded: The commanded speed of most rows, and how many these are.
        looked_rad: Where it looked in the first rows and in the last ones, counted on over whole
            turns; None where that is not known.
    """

    start_s: float
    end_s: float
    rows: int
    mode: Value
    drives: bool
    hindered: bool
    commanded: tuple[Value, int]
    looked_rad: tuple[float, float] | None


class Counts(NamedTuple):
    """In how many rows of a standstill something shows, and how much it is there.

    Attributes:
        told: Commanded to move; `told_m_s` is the median of those speeds.
        stopped: Commanded to stand; `stopped_m_s` as well.
        driving: The wheels turn: ahead or back, else on the spot.
        reach_m: How far apart the places are to and fro between which it went.
    """

    rows: int = 0
    told: int = 0
    told_m_s: float = 0.0
    stopped: int = 0
    stopped_m_s: float = 0.0
    driving: int = 0
    wheels: float = 0.0
    resting: int = 0
    turning: int = 0
    swaying: int = 0
    reach_m: float = 0.0

    def mostly(self, rows: int) -> bool:
        """Whether so many are more than half of the rows."""
        return rows > MOSTLY * self.rows


@dataclass(frozen=True)
class Observed:
    """What the rows of one standstill show, whatever its modes mean."""

    parts: Sequence[Part]
    counts: Counts


@dataclass(frozen=True)
class Evidence:
    """What is known of whether a robot that stood should have moved.

    Attributes:
        should_move: Per part, whether it should have.
        shown_by: What shows it.
        against: What speaks against it, or that nothing is published that could show it.
    """

    should_move: list[bool]
    shown_by: list[str] = field(default_factory=list[str])
    against: list[str] = field(default_factory=list[str])


def observe(columns: Columns, motion: Motion, min_commanded: float, noise_m: float) -> Observed:
    """What the rows of one standstill show; the noise is that of its way's positions."""
    counts = Counts(rows=len(columns.times))
    told, stop, counts = _by_command(columns, motion, min_commanded, counts)
    ahead, spot, counts = _by_wheels(columns, motion, counts)
    turning = turns(columns, motion.heading)
    # Wheels that turn it on the spot move it nowhere; its heading shows whether they do.
    turning |= spot if motion.heading is None else False
    swaying, reach_m = sways(columns, motion, noise_m)
    counts = counts._replace(
        turning=_count(turning), swaying=_count(swaying), reach_m=round(reach_m, 6)
    )
    return Observed(_parts(columns, motion, told | ahead, stop | turning | swaying), counts)


def weigh(observed: Observed, motion: Motion, options: EventOptions, moved_in: MovedIn) -> Evidence:
    """Weigh what was observed of one standstill."""
    counts, parts = observed.counts, observed.parts
    modes, mode_why, mode_against = _by_mode(parts, motion, options, moved_in)
    should_move = [(part.drives or part.mode in modes) and not part.hindered for part in parts]
    against = [*_against_in(counts, motion), *mode_against]
    against += [_turned(motion)] if counts.mostly(counts.turning) else []
    to_and_fro = f"it moved back and forth within {counts.reach_m:.2g} m"
    against += [to_and_fro] if counts.mostly(counts.swaying) else []
    if not any(should_move) and not against:
        modeless = "" if motion.mode else "; if one of them holds the mode, give mode=NAME"
        against = [f"no published signal shows that it should have moved{modeless}"]
    rows = sum(part.rows for part, should in zip(parts, should_move, strict=True) if should)
    return Evidence(should_move, [*mode_why, *_shown_in(counts, motion, rows)], against)


def _turned(motion: Motion) -> str:
    """A turn that was seen, or what only the wheels tell: a quadcopter's also run like that."""
    if motion.heading is not None:
        return "it turned in place"
    return "its wheels turned in opposite directions, as for a turn in place; no heading recorded"


def _shown_in(counts: Counts, motion: Motion, rows: int) -> list[str]:
    """What commands and wheels show of the rows in which it should have moved."""
    signal = motion.commanded or motion.speed
    said: list[str] = []
    if signal and counts.told > TOLD_SHARE * (rows or counts.rows):
        said.append(f"{signal.name} {counts.told_m_s:.3g}")
    if counts.driving:
        unit = " rad/s" if all(wheel.unit == "rad/s" for wheel in motion.wheels) else ""
        said.append(f"wheels at {counts.wheels:.3g}{unit}")
    return said


def _against_in(counts: Counts, motion: Motion) -> list[str]:
    """What commands and wheels show against it."""
    said: list[str] = []
    if motion.commanded and counts.mostly(counts.stopped):
        said.append(f"{motion.commanded.name} {counts.stopped_m_s:.3g}")
    return [*said, "wheels at rest"] if counts.mostly(counts.resting) else said


def _by_command(
    columns: Columns, motion: Motion, min_commanded: float, counts: Counts
) -> tuple[Flags, Flags, Counts]:
    """Rows in which it was commanded to move, and in which it was commanded not to.

    A speed whose name leaves open whether it is commanded or measured is a command where it is
    not 0: it stands.
    """
    signal = motion.commanded or motion.speed
    if signal is None or signal.name not in columns.values:
        none = np.zeros(len(columns.times), np.bool_)
        return none, none, counts
    speeds = columns.aligned(signal.name)
    told = np.abs(speeds) >= min_commanded
    stop = (np.abs(speeds) < min_commanded) & (motion.commanded is not None)
    return told, stop, counts._replace(
        told=_count(told), told_m_s=_median(speeds, told),
        stopped=_count(stop), stopped_m_s=_median(speeds, stop),
    )  # fmt: skip


def _by_wheels(columns: Columns, motion: Motion, counts: Counts) -> tuple[Flags, Flags, Counts]:
    """Rows in which the wheels drive it ahead or back, and in which they turn it on the spot."""
    wheels = [wheel for wheel in motion.wheels if wheel.name in columns.values]
    if not wheels:
        none = np.zeros(len(columns.times), np.bool_)
        return none, none, counts
    speeds = np.nan_to_num(np.stack([columns.aligned(wheel.name) for wheel in wheels]))
    fastest, mean = np.abs(speeds).max(axis=0), np.abs(speeds.mean(axis=0))
    turn = fastest >= WHEELS_TURN
    ahead = turn & (mean >= ON_THE_SPOT * fastest)
    spot = turn & ~ahead
    driving = ahead if ahead.any() else spot
    return (
        (ahead | spot) if motion.heading else ahead,
        spot,
        counts._replace(
            driving=_count(driving), wheels=_median(fastest, driving), resting=_count(~turn)
        ),
    )


def _by_mode(
    parts: Sequence[Part], motion: Motion, options: EventOptions, moved_in: MovedIn
) -> tuple[set[Value], list[str], list[str]]:
    """The modes in which this robot moves, why, and what speaks against it."""
    if motion.mode is None:
        return set(), [], []
    modes = {part.mode: shown(part.mode) for part in parts}
    reasons = {mode: _moves_in(said, options, moved_in) for mode, said in modes.items()}
    why = list(dict.fromkeys(reason for reason in reasons.values() if reason))
    against = [
        f"not checked whether it moves in mode {modes[mode]}: time limit reached"
        if mode in moved_in.cut
        else f"not seen moving in mode {modes[mode]}"
        for mode, reason in reasons.items()
        if reason is None and modes[mode] is not None
    ]
    return {mode for mode, reason in reasons.items() if reason}, why, against


def _moves_in(mode: Value, options: EventOptions, moved_in: MovedIn) -> str | None:
    """Why a robot in that mode should move; None where nothing shows it."""
    if options.moving_modes is not None:
        return f"mode {mode} is one of moving_modes" if mode in options.moving_modes else None
    seen = moved_in.seen(mode)
    if seen is None:
        return None
    where = "" if seen.run_id == moved_in.run_id else f" in run {seen.run_id}"
    return f"in mode {mode}, in which it moved at {seen.speed_m_s:.2g} m/s{where}"


def _parts(columns: Columns, motion: Motion, drives: Flags, hindered: Flags) -> list[Part]:
    """The rows in parts that show the same."""
    modes = _values(columns, motion.mode)
    numbers = {mode: number for number, mode in enumerate(dict.fromkeys(modes))}
    codes = np.array([4 * numbers[mode] for mode in modes], np.intp) + 2 * drives + hindered
    starts = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist()] if len(codes) else []
    course, commanded = _course(columns, motion.heading), _values(columns, motion.commanded)
    return [
        Part(
            columns.times[start],
            columns.times[end - 1],
            end - start,
            modes[start],
            bool(drives[start]),
            bool(hindered[start]),
            Counter(commanded[start:end]).most_common(1)[0],
            None if course is None else _ends_of(course[start:end]),
        )
        for start, end in zip(starts, [*starts[1:], len(codes)], strict=True)
    ]


def _values(columns: Columns, signal: Signal | None) -> Sequence[Value]:
    """One value per row; None where there is no such signal."""
    if signal is None or signal.name not in columns.values:
        return [None] * len(columns.times)
    return columns.values[signal.name]


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
    """Per row whether it looks elsewhere in the two seconds after it than in the two before.

    Means are compared: who wiggles about one heading does not turn. Nearer to the ends of the rows
    what holds two seconds further inside is taken to hold.
    """
    none = np.zeros(len(columns.times), np.bool_)
    if heading is None or heading.name not in columns.values:
        return none
    angles = _radians(columns, heading)
    present = np.flatnonzero(np.isfinite(angles))
    if len(present) < 2:
        return none
    course = np.interp(np.arange(len(angles)), present, np.unwrap(angles[present]))
    times = columns.moments
    within_s = min(TURN_S, float(times[-1] - times[0]) / 2)
    middles = np.minimum(np.maximum(times, times[0] + within_s), times[-1] - within_s)
    edges = [np.searchsorted(times, middles + by_s) for by_s in (-within_s, 0.0, within_s)]
    before, after = (_means_between(course, *pair) for pair in pairwise(edges))
    rows = max(1.0, len(times) * within_s / float(times[-1] - times[0] or 1.0))
    limit = max(TURNED_RAD, HEADING_NOISE * noise_of(course) / math.sqrt(rows))
    return np.asarray(np.abs(after - before) > limit)


def _means_between(values: Array, starts: Indexes, ends: Indexes) -> Array:
    """The means of values [start, end), of one at least."""
    sums = np.concatenate(([0.0], np.cumsum(values)))
    starts = np.minimum(starts, len(values) - 1)
    ends = np.maximum(ends, starts + 1)
    return (sums[ends] - sums[starts]) / (ends - starts)


def turned_rad(parts: Sequence[Part]) -> float | None:
    """How far it turned from the first rows to the last; None where that is not known."""
    looked = [part.looked_rad for part in parts if part.looked_rad is not None]
    return looked[-1][1] - looked[0][0] if looked else None


def usual(found: Iterable[tuple[Value, int]]) -> Value:
    """Of values, each with how many rows have it, the one that most have."""
    counts = Counter[Value]()
    for value, rows in found:
        counts[value] += rows
    return counts.most_common(1)[0][0] if counts else None


def _course(columns: Columns, heading: Signal | None) -> Array | None:
    """Where it looks, counted on over whole turns, row by row; NaN where a row does not tell."""
    if heading is None or heading.name not in columns.values:
        return None
    course: Array = np.array(_radians(columns, heading))
    present = np.isfinite(course)
    course[~present] = np.nan
    course[present] = np.unwrap(course[present])
    return course


def _ends_of(course: Array) -> tuple[float, float] | None:
    """The medians of the first and of the last rows."""
    course = course[~np.isnan(course)]
    if not len(course):
        return None
    rows = max(1, min(_HEADING_ROWS, len(course) // 2))
    return median(course[:rows]), median(course[-rows:])


def _radians(columns: Columns, angle: Signal) -> Array:
    return columns.aligned(angle.name) * (math.tau / (angle.turn or math.tau))


def _count(flags: Flags) -> int:
    return int(np.count_nonzero(flags))


def _median(values: Array, flags: Flags) -> float:
    """Of the values in some rows; 0 of none."""
    return median(values[flags]) if flags.any() else 0.0
