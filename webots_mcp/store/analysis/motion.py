"""Where a robot is, whether it should move, and whether it does."""

from __future__ import annotations

import json
import math
import re
import statistics
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.reading.gaps import GAP_INTERVALS, rhythm_of
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.signals.catalogue import one_signal
from webots_mcp.store.signals.flatten import Value
from webots_mcp.store.signals.registry import Signal

NOISE_LEG: Final = 6.0  # standard deviations: one row in 8,000 is so far from another by noise
LONGEST_NOISE_LEG_M: Final = 0.1  # beyond, it is rather a robot that turns between any two rows
NOISE_ROWS: Final = 2000
FARTHEST_M: Final = 1e9  # beyond, a number is no place (an infinity, an integer of 400 digits)
SETTLED_SHARE: Final = 0.2  # of stuck_m: within it of the stuck place is where it begins and ends

_BRANCHES: Final = ("pose", "position", "pos", "gps", "odometry", "odom", "location", "")
_AXES: Final = (("0", "1"), ("x", "y"), ("x_m", "y_m"))
_MODE: Final = re.compile(r"(^|\.)(mode|state|behaviou?r|action|task|phase|status)$", re.IGNORECASE)
_STILL: Final = re.compile(
    r"idle|stop|wait|paus|hold|dock|charg|turn|rotat|spin|done|finish|init|ready|rest|stand|sleep",
    re.IGNORECASE,
)
_TAIL: Final = r"([._](x|vx|linear|speed|velocity|m_s|mps))*$"
_COMMANDED: Final = re.compile(
    rf"(^|[._])(commanded|command|cmd|cmd_vel|target_speed){_TAIL}", re.IGNORECASE
)
_SPEED: Final = re.compile(rf"(^|[._])(speed|velocity|linear){_TAIL}", re.IGNORECASE)


@dataclass(frozen=True)
class Motion:
    """The signals that tell about a robot's motion; None where there is none.

    Attributes:
        position: x and y in metres.
        commanded: Speed that it should have.
        measured: The name leaves open whether that speed is commanded or measured; then a mode
            in which it should move tells as well.
        mode: What it is doing.
    """

    position: tuple[Signal, Signal] | None
    commanded: Signal | None
    measured: bool
    mode: Signal | None

    @property
    def signals(self) -> list[Signal]:
        """All of them."""
        return [*(self.position or ()), *filter(None, (self.commanded, self.mode))]


@dataclass(frozen=True)
class Stay:
    """It stayed about one place although it should have moved."""

    start_s: float
    end_s: float
    x_m: float
    y_m: float
    mode: Value
    commanded: Value


def find_motion(known: dict[str, Signal], options: EventOptions) -> Motion:
    """Find the signals of motion: those that the options name, else by their names.

    Raises:
        UnknownSignalError: The options name a signal that does not exist.
        InvalidInputError: A name in them means several.
    """
    mode = _named(known, options.mode) or _first(known, _MODE, ("text",))
    commanded = _named(known, options.commanded) or _first(known, _COMMANDED, ("num",))
    measured = commanded is None
    if measured:
        commanded = _first(known, _SPEED, ("num",))
    return Motion(_position(known, options.position), commanded, measured, mode)


def _named(known: dict[str, Signal], name: str | None) -> Signal | None:
    return None if name is None else one_signal(known, name)


def _position(
    known: dict[str, Signal], named: tuple[str, str] | None
) -> tuple[Signal, Signal] | None:
    if named is not None:
        x, y = (_named(known, name) for name in named)
        return (x, y) if x and y else None
    others = sorted(name[:-2] for name in known if name.endswith(".x"))
    for branch in (*_BRANCHES, *others):
        for x, y in _AXES if branch else _AXES[1:]:
            names = (f"{branch}.{x}", f"{branch}.{y}") if branch else (x, y)
            if all(name in known and known[name].is_number for name in names):
                return known[names[0]], known[names[1]]
    return None


def _first(
    known: dict[str, Signal], name: re.Pattern[str], kinds: tuple[str, ...]
) -> Signal | None:
    """The one with the shortest name that fits: `mode` before `arm.mode`."""
    fitting = [each for each in known if name.search(each) and known[each].kind in kinds]
    return known[min(fitting, key=len)] if fitting else None


def find_stays(columns: Columns, motion: Motion, options: EventOptions) -> list[Stay]:
    """Stretches of at least `stuck_s` within `stuck_m`, through all of which it should move.

    Should move: a commanded speed of at least `min_commanded`; where none is published, a mode in
    which it should, or a speed whose name leaves open whether it is commanded or measured. Without
    any of them it is not known, and every stay counts.
    """
    if motion.position is None:
        return []
    x, y = (columns.values[signal.name] for signal in motion.position)
    should = _should_move(columns, motion, options)
    rows = [
        index
        for index in range(len(columns.times))
        if type(x[index]) in (float, int) and type(y[index]) in (float, int)
    ]
    times = [columns.times[index] for index in rows]
    places = [(float(x[index] or 0), float(y[index] or 0)) for index in rows]
    wanted = [should[index] for index in rows]
    return [
        _stay(columns, motion, rows[start:end], times[start:end], places[start:end], options)
        for start, end in _stretches(times, places, wanted, options)
    ]


def _should_move(columns: Columns, motion: Motion, options: EventOptions) -> list[bool]:
    if motion.commanded is None and motion.mode is None:
        return [True] * len(columns.times)
    should = [False] * len(columns.times)
    if motion.commanded is not None:
        should = [
            isinstance(value, (int, float)) and abs(value) >= options.min_commanded
            for value in columns.values[motion.commanded.name]
        ]
    if motion.mode is not None and (motion.commanded is None or motion.measured):
        modes = columns.values[motion.mode.name]
        moving = {mode: is_moving(mode, options) for mode in set(modes)}
        return [moving[mode] or fast for mode, fast in zip(modes, should, strict=True)]
    return should


def is_moving(mode: Value, options: EventOptions) -> bool:
    """Whether a robot in that mode should move."""
    if mode is None:
        return False
    name = mode if isinstance(mode, str) else json.dumps(mode)
    if options.moving_modes is not None:
        return name in options.moving_modes
    return not _STILL.search(name)


def _stretches(
    times: Sequence[float],
    places: Sequence[tuple[float, float]],
    wanted: Sequence[bool],
    options: EventOptions,
) -> Iterable[tuple[int, int]]:
    """Index ranges [start, end) in which every place is within `stuck_m` of the first.

    Where the place `stuck_s` later is farther away, no stretch begins, and one look was enough. A
    recording gap ends a stretch: nobody knows what happened in it.
    """
    gap_s = GAP_INTERVALS * (rhythm_of(times).interval_s or math.inf)
    start = 0
    while start < len(times):
        if not wanted[start]:
            start += 1
            continue
        later = bisect_left(times, times[start] + options.stuck_s, start)
        if later == len(times):
            return
        if math.dist(places[start], places[later]) > options.stuck_m:
            start += 1
            continue
        end = start
        while (
            end < len(times)
            and wanted[end]
            and times[end] - times[max(start, end - 1)] <= gap_s
            and math.dist(places[start], places[end]) <= options.stuck_m
        ):
            end += 1
        if times[end - 1] - times[start] >= options.stuck_s:
            yield start, end
            start = end
        else:
            start += 1


def _stay(
    columns: Columns,
    motion: Motion,
    rows: Sequence[int],
    times: Sequence[float],
    places: Sequence[tuple[float, float]],
    options: EventOptions,
) -> Stay:
    """The place is the median; what came before and after it was reached is cut off."""
    place = (statistics.median(x for x, _ in places), statistics.median(y for _, y in places))
    limit_m = SETTLED_SHARE * options.stuck_m
    settled = [index for index, each in enumerate(places) if math.dist(each, place) <= limit_m]
    first, last = (settled[0], settled[-1]) if settled else (0, len(times) - 1)
    middle = rows[(first + last) // 2]
    mode = columns.values[motion.mode.name][middle] if motion.mode else None
    commanded = columns.values[motion.commanded.name][middle] if motion.commanded else None
    return Stay(times[first], times[last], *place, mode, commanded)


def places_of(columns: Columns, position: tuple[Signal, Signal]) -> list[tuple[float, float]]:
    """Where it was, of the rows that have a position."""
    x, y = (columns.values[signal.name] for signal in position)
    return [
        (float(a), float(b))
        for a, b in zip(x, y, strict=True)
        if isinstance(a, (int, float)) and isinstance(b, (int, float))
        if max(abs(a), abs(b)) <= FARTHEST_M
    ]


def path_length(columns: Columns, position: tuple[Signal, Signal]) -> float:
    """Metres travelled: the sum of legs that are longer than the noise of the position makes them.

    From row to row a noise of 1 cm would add up to metres while the robot stands still.
    """
    places = places_of(columns, position)
    if not places:
        return 0.0
    shortest_m = min(NOISE_LEG * _noise_m(places), LONGEST_NOISE_LEG_M)
    length_m, counted = 0.0, places[0]
    for place in places:
        if (leg_m := math.dist(counted, place)) > shortest_m:
            length_m += leg_m
            counted = place
    return length_m + math.dist(counted, places[-1])


def _noise_m(places: Sequence[tuple[float, float]]) -> float:
    """Standard deviation of the noise in x and in y: what is no steady motion over three rows.

    The second difference of independent noise has a standard deviation of sqrt(6) times that of
    the noise, and its length in the plane, of a Rayleigh distribution, the median 1.1774 times as
    much. At most a few thousand rows are looked at.
    """
    every = range(0, len(places) - 2, len(places) // NOISE_ROWS + 1)
    bends = [
        math.dist((a[0] + c[0], a[1] + c[1]), (2 * b[0], 2 * b[1]))
        for a, b, c in (places[index : index + 3] for index in every)
    ]
    return statistics.median(bends) / (1.1774 * math.sqrt(6)) if bends else 0.0
