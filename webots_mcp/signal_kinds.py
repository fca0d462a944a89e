"""What a name and its values tell of a signal, and where its value stands in a recorded state.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Container
from typing import Any, Final, Literal, NamedTuple, cast

from webots_mcp.naming import (
    LONGEST_SPREAD_ARRAY,
    REDUCTIONS,
    Value,
    angle_unit,
    in_snake_case,
    unit_in,
)

Kind = Literal["num", "bool", "text", "angle", "null"]
MAX_ANGLE_RAD: Final = 6.3  # a value beyond is in degrees, or turns were counted
MAX_YAW_RAD: Final = 3.2  # the last item of a pose that goes beyond is no yaw

_END_OF_POSE: Final = re.compile(r"(^|[._])(?:pose|odom|odometry)\.([235])$")


class Place(NamedTuple):
    """Where a signal's value stands in a state row.

    Attributes:
        path: For `json_extract(state.data, path)`.
        reduction: None, or how the long array at `path` becomes one number.
    """

    path: str
    reduction: str | None


def places(state: dict[str, Any]) -> dict[str, Place]:
    """Where each leaf of a state stands; the same names as `flatten`, but slower."""
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
    """What a single value says about its signal; an angle also by the signal's name.

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
    limit = MAX_YAW_RAD if ends_pose else MAX_ANGLE_RAD if angle_unit(name) == "rad" else -1.0
    return "angle" if abs(value) <= limit else "num"


def turn_of(name: str, kind: Kind) -> float | None:
    """A whole turn of an angle: 2 pi, or 360 where the name says degrees; else None."""
    if kind == "angle":
        return math.tau
    return 360.0 if kind == "num" and angle_unit(name) == "deg" else None


def ends_pose(name: str, names: Container[str]) -> bool:
    """Whether it is the last of three, four or six items of a pose or of odometry.

    There the yaw stands, if anywhere: `[x, y, yaw]`, `[x, y, z, yaw]`, `[x, y, z, roll, pitch,
    yaw]`.
    """
    last = _END_OF_POSE.search(in_snake_case(name))
    return last is not None and f"{name[:-1]}{int(last[2]) + 1}" not in names


def widen(known: Kind, seen: Kind) -> Kind:
    """The kind of a signal that was `known` when a value of kind `seen` comes."""
    if known == seen or seen == "null":
        return known
    if known == "null":
        return seen
    return "text" if "text" in (known, seen) else "num"


def unit_of(name: str, kind: Kind) -> str | None:
    """The unit, where a part of the name ends in one (`speed_m_s`, `distance_m.left`)."""
    if kind == "angle":
        return "rad"
    if kind != "num" or name.rpartition(".")[2] in ("count", "argmin"):
        return None
    return unit_in(name)
