"""The values of fields of the scene tree: check, read, write and compare them.

Webots' package accepts exact types only and reports others by printing, so every value is checked
before it is written.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, cast

from webots_mcp.errors import InvalidInputError

MOST_ENTRIES: Final = 200  # of a field that are set at once: each is a request to Webots
MOST_CHARACTERS: Final = 10_000  # of one text
# Fields that name programs that Webots runs: it searches each in its folder of the project.
_PROGRAMS: Final = ("controller", "window", "remoteControl", "physics")


@dataclass(frozen=True)
class FieldPrecision:
    """Webots' precision of numbers in fields.

    Attributes:
        largest: Largest number that Webots accepts.
        tolerance: Relative difference that counts as equal: Webots may store a value in single
            precision.
    """

    largest: float = 3.4028234e38
    tolerance: float = 1e-6


_PRECISION: Final = FieldPrecision()


def checked(path: str, type_name: str, value: object) -> Any:
    """Return a value in the type that Webots' package accepts.

    Raises:
        InvalidInputError: If the field has another type; the text shows an example.
    """
    many, kind = type_name.startswith("MF"), _KINDS.get(type_name[2:])
    if kind is None:
        raise InvalidInputError(
            f"{path} contains nodes ({type_name}): webots_add_node and webots_remove_node change "
            "them; "
            f"to set a field of a node in it, extend the path, such as {path}"
            f"{'[0]' if many else ''}.name"
        )
    try:
        if not many:
            return kind.convert(value)
        values = cast("list[Any]", value)
        if not isinstance(value, list) or len(values) > MOST_ENTRIES:
            raise _RefusedError
        return [kind.convert(each) for each in values]
    except _RefusedError:
        expected = f"{kind.expected}, such as {kind.example}"
        if many:
            expected = f"a list of at most {MOST_ENTRIES}, each {expected}: [{kind.example}]"
        raise InvalidInputError(
            f"{path} is of type {type_name}: give {expected}; got {value!r:.100}"
        ) from None


def require_no_path(field: str, value: object) -> None:
    """Refuse a path in a field that names a program: it could start one outside of the project.

    Raises:
        InvalidInputError: If the value is a path.
    """
    if field not in _PROGRAMS or not isinstance(value, str):
        return
    if value == ".." or any(each in value for each in "/\\"):
        raise InvalidInputError(
            f"{field} must be the name of a program in its folder of the project, not a path: "
            f"{value!r:.200}"
        )


def read(field: Any, index: int | None = None) -> Any:
    """Read a field that holds no nodes, or one of its entries."""
    kind = str(field.getTypeName())[2:]
    if field.getCount() < 0:
        return _plain(kind, getattr(field, f"getSF{kind}")())
    get = getattr(field, f"getMF{kind}")
    if index is not None:
        return _plain(kind, get(index))
    return [_plain(kind, get(each)) for each in range(field.getCount())]


def read_entries(field: Any, start: int, most: int) -> list[Any]:
    """Read up to `most` entries of a multi-valued field, from index `start` on."""
    return [read(field, index) for index in range(start, min(start + most, field.getCount()))]


def write(field: Any, value: Any, index: int | None = None) -> None:
    """Set a field, or one entry of it, to a checked value; Webots does so with the next step."""
    kind = str(field.getTypeName())[2:]
    if field.getCount() < 0:
        getattr(field, f"setSF{kind}")(value)
    elif index is not None:
        getattr(field, f"setMF{kind}")(index, value)
    else:
        _write_all(field, kind, value)


def is_same(type_name: str, one: Any, other: Any) -> bool:
    """Return whether two values are equal within the precision that Webots stores."""
    if type_name.startswith("MF"):
        single = f"SF{type_name[2:]}"
        return len(one) == len(other) and all(map(lambda a, b: is_same(single, a, b), one, other))
    return _distance(type_name, one, other) == 0.0


def is_nearer(type_name: str, value: Any, wanted: Any, before: Any) -> bool:
    """Return whether a value is closer to the wanted one than to the one before.

    Physics may have changed it since it was set, so that it equals neither.
    """
    if type_name.startswith("MF") or type_name[2:] in ("Bool", "Int32", "String"):
        return is_same(type_name, value, wanted)
    from_before = _distance(type_name, value, before)
    return _distance(type_name, value, wanted) <= from_before and from_before > 0.0


class _RefusedError(ValueError):
    """A value that a field cannot have."""


def _bool(value: object) -> bool:
    if not isinstance(value, bool):
        raise _RefusedError
    return value


def _int32(value: object) -> int:
    number = int(value) if isinstance(value, float) and value.is_integer() else value
    if isinstance(number, bool) or not isinstance(number, int) or not -(2**31) <= number < 2**31:
        raise _RefusedError
    return number


def _float(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _RefusedError
    if not abs(value) <= _PRECISION.largest:  # NaN as well
        raise _RefusedError
    return float(value)


def _string(value: object) -> str:
    if isinstance(value, (list, dict)):  # a JSON text that the client's SDK has already parsed
        value = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, str) or len(value) > MOST_CHARACTERS or "\0" in value:
        raise _RefusedError
    return value


def _floats(length: int) -> Callable[[object], list[float]]:
    def convert(value: object) -> list[float]:
        if not isinstance(value, list) or len(cast("list[Any]", value)) != length:
            raise _RefusedError
        return [_float(number) for number in cast("list[Any]", value)]

    return convert


def _color(value: object) -> list[float]:
    color = _floats(3)(value)
    if not all(0.0 <= part <= 1.0 for part in color):
        raise _RefusedError
    return color


def _rotation(value: object) -> list[float]:
    rotation = _floats(4)(value)
    if not any(rotation[:3]):
        raise _RefusedError
    return rotation


class _Kind(NamedTuple):
    convert: Callable[[object], Any]
    expected: str
    example: str


_KINDS: Final[dict[str, _Kind]] = {
    "Bool": _Kind(_bool, "true or false", "true"),
    "Int32": _Kind(_int32, "a whole number of 32 bits", "3"),
    "Float": _Kind(_float, "a finite number", "0.5"),
    "Vec2f": _Kind(_floats(2), "2 finite numbers", "[0.5, 1]"),
    "Vec3f": _Kind(_floats(3), "3 finite numbers", "[0, 0.5, 0.1]"),
    "Rotation": _Kind(_rotation, "an axis (not 0 0 0) and an angle in rad", "[0, 0, 1, 1.57]"),
    "Color": _Kind(_color, "red, green and blue, each from 0 to 1", "[1, 0.5, 0]"),
    "String": _Kind(_string, f"a text of at most {MOST_CHARACTERS} characters", '"text"'),
}


def _plain(kind: str, value: Any) -> Any:
    return bool(value) if kind == "Bool" else value


def _write_all(field: Any, kind: str, values: Sequence[Any]) -> None:
    """Set the existing entries, then insert missing ones or remove surplus ones."""
    set_entry, count = getattr(field, f"setMF{kind}"), field.getCount()
    for index, value in enumerate(values[:count]):
        set_entry(index, value)
    for index in range(count, len(values)):
        getattr(field, f"insertMF{kind}")(index, values[index])
    for index in range(count - 1, len(values) - 1, -1):
        field.removeMF(index)


def _distance(type_name: str, one: Any, other: Any) -> float:
    """Return the distance of two single values; 0 within the precision that Webots stores."""
    if type_name[2:] in ("Bool", "Int32", "String"):
        return float(one != other)
    a, b = _as_vector(type_name, one), _as_vector(type_name, other)
    apart = math.dist(a, b)
    if type_name == "SFRotation":  # a quaternion and its negative are one rotation
        apart = min(apart, math.dist(a, [-part for part in b]))
    return apart if apart > _PRECISION.tolerance * max(1.0, *map(abs, a)) else 0.0


def _as_vector(type_name: str, value: Any) -> list[float]:
    if type_name == "SFFloat":
        return [value]
    return _quaternion(value) if type_name == "SFRotation" else value


def _quaternion(rotation: Sequence[float]) -> list[float]:
    *axis, angle_rad = rotation
    length = math.hypot(*axis) or 1.0
    sine = math.sin(angle_rad / 2.0) / length
    return [math.cos(angle_rad / 2.0), *(sine * part for part in axis)]
