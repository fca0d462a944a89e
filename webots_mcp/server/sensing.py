"""Which part of a published state is sensor values."""

from __future__ import annotations

from typing import Any, Final, cast

# Webots device classes that sense nothing.
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
    """The members of a state that are named after a sensor of the robot, or like one."""
    sensors = sensor_devices(devices)
    return {key: state[key] for key in state if key in sensors or _sounds_like_a_sensor(key)}


def sensor_devices(devices: dict[str, str]) -> dict[str, str]:
    """The devices that sense: name to class."""
    return {name: kind for name, kind in devices.items() if kind not in _NO_SENSORS}


def unnamed_devices(sensors: dict[str, Any], devices: dict[str, str]) -> dict[str, str]:
    """The sensor devices whose name appears nowhere among the published values."""
    published = set(_keys(sensors))
    return {name: kind for name, kind in sensor_devices(devices).items() if name not in published}


def _sounds_like_a_sensor(key: str) -> bool:
    return any(word in key.lower() for word in _WORDS)


def _keys(value: Any) -> list[str]:
    if not isinstance(value, dict):
        return []
    members = cast("dict[str, Any]", value)
    return [*members, *(key for inner in members.values() for key in _keys(inner))]
