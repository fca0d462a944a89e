"""The register of signals: every dotted name that a robot's states ever held, and what it means.

A name and its values tell the kind and unit of a signal, the names of a robot together which of
them tell how it moves (its roles). The bridge enters names when it first records them, and the
maintainer those that came otherwise.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import math
import re
import sqlite3
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import filterfalse, islice
from typing import Any, Final, Literal, NamedTuple, cast

from webots_mcp.signals.meaning import is_asked_for, meaning_by_name, own_names
from webots_mcp.signals.naming import (
    LONGEST_SPREAD_ARRAY,
    METRES,
    OWN,
    REDUCTIONS,
    Value,
    angle_unit,
    flatten,
    in_snake_case,
    is_seen_speed,
    modes_in,
    positions_in,
    unit_in,
    words_of,
)

# What a name and its values tell of a signal, and where its value stands in a recorded state.


Kind = Literal["num", "bool", "text", "angle", "null"]

_END_OF_POSE: Final = re.compile(r"(^|[._])(?:pose|odom|odometry)\.([235])$")
PLACES: Final = ("", *(str(place) for place in range(2, 10)))  # in line for a role
_TAIL: Final = r"([._](x|vx|linear|speed|velocity|m_s|mps)|\.v)*$"  # `_v` is in volts
_COMMANDED: Final = re.compile(
    r"(^|[._])(commanded|command|cmd|cmd_vel(\.linear)?(\.0)?|target_speed"
    rf"|(speed|velocity)[._](setpoint|target|ref)){_TAIL}"
)
_SPEED: Final = re.compile(rf"(^|[._])(speed|velocity|linear){_TAIL}")
_WHEEL: Final = re.compile(
    r"(^|[._])(wheels?|(left|right)_motors?|motors?[._]?(left|right|\d)?)([._]|$)"
)
_NO_SPEED: Final = re.compile(  # of a wheel or a motor; and motors that move no robot
    r"(^|[._])(position|pos|angle|encoders?|ticks?|odo\w*|distance|torque|force|current|power"
    r"|temp\w*|radius|base|track|width|slip|contact|max|min|limit|gain|count|volt\w*"
    r"|arm|gripper|hand|head|neck|joint|finger|lidar|camera|mast|lift)([._]|$)",
)
_SIDE: Final = r"(\d|[lr]|(front|rear|back)?_?(left|right))"
_COMMANDED_WHEEL: Final = re.compile(
    rf"(^|[._])(commands?|cmds?|commanded|target_speeds?)[._]{_SIDE}([._](speed|velocity|rad_s))*$"
)
_ANGLES: Final = ("rad", "deg", *METRES)  # units of where a wheel is, not of how fast it turns
_THIRD_AXES: Final = {"0": "2", "x": "z", "X": "Z", "x_m": "z_m", "x_cm": "z_cm", "x_mm": "z_mm"}
_HEADINGS: Final = frozenset(("heading", "yaw", "theta", "bearing"))
_OF_FLAT_NAME: Final = re.compile(r"(^|_)x(?=_|$)")  # the axis in pose_x, x_m
_TILTS: Final = frozenset(("roll", "pitch", "tilt"))
_HEADING: Final = re.compile(r"(^|\.)(deg\w*_)?(heading|yaw|theta|bearing)[^.]*")
_ALTITUDE: Final = ("altitude", "alt")
_MOTIONS: Final = ("commanded_speed", "speed", "wheel", "commanded_wheel")
_KEPT: Final = 4096  # names whose motion is remembered
MAX_SIGNALS: Final = 2000  # of one robot: keys made of ids or times would grow without end
MOST_CHOICES: Final = 20  # that a number which names a mode has
ADDED_AT_ONCE: Final = 50  # in one statement, which holds the write lock for half a millisecond
_COLUMNS: Final = "robot_id, name, path, reduction, first_seen_wall_time_s, kind, unit, role"
_ADD: Final = f"INSERT OR IGNORE INTO signal ({_COLUMNS}) VALUES "
_MARKS: Final = "(?, ?, ?, ?, ?, ?, ?, ?)"
MOST_KEYS: Final = 1000  # of a state that are compared
_MOST_SHAPES: Final = 64  # keys made of ids or times would make every state a new one
MOST_CHANGES: Final = 1000  # in one run; a text that changes in every row is not a mode
_LONGEST_TEXT: Final = 1000  # characters; a longer text is not a mode either
_UNSEEN: Final = object()


class AngleRanges(NamedTuple):
    """Values that show whether a signal is an angle in radians.

    Attributes:
        angle_rad: Maximum of an angle; larger values are in degrees, or turns were counted.
        yaw_rad: Maximum of the last item of a pose; with larger values it is no yaw.
    """

    angle_rad: float = 6.3
    yaw_rad: float = 3.2


_ANGLE_RANGES: Final = AngleRanges()


class Place(NamedTuple):
    """Where a signal's value stands in a state row.

    Attributes:
        path: For `json_extract(state.data, path)`.
        reduction: None, or how the long array at `path` becomes one number.
    """

    path: str
    reduction: str | None


def places(state: dict[str, Any]) -> dict[str, Place]:
    """Return where each leaf of a state stands; the same names as `flatten`, but slower."""
    found: dict[str, Place] = {}
    for key, value in state.items():
        _locate(key, f"$.{_step(key)}", value, found)
    return found


def _locate(name: str, path: str, value: Any, found: dict[str, Place]) -> None:
    prefix = f"{name}."
    if isinstance(value, dict):
        for key, item in cast("dict[str, Any]", value).items():
            _locate(prefix + key, f"{path}.{_step(key)}", item, found)
    elif not isinstance(value, list):
        found[name] = Place(path, None)
    elif len(cast("list[Any]", value)) <= LONGEST_SPREAD_ARRAY:
        for index, item in enumerate(cast("list[Any]", value)):
            _locate(f"{prefix}{index}", f"{path}[{index}]", item, found)
    else:
        for reduction in REDUCTIONS:
            found[prefix + reduction] = Place(path, reduction)


def _step(key: str) -> str:
    if key.isidentifier() and key.isascii():
        return key
    return f'"{key}"' if is_reachable(key) else json.dumps(key, ensure_ascii=False)


def is_reachable(name: str) -> bool:
    """Whether a JSON path finds that name whatever the version of SQLite, however it is escaped."""
    return not any(character in '"\\' or character < " " for character in name)


def kind_of(name: str, value: Value, *, ends_pose: bool = False) -> Kind:
    """Return what a single value says about its signal; an angle also by the signal's name.

    Args:
        name: Of the signal.
        value: One that it had.
        ends_pose: It is the yaw of a pose, if it is an angle at all: see `ends_pose`.
    """
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, str):
        return "text"
    limit = (
        _ANGLE_RANGES.yaw_rad
        if ends_pose
        else _ANGLE_RANGES.angle_rad
        if angle_unit(name) == "rad"
        else -1.0
    )
    return "angle" if abs(value) <= limit else "num"


def turn_of(name: str, kind: Kind) -> float | None:
    """Return a whole turn of an angle: 2 pi, or 360 where the name says degrees; else None."""
    if kind == "angle":
        return math.tau
    return 360.0 if kind == "num" and angle_unit(name) == "deg" else None


def ends_pose(name: str, names: Container[str]) -> bool:
    """Return whether it is the last of three, four or six items of a pose or of odometry.

    There the yaw stands, if anywhere: `[x, y, yaw]`, `[x, y, z, yaw]`, `[x, y, z, roll, pitch,
    yaw]`.
    """
    last = _END_OF_POSE.search(in_snake_case(name))
    return last is not None and f"{name[:-1]}{int(last[2]) + 1}" not in names


def widen(known: Kind, seen: Kind) -> Kind:
    """Return the kind of a signal that was `known` when a value of kind `seen` comes."""
    if known == seen or seen == "null":
        return known
    if known == "null":
        return seen
    return "text" if "text" in (known, seen) else "num"


def unit_of(name: str, kind: Kind) -> str | None:
    """Return the unit, where a part of the name ends in one (`speed_m_s`, `distance_m.left`)."""
    if kind == "angle":
        return "rad"
    if kind != "num" or name.rpartition(".")[2] in ("count", "argmin"):
        return None
    return unit_in(name)


# Which signals of a robot tell how it moves: decided here alone, by their names and kinds.
#
# The outcome stands in `signal.role`, where tools, views and pools read it:
#
#     x, y, z           position; z where it has one
#     yaw               where the robot faces
#     mode              what it is doing: a text, or a whole number with few different values
#     commanded_speed   how fast it shall be
#     speed             how fast it is; the name leaves open whether it is commanded or measured
#     wheel             how fast one of its several wheels or driving motors turns
#     commanded_wheel   how fast one of them shall turn
#
# The robot's other names decide as well: `pose.0` is x only next to `pose.1`. Where several signals
# fit, a run may have the second alone, as its code was another: so each has a place in line, `x`
# before `x2` (with `y2`, `z2`) up to `x9`, and the first that is there counts.


def decide_roles(
    kinds: Mapping[str, Kind],
    choices: Container[str] = (),
    position: tuple[str, str] | None = None,
) -> dict[str, str]:
    """Return the role of each signal of a robot that has one.

    Args:
        kinds: Of all names that the robot has published.
        choices: Of the numbers, those that are whole and have few different values.
        position: x and y, where they are known already; else they are found by their names.
    """
    # A path in SQL does not reach all names, whatever the version of SQLite.
    named = own_names(name for name in kinds if is_reachable(name))
    names: dict[str, str] = {}
    for name in sorted(named, key=_shortest):
        names.setdefault(named[name], name)
    known: dict[str, Kind] = {own: kinds[names[own]] for own in dict.fromkeys(named.values())}
    few = {own for own in known if names[own] in choices}
    if position is not None:
        position = (named.get(position[0], position[0]), named.get(position[1], position[1]))
    return {names.get(own, own): role for own, role in _roles_in(known, few, position).items()}


def _roles_in(
    known: Mapping[str, Kind], choices: Container[str], position: tuple[str, str] | None
) -> dict[str, str]:
    roles: dict[str, str] = {}
    measured: dict[str, Kind] = {
        name: kind for name, kind in known.items() if not is_asked_for(name)
    }
    pairs = _positions(measured)
    if position is not None:
        pairs = [position, *(pair for pair in pairs if pair != position)]
    for (x, y), place in zip(_apart(pairs), PLACES, strict=False):
        roles |= {x: f"x{place}", y: f"y{place}"}
        if (z := _height(measured, x, first=not place)) is not None:
            roles.setdefault(z, f"z{place}")
    _line_up(roles, "yaw", _yaws(measured, pairs))
    texts = [name for name, kind in known.items() if kind == "text"]
    numbers = [name for name, kind in known.items() if kind == "num"]
    _line_up(roles, "mode", modes_in(texts, [name for name in numbers if name in choices]))
    _add_speeds(roles, numbers)
    return roles


def _line_up(roles: dict[str, str], role: str, names: Iterable[str]) -> None:
    """Give a role to names that have none, the best first."""
    free = (name for name in names if name not in roles)
    roles.update({name: f"{role}{place}" for name, place in zip(free, PLACES, strict=False)})


def _positions(known: Mapping[str, Kind]) -> list[tuple[str, str]]:
    """Those that never held a number yet come last."""
    held = {name for name, kind in known.items() if kind in ("num", "angle")}
    numeric = held | {name for name, kind in known.items() if kind == "null"}
    pairs = positions_in(held)
    return pairs if len(held) == len(numeric) else [*pairs, *positions_in(numeric)]


def _apart(pairs: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Those that share no name with one before them."""
    taken: set[str] = set()
    found: list[tuple[str, str]] = []
    for pair in pairs:
        if taken.isdisjoint(pair):
            taken.update(pair)
            found.append(pair)
    return found


def _height(known: Mapping[str, Kind], x: str, *, first: bool) -> str | None:
    """The third of the position's numbers, or an altitude next to it; for the first at the top too.

    The third of a pose or odometry of three is its heading.
    """
    branch, _, axis = x.rpartition(".")
    camel = f"{axis[:-1]}Z" if axis.endswith("X") else axis
    for last in (_THIRD_AXES.get(axis, ""), _OF_FLAT_NAME.sub(r"\1z", axis), camel):
        third = f"{branch}.{last}".removeprefix(".")
        if third != x and known.get(third) == "num" and not ends_pose(third, known):
            return third
    branches = (branch, "") if first else (branch,)
    altitudes = (name for name, kind in known.items() if kind == "num" and _is_altitude(name))
    return min((each for each in altitudes if _branch_of(each) in branches), default=None)


@lru_cache(maxsize=_KEPT)
def _is_altitude(name: str) -> bool:
    return words_of(name.rpartition(".")[2])[0] in _ALTITUDE


def _branch_of(name: str) -> str:
    return name.rpartition(".")[0]


def _yaws(known: Mapping[str, Kind], pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Angles next to the first position; those whose names say so; those next to other positions.

    Of each the shortest first.
    """
    angles = sorted(filterfalse(_says_tilt, _angles(known)), key=_shortest)
    branches = [branch for x, _ in pairs if (branch := _branch_of(x))]
    first = branches[0] if branches and _branch_of(pairs[0][0]) else None
    beside = [name for name in angles if _branch_of(name) == first]
    named = [name for name in angles if _says_heading(name)]
    others = [name for name in angles if _branch_of(name) in branches]
    return list(dict.fromkeys([*beside, *named, *others]))


def _angles(known: Mapping[str, Kind]) -> list[str]:
    return [name for name, kind in known.items() if turn_of(name, kind) is not None]


@lru_cache(maxsize=_KEPT)
def _says_tilt(name: str) -> bool:
    return not _TILTS.isdisjoint(words_of(name.rpartition(".")[2]))


@lru_cache(maxsize=_KEPT)
def _says_heading(name: str) -> bool:
    words = words_of(name.rpartition(".")[2])
    of_own = any(word in _HEADINGS for word in words) and (OWN | _HEADINGS).issuperset(words)
    return of_own or _HEADING.search(in_snake_case(name)) is not None


def _add_speeds(roles: dict[str, str], numbers: Iterable[str]) -> None:
    """Speeds and wheels, by what the names mean among each other."""
    by_motion: dict[str, list[str]] = {each: [] for each in _MOTIONS}
    names = frozenset(numbers)
    for name in sorted(names, key=_shortest):
        reported = _motions_of(name)
        meaning = meaning_by_name(name, "num", next(iter(reported), None), names)
        if meaning.role == "limit":
            continue
        if meaning.quantity == "speed":
            by_motion["commanded_speed" if meaning.sets else "speed"].append(name)
        elif meaning.quantity == "wheel speed":
            by_motion["commanded_wheel" if meaning.sets else "wheel"].append(name)
        elif "wheel" in reported and meaning.quantity == "motor speed":
            by_motion["wheel"].append(name)
    _line_up(roles, "commanded_speed", by_motion["commanded_speed"])
    _line_up(roles, "speed", by_motion["speed"])
    for role in ("wheel", "commanded_wheel"):
        roles.update({name: role for name in by_motion[role] if name not in roles})


@lru_cache(maxsize=_KEPT)
def _motions_of(name: str) -> tuple[str, ...]:
    """Return what a number may tell by its name."""
    if is_seen_speed(name):
        return ()
    words = in_snake_case(name)
    is_wheel = _WHEEL.search(words) is not None
    if _COMMANDED_WHEEL.search(words) and not _NO_SPEED.search(words):
        return ("commanded_wheel",)
    if _COMMANDED.search(words):
        found = ["commanded_speed"]
    else:
        found = ["speed"] if _SPEED.search(words) and not is_wheel else []
    if is_wheel and not _NO_SPEED.search(words) and unit_in(name) not in _ANGLES:
        found.append("wheel")
    return tuple(found)


def _shortest(name: str) -> tuple[int, str]:
    return len(name), name


def pair_in(roles: Container[str]) -> str | None:
    """Return the place in line of the first position of which both x and y are there."""
    return next((place for place in PLACES if f"x{place}" in roles and f"y{place}" in roles), None)


def first_in(role: str, roles: Container[str]) -> str | None:
    """Return the first in line for a role, of those that are there."""
    return next((f"{role}{place}" for place in PLACES if f"{role}{place}" in roles), None)


class Seen(NamedTuple):
    """What some values of a signal tell of it.

    Attributes:
        path: For `json_extract(state.data, path)`.
        reduction: None, or how the long array at `path` becomes one number.
        kind: Of these values.
        is_choice: They are whole numbers, and few different ones; as far as there are any.
    """

    path: str
    reduction: str | None
    kind: Kind
    is_choice: bool
    first_wall_time_s: float


class Described(NamedTuple):
    """What the register says of a signal that may change."""

    kind: Kind
    unit: str | None
    role: str | None


class Changes(NamedTuple):
    """What is to be written into the register of a robot, by name."""

    new: dict[str, tuple[Seen, Described]]
    changed: dict[str, Described]


def find_changes(
    connection: sqlite3.Connection, robot_id: int, seen: Mapping[str, Seen]
) -> Changes:
    """Return what is missing in the register of a robot once these values are recorded.

    Names beyond `MAX_SIGNALS` of a robot stay out. Of each name the kind is widened; which roles
    the names have is decided anew.
    """
    statement = (
        "SELECT name, kind, unit, role, max - min FROM signal "
        "WHERE robot_id = ? AND typeof(name) = 'text' ORDER BY id"
    )
    rows = connection.execute(statement, (robot_id,)).fetchall()
    known = {name: Described(*described) for name, *described, _ in rows}
    spans = {name: span or 0.0 for name, *_, span in rows}
    fresh = [name for name in seen if name not in known][: max(0, MAX_SIGNALS - len(known))]
    kinds: dict[str, Kind] = {name: each.kind for name, each in known.items()}
    for name in (*known, *fresh):
        if name in seen:
            kinds[name] = widen(kinds.get(name, "null"), seen[name].kind)
    choices = {
        name
        for name in kinds
        if (name not in seen or seen[name].is_choice)
        if _may_be_choice(known.get(name), spans.get(name, 0.0))
    }
    roles = decide_roles(kinds, choices)
    now = {
        name: Described(
            kind,
            known[name].unit if name in known and kind == known[name].kind else unit_of(name, kind),
            roles.get(name),
        )
        for name, kind in kinds.items()
    }
    return Changes(
        {name: (seen[name], now[name]) for name in fresh},
        {name: each for name, each in now.items() if each != known.get(name, each)},
    )


def _may_be_choice(known: Described | None, span: float) -> bool:
    """By what was recorded before: who is none any more has no role."""
    return known is None or known.kind == "null" or (bool(known.role) and span <= MOST_CHOICES)


def write_changes(connection: sqlite3.Connection, robot_id: int, changes: Changes) -> None:
    """Write them; names that another process has entered meanwhile stay as they are."""
    new = [
        (robot_id, name, *seen[:2], seen.first_wall_time_s, *described)
        for name, (seen, described) in changes.new.items()
    ]
    for start in range(0, len(new), ADDED_AT_ONCE):
        some = new[start : start + ADDED_AT_ONCE]
        marks = ", ".join([_MARKS] * len(some))
        connection.execute(_ADD + marks, [value for row in some for value in row])
    changed = [(*each, robot_id, name) for name, each in changes.changed.items()]
    statement = "UPDATE signal SET kind = ?, unit = ?, role = ? WHERE robot_id = ? AND name = ?"
    connection.executemany(statement, changed)


# What a recorder checks in each state: names that are new, and changes of what the robot does.


class SignalNames:
    """What the register has of this session's names.

    A state is checked if its keys at the top or the number of its values are new, and in the
    2nd, 4th, 8th, ... row of the session: what was null at first may have a value by then.
    """

    def __init__(self) -> None:
        self._shapes: set[tuple[Any, ...]] = set()
        self._rows = 0
        self._known: dict[str, tuple[Kind, bool]] = {}  # kind, and whether numbers are whole
        self._waiting: dict[str, Seen] = {}

    def register(
        self, state: Mapping[Any, Any], text: str, enter: Callable[[dict[str, Seen]], bool]
    ) -> None:
        """Enter the names that are new, some of many.

        Args:
            state: Which was recorded.
            text: Its JSON.
            enter: Enters names into the register; False where that has to wait.
        """
        self._rows = rows = self._rows + 1
        # Cheaper than a walk through the state: a name more is mostly a comma more.
        keys = state if state.__class__ is dict else ()
        shape = (text.count(","), *islice(keys, MOST_KEYS))
        if shape not in self._shapes and len(self._shapes) < _MOST_SHAPES:
            self._shapes.add(shape)
        elif rows & (rows - 1):
            if self._waiting:
                self._enter(enter)
            return
        self._take(text)
        if self._waiting:
            self._enter(enter)

    def _take(self, text: str) -> None:
        state = cast("dict[str, Any]", json.loads(text))
        values, now_s = flatten(state), time.time()
        reported = dict[str, tuple[Kind, bool]]()
        room = MAX_SIGNALS - len(self._known)
        for name, value in values.items():
            is_new = name not in self._known
            if is_new and room <= 0:
                continue
            kind, is_whole = before = self._known.get(name, ("null", True))
            kind = widen(kind, kind_of(name, value, ends_pose=ends_pose(name, values)))
            is_whole = is_whole and (value is None or type(value) is int)
            if is_new or (kind, is_whole) != before:
                room -= is_new
                reported[name] = kind, is_whole
        found = places(_part_with(reported, state))
        self._waiting |= {name: Seen(*found[name], *each, now_s) for name, each in reported.items()}
        self._known |= reported

    def _enter(self, enter: Callable[[dict[str, Seen]], bool]) -> None:
        some = dict(islice(self._waiting.items(), ADDED_AT_ONCE))
        if enter(some):
            for name in some:
                del self._waiting[name]

    def begin_anew(self) -> tuple[()]:
        """Another database does not have the names; returns what else it needs: nothing."""
        self._shapes.clear()
        self._known.clear()
        self._waiting.clear()
        return ()


def _part_with(names: Iterable[str], state: dict[str, Any]) -> dict[str, Any]:
    """Of a state the items that have leaves of these names: few, where it is very long."""
    parts = (name.split(".") for name in names)
    keys = {".".join(each[:n]) for each in parts for n in range(1, len(each) + 1)}
    return {key: value for key, value in state.items() if key in keys}


class StateChanges:
    """Compares the texts and booleans at the top of each recorded state with the last one.

    Only the top level: a comparison of every leaf would cost more than writing the row. Changes
    deeper down are found in the rows.
    """

    def __init__(self) -> None:
        self._last: dict[Any, object] = {}
        self._count = 0

    def forget(self) -> None:
        """A new run has begun: its first values are not changes."""
        self._last.clear()
        self._count = 0

    def compare(self, state: Mapping[Any, Any]) -> list[tuple[Any, object, object]]:
        """Return the (key, before, after) of each change since the last call; usually none."""
        changed: list[tuple[Any, object, object]] = []
        last = self._last
        if len(state) > MOST_KEYS:
            return changed
        for key, value in islice(state.items(), MOST_KEYS):  # a user's mapping may be endless
            if type(value) is not bool and not (type(value) is str and len(value) <= _LONGEST_TEXT):
                continue
            before = last.get(key, _UNSEEN)
            if before is value or before == value:
                continue
            if before is _UNSEEN and len(last) >= MOST_KEYS:
                continue  # keys that change all the time would fill the memory
            last[key] = value
            if before is not _UNSEEN and self._count < MOST_CHANGES:
                self._count += 1
                changed.append((key, before, value))
        return changed
