"""Reads the values of a robot's enabled devices, for `auto_publish`.

Reading enables, changes and consumes nothing: a sensor's sampling period and a receiver's packets
belong to the user's code. A disabled sensor is not read, since Webots prints an error line for
every such reading.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from operator import methodcaller
from typing import Any, Final, NamedTuple, cast

from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.lidar_summary import summarise_lidar, summarise_range_finder
from webots_mcp.bridge.simulation import Simulation

MOST_OBJECTS: Final = 8  # of a camera or a radar that are published, the nearest first
_MOST_READ: Final = 64  # objects of which the nearest are chosen: each is a call of the C library
_WGS84: Final = 1  # GPS.WGS84: degrees, not metres

Failed = Callable[[str, Exception], object]
MOST_READING_US: Final = 100.0  # per call, on average, for rows that go to the ring buffer only
_READINGS: Final = 9  # their median counts, so that a single interrupted reading does not


class Rule(NamedTuple):
    """How the devices of a class are read.

    Attributes:
        group: The key of the state under which they are published.
        period_ms: The sampling period in milliseconds, 0 while the device is disabled; None of
            devices that need not be enabled.
        read: Reads the value.
    """

    group: str
    period_ms: Callable[[Any], int] | None
    read: Callable[[Any], object]


def _sensor(read: Callable[[Any], object]) -> Rule:
    return Rule("sensors", methodcaller("getSamplingPeriod"), read)


def _actuator(group: str, read: Callable[[Any], object]) -> Rule:
    """Return the rule of an actuator: its command can be read without enabling anything."""
    return Rule(group, None, read)


def read_devices(robot: Any, failed: Failed) -> dict[str, object]:
    """Return the values of all enabled sensors, and the commands of the actuators.

    Args:
        robot: A Webots `Robot`.
        failed: Receives name and error of each device that could not be read; it is left out.

    Returns:
        `sensors`: device name to value, as `RULES` says;
        `motors`: device name to `target_position_rad` and `target_velocity_rad_s`, of a linear
            motor `target_position_m` and `target_velocity_m_s`, and its feedback where enabled;
        `actuators`: device name to what it was set to;
        `battery_j`: the charge, where its sensor is enabled;
        `pose`: [x_m, y_m, yaw_rad] from the first GPS and inertial unit, where both are enabled.
    """
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    sensors: dict[str, object] = {}
    groups: dict[str, dict[str, object]] = {"sensors": sensors}
    gps = unit = None  # the first enabled ones
    for name, device in devices.items():
        cls: type[Any] = device.__class__
        rule = _RULES_OF_CLASSES.get(cls, ...)
        if rule is ...:
            rule = _remember_rule(cls)
        if rule is None:
            continue
        try:
            if rule.period_ms is not None and rule.period_ms(device) <= 0:
                continue
            value = rule.read(device)
        except Exception as error:  # noqa: BLE001  (the other devices are still read)
            failed(name, error)
            continue
        if rule.group == "sensors":
            sensors[name] = value
            if gps is None and cls.__name__ == "GPS":
                gps = device, value
            elif unit is None and cls.__name__ == "InertialUnit":
                unit = device, value
        else:
            groups.setdefault(rule.group, {})[name] = value
    pose = {} if gps is None or unit is None else _pose(*gps, unit[1])
    return {**pose, **groups, **_battery(robot)}


def _remember_rule(cls: type[Any]) -> Rule | None:
    """Return the rule of a class of devices, and look its name up only once."""
    rule = RULES.get(cls.__name__)
    if len(_RULES_OF_CLASSES) < _MOST_CLASSES:
        _RULES_OF_CLASSES[cls] = rule
    return rule


def _pose(gps: Any, position: object, angles: object) -> dict[str, object]:
    if gps.getCoordinateSystem() == _WGS84:
        return {}
    (x_m, y_m, _), (*_, yaw) = cast("list[float]", position), cast("list[float]", angles)
    return {"pose": [x_m, y_m, yaw]}


def _battery(robot: Any) -> dict[str, object]:
    period_ms = getattr(robot, "batterySensorGetSamplingPeriod", None)
    return {"battery_j": robot.batterySensorGetValue()} if period_ms and period_ms() > 0 else {}


def _read_motor(motor: Any) -> dict[str, float]:
    """Return the commands of a motor; Webots has one class for rotational and linear ones."""
    if motor.getType() == motor.LINEAR:
        values = {
            "target_position_m": motor.getTargetPosition(),
            "target_velocity_m_s": motor.getVelocity(),
        }
        if motor.getForceFeedbackSamplingPeriod() > 0:
            values["force_feedback_n"] = motor.getForceFeedback()
    else:
        values = {
            "target_position_rad": motor.getTargetPosition(),
            "target_velocity_rad_s": motor.getVelocity(),
        }
        if motor.getTorqueFeedbackSamplingPeriod() > 0:
            values["torque_feedback_nm"] = motor.getTorqueFeedback()
    return values


def _read_connector(connector: Any) -> dict[str, object]:
    return {"locked": connector.isLocked(), **_presence(connector)}


def _read_vacuum_gripper(gripper: Any) -> dict[str, object]:
    return {"on": gripper.isOn(), **_presence(gripper)}


def _presence(device: Any) -> dict[str, object]:
    """Return whether an object is present to grip; the presence sensor is enabled separately."""
    enabled = device.getPresenceSamplingPeriod() > 0
    return {"presence": device.getPresence()} if enabled else {}


def _recognition_period(camera: Any) -> int:
    return camera.getRecognitionSamplingPeriod() if camera.hasRecognition() else 0


def _summarise_recognised(camera: Any) -> dict[str, object]:
    """Return the objects that a camera recognises: count and nearest ones, in the camera's axes."""
    count = camera.getRecognitionNumberOfObjects()
    if not count:
        return _nearest_of(0, [])  # Webots returns a null pointer then, which must not be read
    seen: list[Any] = camera.getRecognitionObjects()[:_MOST_READ]
    objects = [
        {
            "model": each.getModel(),
            "id": each.getId(),
            "distance_m": math.hypot(*each.getPosition()),
            "position_m": list(each.getPosition()),
            "colors": _colors_of(each),
        }
        for each in seen
    ]
    return _nearest_of(count, objects)


def _colors_of(recognised: Any) -> list[float]:
    """Return red, green and blue of each color of an object.

    Webots returns a bare pointer to them, whose memory it frees at the next step.
    """
    count = recognised.getNumberOfColors()
    colors = recognised.getColors() if count else None
    return [colors[i] for i in range(3 * min(count, MOST_OBJECTS))] if colors else []


def _summarise_targets(radar: Any) -> dict[str, object]:
    """Return the targets of a radar: count and nearest ones."""
    count = radar.getNumberOfTargets()
    seen: list[Any] = radar.getTargets()[:_MOST_READ] if count else []
    targets = [
        {
            "distance_m": each.distance,
            "speed_m_s": each.speed,
            "azimuth_rad": each.azimuth,
            "receiver_power": each.receiver_power,
        }
        for each in seen
    ]
    return _nearest_of(count, targets)


def _nearest_of(count: int, read: list[dict[str, Any]]) -> dict[str, object]:
    read.sort(key=lambda each: each["distance_m"])
    nearest_m = read[0]["distance_m"] if read else None
    return {"count": count, "min_m": nearest_m, "nearest": read[:MOST_OBJECTS]}


def _read_touch(device: Any) -> object:
    """Return a vector from a force-3d sensor, a number from the others."""
    if device.getType() != getattr(device, "FORCE3D", None):
        return device.getValue()
    force = device.getValues()  # in Webots a bare pointer to the three
    return [force[i] for i in range(3)] if force else None


# By the names of the classes in Webots' `controller` package. Not here: `Brake`, `Display`,
# `Emitter`, `Pen`, `Skin` and `Speaker`, which have nothing to read, and `Keyboard`, `Mouse` and
# `Joystick`, which are not among the robot's devices, and whose events a reading would consume.
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
    "Lidar": _sensor(summarise_lidar),
    "LightSensor": _sensor(methodcaller("getValue")),
    "Motor": _actuator("motors", _read_motor),
    "PositionSensor": _sensor(methodcaller("getValue")),
    "Radar": _sensor(_summarise_targets),
    "RangeFinder": _sensor(summarise_range_finder),
    "Receiver": _sensor(lambda receiver: {"queue_length": receiver.getQueueLength()}),
    "TouchSensor": _sensor(_read_touch),
    "VacuumGripper": _actuator("actuators", _read_vacuum_gripper),
}
_RULES_OF_CLASSES: Final[dict[type[Any], Rule | None]] = {}  # of those that were seen
_MOST_CLASSES: Final = 1000  # a program may make classes without end


# -- how often devices are read --------------------------------------------------------------------


class DeviceReader:
    """Reads a robot's devices, and measures how long that takes.

    Args:
        describe: Called once, after the first reading: records what the devices are.

    Attributes:
        ring_interval: One call of `auto_publish` in this many reads the devices for the ring
            buffer alone, which limits the mean time of all calls to 100 us.
        why: The reason for an interval above 1; empty while the interval is 1.
    """

    def __init__(
        self,
        simulation: Simulation,
        journal: Journal,
        errors: ErrorReport,
        describe: Callable[[], object],
    ) -> None:
        self._simulation = simulation
        self._journal = journal
        self._errors = errors
        self._describe: Callable[[], object] | None = describe
        self._durations_us: deque[float] = deque(maxlen=_READINGS)
        self._reported_interval = 1
        self.ring_interval = 1
        self.why = ""

    def read(self) -> dict[str, object]:
        """Return the devices' values; each device that cannot be read counts as a failure."""
        if self._simulation.over:
            return {}
        started_s = time.perf_counter()
        try:
            values = read_devices(self._simulation.robot, self._failed)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("auto_publish", error)
            return {}
        finally:
            self._count(1e6 * (time.perf_counter() - started_s))
        if self._describe is not None:
            self._describe_devices(self._describe)
        return values

    def _describe_devices(self, describe: Callable[[], object]) -> None:
        self._describe = None
        try:
            describe()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("describing the devices", error)

    def _failed(self, name: str, error: Exception) -> None:
        self._errors.failed(f"auto_publish of the device {name!r}", error)

    def _count(self, duration_us: float) -> None:
        """Set the interval by the median of the last durations; log it when it has doubled."""
        self._durations_us.append(duration_us)
        if duration_us <= MOST_READING_US and self.ring_interval == 1:
            return  # the median has not grown
        usual_us = sorted(self._durations_us)[len(self._durations_us) // 2]
        interval = max(1, math.ceil(usual_us / MOST_READING_US))
        if interval != self.ring_interval:
            self.ring_interval = interval
            self.why = _why(interval, usual_us) if interval > 1 else ""
        if self.ring_interval > self._reported_interval and len(self._durations_us) == _READINGS:
            self._reported_interval = 2 * self.ring_interval
            self._journal.log("info", "bridge", f"ring buffer: {self.why}")


def _why(interval: int, usual_us: float) -> str:
    share = f"one call of auto_publish() in {interval}"
    return f"{share}, because reading the devices takes {usual_us:.0f} us"


# -- motors after a reset --------------------------------------------------------------------------
# A reset stops each motor at its position. A controller that calls `setPosition(inf)` once, before
# its loop, does not notice the reset, and its robot would stand still from then on. Webots'
# library does not notice it either: `getTargetPosition` still returns the last command, which is
# used here.


def restart_motors(robot: Any, journal: Journal, failed: Failed) -> None:
    """Restart the motors in velocity control after a reset, at their last velocity."""
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    motors = [each for each in devices.items() if type(each[1]).__name__ == "Motor"]
    restarted = [text for name, motor in motors if (text := _restart(name, motor, failed))]
    if restarted:
        what = "the reset stopped these motors; the bridge called setPosition(inf) again"
        listed = ", ".join(restarted)
        journal.log("info", "bridge", f"{what}, with their last velocity: {listed}")


def _restart(name: str, motor: Any, failed: Failed) -> str | None:
    """Restart a motor; return its name and velocity, or None if it was not in velocity control."""
    try:
        target, velocity = motor.getTargetPosition(), motor.getVelocity()
        if not math.isinf(target):
            return None
        if name.count("::") == 1 and motor.getMultiplier() != 1:
            return None  # coupled (`name::part`): the motor of multiplier 1 drives it too
        motor.setPosition(target)
        motor.setVelocity(velocity)  # else it would turn at its maximum velocity
    except Exception as error:  # noqa: BLE001  (the other motors are still restarted)
        failed(f"setPosition(inf) after the reset, of the motor {name!r},", error)
        return None
    return f"{name} ({velocity:g})"
