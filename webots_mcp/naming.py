"""How the values of a state are named: pose.0, sensors.front, lidar.min.

Recorded rows are read by these names, and so are the states that a controller publishes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Final, TypeAlias

from webots_mcp.units import METRES, words_of

Value: TypeAlias = "int | float | str | None"  # a bool is an int

LONGEST_SPREAD_ARRAY: Final = 16  # a longer one is reduced: nobody asks for lidar.117
REDUCTIONS: Final = ("count", "min", "max", "mean", "argmin")

INDEXES: Final = tuple(str(index) for index in range(LONGEST_SPREAD_ARRAY))
FARTHEST_M: Final = 1e9  # beyond, a number is no place (an infinity, an integer of 400 digits)

WORLD: Final = "world"  # the branch in which an observer publishes where each robot is
SOLIDS: Final = "solid"  # the one of other bodies
SEEN_SPEED: Final = "speed_mps"  # how fast it sees each to be
BRANCHES: Final = ("pose", "position", "pos", "gps", "odometry", "odom", "location")
# Words of what is no place, or the place of something else.
ELSEWHERE: Final = frozenset((
    "accel", "acceleration", "accelerometer", "angular", "axis", "cmd", "command", "compass",
    "error", "force", "gravity", "gyro", "imu", "linear", "magnetometer", "offset", "speed",
    "torque", "twist", "vel", "velocity", "wind", "ball", "blob", "box", "desired",
    "destination", "goal", "image", "item", "marker", "object", "obstacle", "pixel",
    "reference", "setpoint", "solid", "target", "waypoint",
))  # fmt: skip
# Words beside an x that leave it the robot's own, as in robot_x and currentPosX.
OWN: Final = frozenset((*BRANCHES, *METRES, "robot", "rover", "current", "actual", "own", "self"))
_SEEN: Final = f"{WORLD}."
PAST_OR_FUTURE: Final = frozenset(("last", "previous", "prev", "old", "next", "desired", "target"))
# Words of actions that ask for the same, whatever their letters; and words that say no more.
_SAME_ACTION: Final = (
    {"pause", "stop", "halt", "freeze"}, {"resume", "start", "play", "continue", "unpause"},
    {"reset", "restart", "rewind"}, {"reload", "restart"}, {"quit", "exit", "shutdown"},
    {"screenshot", "snapshot", "photo"}, {"set", "field", "teleport"},
    {"add", "node", "spawn"}, {"remove", "node", "delete"}, {"drive", "move", "go", "goto"},
)  # fmt: skip
_OF_ACTIONS: Final = frozenset(("simulation", "sim", "world", "robot", "to"))
_LENGTHS: Final = ("m", "cm", "mm")  # units that a place is published in
_AXES: Final = (("0", "1"), ("x", "y"), *((f"x_{unit}", f"y_{unit}") for unit in _LENGTHS))
_TARGETS: Final = frozenset((
    "target", "setpoint", "goal", "desired", "commanded", "command", "cmd", "reference", "ref",
))  # fmt: skip
_MEASURED: Final = frozenset((
    "position", "pos", "actual", "measured", "current", "state", "feedback", "encoder", "sensor",
))  # fmt: skip
_RATES: Final = frozenset(("speed", "velocity", "vel", "rate"))
MODES: Final = ("mode", "behaviour", "behavior", "action", "task", "phase")
STATES: Final = ("state", "status")  # of anything, often of an arm
SPELLINGS: Final = frozenset(("name", "label", "str"))  # after these words: of the same
USUAL_POSITIONS: Final = (
    *((f"{branch}.{x}", f"{branch}.{y}") for branch in BRANCHES for x, y in _AXES),
    *((f"{branch}_{unit}.0", f"{branch}_{unit}.1") for branch in BRANCHES for unit in _LENGTHS),
    *_AXES[1:],  # at the top
)
NO_POSITION: Final = "no position is known: publish pose: [x, y], position: {x, y} or gps in metres"
NAME_POSITION: Final = f"{NO_POSITION}, or name the signals of both: position=[x, y]"
_OBEYED: Final = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u206f]|\r(?!\n)"
)
_LONGEST_COMPARED: Final = 100  # characters of a name


def flatten(state: dict[str, Any]) -> dict[str, Value]:
    """Every number, flag, text and null of a state, by its dotted name.

    Arrays of more than 16 items become `name.count`, `.min`, `.max`, `.mean` and `.argmin` (of
    their numbers; `count` and `argmin` of all items). Where two values share a name (a key that
    holds a dot), the last counts.
    """
    values: dict[str, Value] = {}
    _spread("", state.items(), values)
    return values


def _spread(prefix: str, items: Iterable[tuple[str, Any]], values: dict[str, Value]) -> None:
    for key, value in items:
        kind = value.__class__
        if kind is dict:
            _spread(f"{prefix}{key}.", value.items(), values)
        elif kind is not list:
            values[prefix + key] = value
        elif len(value) <= LONGEST_SPREAD_ARRAY:
            _spread(f"{prefix}{key}.", zip(INDEXES, value, strict=False), values)
        else:
            _reduce(prefix + key, value, values)


def _reduce(name: str, array: list[Any], values: dict[str, Value]) -> None:
    for reduction, value in zip(REDUCTIONS, reduce_array(array), strict=True):
        values[f"{name}.{reduction}"] = value


def reduce_array(array: list[Any]) -> tuple[Value, ...]:
    """An array as one value per reduction."""
    numbers = [item for item in array if type(item) is float or type(item) is int]
    low = min(numbers, default=None)
    return (
        len(array),
        low,
        max(numbers, default=None),
        mean_of(numbers),
        None if low is None else array.index(low),
    )


def mean_of(numbers: Collection[int | float]) -> float | None:
    """Their mean; None of no numbers, and where their sum is beyond all floats."""
    try:
        mean = sum(numbers) / len(numbers) if numbers else math.inf
    except OverflowError:
        return None
    return mean if math.isfinite(mean) else None


def find_position(numeric: Collection[str]) -> tuple[str, str] | None:
    """The names of a robot's x and y, among those of its numbers; None without any.

    In metres, unless the names have another unit: see `units.metres_in`.

    It is what is called `pose`, `position`, `pos`, `gps`, `odometry`, `odom` or `location` (in
    this order), or `x` and `y` at the top, or else the first branch by name that has an x and y:
    one with such a word in its name before others (`currentPosition.x`, `posX`, `robotPose.0`), and
    none of what is elsewhere (`goal`, `ball`) or no place (`velocity`). The views robot_now and
    robot_trajectory have the same rule, row by row. Of several robots that an observer sees none
    is meant.
    """
    for x, y in USUAL_POSITIONS:
        if x in numeric and y in numeric:
            return x, y
    places = {place: name for name in numeric if (place := _place_of(name)) is not None}
    pairs = [
        (branch, (name, places[branch, key, "y"]))
        for (branch, key, axis), name in places.items()
        if axis == "x" and (branch, key, "y") in places
    ]
    branch, found = min(pairs, key=_place_first, default=("", None))
    if branch.startswith(_SEEN) and sum(each.startswith(_SEEN) for each, _ in pairs) > 1:
        return None
    return found


def _place_of(name: str) -> tuple[str, str, str] | None:
    """The branch of an x or y, the rest of its name and which of them it is; None of all else."""
    branch, _, last = name.rpartition(".")
    words = _branch_words(branch)
    if not ELSEWHERE.isdisjoint(words):
        return None
    if last in ("0", "1"):
        is_place = not set(BRANCHES).isdisjoint(words_of(branch.rpartition(".")[2]))
        return (branch, "", "xy"[int(last)]) if is_place else None
    parts = words_of(last)
    axes = [word for word in parts if word in ("x", "y")]
    rest = [word for word in parts if word not in ("x", "y")]
    if len(axes) != 1 or not OWN.issuperset(rest) or not (branch or rest):
        return None
    return branch, "_".join(rest), axes[0]


def _branch_words(branch: str) -> list[str]:
    return [word for part in branch.split(".") for word in words_of(part)]


def find_targets(name: str, names: Iterable[str]) -> tuple[str | None, str | None]:
    """The names of the target of a measured value and of its commanded speed; None without any.

    They differ from it in words alone that say target, or that it is measured: the target of
    `arm.shoulder.position` is `arm.shoulder.target`, that of `joints.0` is `joint_targets.0`; of
    `belt_position` the speed is `belt_speed_cmd`.
    """
    own = _subject_words(name)
    if not _TARGETS.isdisjoint(own):
        return None, None
    subject = own - _MEASURED
    place: str | None = None
    speed: str | None = None
    for other in names:
        words = _subject_words(other)
        if not _TARGETS.isdisjoint(words):
            rest = words - _TARGETS - _MEASURED
            place = place or (other if rest == subject else None)
            is_rate = _RATES.isdisjoint(own) and not _RATES.isdisjoint(rest)
            speed = speed or (other if is_rate and rest - _RATES == subject else None)
    return place, speed


def _subject_words(name: str) -> frozenset[str]:
    """The words of all parts of a name, one of several being the same as one alone."""
    return frozenset(word.rstrip("s") for word in _branch_words(name))


def is_seen_speed(name: str) -> bool:
    """Whether it is how fast an observer sees a body to be, which nobody was told to be."""
    branch, _, rest = name.partition(".")
    return branch in (WORLD, SOLIDS) and rest.endswith(f".{SEEN_SPEED}")


def find_mode(texts: Collection[str], choices: Collection[str] = ()) -> str | None:
    """The name of what a robot is doing, among those of its texts; None without any.

    Where no text tells it, a choice does: a whole number of which there are few values.

    It is `mode`, `behaviour`, `behavior`, `action`, `task` or `phase` (in this order), or else the
    shortest name that ends in one of these words, as `nav.mode`, `driveMode` and `mode_name` do;
    then the same of `state` and `status`. What was or shall be (`lastAction`, `next_state`) is
    none. The views robot_now and robot_trajectory have the same rule, row by row.
    """
    return _mode_among(texts) or _mode_among(choices)


def _mode_among(texts: Collection[str]) -> str | None:
    last_words = {name: _without_spelling(words_of(name.rpartition(".")[2])) for name in texts}
    for words in (MODES, STATES):
        ending = [
            name
            for name, (*before, last) in last_words.items()
            if last in words and PAST_OR_FUTURE.isdisjoint(before)
        ]
        if ending:
            return next((word for word in words if word in texts), min(ending, key=_shortest))
    return None


def _without_spelling(words: Sequence[str]) -> Sequence[str]:
    return words[:-1] if words[1:] and words[-1] in SPELLINGS else words


def _shortest(name: str) -> tuple[int, str]:
    return len(name), name


def _place_first(pair: tuple[str, tuple[str, str]]) -> tuple[bool, tuple[str, str]]:
    named = {*_branch_words(pair[0].rpartition(".")[2]), *words_of(pair[1][0].rpartition(".")[2])}
    return named.isdisjoint(BRANCHES), pair[1]


def listed(names: Collection[str], most: int = 10) -> str:
    """The first of several names, and how many more there are."""
    more = len(names) - most
    return ", ".join(list(names)[:most]) + (f" and {more} more" if more > 0 else "")


def spelled_out(text: str) -> str:
    """A text without what a terminal obeys or what turns the direction of writing.

    Control characters other than tabs and the ends of lines, and Unicode's marks of direction, are
    spelled as JSON spells them.
    """
    return _OBEYED.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def same_in_meaning(action: str, known: Iterable[str]) -> list[str]:
    """The known actions that ask for the same in other words: `pause` for `stop`."""
    return [each for each in known if _groups_of(each) & _groups_of(action)]


def _groups_of(action: str) -> set[int]:
    words = set(words_of(action)) - _OF_ACTIONS
    return {number for number, group in enumerate(_SAME_ACTION) if words and words <= group}


def nearest_first(name: str, known: Iterable[str]) -> list[str]:
    """The known names, those most like the given one first; equally like ones keep their order.

    Alike is who has the same letters, whatever their case, as a whole or in the last part of a
    dotted name: `front` is near `sensors.front`.
    """
    meant = name[:_LONGEST_COMPARED].lower()
    return sorted(known, key=lambda each: -_likeness(meant, each[:_LONGEST_COMPARED].lower()))


def _likeness(name: str, other: str) -> float:
    """From 0 (no letter in common) to 1 (the same)."""
    from difflib import SequenceMatcher  # a controller seldom needs it

    parts = {(name, other), (name, other.rpartition(".")[2]), (name.rpartition(".")[2], other)}
    likeness = max(SequenceMatcher(None, *pair).ratio() for pair in parts)
    return max(likeness, 0.8) if name and name in other else likeness
