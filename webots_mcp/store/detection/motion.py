"""The signals that tell of a robot's motion, and how far it went.

numpy is imported at the first use: the start of a server does not wait for it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from webots_mcp.naming import (
    FARTHEST_M,
    METRES,
    find_mode,
    find_position,
    in_snake_case,
    is_seen_speed,
    metres_in,
    unit_in,
    words_of,
)
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.signals.catalogue import one_signal
from webots_mcp.store.signals.flatten import may_be_yaw
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.analysis.track import PathLength, Track

TRUE_WITHIN: Final = 0.05  # a distance that may be short by less, or by less than so many metres,
TRUE_WITHIN_M: Final = 0.1  # is reported without a doubt
IMPLAUSIBLE_M_S: Final = 50.0  # a mean speed beyond is hardly that of a robot

_TAIL: Final = r"([._](x|vx|linear|speed|velocity|m_s|mps))*$"
_COMMANDED: Final = re.compile(
    rf"(^|[._])(commanded|command|cmd|cmd_vel|target_speed){_TAIL}", re.IGNORECASE
)
_SPEED: Final = re.compile(rf"(^|[._])(speed|velocity|linear){_TAIL}", re.IGNORECASE)
_WHEEL: Final = re.compile(
    r"(^|[._])(wheels?|(left|right)_motors?|motors?[._]?(left|right|\d)?)([._]|$)", re.IGNORECASE
)
_NO_SPEED: Final = re.compile(  # of a wheel or a motor; and motors that move no robot
    r"(^|[._])(position|pos|angle|encoders?|ticks?|odo\w*|distance|torque|force|current|power"
    r"|temp\w*|radius|base|track|width|slip|contact|max|min|limit|gain|count|volt\w*"
    r"|arm|gripper|hand|head|neck|joint|finger|lidar|camera|mast|lift)([._]|$)",
    re.IGNORECASE,
)
_PLACES: Final = ("rad", "deg", *METRES)  # units of where a wheel is, not of how fast it turns
_THIRD_AXES: Final = {"0": "2", "x": "z", "x_m": "z_m", "x_cm": "z_cm", "x_mm": "z_mm"}
_HEADING: Final = re.compile(r"(^|\.)(deg\w*_)?(heading|yaw|theta|bearing)[^.]*", re.IGNORECASE)


@dataclass(frozen=True)
class Motion:
    """The signals that tell of a robot's motion; None or empty where there is none.

    Attributes:
        position: x and y; see `places_of` for them in metres.
        commanded: Speed that it should have; `speed` is one of which the name leaves open whether
            it is commanded or measured.
        mode: What it is doing.
        heading: Where it looks; an angle.
        wheels: Speeds of its wheels or driving motors, commanded or measured.
        height: z: a robot that climbs does not stand still.
    """

    position: tuple[Signal, Signal] | None
    commanded: Signal | None
    speed: Signal | None
    mode: Signal | None
    heading: Signal | None = None
    wheels: tuple[Signal, ...] = ()
    height: Signal | None = None

    @property
    def signals(self) -> list[Signal]:
        """The signals that are reported with an event."""
        speed = self.commanded or self.speed
        return [*(self.position or ()), *filter(None, (speed, self.mode))]

    @property
    def evidence(self) -> list[Signal]:
        """All of them."""
        others = filter(None, (self.height, self.commanded, self.speed, self.mode, self.heading))
        return [*(self.position or ()), *others, *self.wheels]


def find_motion(
    known: dict[str, Signal], options: EventOptions, here: Collection[str] | None = None
) -> Motion:
    """Find the signals of motion: those that the options name, else by their names.

    Args:
        known: All signals of the robot.
        options: Names in them count whatever was published.
        here: What is published in the run: other runs may have had other names. None where that
            does not matter.

    Raises:
        UnknownSignalError: The options name a signal that does not exist.
        InvalidInputError: A name in them means several.
    """
    own = known if here is None else {name: known[name] for name in known if name in here}
    mode = _named(known, options.mode) or _mode(own)
    moved = {name: signal for name, signal in own.items() if not is_seen_speed(name)}
    commanded = _named(known, options.commanded) or _first(moved, _COMMANDED)
    speed = None if commanded else _first(moved, _SPEED, _is_no_wheel)
    wheels = tuple(
        signal
        for name, signal in moved.items()
        if signal.kind == "num" and not _is_no_wheel(name)
        if not _NO_SPEED.search(in_snake_case(name))
        if signal.unit not in _PLACES and signal not in (commanded, speed)
    )
    position = _position(known, options.position) if options.position else _position(own, None)
    position = position or _position(known, None)  # it may be missing in the rows that were seen
    heading, height = _heading(own, position), _height(own, position)
    return Motion(position, commanded, speed, mode, heading, wheels, height)


def _is_no_wheel(name: str) -> bool:
    return not _WHEEL.search(in_snake_case(name))


def _height(known: dict[str, Signal], position: tuple[Signal, Signal] | None) -> Signal | None:
    """The third of the position's numbers, or an altitude next to it or at the top.

    The third of a pose or odometry of three is where it looks.
    """
    branch, _, axis = position[0].name.rpartition(".") if position else ("", "", "")
    name = f"{branch}.{_THIRD_AXES.get(axis, '')}".removeprefix(".")
    if may_be_yaw(name) and f"{branch}.3" not in known:
        name = ""
    altitudes = [each for each in known if position and _is_altitude(each, branch)]
    signals = (known.get(each) for each in (name, *altitudes))
    return next((each for each in signals if each and each.kind == "num"), None)


def _is_altitude(name: str, branch: str) -> bool:
    nearby, _, last = name.rpartition(".")
    return nearby in (branch, "") and words_of(last)[0] in ("altitude", "alt")


def _heading(known: dict[str, Signal], position: tuple[Signal, Signal] | None) -> Signal | None:
    """An angle next to the position, or else the one with the shortest name that says so."""
    angles = [name for name, signal in known.items() if signal.turn is not None]
    branch = position[0].name.rpartition(".")[0] if position else ""
    nearby = [name for name in angles if name.rpartition(".")[0] == branch and branch]
    named = [name for name in angles if _HEADING.search(in_snake_case(name))]
    found = nearby or named
    return known[min(found, key=len)] if found else None


def _named(known: dict[str, Signal], name: str | None) -> Signal | None:
    return None if name is None else one_signal(known, name)


def _position(
    known: dict[str, Signal], named: tuple[str, str] | None
) -> tuple[Signal, Signal] | None:
    if named is not None:
        x, y = (_named(known, name) for name in named)
        return (x, y) if x and y else None
    numeric = [name for name, signal in known.items() if signal.is_number]
    held = [name for name in numeric if known[name].kind != "null"]
    names = find_position(held) or find_position(numeric)
    return (known[names[0]], known[names[1]]) if names else None


def _mode(known: dict[str, Signal]) -> Signal | None:
    texts = {name for name, signal in known.items() if signal.kind == "text"}
    name = find_mode(texts, {name for name, signal in known.items() if signal.is_choice})
    return known[name] if name else None


def _first(
    known: dict[str, Signal], name: re.Pattern[str], wanted: Callable[[str], bool] = bool
) -> Signal | None:
    """The number with the shortest name that fits: `speed` before `arm.speed`."""
    numbers = [each for each, signal in known.items() if signal.kind == "num"]
    fitting = [each for each in numbers if name.search(in_snake_case(each)) and wanted(each)]
    return known[min(fitting, key=len)] if fitting else None


def in_metres(signal: Signal, lengths: Array) -> Array:
    """Lengths that a signal holds, in metres; they are metres where its name has no unit."""
    return lengths * metres_in(signal.name)


def doubt_of_unit(position: tuple[Signal, Signal], speed_m_s: float) -> str | None:
    """That a position without a unit in its names is hardly in metres; None where it may be."""
    name = position[0].name
    if speed_m_s <= IMPLAUSIBLE_M_S or unit_in(name):
        return None
    return (
        f"{name} is taken as metres, since its name has no unit, but robots are not so fast: if it "
        "is in mm, say so in its name (pose_mm, x_mm)"
    )


def places_of(columns: Columns, position: tuple[Signal, Signal]) -> tuple[Array, Array, Array]:
    """Time, and x and y in metres, of the rows that have a position."""
    x, y = (in_metres(each, columns.aligned(each.name)) for each in position)
    there = np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M
    return columns.moments[there], x[there], y[there]


def tracks_in(
    columns: Columns, position: tuple[Signal, Signal], noise_m: float | None = None
) -> list[Track]:
    """The way of the robot in each stretch without a gap; see `track.tracks_of`."""
    from webots_mcp.store.analysis.track import tracks_of

    return tracks_of(*places_of(columns, position), noise_m)


def path_length(
    columns: Columns, position: tuple[Signal, Signal], noise_m: float | None = None
) -> PathLength:
    """The way travelled, without what the noise of the position adds from row to row.

    Args:
        columns: Rows, or samples of a long run.
        position: x and y.
        noise_m: Of samples that lie far apart, what neighbouring rows tell.
    """
    from webots_mcp.store.analysis.track import travelled

    return travelled(tracks_in(columns, position, noise_m))


def doubt_of_length(way: PathLength) -> str | None:
    """By how much a path may be longer than reported; None where that is little."""
    if way.longer_m <= max(TRUE_WITHIN * way.length_m, TRUE_WITHIN_M):
        return None
    noise_mm = float(f"{1000 * way.noise_m:.1g}")
    return (
        f"the path may be up to {_more(way)} longer: position noise of about {noise_mm:g} mm hides "
        "short moves and tight turns; more rows per second show them"
    )


def _more(way: PathLength) -> str:
    """Rounded, so that similar runs share a sentence; in metres where it exceeds the distance."""
    if way.longer_m > way.length_m:
        return f"{way.longer_m:.2g} m"
    return f"{10 * math.ceil(10 * way.longer_m / way.length_m)} %"


def position_noise(columns: Columns, position: tuple[Signal, Signal]) -> float | None:
    """Standard deviation of the noise in each coordinate, in metres; None without a position."""
    tracks = tracks_in(columns, position)
    return tracks[0].noise_m if tracks else None
