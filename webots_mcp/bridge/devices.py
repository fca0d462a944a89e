"""Reading what a robot's enabled devices say, for `auto_publish`.

Nothing is enabled, changed or taken here: a sensor's sampling period and a receiver's packets
belong to the user's code. What needs to be enabled is not read before, since Webots prints an error
line at every such reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from operator import methodcaller
from typing import Any, Final, NamedTuple, cast

SECTORS: Final = 8
MOST_OBJECTS: Final = 8  # of a camera or a radar that are told, the nearest first
_MOST_LOOKED_AT: Final = 64
_WGS84: Final = 1  # GPS.WGS84: degrees, not metres

Failed = Callable[[str, Exception], object]


class Rule(NamedTuple):
    """How the devices of a class are read.

    Attributes:
        group: The key of the state under which they stand.
        period_ms: The sampling period of what is read; 0 while it is disabled.
        read: What they say.
    """

    group: str
    period_ms: Callable[[Any], int]
    read: Callable[[Any], object]


def _sensor(read: Callable[[Any], object]) -> Rule:
    return Rule("sensors", methodcaller("getSamplingPeriod"), read)


def _actuator(group: str, read: Callable[[Any], object]) -> Rule:
    """What was commanded is known to the library, without enabling anything."""
    return Rule(group, _always, read)


def _always(_: Any) -> int:
    return 1


def read_devices(robot: Any, failed: Failed) -> dict[str, object]:
    """The values of all enabled sensors, and what the actuators were commanded.

    Args:
        robot: A Webots `Robot`.
        failed: Told of each device that could not be read, by name; it is left out.

    Returns:
        `sensors`: device name to value, as `RULES` says;
        `motors`: device name to `target_position_rad` and `target_velocity_rad_s`, of a linear
            motor `target_position_m` and `target_velocity_m_s`, and its feedback where enabled;
        `actuators`: device name to what it was set to;
        `battery_j`: the charge, where its sensor is enabled;
        `pose`: [x_m, y_m, yaw_rad] from the first GPS and inertial unit, where both are enabled.
    """
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    groups: dict[str, dict[str, object]] = {"sensors": {}}
    for name, device in devices.items():
        rule = RULES.get(type(device).__name__)
        try:
            if rule is not None and rule.period_ms(device) > 0:
                groups.setdefault(rule.group, {})[name] = rule.read(device)
        except Exception as error:  # noqa: BLE001  (the other devices have something to say)
            failed(name, error)
    return {**_pose(devices, groups["sensors"]), **groups, **_battery(robot)}


def _pose(devices: dict[str, Any], sensors: dict[str, object]) -> dict[str, object]:
    kinds = {type(devices[name]).__name__: name for name in reversed(sensors)}
    gps, unit = kinds.get("GPS"), kinds.get("InertialUnit")
    if gps is None or unit is None or devices[gps].getCoordinateSystem() == _WGS84:
        return {}
    (x_m, y_m, _), (*_, yaw) = cast("list[float]", sensors[gps]), cast("list[float]", sensors[unit])
    return {"pose": [x_m, y_m, yaw]}


def _battery(robot: Any) -> dict[str, object]:
    period_ms = getattr(robot, "batterySensorGetSamplingPeriod", None)
    return {"battery_j": robot.batterySensorGetValue()} if period_ms and period_ms() > 0 else {}


def _read_motor(motor: Any) -> dict[str, float]:
    """Webots has one class for both kinds of motor."""
    if motor.getType() == motor.LINEAR:
        unit, feedback, period_ms = "m", "force_feedback_n", motor.getForceFeedbackSamplingPeriod()
    else:
        unit, feedback = "rad", "torque_feedback_nm"
        period_ms = motor.getTorqueFeedbackSamplingPeriod()
    said = {
        f"target_position_{unit}": motor.getTargetPosition(),
        f"target_velocity_{unit}_s": motor.getVelocity(),
    }
    if period_ms > 0:
        measured = motor.getForceFeedback() if unit == "m" else motor.getTorqueFeedback()
        said[feedback] = measured
    return said


def _read_connector(connector: Any) -> dict[str, object]:
    return {"locked": connector.isLocked(), **_presence(connector)}


def _read_vacuum_gripper(gripper: Any) -> dict[str, object]:
    return {"on": gripper.isOn(), **_presence(gripper)}


def _presence(device: Any) -> dict[str, object]:
    """Whether there is something to hold; its sensor is enabled on its own."""
    enabled = device.getPresenceSamplingPeriod() > 0
    return {"presence": device.getPresence()} if enabled else {}


def _recognition_period(camera: Any) -> int:
    return camera.getRecognitionSamplingPeriod() if camera.hasRecognition() else 0


def _summarise_recognised(camera: Any) -> dict[str, object]:
    """What a camera recognises: how many, and the nearest of them; positions as seen from it."""
    count = camera.getRecognitionNumberOfObjects()
    if not count:
        return _nearest_of(0, [])  # a pointer to nothing cannot be read
    seen: list[Any] = camera.getRecognitionObjects()[:_MOST_LOOKED_AT]
    said = [
        {
            "model": each.getModel(),
            "id": each.getId(),
            "distance_m": math.hypot(*each.getPosition()),
            "position_m": list(each.getPosition()),
        }
        for each in seen
    ]
    return _nearest_of(count, said)


def _summarise_targets(radar: Any) -> dict[str, object]:
    """What a radar sees: how many, and the nearest of them."""
    count = radar.getNumberOfTargets()
    seen: list[Any] = radar.getTargets()[:_MOST_LOOKED_AT] if count else []
    said = [
        {
            "distance_m": each.distance,
            "speed_m_s": each.speed,
            "azimuth_rad": each.azimuth,
            "receiver_power": each.receiver_power,
        }
        for each in seen
    ]
    return _nearest_of(count, said)


def _nearest_of(count: int, said: list[dict[str, Any]]) -> dict[str, object]:
    said.sort(key=lambda each: each["distance_m"])
    nearest_m = said[0]["distance_m"] if said else None
    return {"count": count, "min_m": nearest_m, "nearest": said[:MOST_OBJECTS]}


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


# By the names of the classes in Webots' `controller` package. Not here: `Brake`, `Display`,
# `Emitter`, `Pen`, `Skin` and `Speaker`, which only take orders, and `Keyboard`, `Mouse` and
# `Joystick`, which no device is and whose events a reading would take away.
RULES: Final[dict[str, Rule]] = {
    "Accelerometer": _sensor(methodcaller("getValues")),
    "Altimeter": _sensor(methodcaller("getValue")),
    "Camera": Rule("sensors", _recognition_period, _summarise_recognised),
    "Compass": _sensor(methodcaller("getValues")),
    "Connector": _actuator("actuators", _read_connector),
    "DistanceSensor": _sensor(methodcaller("getValue")),
    "GPS": _sensor(methodcaller("getValues")),
    "Gyro": _sensor(methodcaller("getValues")),
    "InertialUnit": _sensor(methodcaller("getRollPitchYaw")),
    "LED": _actuator("actuators", methodcaller("get")),
    "Lidar": _sensor(_summarise_lidar),
    "LightSensor": _sensor(methodcaller("getValue")),
    "Motor": _actuator("motors", _read_motor),
    "PositionSensor": _sensor(methodcaller("getValue")),
    "Radar": _sensor(_summarise_targets),
    "RangeFinder": _sensor(_summarise_range_finder),
    "Receiver": _sensor(lambda receiver: {"queue_length": receiver.getQueueLength()}),
    "TouchSensor": _sensor(_read_touch),
    "VacuumGripper": _actuator("actuators", _read_vacuum_gripper),
}
