"""The signals that tell of a robot's motion, and how far it went.

numpy is imported at the first use: the start of a server does not wait for it.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from webots_mcp.naming import FARTHEST_M, metres_in, unit_in
from webots_mcp.signal_register import first_in, pair_in
from webots_mcp.store.analysis.arrays import Array, Indexes, median, noise_of, np
from webots_mcp.store.analysis.summary import LARGEST
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.signals.catalogue import one_signal
from webots_mcp.store.signals.registry import Signal, roles_of, stored_roles

if TYPE_CHECKING:
    from webots_mcp.store.analysis.track import PathLength, Track
    from webots_mcp.store.reading.frame import Frame

TRUE_WITHIN: Final = 0.05  # a distance that may be short by less, or by less than so many metres,
TRUE_WITHIN_M: Final = 0.1  # is reported without a doubt
SAMPLES: Final = 8  # parts of a run that tell how noisy it is
SAMPLE_ROWS: Final = 1024  # of each
IMPLAUSIBLE_M_S: Final = 50.0  # a mean speed beyond is hardly that of a robot


@dataclass(frozen=True)
class Motion:
    """The signals that tell of a robot's motion; None or empty where there is none.

    Attributes:
        position: x and y.
        commanded: Speed that it should have; `speed` is one of which the name leaves open whether
            it is commanded or measured.
        mode: What it is doing.
        heading: Where it looks; an angle.
        wheels: Speeds of its wheels or driving motors, commanded or measured; `wheel_commands`
            are speeds that these should have.
        height: z: a robot that climbs does not stand still.
    """

    position: tuple[Signal, Signal] | None
    commanded: Signal | None
    speed: Signal | None
    mode: Signal | None
    heading: Signal | None = None
    wheels: tuple[Signal, ...] = ()
    height: Signal | None = None
    wheel_commands: tuple[Signal, ...] = ()

    @property
    def signals(self) -> list[Signal]:
        """The signals that are reported with an event."""
        speed = self.commanded or self.speed
        return [*(self.position or ()), *filter(None, (speed, self.mode))]

    @property
    def evidence(self) -> list[Signal]:
        """All of them."""
        others = filter(None, (self.height, self.commanded, self.speed, self.mode, self.heading))
        return [*(self.position or ()), *others, *self.wheels, *self.wheel_commands]


def find_motion(
    known: dict[str, Signal], options: EventOptions, here: Collection[str] | None = None
) -> Motion:
    """Find the signals of motion: those that the options name, else those of the roles.

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
    position: tuple[Signal, Signal] | None = None
    if options.position is not None:
        x, y = (one_signal(known, each) for each in options.position)
        position = x, y
    names = (position[0].name, position[1].name) if position else None
    roles = roles_of(own, names) if names else stored_roles(own)
    signals = {role: own[name] for name, role in roles.items() if name in own}

    def first(role: str, name: str | None = None) -> Signal | None:
        if name is not None:
            return one_signal(known, name)
        found = first_in(role, signals)
        return signals[found] if found else None

    def wheels(wanted: str) -> tuple[Signal, ...]:
        named = (own[name] for name, role in roles.items() if role == wanted)
        return tuple(wheel for wheel in named if wheel != commanded)

    place = "" if position else pair_in(signals)
    if position is None:  # it may be missing in the rows that were seen
        ever = {role: known[name] for name, role in stored_roles(known).items()}
        position = _pair(signals, place) or _pair(ever, pair_in(ever))
    commanded = first("commanded_speed", options.commanded)
    return Motion(
        position,
        commanded,
        None if commanded else first("speed"),
        first("mode", options.mode),
        heading=first("yaw"),
        wheels=wheels("wheel"),
        height=signals.get(f"z{place}"),
        wheel_commands=wheels("commanded_wheel"),
    )


def _pair(signals: dict[str, Signal], place: str | None) -> tuple[Signal, Signal] | None:
    return None if place is None else (signals[f"x{place}"], signals[f"y{place}"])


def in_metres(signal: Signal, lengths: Array) -> Array:
    """Lengths that a signal holds, in metres; they are metres where its name has no unit."""
    factor = metres_in(signal.name)
    return lengths if factor == 1 else lengths * factor


def motion_in(frame: Frame, known: dict[str, Signal], options: EventOptions) -> Motion:
    """As `find_motion`, of what is published in a run: others of the robot may have other names.

    Args:
        frame: Of the run: its first or newest row has them.
        known: All signals of the robot.
        options: As for `find_motion`.
    """
    rows = [frame.rows(row, row + 1) for row in {0, len(frame) - 1}]
    telling = [name for name, each in known.items() if options.position or each.role]
    here = {name for name in telling if any(row.held(name).any() for row in rows)}
    return find_motion(known, options, here)


def doubt_of_unit(position: tuple[Signal, Signal], speed_m_s: float) -> str | None:
    """That a position without a unit in its names is hardly in metres; None where it may be."""
    name = position[0].name
    if speed_m_s <= IMPLAUSIBLE_M_S or unit_in(name):
        return None
    return (
        f"{name} is taken as metres, since its name has no unit, but robots are not so fast: if it "
        "is in mm, say so in its name (pose_mm, x_mm)"
    )


class RunNoise:
    """How noisy a run's signals are, by some of its rows: the same of whatever part is asked for.

    Attributes:
        position_m: Standard deviation of the noise in each of x and y.
        interval_s: The usual one between rows.
        rows: Of the run.
    """

    def __init__(self, run: Frame, motion: Motion) -> None:
        starts = np.linspace(0, len(run), SAMPLES, endpoint=False) // SAMPLE_ROWS
        rows = (np.unique(starts) * SAMPLE_ROWS).astype(np.intp).tolist()
        self._parts = [run.rows(row, row + SAMPLE_ROWS) for row in rows]
        self._known: dict[str, float] = {}
        self.rows = len(run)
        intervals = np.concatenate([np.zeros(0), *(np.diff(part.times) for part in self._parts)])
        self.interval_s = median(intervals) if len(intervals) else 0.0
        noises = [self.of(each.name) * metres_in(each.name) for each in motion.position or ()]
        self.position_m = math.hypot(*noises) / math.sqrt(2)

    def of(self, name: str) -> float:
        """Standard deviation of the noise of a signal."""
        if name not in self._known:
            values = np.concatenate([np.zeros(0), *(part.numbers(name) for part in self._parts)])
            self._known[name] = noise_of(values[np.abs(values) <= LARGEST])
        return self._known[name]


def places_in(frame: Frame, position: tuple[Signal, Signal]) -> tuple[Indexes, Array, Array]:
    """The rows that have a position, and it in metres."""
    x, y = (in_metres(each, frame.numbers(each.name)) for each in position)
    rows = np.flatnonzero(np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M)
    return (rows, x, y) if len(rows) == len(frame) else (rows, x[rows], y[rows])


def tracks_in(
    frame: Frame, position: tuple[Signal, Signal], noise: RunNoise
) -> tuple[list[Track], list[Indexes]]:
    """The way of the robot in each stretch without a gap, and the rows of the frame in it."""
    from webots_mcp.store.analysis.track import tracks_of

    rows, x, y = places_in(frame, position)
    times = frame.times if len(rows) == len(frame) else frame.times[rows]
    tracks = tracks_of(times, x, y, noise.position_m, noise.rows)
    ends = np.cumsum([len(track.times) for track in tracks])
    return tracks, np.split(rows, ends)[:-1]


def doubt_of_length(way: PathLength) -> str | None:
    """By how much a path may be longer than reported; None where that is little."""
    if way.longer_m <= max(TRUE_WITHIN * way.length_m, TRUE_WITHIN_M):
        return None
    # Rounded, so that similar runs share a sentence; in metres where it exceeds the distance.
    more = f"{way.longer_m:.2g} m"
    if way.longer_m <= way.length_m:
        more = f"{10 * math.ceil(10 * way.longer_m / way.length_m)} %"
    noise_mm = float(f"{1000 * way.noise_m:.1g}")
    return (
        f"the path may be up to {more} longer: position noise of about {noise_mm:g} mm hides short "
        "moves and tight turns; more rows per second show them"
    )
