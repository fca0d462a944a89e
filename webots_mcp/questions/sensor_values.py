"""Sensor values in a published state.

A member of the state counts if it is named after a sensor device, or contains a word for a sensor.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final, cast

# Webots device classes that are not sensors.
_NO_SENSORS: Final = (
    "Brake", "Connector", "Display", "Emitter", "LED", "LinearMotor", "Motor", "Muscle", "Pen",
    "Propeller", "RotationalMotor", "Skin", "Speaker", "Track", "VacuumGripper",
)  # fmt: skip
_WORDS: Final = (
    "sensor", "lidar", "gps", "imu", "inertial", "compass", "gyro", "accel", "encoder", "touch",
    "bumper", "distance", "range", "radar", "sonar", "light", "altimeter", "camera", "odometry",
    "battery", "force", "contact", "scan",
)  # fmt: skip


def sensor_part(state: dict[str, Any], devices: dict[str, str]) -> dict[str, Any]:
    """Return the members of a state that are named after a sensor, or contain a sensor's word."""
    sensors = _sensor_devices(devices)
    return {key: state[key] for key in state if key in sensors or _has_sensor_word(key)}


def _sensor_devices(devices: dict[str, str]) -> dict[str, str]:
    """Return the devices that are sensors: name to class."""
    return {name: kind for name, kind in devices.items() if kind not in _NO_SENSORS}


def unnamed_devices(state: dict[str, Any], devices: dict[str, str]) -> dict[str, str]:
    """Return the sensor devices whose name is in no name of the published values.

    The words of a name may be anywhere in a path: `front left`, `left_front` and `ds0` match
    `front: {left: 1}` and `ds: [1]`.
    """
    published = [_words(path) for path in _paths(state)]
    return {
        name: kind
        for name, kind in _sensor_devices(devices).items()
        if not any(_words(name) <= words for words in published)
    }


def _has_sensor_word(key: str) -> bool:
    return any(word in key.lower() for word in _WORDS)


def _paths(value: Any, path: str = "") -> Iterator[str]:
    """The path of each member at any depth, and of the first items of arrays."""
    yield path
    if isinstance(value, dict):
        for key, member in cast("dict[str, Any]", value).items():
            yield from _paths(member, f"{path}.{key}")
    elif isinstance(value, list):
        # Each item of an array may be a device.
        for index, item in enumerate(cast("list[Any]", value)[:64]):
            yield from _paths(item, f"{path}.{index}")


def _words(name: str) -> set[str]:
    return set(re.findall(r"[^\W\d_]+|\d+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).lower()))
