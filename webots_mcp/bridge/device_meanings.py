"""Describes the signals that `auto_publish` makes of devices: quantity, unit and limits.

The devices are queried once, at the first reading. If a method fails or is missing in a release of
Webots, its part of the description is omitted. For a supervisor, the scene shows which motors turn
a propeller and which a wheel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, cast

from webots_mcp.bridge.lidar_summary import SECTORS
from webots_mcp.bridge.scene_nodes import world_up_axis
from webots_mcp.signals.meaning import LONGEST_NAME, DeclaredMeaning, Quantity

_ROUND: Final = ("Cylinder", "Sphere", "Capsule")
_WGS84: Final = 1  # GPS.WGS84: degrees, not metres

Described = tuple[DeclaredMeaning, str]
"""The meaning of a signal, and the device that it comes from, in words."""


@dataclass(frozen=True)
class WheelRules:
    """Limits for finding the wheels of a robot, in units of what they compare.

    Attributes:
        motors: Motors that are searched in the scene; each takes about ten requests.
        across_share: Share of an axle's direction that must lie across the robot.
        partner_share: Share of its distance from the middle by which a wheel's partner may differ.
        levels: Levels of nodes that are searched within a bounding object.
    """

    motors: int = 64
    across_share: float = 0.9
    partner_share: float = 0.25
    levels: int = 4


_RULES: Final = WheelRules()


class _Limits(NamedTuple):
    low: float | None = None
    high: float | None = None


def describe_devices(robot: Any, *, is_supervisor: bool) -> list[Described]:
    """Return the meaning of each signal of the devices, in the order of the devices.

    Args:
        robot: A Webots `Robot`.
        is_supervisor: Whether it may read the scene.
    """
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    motors = {name: each for name, each in devices.items() if type(each).__name__ == "Motor"}
    moved_by_motor = _moved_by(robot, motors) if is_supervisor and motors else {}
    up_axis = _up_axis(robot, devices) if is_supervisor else 2
    sensors = {name: _ask(motor, "getPositionSensor") for name, motor in motors.items()}
    found: list[Described] = []
    joints: dict[str, str] = {}
    for name in motors:
        sensor = _ask(sensors[name], "getName")
        if isinstance(sensor, str) and sensor in devices:
            joints[sensor] = name
    for name, device in devices.items():
        describe = _SENSORS.get(type(device).__name__)
        if name in motors:
            partner = next((sensor for sensor, motor in joints.items() if motor == name), None)
            said = _of_motor(name, device, partner, moved_by_motor.get(name))
        elif type(device).__name__ == "PositionSensor":
            joint = joints.get(name, "")
            said = _of_position_sensor(name, device, motors.get(joint), moved_by_motor.get(joint))
        else:
            said = describe(name, device) if describe is not None else iter(())
            if type(device).__name__ == "GPS" and up_axis == 1:
                said = _in_nue(said)
        why = _why(device, moved_by_motor.get(joints.get(name, name)))
        found += [(each, why) for each in said if _is_storable(each.name)]
    if hasattr(robot, "batterySensorGetValue"):
        found.append((_measured("battery_j", "energy", "J"), "battery of the robot"))
    return found


def _ask(device: Any, method: str, *arguments: Any) -> Any:
    """Return what a device answers; None if it has no such method, or the method fails."""
    try:
        return getattr(device, method)(*arguments)
    except Exception:  # noqa: BLE001  (what is not known changes nothing)
        return None


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if math.isfinite(value) else None


def _why(device: Any, moved_by_motor: _MovedBody | None) -> str:
    """Describe the device in words: type, model, sampling period, and what its motor turns."""
    model, period_ms = _ask(device, "getModel"), _ask(device, "getSamplingPeriod")
    words = [f"Webots device {type(device).__name__}"]
    if moved_by_motor is not None:
        words.append(f"its joint turns a {'wheel' if moved_by_motor.side else 'propeller'}")
    if isinstance(model, str) and model and _is_storable(model):
        words.append(f"model {model:.80}")
    if isinstance(period_ms, int) and period_ms > 0:
        words.append(f"measures every {period_ms} ms")
    return ", ".join(words)


def _is_storable(text: str) -> bool:
    return text.isprintable() and len(text) <= LONGEST_NAME


# -- sensors -----------------------------------------------------------------------------------


def _measured(name: str, quantity: Quantity, unit: str | None = None, **more: Any) -> Any:
    return DeclaredMeaning(name, quantity, "measured", unit, **more)


def _table_of(device: Any) -> list[tuple[float, float]]:
    """Return the rows of a lookup table: what is measured, and the value that the sensor gives."""
    table = _ask(device, "getLookupTable")
    if not isinstance(table, (list, tuple)):
        return []
    values = [_number(each) for each in cast("Sequence[object]", table)]
    if None in values or len(values) % 3:
        return []
    plain = cast("list[float]", values)
    return list(zip(plain[::3], plain[1::3], strict=True))


def _range_of(device: Any) -> _Limits:
    given = [given for _, given in _table_of(device)]
    return _Limits(min(given), max(given)) if given else _Limits()


def _of_distance_sensor(name: str, device: Any) -> Iterator[DeclaredMeaning]:
    """Yield a distance; it is in metres if the lookup table does not convert it."""
    table = _table_of(device)
    unit = "m" if table and all(measured == given for measured, given in table) else None
    limits = _Limits(*(_number(_ask(device, each)) for each in ("getMinValue", "getMaxValue")))
    if limits.low is None or limits.high is None or limits.low >= limits.high:
        limits = _range_of(device)
    yield _measured(f"sensors.{name}", "distance", unit, low=limits.low, high=limits.high)


def _of_vector(quantity: Quantity, unit: str | None) -> Any:
    def describe(name: str, device: Any) -> Iterator[DeclaredMeaning]:
        low, high = _range_of(device)
        for item in range(3):
            yield _measured(f"sensors.{name}.{item}", quantity, unit, low=low, high=high)

    return describe


def _of_one_number(quantity: Quantity, unit: str | None) -> Any:
    def describe(name: str, device: Any) -> Iterator[DeclaredMeaning]:
        low, high = _range_of(device)
        yield _measured(f"sensors.{name}", quantity, unit, low=low, high=high)

    return describe


def _of_gps(name: str, device: Any) -> Iterator[DeclaredMeaning]:
    """Yield where it is and how high; latitude and longitude are no position in metres."""
    system = _ask(device, "getCoordinateSystem")
    if system is None:
        return
    plane: tuple[Quantity, Quantity] = ("angle", "angle") if system == _WGS84 else ("x", "y")
    for item, quantity in enumerate(plane):
        unit = "deg" if quantity == "angle" else "m"
        yield _measured(f"sensors.{name}.{item}", quantity, unit)
    yield _measured(f"sensors.{name}.2", "height", "m")


def _in_nue(said: Iterator[DeclaredMeaning]) -> Iterator[DeclaredMeaning]:
    """Yield what a GPS says in a world whose y axis points up."""
    quantities: dict[Quantity | None, Quantity] = {"y": "height", "height": "y"}
    is_local = False
    for each in said:
        is_local = is_local or each.quantity == "x"  # else latitude, longitude and altitude
        swapped = quantities.get(each.quantity, each.quantity) if is_local else each.quantity
        yield each._replace(quantity=swapped)


def _up_axis(robot: Any, devices: dict[str, Any]) -> int:
    """Return the axis of the world that points up, where a GPS makes that a question."""
    if not any(type(each).__name__ == "GPS" for each in devices.values()):
        return 2
    try:
        return world_up_axis(robot)
    except Exception:  # noqa: BLE001  (what is not known changes nothing)
        return 2


def _of_inertial_unit(name: str, _: Any) -> Iterator[DeclaredMeaning]:
    quantities: tuple[Quantity, ...] = ("roll", "pitch", "heading")
    for item, quantity in enumerate(quantities):
        yield _measured(f"sensors.{name}.{item}", quantity, "rad")


def _of_ranges(name: str, device: Any) -> Iterator[DeclaredMeaning]:
    low, high = (_number(_ask(device, each)) for each in ("getMinRange", "getMaxRange"))
    limits = {"low": low, "high": high} if None not in (low, high) else {}
    yield _measured(f"sensors.{name}.min_m", "distance", "m", **limits)
    for sector in range(SECTORS):
        yield _measured(f"sensors.{name}.sector_min_m.{sector}", "distance", "m", **limits)
    for count in ("count", "min_index"):
        yield _measured(f"sensors.{name}.{count}", "count")


def _of_objects(name: str, _: Any) -> Iterator[DeclaredMeaning]:
    yield _measured(f"sensors.{name}.count", "count")
    yield _measured(f"sensors.{name}.min_m", "distance", "m")


def _of_camera(name: str, camera: Any) -> Iterator[DeclaredMeaning]:
    """Yield what it recognises. Which object is the nearest one may change from row to row."""
    if _ask(camera, "hasRecognition") is False:
        return
    yield from _of_objects(name, camera)
    yield _measured(f"sensors.{name}.nearest.*.id", "count")
    yield _measured(f"sensors.{name}.nearest.*.colors.*", "colour")


def _of_radar(name: str, radar: Any) -> Iterator[DeclaredMeaning]:
    yield from _of_objects(name, radar)
    each = f"sensors.{name}.nearest.*"
    yield _measured(f"{each}.speed_m_s", "speed", "m/s")
    yield _measured(f"{each}.azimuth_rad", "angle", "rad")
    yield _measured(f"{each}.receiver_power", "power", "dBm")


def _of_gripper(name: str, _: Any) -> Iterator[DeclaredMeaning]:
    """Yield a connector or a vacuum gripper: whether it holds, and whether something is there."""
    for switch in ("locked", "on"):
        yield DeclaredMeaning(f"actuators.{name}.{switch}", "flag", "commanded")
    yield _measured(f"actuators.{name}.presence", "flag")


def _of_touch_sensor(name: str, device: Any) -> Iterator[DeclaredMeaning]:
    kind = _ask(device, "getType")
    if kind is None:
        return
    if kind == getattr(device, "FORCE3D", None):
        yield from _of_vector("force", "N")(name, device)
    elif kind == getattr(device, "BUMPER", None):
        yield _measured(f"sensors.{name}", "flag")
    else:
        yield from _of_one_number("force", "N")(name, device)


def _of_receiver(name: str, _: Any) -> Iterator[DeclaredMeaning]:
    yield _measured(f"sensors.{name}.queue_length", "count")


def _of_led(name: str, _: Any) -> Iterator[DeclaredMeaning]:
    yield DeclaredMeaning(f"actuators.{name}", "light", "commanded")


_SENSORS: Final[dict[str, Callable[[str, Any], Iterator[DeclaredMeaning]]]] = {
    "Accelerometer": _of_vector("acceleration", "m/s²"),
    "Altimeter": _of_one_number("height", "m"),
    "Camera": _of_camera,
    "Compass": _of_vector("magnetic field", None),
    "Connector": _of_gripper,
    "DistanceSensor": _of_distance_sensor,
    "GPS": _of_gps,
    "Gyro": _of_vector("angular velocity", "rad/s"),
    "InertialUnit": _of_inertial_unit,
    "LED": _of_led,
    "Lidar": _of_ranges,
    "LightSensor": _of_one_number("light", None),
    "Radar": _of_radar,
    "RangeFinder": _of_ranges,
    "Receiver": _of_receiver,
    "TouchSensor": _of_touch_sensor,
    "VacuumGripper": _of_gripper,
}


# -- motors and their joints -------------------------------------------------------------------


class _MovedBody(NamedTuple):
    """What a motor turns, as the scene shows it: its speed, and the side of a wheel."""

    quantity: Quantity
    side: str | None


def _is_linear(motor: Any) -> bool:
    return _ask(motor, "getType") == getattr(motor, "LINEAR", None)


def _limits_of(motor: Any) -> _Limits:
    """Return the limits of a joint's position; equal limits mean that it has none."""
    low, high = (_number(_ask(motor, each)) for each in ("getMinPosition", "getMaxPosition"))
    has_limits = low is not None and high is not None and low < high
    return _Limits(low, high) if has_limits else _Limits()


def _of_motor(
    name: str, motor: Any, sensor: str | None, moved_by_motor: _MovedBody | None
) -> Iterator[DeclaredMeaning]:
    linear = _is_linear(motor)
    unit, limits = "m" if linear else "rad", _limits_of(motor)
    fastest = _number(_ask(motor, "getMaxVelocity"))
    quantity: Quantity | None = moved_by_motor.quantity if moved_by_motor else None
    if quantity is None and (linear or limits.low is not None):
        quantity = "joint speed"  # a wheel or a propeller turns without end
    side = moved_by_motor.side if moved_by_motor else None
    yield DeclaredMeaning(
        f"motors.{name}.target_position_{unit}", "joint position", "target", unit,
        target_of=None if sensor is None else f"sensors.{sensor}", side=side,
        low=limits.low, high=limits.high,
    )  # fmt: skip
    yield DeclaredMeaning(
        f"motors.{name}.target_velocity_{unit}_s", quantity, "commanded", f"{unit}/s", side=side,
        low=-fastest if fastest else None, high=fastest or None,
    )  # fmt: skip
    if linear:
        yield _measured(f"motors.{name}.force_feedback_n", "force", "N", side=side)
    else:
        yield _measured(f"motors.{name}.torque_feedback_nm", "torque", "N·m", side=side)


def _of_position_sensor(
    name: str, sensor: Any, motor: Any, moved_by_motor: _MovedBody | None
) -> Iterator[DeclaredMeaning]:
    linear = _ask(sensor, "getType") == getattr(sensor, "LINEAR", "none")
    linear = linear or (motor is not None and _is_linear(motor))
    unit = "m" if linear else "rad"
    low, high = _Limits() if motor is None else _limits_of(motor)
    side = moved_by_motor.side if moved_by_motor else None
    yield _measured(f"sensors.{name}", "joint position", unit, side=side, low=low, high=high)


# -- what motors turn, in the scene ------------------------------------------------------------


class _Wheel(NamedTuple):
    """A round body on an axle across the robot: where its middle is in the robot's own frame."""

    x: float
    y: float
    z: float

    def is_partner_of(self, other: _Wheel) -> bool:
        """Return whether it lies at the same place on the other side."""
        reach = _RULES.partner_share * max(abs(self.y), abs(other.y))
        return (
            self.y * other.y < 0
            and abs(abs(self.y) - abs(other.y)) <= reach
            and abs(self.x - other.x) <= reach
            and abs(self.z - other.z) <= reach
        )


def _moved_by(robot: Any, motors: dict[str, Any]) -> dict[str, _MovedBody]:
    """Return what motors turn, as far as the scene shows it: propellers and pairs of wheels."""
    own = _ask(robot, "getSelf")
    moved_by_motor: dict[str, _MovedBody] = {}
    wheels: dict[str, _Wheel] = {}
    for name, motor in list(motors.items())[: _RULES.motors]:
        node = _ask(robot, "getFromDevice", getattr(motor, "_tag", None))
        joint = _ask(node, "getParentNode")
        kinds = (_ask(joint, "getTypeName"), _ask(joint, "getBaseTypeName"))
        if "Propeller" in kinds:
            moved_by_motor[name] = _MovedBody("motor speed", None)
        elif "HingeJoint" in kinds and _limits_of(motor).low is None:
            try:
                wheel = _wheel_on(own, joint)
            except Exception:  # noqa: BLE001  (fields that a PROTO hides: it is not known)
                wheel = None
            if wheel is not None:
                wheels[name] = wheel
    lowest = min((each.z for each in wheels.values()), default=0.0)
    for name, wheel in wheels.items():
        is_low = wheel.z - lowest <= max(abs(wheel.y), 0.01)
        if is_low and any(wheel.is_partner_of(other) for other in wheels.values()):
            moved_by_motor[name] = _MovedBody("wheel speed", "left" if wheel.y > 0 else "right")
    return moved_by_motor


def _wheel_on(own: Any, joint: Any) -> _Wheel | None:
    """Return the wheel that a hinge joint turns.

    Returns:
        None if the joint's end is not round, or its axle does not lie across the robot.

    Raises:
        Exception: If something cannot be read.
    """
    end = joint.getField("endPoint").getSFNode()
    parameters = joint.getField("jointParameters").getSFNode()
    axis = parameters.getField("axis").getSFVec3f()
    orientation = own.getOrientation()
    axle = _inverse(orientation, _turned(joint.getParentNode().getOrientation(), axis))
    length = math.hypot(*axle)
    if not length or not abs(axle[1]) >= _RULES.across_share * length:  # also where it is NaN
        return None
    if not _is_round(end.getField("boundingObject").getSFNode()):
        return None
    offset = [a - b for a, b in zip(end.getPosition(), own.getPosition(), strict=True)]
    place = _Wheel(*_inverse(orientation, offset))
    return place if all(map(math.isfinite, place)) else None


def _is_round(node: Any) -> bool:
    """Return whether a bounding object is a cylinder, a sphere or a capsule."""
    for _ in range(_RULES.levels):
        kind = node.getTypeName()
        if kind in _ROUND:
            return True
        if kind == "Shape":
            node = node.getField("geometry").getSFNode()
        else:  # a Pose, a Transform or a Group
            node = node.getField("children").getMFNode(0)
    return False


def _turned(matrix: Sequence[float], vector: Sequence[float]) -> list[float]:
    """Rotate a vector by a matrix, which is given by rows."""
    return [sum(matrix[3 * row + i] * vector[i] for i in range(3)) for row in range(3)]


def _inverse(matrix: Sequence[float], vector: Sequence[float]) -> list[float]:
    """Rotate a vector by the inverse of a rotation matrix."""
    return [sum(matrix[3 * i + row] * vector[i] for i in range(3)) for row in range(3)]
