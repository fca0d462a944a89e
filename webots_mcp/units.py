"""Units in names: `front_mm`, `speed_m_s`, `heading_deg`, `headingDeg`, `pose_cm.0`, `mmAlong`.

Recorded rows are judged by these units, and so are the states that a controller publishes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Final, Literal

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
_LONGEST_UNIT: Final = 3  # words: m_per_s
_ANGLES: Final = ("yaw", "heading", "theta", "bearing", "roll", "pitch")
_ANGLES_IF_UNIT: Final = (*_ANGLES, "course")  # a course without a unit may be of anything
_HUMP: Final = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_KEPT: Final = 4096  # names whose units are remembered


@lru_cache(maxsize=_KEPT)
def unit_in(name: str) -> str | None:
    """The unit that the last part of a name has, or else one before it; None without any."""
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
    return tuple(_HUMP.sub("_", part).lower().split("_"))


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
        for start in range(max(0, end - _LONGEST_UNIT), end):
            unit = "_".join(words[start:end])
            if unit in _UNITS and (len(unit) > 1 or part.lower().endswith(f"_{unit}")):
                return _UNITS[unit] if words.count("per") == unit.count("per") else None
    return None
