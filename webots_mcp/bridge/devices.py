"""Reading what a robot's enabled devices say, for `auto_publish`.

Nothing is enabled or changed here: a sensor's sampling period belongs to the user's code.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, Final

SECTORS: Final = 8

# Class name in Webots' `controller` package: how its value is read. Cameras, displays and
# radios have no number to publish and are left out.
_READERS: Final[dict[str, Callable[[Any], object]]] = {
    "Accelerometer": lambda device: device.getValues(),
    "Altimeter": lambda device: device.getValue(),
    "Compass": lambda device: device.getValues(),
    "DistanceSensor": lambda device: device.getValue(),
    "GPS": lambda device: device.getValues(),
    "Gyro": lambda device: device.getValues(),
    "InertialUnit": lambda device: device.getRollPitchYaw(),
    "Lidar": lambda device: _summarise_lidar(device),
    "LightSensor": lambda device: device.getValue(),
    "PositionSensor": lambda device: device.getValue(),
    "RangeFinder": lambda device: _summarise_range_finder(device),
    "TouchSensor": lambda device: _read_touch(device),
}


def read_devices(robot: Any) -> dict[str, object]:
    """The values of all enabled sensors, and what the motors were commanded.

    Returns:
        `sensors`: device name to value (float, list of floats, or for a lidar its summary);
        `motors`: device name to `target_position_rad` and `target_velocity_rad_s`, of a linear
            motor `target_position_m` and `target_velocity_m_s`;
        `pose`: [x_m, y_m, yaw_rad] from the first GPS and inertial unit, where both are enabled.
    """
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    sensors = {name: _read(device) for name, device in devices.items() if _is_enabled(device)}
    motors = {
        name: _commanded(device)
        for name, device in devices.items()
        if type(device).__name__ == "Motor"
    }
    state: dict[str, object] = {"sensors": sensors}
    if motors:
        state["motors"] = motors
    pose = _pose(devices)
    return {"pose": pose, **state} if pose else state


def _is_enabled(device: Any) -> bool:
    """A disabled sensor prints an error line at every reading."""
    return type(device).__name__ in _READERS and device.getSamplingPeriod() > 0


def _read(device: Any) -> object:
    return _READERS[type(device).__name__](device)


def _commanded(motor: Any) -> dict[str, float]:
    """Webots has one class for both kinds of motor."""
    unit = "m" if motor.getType() == motor.LINEAR else "rad"
    return {
        f"target_position_{unit}": motor.getTargetPosition(),
        f"target_velocity_{unit}_s": motor.getVelocity(),
    }


def _pose(devices: dict[str, Any]) -> list[float] | None:
    gps = _first_enabled(devices, "GPS")
    unit = _first_enabled(devices, "InertialUnit")
    if gps is None or unit is None:
        return None
    x_m, y_m, _ = gps.getValues()
    return [x_m, y_m, unit.getRollPitchYaw()[2]]


def _first_enabled(devices: dict[str, Any], kind: str) -> Any:
    found = (d for d in devices.values() if type(d).__name__ == kind and _is_enabled(d))
    return next(found, None)


def _read_touch(device: Any) -> object:
    """A force-3d sensor has a vector, the others a number."""
    if device.getType() != getattr(device, "FORCE3D", None):
        return device.getValue()
    force = device.getValues()  # in Webots a bare pointer to the three
    return [force[i] for i in range(3)] if force else None


def _summarise_lidar(device: Any) -> dict[str, object] | None:
    """Its image is layer after layer, each from left to right."""
    return _summarise_ranges(device, device.getHorizontalResolution())


def _summarise_range_finder(device: Any) -> dict[str, object] | None:
    """Its image is row after row, each from left to right."""
    return _summarise_ranges(device, device.getWidth())


def _summarise_ranges(device: Any, columns: int) -> dict[str, object] | None:
    """The nearest distance and where, and the minimum of eight sectors; None before data.

    Testing the raw pointer first matters: reading a null one can kill the interpreter.
    """
    if not device.range_image:
        return None
    ranges: list[float] = device.getRangeImage()
    directions = _column_minima(ranges, columns)
    nearest = min(filter(math.isfinite, directions), default=None)
    return {
        "count": len(ranges),
        "min_m": math.inf if nearest is None else nearest,
        "min_index": None if nearest is None else ranges.index(nearest),
        "sector_min_m": _sector_minima(directions),
    }


def _column_minima(ranges: list[float], columns: int) -> list[float]:
    """The nearest distance in each direction, over all layers or rows."""
    if not 0 < columns < len(ranges):
        return ranges
    rows = [ranges[i : i + columns] for i in range(0, len(ranges), columns)]
    return list(map(min, zip(*rows, strict=False)))


def _sector_minima(directions: list[float]) -> list[float]:
    """From left to right; of fewer than eight directions each is a sector of its own."""
    count = min(SECTORS, len(directions))
    bounds = [len(directions) * i // count for i in range(count + 1)]
    return [min(directions[i:j]) for i, j in pairwise(bounds)]
