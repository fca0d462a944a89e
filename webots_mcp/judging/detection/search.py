"""One search in a stretch of a run: what a detector may read, and events with their true ends.

For that the signals that tell of a robot's motion, how far it went, in which modes it moves.
"""

from __future__ import annotations

import copy
import math
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

from webots_mcp.analysis.arrays import Array, Indexes, median, noise_of, np
from webots_mcp.analysis.path_length import PathLength, SmoothedTrack, tracks_of
from webots_mcp.analysis.summary import LARGEST
from webots_mcp.judging.detection.event import Alike, Event, NotAskedError, NotSearchableError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.verdicts import Cause, JudgedInterval, SearchCoverage
from webots_mcp.signals.meaning import INPUTS, Meaning, Quantity, own_names, words_in
from webots_mcp.signals.naming import FARTHEST_M, listed, unit_in, words_of
from webots_mcp.signals.register import first_in, pair_in
from webots_mcp.store.chunks import shown
from webots_mcp.store.meanings import meanings_of
from webots_mcp.store.reading.behaviour import with_behaviour
from webots_mcp.store.reading.catalogue import one_signal, resolve_signals
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import frame_of_purged, recorded_bounds
from webots_mcp.store.reading.segment import Deadline, Segment, just_after, read_so_far
from webots_mcp.store.registered_signals import RegisteredSignal, roles_of, stored_roles

TRUE_WITHIN: Final = 0.05  # a distance that may be short by less, or by less than so many metres,
TRUE_WITHIN_M: Final = 0.1  # is reported without a doubt
SAMPLES: Final = 8  # parts of a run that tell how noisy it is
SAMPLE_ROWS: Final = 1024  # of each
IMPLAUSIBLE_M_S: Final = 50.0  # a mean speed beyond is hardly that of a robot
ROLLS_OUT_S: Final = 1.5  # after a mode began, the motion of the mode before may go on
LEAST_MOVED_M: Final = 0.3  # within so long: who drifts about a place does not move
AWAY_S: Final = 20.0
LEAST_NOISE: Final = 8.0  # deviations of what is left of the noise
USUALLY_STANDS: Final = 4  # times as many visits as it moves in, of at least so many visits
LEAST_VISITS: Final = 3
_AHEAD: Final = frozenset(("x", "vx", "forward", "ahead", "0"))
_ASIDE: Final = frozenset(("y", "vy", "sideways", "sideway", "lateral", "strafe", "side", "1"))
_ODOMETRY: Final = frozenset(("odometry",))
_OF_MOTION: Final = ("speed", "turn rate", "wheel speed", "heading")
EARLIER_RUNS: Final = 3
MOST_ROWS: Final = 2_000_000  # of a run: its first ones
_STANDS_SHARE: Final = 0.8  # of a visit
_MOVES_SHARE: Final = 0.1  # of the samples of a visit, or of so many
_ENOUGH: Final = 200
_SAMPLE_S: Final = 0.5
_FAST: Final = 0.9  # of the speeds while it moves are below what is called fast
_PACE_S: Final = 1.0  # over so long a speed is measured; longer, by so much for each metre of noise
_PACE_S_PER_M: Final = 100.0
_EARLIER: Final = (
    "SELECT id FROM run WHERE robot_id = (SELECT robot_id FROM run WHERE id = ?) AND id < ? "
    "ORDER BY id DESC LIMIT ?"
)
FARTHER: Final = 8.0  # times as far is looked for the ends of what reaches out of a segment
MOST_NAMED: Final = 5
NO_TIME: Final = "time limit reached: ask for this kind alone, or a shorter range"
_ROW: Final = "SELECT wall_time_s FROM state WHERE run_id = ?"
_LAST_ROW: Final = f"{_ROW} AND sim_time_s <= ? ORDER BY sim_time_s DESC, id DESC LIMIT 1"
_FIRST_ROW: Final = f"{_ROW} ORDER BY sim_time_s, id LIMIT 1"
_OF_SEGMENT: Final = ("recorded", "frame")


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
        turn_command: How fast it should turn.
        sideways: How fast it should go to its side, as a robot with omnidirectional wheels can.
    """

    position: tuple[RegisteredSignal, RegisteredSignal] | None
    commanded: RegisteredSignal | None
    speed: RegisteredSignal | None
    mode: RegisteredSignal | None
    heading: RegisteredSignal | None = None
    wheels: tuple[RegisteredSignal, ...] = ()
    height: RegisteredSignal | None = None
    wheel_commands: tuple[RegisteredSignal, ...] = ()
    turn_command: RegisteredSignal | None = None
    sideways: RegisteredSignal | None = None

    @property
    def signals(self) -> list[RegisteredSignal]:
        """The signals that are reported with an event."""
        speed = self.commanded or self.speed
        return [*(self.position or ()), *filter(None, (speed, self.mode))]

    @property
    def evidence(self) -> list[RegisteredSignal]:
        """All of them."""
        others = filter(
            None,
            (
                self.height,
                self.commanded,
                self.sideways,
                self.turn_command,
                self.speed,
                self.mode,
                self.heading,
            ),
        )
        return [*(self.position or ()), *others, *self.wheels, *self.wheel_commands]


def find_motion(
    known: dict[str, RegisteredSignal], options: EventOptions, here: Collection[str] | None = None
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
    position: tuple[RegisteredSignal, RegisteredSignal] | None = None
    if options.position is not None:
        x, y = (one_signal(known, each) for each in options.position)
        position = x, y
    meanings = meanings_of(own)
    declared = {
        meaning.quantity: own[name]
        for name, meaning in reversed(meanings.items())
        if meaning.source == "declared" and not meaning.sets and meaning.role != "limit"
    }
    if position is None and "x" in declared and "y" in declared:
        position = declared["x"], declared["y"]
    names = (position[0].name, position[1].name) if position else None
    roles = roles_of(own, names) if names else stored_roles(own)
    signals = {
        role: own[name]
        for name, role in roles.items()
        if name in own and _may_have(role, name, meanings[name])
    }

    def first(role: str, name: str | None = None) -> RegisteredSignal | None:
        if name is not None:
            return one_signal(known, name)
        found = first_in(role, signals)
        return signals[found] if found else None

    def meant(quantity: Quantity, *, sets: bool) -> list[RegisteredSignal]:
        return [
            own[name]
            for name, meaning in meanings.items()
            if meaning.quantity == quantity and meaning.sets == sets and meaning.role != "limit"
        ]

    place = "" if position else pair_in(signals)
    if position is None:  # it may be missing in the rows that were seen
        all_meanings = meanings_of(known)
        ever = {
            role: known[name]
            for name, role in stored_roles(known).items()
            if _may_have(role, name, all_meanings[name])
        }
        position = _pair(signals, place) or _pair(ever, pair_in(ever))
    commanded = first("commanded_speed", options.commanded)
    if options.commanded is None and (
        commanded is None or commanded not in meant("speed", sets=True)
    ):
        commanded = next(iter(meant("speed", sets=True)), None)
    speed = first("speed")
    if speed is not None and meanings[speed.name].quantity != "speed":
        speed = next(iter(meant("speed", sets=False)), None)
    wheels, wheel_commands = (meant("wheel speed", sets=sets) for sets in (False, True))
    return Motion(
        position,
        commanded,
        None if commanded else speed,
        (declared.get("mode") if options.mode is None else None) or first("mode", options.mode),
        heading=declared.get("heading") or first("yaw") or _heading_among(meant),
        wheels=tuple(each for each in wheels if each != commanded),
        height=declared.get("height") or signals.get(f"z{place}"),
        wheel_commands=tuple(each for each in wheel_commands if each != commanded),
        turn_command=next(iter(meant("turn rate", sets=True)), None),
        sideways=None if commanded is None else _sideways_of(commanded, known),
    )


def _sideways_of(
    commanded: RegisteredSignal, known: dict[str, RegisteredSignal]
) -> RegisteredSignal | None:
    """The command to go sideways that stands next to one to go ahead: `cmd.vy` next to `cmd.vx`.

    The second item of an array is one only if there is a third, which then is the turn rate.
    """
    words = frozenset(_parts_of(commanded.name)) - _AHEAD
    for name, signal in known.items():
        own = frozenset(_parts_of(name))
        if name == commanded.name or not signal.is_number or own & _AHEAD or own - _ASIDE != words:
            continue
        if own & _ASIDE and ("1" not in own or f"{name[:-1]}2" in known):
            return signal
    return None


def _parts_of(name: str) -> Iterator[str]:
    return (word for part in name.split(".") for word in words_of(part))


def _heading_among(meant: Callable[..., list[RegisteredSignal]]) -> RegisteredSignal | None:
    """The first measured heading of which it is known what a whole turn is."""
    return next((each for each in meant("heading", sets=False) if each.turn), None)


_OF_ROLES: Final = {"x": "x", "y": "y", "z": "height", "yaw": "heading", "mode": "mode"}


def _may_have(role: str, name: str, meaning: Meaning) -> bool:
    """Whether a signal may have a role by its name: nothing stronger says something else.

    What a person moves by hand, and where the robot shall go, is not where it is.
    """
    quantity = _OF_ROLES.get(role.rstrip("0123456789"))
    by_hand = not INPUTS.isdisjoint(words_in(name))
    if quantity not in (None, "mode") and meaning.source == "named" and (meaning.sets or by_hand):
        return False
    is_said = meaning.source in ("declared", "device") and meaning.quantity is not None
    return quantity is None or not is_said or meaning.quantity == quantity


def _pair(
    signals: dict[str, RegisteredSignal], place: str | None
) -> tuple[RegisteredSignal, RegisteredSignal] | None:
    return None if place is None else (signals[f"x{place}"], signals[f"y{place}"])


def in_metres(signal: RegisteredSignal, lengths: Array) -> Array:
    """Lengths that a signal holds, in metres; they are metres where it has no unit."""
    factor = signal.metres
    return lengths if factor == 1 else lengths * factor


def motion_in(frame: Frame, known: dict[str, RegisteredSignal], options: EventOptions) -> Motion:
    """As `find_motion`, of what is published in a run: others of the robot may have other names.

    Args:
        frame: Of the run: its first or newest row has them.
        known: All signals of the robot.
        options: As for `find_motion`.
    """
    rows = [frame.rows(row, row + 1) for row in {0, len(frame) - 1}]
    meanings = meanings_of(known)
    telling = [
        name
        for name, each in known.items()
        if options.position or each.role or each.stated or meanings[name].quantity in _OF_MOTION
    ]
    known_of_all = frame.whole_statistics()  # of a short run, without opening its chunks
    if known_of_all is None:
        here = {name for name in telling if any(row.held(name).any() for row in rows)}
    else:
        always = {name for name, each in known_of_all.items() if each.row_count == len(frame)}
        some = known_of_all.keys() - always
        here = {
            name
            for name in telling
            if name in always or (name in some and any(row.held(name).any() for row in rows))
        }
    return find_motion(known, options, here)


def is_counted_by_wheels(x: RegisteredSignal) -> bool:
    """Whether a position is counted by the wheels themselves, which may spin in place."""
    return not x.stated and not _ODOMETRY.isdisjoint(words_in(x.name))


def doubt_of_unit(
    position: tuple[RegisteredSignal, RegisteredSignal], speed_m_s: float
) -> str | None:
    """That a position without a unit in its names is hardly in metres; None where it may be."""
    name = position[0].name
    if speed_m_s <= IMPLAUSIBLE_M_S or unit_in(name) or position[0].stated_unit:
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
        noises = [self.of(each.name) * each.metres for each in motion.position or ()]
        self.position_m = math.hypot(*noises) / math.sqrt(2)

    def of(self, name: str) -> float:
        """Standard deviation of the noise of a signal."""
        if name not in self._known:
            values = np.concatenate([np.zeros(0), *(part.numbers(name) for part in self._parts)])
            self._known[name] = noise_of(values[np.abs(values) <= LARGEST])
        return self._known[name]


def places_in(
    frame: Frame, position: tuple[RegisteredSignal, RegisteredSignal]
) -> tuple[Indexes, Array, Array]:
    """The rows that have a position, and it in metres."""
    names = tuple((each.name, each.metres) for each in position)
    return frame.shared(("places", names), lambda: _places_in(frame, position))


def _places_in(
    frame: Frame, position: tuple[RegisteredSignal, RegisteredSignal]
) -> tuple[Indexes, Array, Array]:
    x, y = (in_metres(each, frame.bridged(each.name)) for each in position)
    rows = np.flatnonzero(np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M)
    return (rows, x, y) if len(rows) == len(frame) else (rows, x[rows], y[rows])


def course_in(frame: Frame, heading: RegisteredSignal) -> Array:
    """The heading in each row in rad, as if whole turns were counted; NaN where it is unknown."""
    turn = heading.turn or math.tau
    course = frame.bridged(heading.name, turn)
    return course if turn == math.tau else course * (math.tau / turn)


def tracks_in(
    frame: Frame, position: tuple[RegisteredSignal, RegisteredSignal], noise: RunNoise
) -> tuple[list[SmoothedTrack], list[Indexes]]:
    """The way of the robot in each stretch without a gap, and the rows of the frame in it."""
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


# -- in which modes a robot moves and stands: seen in this run and in earlier ones -----------------


@dataclass(frozen=True)
class ModeUse:
    """What a robot did in a mode.

    Attributes:
        moving: Visits of it in which it moved; `standing` those in which it mostly stood.
        speed_m_s: How fast it usually was while it moved; `run_id` says in which run.
    """

    moving: int = 0
    standing: int = 0
    speed_m_s: float = 0.0
    run_id: int = 0

    @property
    def usually_stands(self) -> bool:
        """Whether it moved in few of many visits."""
        return self.standing >= max(LEAST_VISITS, USUALLY_STANDS * self.moving)

    def with_more(self, other: ModeUse) -> ModeUse:
        """Together with another; the speed is the first that is known."""
        moving, standing = self.moving + other.moving, self.standing + other.standing
        return replace(self if self.moving else other, moving=moving, standing=standing)


class ModeUses:
    """What a robot does in its modes, from as many of its runs as that takes.

    Attributes:
        run_id: The run that is searched.
        is_cut: There was no time to read all of these runs.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        run: Frame,
        motion: Motion,
        options: EventOptions,
        deadline: Deadline,
        noise: RunNoise | None = None,
    ) -> None:
        """Prepare to read the run.

        Args:
            connection: Any.
            run: The run that is searched.
            motion: Which signals tell.
            options: What counts as standing.
            deadline: For the other runs.
            noise: Of the run, where it is known already.
        """
        self.run_id = run.run_id
        self.is_cut = False
        self._motion = motion
        self._options = options
        self._frames = self._runs(connection, run, deadline)
        self._noise = noise if noise is not None and len(run) <= MOST_ROWS else None
        self._known: dict[str, ModeUse] = {}

    def of(self, mode: str) -> ModeUse:
        """What it did in a mode; runs are read until it moved in a few visits of it."""
        while self._known.get(mode, ModeUse()).moving < LEAST_VISITS:
            if (frame := next(self._frames, None)) is None:
                break
            self.is_cut |= frame.cut_at_s is not None
            noise = self._noise if frame.run_id == self.run_id else None
            for name, use in uses_in(frame, self._motion, self._options, noise):
                self._known[name] = self._known.get(name, ModeUse()).with_more(use)
        return self._known.get(mode, ModeUse())

    def _runs(
        self, connection: sqlite3.Connection, run: Frame, deadline: Deadline
    ) -> Iterator[Frame]:
        """The run and a few of the same robot before it, as far as there is time."""
        earlier = connection.execute(_EARLIER, (run.run_id, run.run_id, EARLIER_RUNS)).fetchall()
        for run_id in (run.run_id, *(run_id for (run_id,) in earlier)):
            if deadline.passed:
                self.is_cut = True
                return
            bounds = recorded_bounds(connection, run_id)
            if run_id == run.run_id:
                yield run.rows(0, MOST_ROWS)
            elif bounds is not None:
                whole = Segment(run_id, bounds[0], just_after(bounds[1]))
                yield read_frame(connection, whole, deadline).rows(0, MOST_ROWS)


def uses_in(
    frame: Frame, motion: Motion, options: EventOptions, noise: RunNoise | None = None
) -> Iterator[tuple[str, ModeUse]]:
    """What a robot did in the modes of a frame, by its mean places in half a second each.

    Args:
        frame: The rows.
        motion: Which signals tell.
        options: What counts as standing.
        noise: Of the frame, where it is known already.
    """
    if motion.mode is None or motion.position is None:
        return
    codes, labels = frame.coded(motion.mode.name)
    rows, x, y = places_in(frame, motion.position)
    if not len(rows):
        return
    is_all = len(rows) == len(frame)
    times, codes = (frame.times, codes) if is_all else (frame.times[rows], codes[rows])
    same = (np.diff(times // _SAMPLE_S) == 0) & (np.diff(codes) == 0)
    starts = np.flatnonzero(np.append(True, ~same))
    counts = np.diff(starts, append=len(rows))
    times, x, y = (np.add.reduceat(each, starts) / counts for each in (times, x, y))
    noise = noise or RunNoise(frame, motion)
    left_m = noise.position_m / median(counts) ** 0.5
    codes: Indexes = codes[starts]
    changes = np.flatnonzero(np.diff(codes)) + 1
    visits = np.searchsorted(changes, np.arange(len(codes)), "right")
    begins_s = np.append(times[0] - ROLLS_OUT_S, times[changes])[visits]
    there = np.flatnonzero(times >= begins_s + ROLLS_OUT_S)
    times, x, y = times[there], x[there], y[there]
    codes, visits = codes[there], visits[there]
    firsts = np.flatnonzero(np.diff(visits, prepend=-1))
    lengths = np.diff(firsts, append=len(visits))
    last = np.repeat(firsts + lengths - 1, lengths)

    def way_m(over_s: float) -> tuple[Array, Array]:
        later = np.minimum(np.searchsorted(times, times + over_s), last)
        return np.hypot(x[later] - x, y[later] - y), times[later] - times

    noise_m = LEAST_NOISE * left_m
    got_away = way_m(AWAY_S)[0] >= max(LEAST_MOVED_M, noise_m)
    moved = np.add.reduceat(got_away * 1.0, firsts) >= _MOVES_SHARE * np.minimum(lengths, _ENOUGH)
    slow = way_m(options.stuck_s)[0] <= max(options.stuck_m, noise_m)
    stood = np.add.reduceat(slow * 1.0, firsts) >= _STANDS_SHARE * lengths
    stood &= times[firsts + lengths - 1] - times[firsts] >= options.stuck_s
    paced_m, took_s = way_m(pace_s := max(_PACE_S, _PACE_S_PER_M * left_m))
    speeds = paced_m / np.maximum(took_s, pace_s / 2)
    for code in np.unique(codes).tolist():
        own, mode = codes[firsts] == code, shown(labels[int(code)])
        some = speeds[np.repeat(own & moved, lengths)]
        # Not beside the greatest one: where it was put elsewhere it seems to be very fast.
        fast = float(np.quantile(some, _FAST)) if len(some) else 0.0
        speed_m_s = median(some[some >= fast / 2]) if len(some) else 0.0
        counted = int((own & moved).sum()), int((own & stood).sum())
        if mode is not None:
            yield mode, ModeUse(*counted, speed_m_s, frame.run_id)


# -- a search --------------------------------------------------------------------------------------


@dataclass
class Search:
    """What is looked for in a segment of one run.

    Attributes:
        known: The signals of the robot.
        kinds: All that are looked for in it.
        asked: The part of the segment that was asked about, where that was widened to find ends.
        coverage: Of each kind, what could be judged, and what came near to an event.
        shared: What a detector found that others of its module, and later looks, need as well.
    """

    connection: sqlite3.Connection
    segment: Segment
    known: dict[str, RegisteredSignal]
    kinds: Sequence[EventKind]
    options: EventOptions
    deadline: Deadline
    coverage: SearchCoverage = field(default_factory=SearchCoverage)
    asked: Segment | None = None
    shared: dict[type, Any] = field(default_factory=dict[type, Any])
    _walls: dict[float, float] = field(default_factory=dict[float, float])

    def of(self, segment: Segment, **changes: Any) -> Search:
        """The same in another segment of the run, of which it is known what is known of this."""
        other = copy.copy(self)
        for name in _OF_SEGMENT:
            other.__dict__.pop(name, None)
        other.__dict__.update(changes, segment=segment)
        return other

    @cached_property
    def bounds(self) -> tuple[float, float] | None:
        """First and last simulation time of the run's rows; None where it has none."""
        return recorded_bounds(self.connection, self.segment.run_id)

    @property
    def began_s(self) -> float:
        """The run's first row."""
        return self.bounds[0] if self.bounds else self.segment.start_s

    @property
    def ended_s(self) -> float:
        """The run's newest row."""
        return self.bounds[1] if self.bounds else self.segment.end_s

    @property
    def length_s(self) -> float:
        """From the run's first row to its newest one."""
        return self.ended_s - self.began_s

    @cached_property
    def recorded(self) -> Segment | None:
        """The part of the segment that was recorded; None where nothing was."""
        here = self.segment
        if not self.bounds or self.ended_s < here.start_s or self.began_s >= here.end_s:
            return None
        ends = max(here.start_s, self.began_s), min(here.end_s, just_after(self.ended_s))
        return replace(here, start_s=ends[0], end_s=ends[1])

    @cached_property
    def motion(self) -> Motion:
        """The signals that tell how the robot moves in this run."""
        return motion_in(self.whole, self.known, self.options)

    @cached_property
    def noise(self) -> RunNoise:
        """How noisy the run's signals are."""
        return RunNoise(self.whole, self.motion)

    @cached_property
    def meanings(self) -> dict[str, Meaning]:
        """What each signal of the robot means, also by its values where they were read."""
        memo = read_so_far(self.connection).setdefault(("meanings", self.segment.run_id), [])
        for known, meanings in memo:
            if known == self.known:
                return meanings
        meanings = meanings_of(self.known)
        try:
            whole = self.whole
        except NotSearchableError:
            return meanings
        meanings = with_behaviour(meanings, self.known, whole)
        if whole.cut_at_s is None:
            memo.append((self.known, meanings))
        return meanings

    @cached_property
    def own_names(self) -> dict[str, str]:
        """By name, each name without branches that say nothing."""
        return own_names(self.known)

    @cached_property
    def branches(self) -> dict[str, str]:
        """By name, the first part of each name that says something."""
        return {name: own.partition(".")[0] for name, own in self.own_names.items()}

    @cached_property
    def signals(self) -> list[RegisteredSignal]:
        """Those that are looked at."""
        return resolve_signals(self.known, self.options.signals) if self.known else []

    @cached_property
    def numbers(self) -> list[RegisteredSignal]:
        """Of the signals the numeric ones."""
        return [signal for signal in self.signals if signal.is_number]

    def required_numbers(self) -> list[RegisteredSignal]:
        """The numeric signals.

        Raises:
            NotSearchableError: There are none.
        """
        if not self.numbers:
            raise NotSearchableError("no number was published, or none with these names")
        return self.numbers

    def required_quantities(self) -> list[RegisteredSignal]:
        """The numeric signals that are no index of an array.

        Raises:
            NotSearchableError: There are none.
        """
        quantities = [signal for signal in self.required_numbers() if not signal.is_index]
        if not quantities:
            raise NotSearchableError(
                "the index of an array's smallest item normally jumps and stays constant"
            )
        return quantities

    @cached_property
    def frame(self) -> Frame:
        """The rows of the segment.

        Raises:
            NotSearchableError: None of them is left, or could be read in time.
        """
        frame = read_frame(self.connection, self.segment, self.deadline)
        if not len(frame) and frame.unread:
            raise NotSearchableError("; ".join(map(str, frame.unread)))
        return frame

    @cached_property
    def whole(self) -> Frame:
        """The rows of the whole run."""
        part = Segment(self.segment.run_id, self.began_s, just_after(self.ended_s))
        is_all = replace(self.segment, open_start=False, open_end=False) == part
        return self.frame if is_all else read_frame(self.connection, part, self.deadline)

    def event(
        self, kind: str, start_s: float, end_s: float, name: str | None, **details: Any
    ) -> Event:
        """An event of this run; what has a duration and reaches the newest row goes on."""
        ongoing = end_s >= self.ended_s > start_s
        place = (self.segment.run_id, start_s, end_s, self.wall_time_at(start_s))
        return Event(kind, *place, name, details, ongoing)

    @cached_property
    def _purged(self) -> Frame | None:
        return frame_of_purged(self.connection, self.segment.run_id)

    def wall_time_at(self, time_s: float) -> float:
        """Of the last row at or before a simulation time; else of the first one, or 0."""
        if self._purged is not None and len(self._purged):
            place = int(np.searchsorted(self._purged.times, time_s, "right")) - 1
            return float(self._purged.wall_times[max(place, 0)])
        if (known := self._walls.get(time_s)) is None:
            run_id = self.segment.run_id
            row = self.connection.execute(_LAST_ROW, (run_id, time_s)).fetchone()
            row = row or self.connection.execute(_FIRST_ROW, (run_id,)).fetchone()
            known = self._walls[time_s] = float(row[0]) if row else 0.0
        return known

    def not_searched(self, kind: str, *reasons: str, cause: Cause | None = None) -> None:
        """Note why a kind was not looked for, or where it was not."""
        self.coverage.not_searched(kind, *reasons, cause=cause)

    def judged(
        self,
        kind: str,
        signals: Iterable[RegisteredSignal],
        spans_s: Sequence[tuple[float, float]] | None = None,
    ) -> None:
        """Note which signals were judged for a kind.

        Args:
            kind: What was looked for.
            signals: Those that were judged.
            spans_s: Where that was possible; None: in all that was read.
        """
        coverage = self.coverage.of(kind)
        coverage.signals |= {each.name: None for each in signals}
        coverage.intervals += [
            JudgedInterval(self.segment.run_id, *span) for span in self._asked_of(spans_s or ())
        ]

    def judged_nothing(self, kind: str, reason: str, cause: Cause | None = None) -> None:
        """Note why nothing of this run could be judged for a kind."""
        coverage, run_id = self.coverage.of(kind), self.segment.run_id
        coverage.intervals = [each for each in coverage.intervals if each.run_id != run_id]
        coverage.note_missing(reason, cause)

    def _asked_of(self, spans_s: Sequence[tuple[float, float]]) -> Iterator[tuple[float, float]]:
        """What of these spans was asked about."""
        asked = self.asked or self.segment
        for start_s, end_s in spans_s:
            first_s, last_s = max(start_s, asked.start_s), min(end_s, asked.end_s)
            if first_s <= last_s:
                yield first_s, last_s

    def note_interval(self, kind: EventKind) -> None:
        """Note what was read as judged, where the detector itself did not say what it judged."""
        coverage, run_id = self.coverage.of(kind.name), self.segment.run_id
        if any(each.run_id == run_id for each in coverage.intervals):
            return
        if kind.stored or self.bounds is None:
            first_s, last_s = self.bounds or (0.0, 0.0)
            coverage.intervals.append(JudgedInterval(run_id, first_s, last_s))
            return
        (read,) = list(self._asked_of([self.bounds])) or [(0.0, 0.0)]
        unread = sorted(self.frame.unread)
        starts_s = [read[0], *(each.end_s for each in unread)]
        ends_s = [*(each.start_s for each in unread), read[1]]
        if not unread or len(self.frame):
            coverage.intervals += [
                JudgedInterval(run_id, *span)
                for span in zip(starts_s, ends_s, strict=True)
                if span[0] <= span[1]
            ]

    def in_time(
        self, kind: str, signals: Sequence[RegisteredSignal], *, judged: bool = True
    ) -> Iterator[RegisteredSignal]:
        """The signals as long as there is time; which of them are not looked at is noted.

        Args:
            kind: What is looked for.
            signals: In this order.
            judged: Numbers that are too large cannot be.

        Raises:
            NotSearchableError: There is no time for any.
        """
        large: list[str] = []
        for index, signal in enumerate(signals):
            if self.deadline.passed:
                if not index:
                    raise NotSearchableError(NO_TIME)
                names = listed([each.name for each in signals[index:]], 3)
                why = f"time limit reached, {len(signals) - index} signals left: ask for {names}"
                self.not_searched(kind, why)
                break
            large += [signal.name] if judged and self._is_large(signal) else []
            self.coverage.of(kind).signals[signal.name] = None
            yield signal
        if large:
            why = f"{were_not_searched(large)}: numbers beyond {LARGEST:g}"
            self.not_searched(kind, why)

    def _is_large(self, signal: RegisteredSignal) -> bool:
        zones = self.frame.zone_map(signal.name)
        may_be_large = zones.value_count < zones.held_count
        if not may_be_large.any():
            return False
        spans = zones.spans(may_be_large)
        parts = (self.frame.rows(*span).numbers(signal.name) for span in spans)
        return any((np.abs(part) > LARGEST).any() for part in parts)

    def note_nearest(self, kind: str, share: float, what: str) -> None:
        """Note what came near to an event, as a share of what would be one."""
        where = f" (run {self.segment.run_id})" if self.coverage.of_several_runs else ""
        self.coverage.note_nearest(kind, share, what + where)


@dataclass(frozen=True)
class EventKind:
    """A kind of event. One of these, entered in `events.KINDS`, is all that a new kind takes.

    Attributes:
        name: Its name in questions and answers.
        means: What the name leaves open, in a few words; empty where it leaves nothing open.
        find: Finds the events in the segment of a search. Its coverage goes into the search: the
            signals that it judged (`in_time`, `judged`), what it could not (`not_searched`), what
            came nearest to an event (`note_nearest`). It raises `NotSearchableError` where it
            cannot search at all.
        stored: It was stored when it happened: nothing is judged, and a timeline shows it.
        usual: Whether it is looked for where no kinds are named.
        lasts: It has a begin and an end, which are followed out of the range.
        least_s: How long it has to last; a shorter range has to be widened by as much.
        around_s: How far around a range it has to be looked for, where it may be shorter than that.
        ends_within_s: How exactly its begin and end are known: nearer to the end of what was
            looked at it may go on there.
        of_numbers: The numeric signals are looked at.
        routine: It happens all the time; it is shown in the room that all other kinds leave.
        counted: Comparisons of runs count it.
        drawn: Its place among the rows below a plot, the least first; None if it has none there.
        alike: How similar ones are reported as one; None where each is reported by itself.
        severity: How bad it is compared with other kinds; 0 if it is no fault by itself.
    """

    name: str
    means: str
    find: Callable[[Search], Iterable[Event]]
    stored: bool = False
    usual: Callable[[EventOptions], bool] = lambda options: True
    lasts: bool = False
    least_s: Callable[[EventOptions], float] = lambda options: 0.0
    around_s: Callable[[EventOptions], float] = lambda options: 0.0
    ends_within_s: Callable[[Event], float] = lambda event: 0.0
    of_numbers: bool = False
    routine: bool = False
    counted: bool = True
    drawn: int | None = None
    alike: Alike | None = None
    severity: int = 0


def were_not_searched(names: Sequence[str]) -> str:
    """Return the first names of signals, and that they were not searched."""
    return f"{listed(names, MOST_NAMED)} {'was' if len(names) == 1 else 'were'} not searched"


def events_touching(search: Search) -> list[Event]:
    """The events that lie in the segment of a search, or reach into it.

    What has no begin or no end where was looked is followed out of it: at first as far as the
    shortest time that counts, then each time 8 times as far.
    """
    if search.deadline.passed:
        for kind in search.kinds:
            search.not_searched(kind.name, NO_TIME)
        return []
    segment = search.recorded
    kinds = [kind for kind in search.kinds if kind.lasts or not kind.stored]
    found = _found(search.of(search.segment, kinds=[e for e in search.kinds if e not in kinds]))
    if segment is None:
        for kind in kinds:
            why = f"run {search.segment.run_id} has no row in that range"
            search.not_searched(kind.name, why)
        return found
    reaches_s = ((each.least_s, each.around_s) for each in kinds)
    reach_s = max((of(search.options) for both in reaches_s for of in both), default=0.0)
    looked, cut, waiting = search.of(segment, asked=segment), list[Event](), list[Event]()
    while kinds and not (cut and search.deadline.passed):
        looked = looked.of(_around(search, segment, reach_s), kinds=kinds)
        touching = (e for e in _found(looked) if e.start_s < segment.end_s)
        events = [each for each in touching if each.end_s >= segment.start_s]
        if cut and search.deadline.passed:
            break  # some may be lacking
        by_name = {kind.name: kind for kind in kinds}
        cut = [each for each in events if _is_cut(each, by_name[each.kind], looked)]
        names = {each.kind for each in cut}
        kinds = [kind for kind in kinds if kind.name in names]
        found += [each for each in events if each.kind not in names]
        waiting = [each for each in events if each.kind in names]
        reach_s = FARTHER * max(reach_s, 1.0)
        looked.coverage = SearchCoverage()  # what the longer one lacks is known
    for each in cut:
        why = f"the one at {each.start_s:.3f} s may last longer: time limit reached"
        search.not_searched(each.kind, why)
    return found + waiting


def _found(search: Search) -> list[Event]:
    """The events in the segment of a search, cut off at its ends."""
    return [event for kind in search.kinds for event in _found_of(kind, search)]


def _found_of(kind: EventKind, search: Search) -> list[Event]:
    """The events of a kind; what could be judged for it goes into the search's coverage."""
    try:
        found = list(kind.find(search))
    except NotAskedError:
        return []
    except NotSearchableError as error:
        search.judged_nothing(kind.name, str(error), error.cause)
        return []
    if not found and kind.lasts and search.length_s < (least_s := kind.least_s(search.options)):
        run = f"run {search.segment.run_id} lasted only {search.length_s:.3g} s"
        search.judged_nothing(kind.name, f"{run}; this kind needs at least {least_s:g} s")
        return []
    search.note_interval(kind)
    if not kind.stored:
        search.not_searched(kind.name, *map(str, search.frame.unread))
    return found


def _is_cut(event: Event, kind: EventKind, looked: Search) -> bool:
    """Whether it reaches the first or last row that was looked at, and others follow there."""
    if not kind.lasts:
        return False
    segment = looked.segment
    within_s, (first_s, last_s) = kind.ends_within_s(event), looked.frame.bounds_s
    at_begin = segment.start_s > looked.began_s and event.start_s - within_s <= first_s
    return at_begin or (segment.end_s <= looked.ended_s and event.end_s + within_s >= last_s)


def _around(search: Search, segment: Segment, reach_s: float) -> Segment:
    """The segment with so much before and after it, as far as there is something."""
    start_s = max(search.began_s, segment.start_s - reach_s)
    end_s = min(just_after(search.ended_s), segment.end_s + reach_s)
    if (start_s, end_s) == (segment.start_s, segment.end_s):
        return segment
    return Segment(segment.run_id, start_s, end_s)
