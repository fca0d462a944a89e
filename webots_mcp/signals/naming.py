"""How the values of a state are named: pose.0, sensors.front, lidar.min; and units in names.

A unit may stand in a name in many ways: `front_mm`, `speed_m_s`, `headingDeg`, `pose_cm.0`.

Recorded rows are read by these names, and so are the states that a controller publishes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from itertools import takewhile
from typing import Any, Final, Literal, NamedTuple, TypeAlias

Value: TypeAlias = "int | float | str | None"  # a bool is an int

METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0}  # of lengths

_DEGREES: Final = ("deg", "degs", "degree", "degrees")
_RADIANS: Final = ("rad", "rads", "radian", "radians")
_MOVING: Final = (*METRES, "rad", "deg")
_PER_SECOND: Final = ("_s", "ps", "_per_s", "_per_sec", "_per_second")
_UNITS: Final = {
    **{each: each for each in METRES},
    **dict.fromkeys(_DEGREES, "deg"),
    **dict.fromkeys(_RADIANS, "rad"),
    **{f"{unit}{per}": f"{unit}/s" for unit in _MOVING for per in _PER_SECOND},
    **{f"{unit}{per}": f"{unit}/s²" for unit in _MOVING for per in ("_s2", "ps2", "_per_s2")},
    "km_h": "km/h", "kmh": "km/h", "rpm": "rpm", "ms": "ms", "s": "s", "hz": "Hz", "v": "V",
    "a": "A", "w": "W", "nm": "N·m", "n": "N", "kg": "kg", "percent": "%", "bytes": "B",
}  # fmt: skip
_ANGLES: Final = ("yaw", "heading", "theta", "bearing", "roll", "pitch")
_ANGLES_IF_UNIT: Final = (*_ANGLES, "course")  # a course without a unit may be of anything
_KEPT: Final = 4096  # names whose units are remembered

LONGEST_SPREAD_ARRAY: Final = 16  # a longer one is reduced: lidar.117 is of no interest
REDUCTIONS: Final = ("count", "min", "max", "mean", "argmin")

INDEXES: Final = tuple(str(index) for index in range(LONGEST_SPREAD_ARRAY))
FARTHEST_M: Final = 1e9  # beyond, a number is no place (an infinity, an integer of 400 digits)

WORLD: Final = "world"  # the branch in which an observer publishes where each robot is
SOLIDS: Final = "solid"  # the one of other bodies
OBSERVED: Final = "observer"  # the branch of a robot's pose that only an observer recorded
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
# Words next to an x that leave it the robot's own, as in robot_x and currentPosX.
OWN: Final = frozenset((
    *BRANCHES, *METRES, "robot", "rover", "current", "actual", "own", "self", "body", "base",
    "vehicle", "drone", "car", "agent", "estimate", "estimated", "filtered", "fused", "ekf", "slam",
    "true", "ground", "truth", "map", "local", "global",
))  # fmt: skip
_SEEN: Final = f"{WORLD}."
PAST_OR_FUTURE: Final = frozenset(("last", "previous", "prev", "old", "next", "desired", "target"))
# Words of actions and of arguments that mean the same, whatever their letters.
_SAME_MEANING: Final = (
    {"pause", "stop", "halt", "freeze"}, {"resume", "start", "play", "continue", "unpause"},
    {"screenshot", "snapshot", "photo"}, {"set", "field", "teleport", "move", "place", "change"},
    {"add", "node", "spawn"}, {"drive", "move", "go", "goto"},
    {"duration", "for", "period", "s", "seconds", "time"},
    {"action", "command"}, {"condition", "until"},
)  # fmt: skip
# Words of actions, commands and options that lose something: none is ever offered as a correction.
_DESTRUCTIVE: Final = frozenset((
    "clear", "delete", "discard", "drop", "erase", "exit", "force", "kill", "load", "new",
    "overwrite", "prune", "purge", "quit", "reload", "remove", "replace", "reset", "restart",
    "rewind", "shutdown", "terminate", "uninstall", "wipe",
))  # fmt: skip
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
    ("X", "Y"),
)
NO_POSITION: Final = "no position is known: publish pose: [x, y], position: {x, y} or gps in metres"
NAME_POSITION: Final = f"{NO_POSITION}, or name the signals of both: position=[x, y]"
_OBEYED: Final = re.compile(
    r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u206f]|\r(?!\n)"
)


class NameLimits(NamedTuple):
    """Limits of how much of a name is read.

    Attributes:
        unit_words: Words of a unit, as in m_per_s.
        index_digits: Digits of the index of an item.
        compared_characters: Length up to which names are compared for similarity.
    """

    unit_words: int = 3
    index_digits: int = 7
    compared_characters: int = 100


_NAME_LIMITS: Final = NameLimits()


def array_item(name: str) -> tuple[str, int] | None:
    """Return the array and the place that a name of an item means; None of other names.

    `scan.12` is item 12 of `scan`, and so is `scan[12]`: see `with_dots`.
    """
    array, _, last = name.rpartition(".")
    is_place = last.isascii() and last.isdigit() and len(last) <= _NAME_LIMITS.index_digits
    return (array, int(last)) if array and is_place else None


def with_dots(name: str) -> str:
    """Return a name as signals are called: `pose[0]` as `pose.0`."""
    return re.sub(r"\[(\d+)\]", r".\1", name)


def flatten(state: dict[str, Any]) -> dict[str, Value]:
    """Return every number, flag, text and null of a state, by its dotted name.

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
    """Return an array as one value per reduction."""
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
    """Their mean, the same by each version of Python; None of none, and where it is no float."""
    try:
        mean = math.fsum(numbers) / len(numbers) if numbers else math.inf
    except (OverflowError, ValueError):
        return None
    return mean if math.isfinite(mean) else None


def find_position(numeric: Collection[str]) -> tuple[str, str] | None:
    """Return the names of a robot's x and y, among those of its numbers; None without any.

    In metres, unless the names have another unit: see `units.metres_in`.
    """
    return next(iter(positions_in(numeric)), None)


def positions_in(numeric: Collection[str]) -> list[tuple[str, str]]:
    """Return the names that may be a robot's x and y, the best ones first.

    It is what is called `pose`, `position`, `pos`, `gps`, `odometry`, `odom` or `location` (in
    this order), or `x` and `y` at the top, or else the first branch by name that has an x and y:
    one with such a word in its name before others (`currentPosition.x`, `posX`, `robotPose.0`), and
    none of what is elsewhere (`goal`, `ball`) or no place (`velocity`). Where an observer sees
    several robots, none of their positions is taken, nor one that comes after them.
    """
    usual = [(x, y) for x, y in USUAL_POSITIONS if x in numeric and y in numeric]
    places = {place: name for name in numeric if (place := _place_of(name)) is not None}
    pairs = [
        (branch, (name, places[branch, key, "y"]))
        for (branch, key, axis), name in places.items()
        if axis == "x" and (branch, key, "y") in places
    ]
    pairs.sort(key=_place_first)
    if sum(branch.startswith(_SEEN) for branch, _ in pairs) > 1:
        pairs = takewhile(lambda pair: not pair[0].startswith(_SEEN), pairs)
    return list(dict.fromkeys([*usual, *(names for _, names in pairs)]))


@lru_cache(maxsize=_KEPT)
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


@lru_cache(maxsize=_KEPT)
def _subject_words(name: str) -> frozenset[str]:
    """Return the words of all parts of a name, one of several being the same as one alone."""
    return frozenset(word.rstrip("s") for word in _branch_words(name))


def is_seen_speed(name: str) -> bool:
    """Return whether it is the speed of a body as an observer sees it, which no command set."""
    branch, _, rest = name.partition(".")
    return branch in (WORLD, SOLIDS) and rest.endswith(f".{SEEN_SPEED}")


def find_mode(texts: Collection[str]) -> str | None:
    """Return the name of what a robot is doing, among those of its texts; None without any."""
    return next(iter(modes_in(texts)), None)


def modes_in(texts: Collection[str], choices: Collection[str] = ()) -> list[str]:
    """The names that may be of what a robot is doing, the best ones first; texts before `choices`.

    It is `mode`, `behaviour`, `behavior`, `action`, `task` or `phase` (in this order), or else the
    shortest name that ends in one of these words, as `nav.mode`, `driveMode` and `mode_name` do;
    then the same of `state` and `status`. What was or shall be (`lastAction`, `next_state`) is
    none.
    """
    return [*_modes_among(texts), *_modes_among(choices)]


def _modes_among(names: Iterable[str]) -> list[str]:
    ranks = {name: rank for name in names if (rank := _mode_rank(name)) is not None}
    return sorted(ranks, key=lambda name: (ranks[name], name))


@lru_cache(maxsize=_KEPT)
def _mode_rank(name: str) -> tuple[bool, int, int] | None:
    """Lower is better: is it of anything, the word's own rank, the length; None of no mode."""
    *before, last = _without_spelling(words_of(name.rpartition(".")[2]))
    if last not in (*MODES, *STATES) or not PAST_OR_FUTURE.isdisjoint(before):
        return None
    words = MODES if last in MODES else STATES
    return last in STATES, words.index(name) if name in words else len(words), len(name)


def _without_spelling(words: Sequence[str]) -> Sequence[str]:
    return words[:-1] if words[1:] and words[-1] in SPELLINGS else words


def _place_first(pair: tuple[str, tuple[str, str]]) -> tuple[bool, tuple[str, str]]:
    named = {*_branch_words(pair[0].rpartition(".")[2]), *words_of(pair[1][0].rpartition(".")[2])}
    return named.isdisjoint(BRANCHES), pair[1]


def listed(names: Collection[str], most: int = 10) -> str:
    """Return the first of several names, and how many more there are."""
    more = len(names) - most
    return ", ".join(list(names)[:most]) + (f" and {more} more" if more > 0 else "")


def counted(count: int, what: str) -> str:
    """Return how many there are: `1 row`, `2 rows`."""
    return f"{count} {what}" + "s" * (count != 1)


def spelled_out(text: str) -> str:
    """Return a text without what a terminal obeys or what turns the direction of writing.

    Control characters other than tabs and the ends of lines, and Unicode's marks of direction, are
    spelled as JSON spells them.
    """
    return _OBEYED.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def perhaps_meant(action: str, known: Iterable[str], most: int = 3) -> list[str]:
    """Return the known actions that may have been meant, none of which loses anything.

    Those that ask for the same in other words (`pause` for `stop`), else those spelled like it:
    none where the nearest of them, or the given one, loses something.
    """
    from difflib import get_close_matches

    names = list(known)
    harmless = [each for each in names if not is_destructive(each)]
    if same := [each for each in harmless if _groups_of(each) & _groups_of(action)]:
        return same
    spelled = action[: _NAME_LIMITS.compared_characters]
    nearest = get_close_matches(spelled, names, 1)
    if is_destructive(action) or not nearest or is_destructive(nearest[0]):
        return []
    return get_close_matches(spelled, harmless, most)


def misfit_of_parameters(
    given: Iterable[str], known: Sequence[str] | None, required: Iterable[str], action: str
) -> str | None:
    """Return the error for parameters that an action does not take, or that are missing.

    Args:
        given: The names that were given.
        known: The names of its parameters; None where any name may be given.
        required: Those that must be given.
        action: Its name.

    Returns:
        None where the names fit.
    """
    if known is None:
        return None
    names = list(given)
    unknown = [name for name in names if name not in known]
    missing = [name for name in required if name not in names]
    if not unknown and not missing:
        return None
    wrong, fault = (unknown, "takes no") if unknown else (missing, "needs the")
    word = "parameter" if len(wrong) == 1 else "parameters"
    text = f"action {action!r} {fault} {word} {', '.join(f'{name!r:.80}' for name in wrong[:5])}"
    if not known:
        return f"{text}: it takes none"
    from difflib import get_close_matches

    near = get_close_matches(unknown[0], known, 1, 0.5) if unknown else []
    offer = f". Did you mean {near[0]!r}? It" if near else ": it"
    return f"{text}{offer} takes {', '.join(map(repr, known))}"


def is_destructive(action: str) -> bool:
    """Return whether an action, command or option says by its name that it loses something."""
    return not _DESTRUCTIVE.isdisjoint(words_of(re.sub(r"\W+", "_", action)))


def harmless_first(action: str, known: Iterable[str]) -> list[str]:
    """Return all known actions: what may have been meant, the nearest, and last what destroys."""
    names = nearest_first(action, known)
    ordered = [*perhaps_meant(action, names), *sorted(names, key=is_destructive)]
    return list(dict.fromkeys(ordered))


def _groups_of(action: str) -> set[int]:
    words = set(words_of(action)) - _OF_ACTIONS
    return {number for number, group in enumerate(_SAME_MEANING) if words and words <= group}


def nearest_first(name: str, known: Iterable[str]) -> list[str]:
    """The known names, those most like the given one first; equally like ones keep their order.

    Alike is who has the same letters, whatever their case, as a whole or in the last part of a
    dotted name: `front` is near `sensors.front`.
    """
    wanted = name[: _NAME_LIMITS.compared_characters].lower()
    return sorted(
        known, key=lambda each: -_likeness(wanted, each[: _NAME_LIMITS.compared_characters].lower())
    )


def _likeness(name: str, other: str) -> float:
    """From 0 (no letter in common) to 1 (the same)."""
    from difflib import SequenceMatcher  # a controller seldom needs it

    parts = {(name, other), (name, other.rpartition(".")[2]), (name.rpartition(".")[2], other)}
    likeness = max(SequenceMatcher(None, *pair).ratio() for pair in parts)
    return max(likeness, 0.8) if name and name in other else likeness


@lru_cache(maxsize=_KEPT)
def unit_in(name: str) -> str | None:
    """Return the unit that the last part of a name has, or else one before it; None without any."""
    units = (_unit_of(part) for part in reversed(name.split(".")))
    return next(filter(None, units), None)


def metres_in(name: str) -> float:
    """What one of the unit of a length is in metres; Webots' own, 1, where the name has none."""
    return METRES.get(unit_in(name) or "m", 1.0)


@lru_cache(maxsize=_KEPT)
def angle_unit(name: str) -> Literal["rad", "deg"] | None:
    """In what an angle is measured by its name, radians unless it says degrees; else None.

    The unit stands after or before the word: `heading_deg`, `deg_heading`, `yawDegrees`,
    `bearing.rad`.
    """
    parts = name.split(".")
    if parts[-1].isdigit():
        parts.pop()
    words = [word for part in parts[-2:] for word in words_of(part)]
    units = (*_DEGREES, *_RADIANS)
    after, before = words[-1:], words[-2:-1]
    if after and after[0] in units:
        word, unit = before, after
    else:
        word, unit = after, [each for each in before if each in units]
    if not word or word[0] not in (_ANGLES_IF_UNIT if unit else _ANGLES):
        return None
    return "deg" if unit and unit[0] in _DEGREES else "rad"


@lru_cache(maxsize=_KEPT)
def words_of(part: str) -> Sequence[str]:
    """The words of one part of a dotted name, in lower case: of `posX` and `pos_x` pos and x."""
    return tuple(
        re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", part).lower().split("_")
    )


@lru_cache(maxsize=_KEPT)
def in_snake_case(name: str) -> str:
    """A dotted name in lower case with underscores: of `nav.targetSpeed` nav.target_speed."""
    return ".".join("_".join(words_of(part)) for part in name.split("."))


def _unit_of(part: str) -> str | None:
    """That of one part of a dotted name: `front_mm`, `mmAlong`, `x_mm_filtered`.

    The last one counts. A single letter is one only at the end, after an underscore, and what is
    per anything but a second (`ticks_per_mm`) has none that is known.
    """
    words = words_of(part)
    for end in range(len(words), 0, -1):
        for start in range(max(0, end - _NAME_LIMITS.unit_words), end):
            unit = "_".join(words[start:end])
            if unit in _UNITS and (len(unit) > 1 or part.lower().endswith(f"_{unit}")):
                return _UNITS[unit] if words.count("per") == unit.count("per") else None
    return None
