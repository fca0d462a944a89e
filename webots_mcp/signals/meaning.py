"""What signals mean: the quantity, role, unit and side of each, and where that is known from.

A meaning is declared by a person, known from the device that was read, or read from the name. The
words of names are compared as whole words, in their singular and common short forms; no part of a
name is matched as a bare text. A signal without any of these has an unknown meaning, and is not
judged.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final, Literal, NamedTuple, cast, get_args

from webots_mcp.signals.naming import (
    BRANCHES,
    ELSEWHERE,
    OBSERVED,
    REDUCTIONS,
    SOLIDS,
    WORLD,
    angle_unit,
    unit_in,
    words_of,
)

Quantity = Literal[
    "x", "y", "height", "heading", "roll", "pitch", "speed", "turn rate", "wheel speed",
    "motor speed", "joint position", "joint speed", "distance", "force", "torque", "current",
    "voltage", "temperature", "pressure", "light", "acceleration", "angular velocity",
    "magnetic field", "percentage", "energy", "power", "angle", "colour", "time", "count", "flag",
    "mode", "text",
]  # fmt: skip
Role = Literal["measured", "commanded", "target", "limit"]
Source = Literal["declared", "device", "named", "behaviour", "unknown"]

QUANTITIES: Final[tuple[Quantity, ...]] = get_args(Quantity)
ROLES: Final[tuple[Role, ...]] = get_args(Role)
DECLARED_WORDS: Final = (  # for those who declare a meaning: likely ones, none of them a guess
    "quantity is distance, speed, wheel speed, joint position, force or another; role is "
    "measured, commanded, target or limit"
)
SOURCES: Final[tuple[Source, ...]] = get_args(Source)  # the strongest first
FIRM: Final = frozenset[Source](("declared", "device", "named"))  # a failure may rest on these
_OF_OTHERS: Final = (f"{WORLD}.", f"{SOLIDS}.")
SIDES: Final = (
    "left", "right", "front", "rear", "front left", "front right", "rear left", "rear right",
)  # fmt: skip
_UNITS: Final = {  # as people write them, and as names are understood
    "meter": "m", "meters": "m", "metre": "m", "metres": "m", "degree": "deg", "degrees": "deg",
    "°": "deg", "radian": "rad", "radians": "rad", "°/s": "deg/s", "rev/min": "rpm", "1/min": "rpm",
    "r/min": "rpm", "kph": "km/h", "kmh": "km/h", "mps": "m/s", "rad/sec": "rad/s",
    "deg/sec": "deg/s",
}  # fmt: skip
LONGEST_NAME: Final = 500  # characters of a signal's name that a meaning is declared for
_LONGEST_UNIT: Final = 20  # characters
_BAD_UNIT: Final = "signal {!r}: unit must be a text of up to {} characters, such as 'm/s', not {}"

# -- the words of names ------------------------------------------------------------------------

_SHORT_FORMS: Final = {
    "pos": "position", "vel": "velocity", "spd": "speed", "cmd": "command", "tgt": "target",
    "ref": "reference", "dist": "distance", "temp": "temperature", "acc": "acceleration",
    "accel": "acceleration", "ang": "angle", "odom": "odometry", "odo": "odometry",
    "enc": "encoder", "mot": "motor", "whl": "wheel", "lin": "linear", "pct": "percent",
    "batt": "battery", "volt": "voltage", "alt": "altitude", "hdg": "heading", "mag": "compass",
    "magnetometer": "compass", "commanded": "command", "omega": "angular", "num": "count",
    "baro": "pressure", "barometer": "pressure", "illuminance": "light", "brightness": "light",
    "proximity": "distance", "ps": "distance", "ds": "distance", "ir": "distance",
    "clearance": "distance", "sonar": "distance", "lidar": "distance", "range": "distance",
    "ultrasonic": "distance", "ultrasound": "distance", "tof": "distance", "laser": "distance",
    "rangefinder": "distance",
}  # fmt: skip
_SIDES: Final = {
    "left": "left", "right": "right", "l": "left", "r": "right", "fl": "front left",
    "fr": "front right", "rl": "rear left", "rr": "rear right", "bl": "rear left",
    "br": "rear right",
}  # fmt: skip
_ENDS: Final = {"front": "front", "rear": "rear", "back": "rear"}
_COMMAND: Final = frozenset(("command", "demand"))
_TARGET: Final = frozenset(("target", "setpoint", "goal", "desired", "reference"))
_LIMIT: Final = frozenset(("limit", "max", "min", "maximum", "minimum", "threshold"))
_MEASURED: Final = frozenset(("measured", "actual", "feedback", "encoder", "sensor", "real"))
_COUNTS: Final = frozenset((
    "count", "counter", "length", "queue", "item", "tick", "step", "score", "packet", "encoder",
    "index", "id", "lap", "goal", "collision", "episode", "gear", "level", "size", "iteration",
))  # fmt: skip
_NOT_OF_SUBJECT: Final = frozenset((
    *_COMMAND, *_TARGET, *_MEASURED, "position", "angle", "speed", "velocity", "rate", "current",
    "state", "value", "rad", "deg", "m", "s", "rpm", "mm",
))  # fmt: skip
_JOINTS: Final = frozenset((
    "joint", "arm", "elbow", "shoulder", "wrist", "knee", "hip", "ankle", "neck", "waist", "torso",
    "gripper", "finger", "claw", "jaw", "hand", "leg", "pan", "tilt", "turret", "mast", "slider",
    "servo", "steering",
))  # fmt: skip
HOLDING: Final = frozenset(("gripper", "finger", "claw", "jaw", "hand"))  # they close on things
_FREE_MOTORS: Final = frozenset((  # motors that move no robot over the ground by wheels
    "fan", "propeller", "prop", "rotor", "engine", "brush", "pump", "spindle", "conveyor", "belt",
    "thruster", "vacuum", "drum", "blade", "turbine",
))  # fmt: skip
INPUTS: Final = frozenset((  # what a person moves by hand
    "joystick", "stick", "gamepad", "joypad", "pad", "axis", "axe", "mouse", "touch", "cursor",
    "keyboard", "key", "button", "input",
))  # fmt: skip
_HEADINGS: Final = frozenset(("heading", "yaw"))
_OF_HEADINGS: Final = frozenset((  # what measures a heading, and words next to it
    "compass", "gyro", "gyroscope", "imu", "gps", "gnss", "odometry", "estimate", "estimated",
    "fused", "ekf", "true", "robot", "body", "base", "raw", "rad", "deg", "value", "angle",
    "attitude", "orientation", "euler", "rpy", "ahrs", "filtered", "pose", "position", "location",
    "vehicle", "drone", "car", "rover",
)) | _MEASURED | _TARGET | _COMMAND  # fmt: skip
_ATTITUDE: Final[tuple[Quantity, ...]] = ("roll", "pitch", "heading")  # the items of `rpy`
_ATTITUDE_ITEMS: Final = re.compile(r"\.([012])$")
_TURNING: Final = frozenset(("angular", "turn", "rotation", "steer"))
_HEIGHTS: Final = frozenset(("height", "altitude"))
_GYROS: Final = frozenset(("gyro", "imu", "gyroscope"))
_WORD_QUANTITIES: Final[dict[str, Quantity]] = {
    "distance": "distance", "force": "force", "torque": "torque", "voltage": "voltage",
    "temperature": "temperature", "pressure": "pressure", "suction": "pressure", "light": "light",
    "lux": "light", "acceleration": "acceleration", "gyro": "angular velocity",
    "compass": "magnetic field", "percent": "percentage", "roll": "roll", "pitch": "pitch",
    "time": "time", "timestamp": "time",
}  # fmt: skip
_UNIT_QUANTITIES: Final[dict[str, Quantity]] = {
    "N": "force", "N·m": "torque", "A": "current", "V": "voltage", "%": "percentage",
    "m/s²": "acceleration", "s": "time", "ms": "time", "rad/s²": "angular velocity",
}  # fmt: skip
_MORE_UNITS: Final[dict[str, Quantity]] = {  # as words at the end of a name
    "pa": "pressure", "kpa": "pressure", "hpa": "pressure", "bar": "pressure", "lux": "light",
    "lx": "light", "c": "temperature", "celsius": "temperature", "k": "temperature",
    "kelvin": "temperature", "mv": "voltage", "ma": "current",
}  # fmt: skip
_OF_POSES: Final[dict[str, Quantity]] = {"x": "x", "y": "y", "z": "height", "yaw": "heading"}
# A quantity that may be nothing at any time: an actuator is off, a foot is in the air, it is dark.
CAN_BE_OFF: Final = frozenset[Quantity | None]((
    "speed", "turn rate", "wheel speed", "motor speed", "joint speed", "force", "torque", "current",
    "pressure", "light", "acceleration", "angular velocity", "power",
))  # fmt: skip
# A quantity that cannot step away and back between two rows: its mass or capacity forbids it.
INERT: Final = frozenset[Quantity | None]((
    "x", "y", "height", "heading", "roll", "pitch", "joint position", "voltage", "temperature",
    "percentage", "energy",
))  # fmt: skip
ANGLES: Final = frozenset[Quantity | None](("heading", "roll", "pitch", "joint position", "angle"))
_NO_SENSOR: Final = frozenset[Quantity | None]((
    None, "colour", "count", "flag", "mode", "text", "time",
))  # fmt: skip
_CHOICES: Final[dict[str, tuple[str, ...]]] = {
    "quantity": QUANTITIES, "role": ROLES, "side": SIDES,
}  # fmt: skip
_DIRECTIONS: Final = frozenset(
    ("front", "rear", "left", "right", "center", "middle", "side", "sensor", "obstacle")
)
_NO_SPEED: Final = frozenset((
    "position", "angle", "tick", "distance", "torque", "force", "current", "power", "temperature",
    "radius", "base", "track", "width", "slip", "contact", "gain", "count", "voltage", "limit",
    "encoder", "odometry",
))  # fmt: skip
_OF_SPEEDS: Final = frozenset((
    "speed", "velocity", "robot", "forward", "linear", "command", "target", "measured", "actual",
    "m", "mm", "cm", "s", "km", "h", "kmh", "kph", "ps", "mps", "setpoint", "desired", "reference",
    "body", "gps", "base", "odometry", "sensor",
))  # fmt: skip

# Branches that hold all sorts of things of the robot itself.
_CONTAINERS: Final = frozenset((
    "state", "status", "data", "value", "telemetry", "reading", "measurement", "observation", "obs",
    "info", "message", "msg", "payload", "robot", "rover", "vehicle", "self", "own",
))  # fmt: skip
_CLOCKS: Final = frozenset(("time", "timestamp", "stamp", "t", "clock", "step", "sim"))
# Words that say something of what stands below them.
_TELLING: Final = frozenset((
    *_COMMAND, *_TARGET, *_LIMIT, *_MEASURED, *_COUNTS, *_JOINTS, *HOLDING, *_FREE_MOTORS, *INPUTS,
    *_HEADINGS, *_OF_HEADINGS, *_TURNING, *_HEIGHTS, *_GYROS, *_WORD_QUANTITIES, *_DIRECTIONS,
    *_NO_SPEED, *_OF_SPEEDS, *_SIDES, *_ENDS, *_SHORT_FORMS.values(), *BRANCHES, *ELSEWHERE,
    "wheel", "motor", "camera", "display", "led", WORLD, SOLIDS, OBSERVED,
))  # fmt: skip


class RememberedMeanings(NamedTuple):
    """Sizes of caches.

    Attributes:
        names: Names whose words are cached.
        robots: Lists of names whose meanings are cached.
    """

    names: int = 4096
    robots: int = 16


_CACHE: Final = RememberedMeanings()


class BehaviourRules(NamedTuple):
    """What the values of an unknown signal must show before a meaning follows.

    Attributes:
        turn_share: Share of a turn that an angle jumps at the end of its scale.
        levels: Different values up to which a signal counts as quantised.
        values: Number of values from which something follows.
    """

    turn_share: float = 0.9
    levels: int = 8
    values: int = 20


_BEHAVIOUR: Final = BehaviourRules()


@lru_cache(maxsize=_CACHE.names)
def words_in(name: str) -> tuple[str, ...]:
    """Return the words of a dotted name in their long, singular form: `motorsCmd.0`, motor command.

    Numbers of items are left out.
    """
    words = (word for part in name.split(".") for word in words_of(part) if word)
    found: list[str] = []
    for word in words:
        word = word.rstrip("0123456789")
        if not word:
            continue
        singular = word[:-1] if len(word) > 3 and word.endswith("s") and word[-2] != "s" else word
        found.append(_SHORT_FORMS.get(singular, _SHORT_FORMS.get(word, singular)))
    return tuple(found)


def own_names(names: Iterable[str]) -> dict[str, str]:
    """Return each of a robot's names without leading branches that say nothing of what it means.

    `state.gps.x` means what `gps.x` does, and where all that a robot publishes stands under one
    key, such as its own name, that key says nothing. Times may stand next to it. Names of which the
    same would be left stay whole: `state.gps.x` next to `gps.x` is another signal.
    """
    found = _without_shared({name: _without_containers(name) for name in names})
    often = Counter(found.values())
    return {name: own if often[own] == 1 else name for name, own in found.items()}


def _without_shared(found: dict[str, str]) -> dict[str, str]:
    """Return names without the key below which all of them stand, if there is one."""
    tops = {
        own.partition(".")[0]
        for own in found.values()
        if "." in own or _CLOCKS.isdisjoint(words_in(own))
    }
    if len(tops) != 1 or not _TELLING.isdisjoint(words_in(top := next(iter(tops)))):
        return found
    below = f"{top}."
    parts = [own.removeprefix(below) for own in found.values() if own.startswith(below)]
    if not parts or any(part[:1].isdigit() for part in parts):  # items of one array
        return found
    return {name: _without_containers(own.removeprefix(below)) for name, own in found.items()}


@lru_cache(maxsize=_CACHE.names)
def _without_containers(name: str) -> str:
    top, _, rest = name.partition(".")
    while rest and not rest[0].isdigit() and _CONTAINERS.issuperset(words_in(top)):
        name = rest
        top, _, rest = name.partition(".")
    return name


@lru_cache(maxsize=_CACHE.names)
def side_in(name: str) -> str | None:
    """Return the side in a name, such as `left` or `front right`; None without one."""
    words = words_in(name)
    side = next((_SIDES[word] for word in words if word in _SIDES), None)
    end = next((_ENDS[word] for word in words if word in _ENDS), None)
    if side is None or " " in side or end is None:
        return side
    return f"{end} {side}"


def understood_words() -> dict[str, list[str]]:
    """Return the words and units of names that are understood, by what they say.

    They are given in the long, singular form. The documentation shows this list.
    """
    said: dict[str, set[str]] = {}
    for word, quantity in (*_WORD_QUANTITIES.items(), *_MORE_UNITS.items()):
        said.setdefault(quantity, set()).add(word)
    for unit, quantity in _UNIT_QUANTITIES.items():
        said.setdefault(quantity, set()).add(unit)
    groups = {
        "role commanded": _COMMAND,
        "role target": _TARGET,
        "role limit": _LIMIT,
        "role measured": _MEASURED,
        "side": frozenset((*_SIDES, *_ENDS)),
        **said,
        "speed, with unit or alone": frozenset(("speed", "velocity")),
        "wheel speed": frozenset(("wheel",)),
        "turn rate": _TURNING | {"yaw", "heading"},
        "joint position or joint speed": _JOINTS,
        "motor speed, not of a wheel": _FREE_MOTORS,
        "angular velocity": said.get("angular velocity", set()) | _GYROS,
        "height, with a unit of length": _HEIGHTS,
        "count": _COUNTS,
        "moved by hand, no position": INPUTS,
    }
    return {meaning: sorted(words) for meaning, words in groups.items()}


def declaration_of(name: str) -> str:
    """Return the call that declares a signal, with its quantity and its role left open."""
    return f"webots_describe_signals(signals={[name]}, quantity='...', role='...')"


def short_forms() -> dict[str, str]:
    """Return the short forms that are understood, with the long form of each."""
    return dict(sorted(_SHORT_FORMS.items()))


# -- meanings ----------------------------------------------------------------------------------


class Meaning(NamedTuple):
    """What a signal means.

    Attributes:
        quantity: What is measured or set; None where that is unknown.
        role: Whether it is measured, commanded, a target or a limit; None where that is open.
        unit: Its unit.
        target_of: The signal whose target this is.
        same_as: The signal that measures the same thing.
        side: Which part of the robot it is of.
        low: The lowest value it can have; `high` the highest.
        limits_by: Where `low` and `high` are known from.
        source: Where the meaning is known from.
        why: The reason, for a person.
    """

    quantity: Quantity | None = None
    role: Role | None = None
    unit: str | None = None
    target_of: str | None = None
    same_as: str | None = None
    side: str | None = None
    low: float | None = None
    high: float | None = None
    limits_by: Source = "unknown"
    source: Source = "unknown"
    why: str = ""

    @property
    def is_firm(self) -> bool:
        """Whether a failure may rest on it."""
        return self.source in FIRM

    @property
    def is_sensed(self) -> bool:
        """Whether it is the reading of a sensor: a known quantity that nobody set or counted."""
        return self.quantity not in _NO_SENSOR and self.role in (None, "measured")

    @property
    def words(self) -> str | None:
        """What it is in words, such as `commanded wheel speed, left`; None where it is unknown."""
        if self.quantity is None:
            return None
        said = " ".join(filter(None, (self.role, self.quantity)))
        return f"{said}, {self.side}" if self.side else said

    @property
    def sets(self) -> bool:
        """Whether it says what is wanted, not what is."""
        return self.role in ("commanded", "target")


UNKNOWN: Final = Meaning(why="its name does not say what it is")


def meaning_by_name(
    name: str, kind: str, register_role: str | None = None, names: Iterable[str] = ()
) -> Meaning:
    """Return what a signal's name and kind tell.

    Args:
        name: The signal.
        kind: `num`, `bool`, `text`, `angle` or `null`, as the register has it.
        register_role: Its role in the register: `x`, `yaw`, `mode`, `wheel` and so on.
        names: All names of the robot, of which partners are found.
    """
    base = (register_role or "").rstrip("0123456789")
    if name.startswith(_OF_OTHERS):
        return Meaning(why="an observer saw it: it is of a body, not of the robot's own devices")
    if base == "mode":
        return _named("mode", None, name, "its name is one of a mode")
    if kind == "bool":
        return _named("flag", _role_in(name), name, "it is true or false")
    if kind == "text":
        return _named("text", _role_in(name), name, "it is a text")
    if kind == "null":
        return UNKNOWN
    names = frozenset(names)
    if (array := _array_reduced_to(name, names)) is not None:
        return _of_reduction(name, array, names)
    if base in _OF_POSES:
        return _named(
            _OF_POSES[base], _role_in(name) or "measured", name, "its name is one of a pose"
        )
    quantity = _quantity_in(name, kind, base, names)
    if quantity is None:
        return UNKNOWN
    return _named(quantity, _role_of(name, quantity, base), name, f"its name says {quantity}")


def _array_reduced_to(name: str, names: frozenset[str]) -> str | None:
    """The array that a number sums up: of one that is reduced each of the reductions is there."""
    array, _, last = name.rpartition(".")
    if not array or last not in REDUCTIONS:
        return None
    return array if all(f"{array}.{each}" in names for each in REDUCTIONS) else None


def _of_reduction(name: str, array: str, names: Iterable[str]) -> Meaning:
    """Return the meaning of a reduction: minimum, maximum and mean have the array's quantity."""
    last = name.rpartition(".")[2]
    if last in ("count", "argmin"):
        why = "how many items an array has" if last == "count" else "which item is the least"
        return _named("count", "measured", name, why)
    of_array = meaning_by_name(array, "num", None, names)
    if of_array.quantity is None:
        return of_array
    return of_array._replace(why=f"{of_array.why}; it is the {last} of an array")


def meanings_by_name(
    kinds: Mapping[str, str], register_roles: Mapping[str, str]
) -> dict[str, Meaning]:
    """Return the meaning of each of a robot's signals, as far as their names tell.

    Args:
        kinds: The kind of each signal.
        register_roles: The roles of those that have one.
    """
    asked = tuple((name, kind, register_roles.get(name)) for name, kind in kinds.items())
    return dict(_meanings_of_all(asked))


@lru_cache(maxsize=_CACHE.robots)  # a question about many runs asks of the same names
def _meanings_of_all(asked: tuple[tuple[str, str, str | None], ...]) -> dict[str, Meaning]:
    own = own_names(name for name, _, _ in asked)
    names = frozenset(own.values())
    return {name: meaning_by_name(own[name], kind, role, names) for name, kind, role in asked}


# -- meanings that only the values tell ----------------------------------------------------------


def meaning_by_behaviour(values: Sequence[float]) -> Meaning:
    """Return what the values of a signal tell where neither a person, a device nor its name does.

    Args:
        values: Finite ones, in order; a part of them is enough.

    Returns:
        A meaning of the source `behaviour`, on which a warning may rest; else an unknown one. What
        is constant or quantised has no quantity.
    """
    if len(values) < _BEHAVIOUR.values:
        return UNKNOWN
    levels = set(values)
    if len(levels) == 1:
        return _behaves(None, "its value never changed")
    if levels == {0.0, 1.0}:
        return _behaves("flag", "its values are 0 and 1")
    steps = [after - before for before, after in pairwise(values) if after != before]
    rises = [step for step in steps if step > 0]
    is_whole = all(value == int(value) for value in values)
    falls = [after for before, after in pairwise(values) if after < before]
    falls_to_start = not falls or max(falls) <= min(levels) + 1
    if (
        is_whole
        and falls_to_start
        and len(rises) > len(steps) / 2
        and len(levels) > _BEHAVIOUR.levels
    ):
        return _behaves("count", "its whole numbers only rise, or begin again")
    for turn, unit in ((math.tau, "rad"), (360.0, "deg")):
        fits = max(map(abs, values)) <= turn * 1.01 and max(values) - min(values) <= turn * 1.01
        leaps = [step for step in steps if abs(step) >= _BEHAVIOUR.turn_share * turn]
        others = [abs(step) for step in steps if abs(step) < _BEHAVIOUR.turn_share * turn]
        if fits and leaps and others and max(others) < turn / 4:
            angle = _behaves("heading", "it leaps by a full turn, as an angle does")
            return angle._replace(unit=unit)
    if len(levels) <= _BEHAVIOUR.levels:
        return _behaves(None, f"it has only {len(levels)} different values")
    return UNKNOWN


def _behaves(quantity: Quantity | None, why: str) -> Meaning:
    return Meaning(quantity, source="behaviour", why=why)


# -- meanings that are declared, or known from a device ------------------------------------------


class DeclaredMeaning(NamedTuple):
    """What is said of a signal; None where nothing is said. The fields are those of `Meaning`."""

    name: str
    quantity: Quantity | None = None
    role: Role | None = None
    unit: str | None = None
    target_of: str | None = None
    same_as: str | None = None
    side: str | None = None
    low: float | None = None
    high: float | None = None


MEANING_FIELDS: Final = DeclaredMeaning._fields[1:]


class StatedMeaning(NamedTuple):
    """What a source says of a signal.

    Attributes:
        said: What it says.
        source: `declared` or `device`.
        why: The reason, for a person.
    """

    said: DeclaredMeaning
    source: Source
    why: str


def declare_meaning(name: object, /, **said: object) -> DeclaredMeaning:
    """Return a declaration that is checked as a whole.

    Args:
        name: The signal, or a pattern in which `*` stands for any text.
        said: Values by the names in `MEANING_FIELDS`. None is the same as leaving one out.

    Raises:
        ValueError: A value is not allowed, or nothing is said. The text names what is allowed.
    """
    name = _signal_name("name", name)
    given = {field: value for field, value in said.items() if value is not None}
    if unknown := sorted(given.keys() - set(MEANING_FIELDS)):
        fields = ", ".join(MEANING_FIELDS)
        raise ValueError(f"unknown field {unknown[0]!r} of signal {name!r}. Fields: {fields}")
    if not given:
        fields = ", ".join(MEANING_FIELDS)
        raise ValueError(f"Nothing is declared for signal {name!r}. Give one or more of {fields}")
    checked = {field: _checked(name, field, value) for field, value in given.items()}
    low, high = checked.get("low"), checked.get("high")
    if low is not None and high is not None and low > high:
        raise ValueError(
            f"Signal {name!r}: low={low:g} is greater than high={high:g}. Swap the two."
        )
    return DeclaredMeaning(name, **checked)


def _checked(name: str, field: str, value: object) -> Any:
    if field in _CHOICES:
        if value not in _CHOICES[field]:
            allowed = ", ".join(_CHOICES[field])
            raise ValueError(
                f"signal {name!r}: {field} cannot be {value!r:.80}. Use one of {allowed}"
            )
        return value
    if field in ("target_of", "same_as"):
        other = _signal_name(field, value)
        if other == name or "*" in other:
            raise ValueError(f"signal {name!r}: {field} must be the name of one other signal")
        return other
    if field == "unit":
        if not isinstance(value, str) or not value or not value.isprintable():
            raise ValueError(_BAD_UNIT.format(name, _LONGEST_UNIT, f"{value!r:.80}"))
        if len(value) > _LONGEST_UNIT:
            raise ValueError(_BAD_UNIT.format(name, _LONGEST_UNIT, f"{value!r:.80}"))
        return _UNITS.get(value.lower(), value)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not _is_finite(value):
        raise ValueError(f"signal {name!r}: {field} must be a finite number, not {value!r:.80}")
    return float(value)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def _signal_name(field: str, value: object) -> str:
    if isinstance(value, str) and value.isprintable() and 0 < len(value) <= LONGEST_NAME:
        return value
    raise ValueError(
        f"{field} must be the name of a signal, such as 'motors.left', not {value!r:.80}"
    )


def fits_pattern(pattern: str, name: str) -> bool:
    """Return whether a pattern fits a name: `*` stands for any text, and nothing else is special.

    In one pass: a regular expression tries all ways, which a long name makes many.
    """
    first, *parts = pattern.split("*")
    if not parts:
        return name == first
    at = len(first) if name.startswith(first) else -1
    for part in parts[:-1]:
        found = name.find(part, at) if at >= 0 else -1
        at = found + len(part) if found >= 0 else -1
    return at >= 0 and name.endswith(parts[-1], at)


def meaning_stated(name: str, stated: Sequence[StatedMeaning], named: Meaning) -> Meaning:
    """Return what a signal means by all that is said of it and by its name.

    Each field is that of the strongest source that says it. Unit, limits and role of a weaker
    source count only where the stronger one does not say another quantity.

    Args:
        name: The signal.
        stated: What is said of it, the strongest first.
        named: The meaning of its name.
    """
    meaning = named
    for each in reversed(stated):
        meaning = _stated_over(name, each, meaning)
    return meaning


def _stated_over(name: str, stated: StatedMeaning, weaker: Meaning) -> Meaning:
    said = stated.said
    quantity = said.quantity or weaker.quantity
    agrees = weaker.quantity in (None, quantity)
    role = said.role or (weaker.role if agrees else None)
    if role is None and quantity is not None:
        role = _role_of(name, quantity, "")
    decides = said.quantity is not None or weaker.quantity is None
    low, high, limits_by = said.low, said.high, stated.source
    if low is None and high is None and agrees:
        low, high, limits_by = weaker.low, weaker.high, weaker.limits_by
    return Meaning(
        quantity,
        role,
        said.unit or (weaker.unit if agrees else None) or unit_in(name),
        said.target_of or weaker.target_of,
        said.same_as or weaker.same_as,
        said.side or weaker.side or side_in(name),
        low,
        high,
        limits_by,
        stated.source if decides else weaker.source,
        stated.why if decides else f"{weaker.why}; {stated.why}",
    )


def targets_in(meanings: Mapping[str, Meaning]) -> list[tuple[str, str]]:
    """Return the pairs of a measured signal and its target.

    Declared ones count first; a signal that is the same as another one has its target too. Else
    both have the same quantity, or one of them none that is known, and the same words but for those
    of a role and of the quantity itself: `elbow.pos` and `elbow.target`, `wheels.left.velocity` and
    `wheels.left.target`.
    """
    found: dict[str, str] = {
        each.target_of: name
        for name, each in meanings.items()
        if each.target_of is not None and each.target_of in meanings
    }
    for name, each in meanings.items():
        if each.same_as is not None and each.same_as in meanings and not each.sets:
            for one, other in ((name, each.same_as), (each.same_as, name)):
                if other in found:
                    found.setdefault(one, found[other])
    by_subject: dict[tuple[frozenset[str], tuple[str, ...]], list[str]] = {}
    for name, meaning in meanings.items():
        if meaning.sets or (meaning.quantity is None and _role_in(name) in ("commanded", "target")):
            by_subject.setdefault(_subject_of(name), []).append(name)
    for name, meaning in meanings.items():
        if name in found or meaning.sets or meaning.role == "limit" or not _subject_of(name)[0]:
            continue
        for target in by_subject.get(_subject_of(name), ()):
            quantities = {meaning.quantity, meanings[target].quantity} - {None}
            if target != name and len(quantities) <= 1 and meanings[target].target_of is None:
                found[name] = target
                break
    return list(found.items())


@lru_cache(maxsize=_CACHE.names)
def _subject_of(name: str) -> tuple[frozenset[str], tuple[str, ...]]:
    """The words of a name without those of its role and quantity, and its numbers of items."""
    words = (word for part in name.split(".") for word in words_of(part))
    items = tuple(
        word[len(stem) :]
        for word in words
        for stem in [word.rstrip("0123456789")]
        if stem != word and stem not in _NOT_OF_SUBJECT  # the 2 of m/s2 is of a unit
    )
    return frozenset(words_in(name)) - _NOT_OF_SUBJECT, items


def _named(quantity: Quantity, role: Role | None, name: str, why: str) -> Meaning:
    unit = unit_in(name)
    return Meaning(quantity, role, unit, side=side_in(name), source="named", why=why)


@lru_cache(maxsize=_CACHE.names)
def is_asked_for(name: str) -> bool:
    """Return whether a name is of a command, a target or an input: of nothing measured."""
    words = frozenset(words_in(name))
    return bool(words & (_COMMAND | _TARGET | INPUTS))


def _role_in(name: str) -> Role | None:
    words = frozenset(words_in(name))
    if words & _COMMAND:
        return "commanded"
    if words & _TARGET:
        return "target"
    if words & _LIMIT:
        return "limit"
    return "measured" if words & _MEASURED else None


def _role_of(name: str, quantity: Quantity, base: str) -> Role | None:
    if base.startswith("commanded"):
        return "commanded"
    found = _role_in(name)
    if found is not None or quantity in ("speed", "turn rate", "wheel speed", "motor speed"):
        return found  # of a speed without such a word it is open whether it was measured
    return "measured"


def _quantity_in(name: str, kind: str, base: str, names: frozenset[str]) -> Quantity | None:
    words, unit, last = words_in(name), unit_in(name), words_of(name.rpartition(".")[2])[-1]
    said = frozenset(words)
    if _COUNTS & {words[-1] if words else "", *words[-2:-1]} and unit is None and kind == "num":
        return "count"
    if motion := _motion_in(name, base, said, unit, names):
        return motion
    if unit in _UNIT_QUANTITIES:
        return _UNIT_QUANTITIES[unit]
    if last in _MORE_UNITS and len(words) > 1:
        return _MORE_UNITS[last]
    if last in ("roll", "pitch") and unit in (None, "rad", "deg"):
        return cast("Quantity", last)
    if (turned := _ATTITUDE_ITEMS.search(name)) is not None and "rpy" in said:
        return _ATTITUDE[int(turned[1])]
    if kind == "angle" or angle_unit(name) is not None or unit in ("rad", "deg"):
        if said & _JOINTS:
            return "joint position"
        if said & _HEADINGS and said <= _HEADINGS | _OF_HEADINGS:
            return "heading"
        if "roll" in said:
            return "roll"
        return "pitch" if "pitch" in said else None
    if unit in ("m", "cm", "mm", "km") and not said & _JOINTS:
        return "height" if said & _HEIGHTS else "distance"
    for word in words:
        if word in _WORD_QUANTITIES:
            return _WORD_QUANTITIES[word]
    if said & _JOINTS and said & {"position", "angle", *_TARGET, *_COMMAND}:
        return "joint position"
    if unit in ("rad/s", "deg/s"):
        return "angular velocity"
    # What a robot has in front is a distance: a wheel or a motor there says that it is one.
    return "distance" if said & {"front", "rear"} and said <= _DIRECTIONS else None


def _motion_in(
    name: str, base: str, said: frozenset[str], unit: str | None, names: frozenset[str]
) -> Quantity | None:
    """Return which speed it is, of robot, wheel, motor or joint; None where it is no speed."""
    is_rate = unit in ("rad/s", "deg/s", "rpm")
    is_speed = bool(said & {"speed", "velocity"}) or unit in ("m/s", "cm/s", "mm/s", "km/h")
    if not (
        is_rate
        or is_speed
        or base in ("commanded_speed", "speed", "wheel", "commanded_wheel")
        or said & {"command", "motor", "wheel"}
    ):
        return None
    if said & _FREE_MOTORS:
        return "motor speed"
    if said & _JOINTS:
        return "joint speed" if is_rate or is_speed else None
    if not (is_rate or is_speed) and (unit in ("rad", "deg") or _is_sensor_of_turns(name)):
        return None  # how far it has turned
    if "wheel" in said and not said & _NO_SPEED:
        return "wheel speed"
    if said & _GYROS:
        return "angular velocity"
    if said & _TURNING and (is_rate or is_speed or said & _COMMAND):
        last = name.rpartition(".")[2]
        return "turn rate" if last not in ("x", "y", "0", "1") else None
    if said & {"yaw", "heading"} and (is_rate or "rate" in said):
        return "turn rate"
    side = side_in(name)
    if base in ("wheel", "commanded_wheel"):
        # Motors without a side may be those of propellers or of anything else.
        return "wheel speed" if side or base == "commanded_wheel" else "motor speed"
    if side and is_speed and not said & _NO_SPEED and _has_other_side(name, side, names):
        return "wheel speed"
    if base in ("commanded_speed", "speed"):
        return "speed"
    if is_speed and said <= _OF_SPEEDS:
        return "speed"
    return None


def _is_sensor_of_turns(name: str) -> bool:
    """Return whether it is a position sensor of a wheel or a motor, which gives an angle."""
    parts = (frozenset(words_in(part)) for part in name.split("."))
    return any("sensor" in words and words & {"wheel", "motor"} for words in parts)


def _has_other_side(name: str, side: str, names: frozenset[str]) -> bool:
    """Return whether a signal of the other side has the same words otherwise."""
    other = {"left": "right", "right": "left"}
    own = tuple(other.get(word, word) for word in words_in(name))
    return any(words_in(each) == own for each in names if each != name)
