"""What devices say of the signals that are made of them."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, catch_up, heartbeat_now
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge.device_meanings import describe_devices
from webots_mcp.database.connection import connect
from webots_mcp.signals.meaning import DeclaredMeaning
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.meanings import meanings_of
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.segment import Subject

LEFT, RIGHT = "left wheel motor", "right wheel motor"
IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
ACROSS, ALONG, UP = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]


def device(class_name: str, **answers: Any) -> Any:
    """A device of Webots that has these methods and no others."""
    methods = {name: _answering(value) for name, value in answers.items()}
    return type(class_name, (), methods)()


def _answering(value: Any) -> Callable[..., Any]:
    def answer(_: Any) -> Any:
        if isinstance(value, Exception):
            raise value
        return value

    return answer


def said_of(**devices: Any) -> dict[str, DeclaredMeaning]:
    robot = SimpleNamespace(devices=devices)
    return {said.name: said for said, _ in describe_devices(robot, is_supervisor=False)}


def test_a_motor_and_the_sensor_of_its_joint_belong_together_and_wheels_have_sides(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    assert robot.step(STEP_MS) != -1
    bridge.auto_publish()
    sql = "SELECT quantity, role, unit, side, target_of, high FROM meaning WHERE name = ?"
    assert recording.rows(sql, f"motors.{LEFT}.target_velocity_rad_s") == [
        ("wheel speed", "commanded", "rad/s", "left", None, 12.0)
    ]
    assert recording.rows(sql, f"motors.{RIGHT}.target_position_rad") == [
        ("joint position", "target", "rad", "right", "sensors.right wheel sensor", None)
    ]
    (why,) = recording.rows("SELECT why FROM meaning WHERE name = 'sensors.left wheel sensor'")
    assert why == "Webots device PositionSensor, its joint turns a wheel"
    assert recording.rows("SELECT DISTINCT source, set_by FROM meaning") == [("device", "bridge")]


def test_an_attached_robot_has_them_after_its_first_step_and_asks_once(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    get = robot.getFromDevice

    def count(_: Any, tag: int) -> Any:
        asked.append(tag)
        return get(tag)

    monkeypatch.setattr(type(robot), "getFromDevice", count)
    robot.getDevice("ds_left").enable(STEP_MS)
    with MCPBridge.attach(robot, database=database, throttle_interval=1):
        for _ in range(5):
            robot.step(STEP_MS)
    assert len(asked) == 2
    sql = "SELECT quantity, unit, low, high, why FROM meaning WHERE name = 'sensors.ds_left'"
    assert Recording(database).rows(sql) == [
        ("distance", "m", 0.0, 1.0, "Webots device DistanceSensor, measures every 16 ms")
    ]


def test_a_device_counts_before_a_name_that_says_something_else(
    robot: InProcessSupervisor, database: MemoryDatabase
) -> None:
    sensor = robot.getDevice("left wheel sensor")
    sensor.enable(STEP_MS)
    with MCPBridge.attach(robot, database=database, throttle_interval=1):
        for _ in range(3):
            robot.step(STEP_MS)
    with closing(connect(database, "reader")) as connection:
        found = meanings_of(catalogue(connection, Subject(1, "rover", 1)))
    meaning = found["sensors.left wheel sensor"]
    assert (meaning.quantity, meaning.source, meaning.side) == ("joint position", "device", "left")


def test_a_new_database_has_what_the_devices_say_too(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        robot.step(STEP_MS)
        bridge.auto_publish()
        before = filed.rows("SELECT name, quantity FROM meaning ORDER BY name")
        for each in file.parent.glob("webots.db*"):
            each.unlink()
        heartbeat_now(bridge)
        bridge.auto_publish()
        catch_up(bridge)
        assert filed.rows("SELECT name, quantity FROM meaning ORDER BY name") == before != []


def test_a_robot_that_may_not_look_into_the_scene_says_what_its_devices_say() -> None:
    names = ("target_position_rad", "target_velocity_rad_s")
    motor = device("Motor", getType=0, getMinPosition=0.0, getMaxPosition=0.0, getMaxVelocity=6.28)
    said = said_of(m=motor)
    position, velocity = (said[f"motors.m.{name}"] for name in names)
    assert (position.quantity, position.low, velocity.quantity) == ("joint position", None, None)
    assert (velocity.role, velocity.low, velocity.high) == ("commanded", -6.28, 6.28)


def test_a_joint_with_limits_is_no_wheel() -> None:
    sensor = device("PositionSensor", getName="elbow sensor")
    motor = device(
        "Motor", getType=0, getMinPosition=-1.0, getMaxPosition=2.0, getMaxVelocity=3.0,
        getPositionSensor=device("PositionSensor", getName="elbow sensor"),
    )  # fmt: skip
    said = {"elbow sensor": sensor, "elbow": motor}
    found = said_of(**said)
    assert found["motors.elbow.target_velocity_rad_s"].quantity == "joint speed"
    target = found["motors.elbow.target_position_rad"]
    assert (target.target_of, target.low, target.high) == ("sensors.elbow sensor", -1.0, 2.0)
    measured = found["sensors.elbow sensor"]
    assert (measured.role, measured.low, measured.high) == ("measured", -1.0, 2.0)


def test_a_linear_motor_is_in_metres() -> None:
    motor = device("Motor", getType=1, getMaxVelocity=0.5)
    type(motor).LINEAR = 1  # type: ignore[attr-defined]
    found = said_of(lift=motor)
    assert found["motors.lift.target_position_m"].unit == "m"
    assert found["motors.lift.target_velocity_m_s"].quantity == "joint speed"


@pytest.mark.parametrize(
    ("table", "unit", "low", "high"),
    [
        ([0.0, 0.0, 0.0, 1.0, 1.0, 0.0], "m", 0.0, 1.0),
        ([0.0, 1000.0, 0.0, 0.1, 80.0, 0.0], None, 80.0, 1000.0),
        ([], None, None, None),
        ([0.0, float("inf"), 0.0], None, None, None),
        ([0.0, 1.0], None, None, None),
        ("a table", None, None, None),
    ],
)
def test_a_distance_sensor_has_the_range_of_its_lookup_table(
    table: Any, unit: str | None, low: float | None, high: float | None
) -> None:
    said = said_of(ps0=device("DistanceSensor", getLookupTable=table))["sensors.ps0"]
    assert (said.quantity, said.unit, said.low, said.high) == ("distance", unit, low, high)


def test_latitude_and_longitude_are_no_position_in_metres() -> None:
    assert said_of(gps=device("GPS", getCoordinateSystem=1)) == {}
    local = said_of(gps=device("GPS", getCoordinateSystem=0))
    assert [each.quantity for each in local.values()] == ["x", "y", "height"]


@pytest.mark.parametrize(
    ("kind", "names", "quantity"),
    [(0, ["sensors.t"], "flag"), (1, ["sensors.t"], "force"),
     (2, ["sensors.t.0", "sensors.t.1", "sensors.t.2"], "force")],
)  # fmt: skip
def test_a_touch_sensor_is_a_flag_or_a_force(kind: int, names: list[str], quantity: str) -> None:
    sensor = device("TouchSensor", getType=kind)
    type(sensor).BUMPER, type(sensor).FORCE3D = 0, 2  # type: ignore[attr-defined]
    found = said_of(t=sensor)
    assert list(found) == names
    assert {each.quantity for each in found.values()} == {quantity}


@pytest.mark.parametrize("kind", ["DistanceSensor", "GPS", "Motor", "Lidar", "TouchSensor"])
def test_methods_that_are_missing_or_fail_leave_out_only_what_they_would_say(kind: str) -> None:
    broken = device(kind, getModel=RuntimeError("gone"), getLookupTable=RuntimeError("gone"),
                    getMaxVelocity=RuntimeError("gone"))  # fmt: skip
    found = said_of(broken=broken, fine=device("Gyro"))
    assert found["sensors.fine.0"].quantity == "angular velocity"
    assert all(each.low is None for each in found.values())


# -- what the scene shows ------------------------------------------------------------------------


def node(type_name: str, position: Any = None, **fields: Any) -> Any:
    """A node of the scene with some fields."""

    def get_field(name: str) -> Any:
        value = fields.get(name)
        if value is None:
            return None

        def entry(at: int) -> Any:
            return value[at]

        return SimpleNamespace(getSFNode=lambda: value, getSFVec3f=lambda: value, getMFNode=entry)

    return SimpleNamespace(
        getTypeName=lambda: type_name,
        getBaseTypeName=lambda: type_name,
        getField=get_field,
        getPosition=lambda: position,
        getOrientation=lambda: IDENTITY,
        getParentNode=lambda: fields.get("parent"),
    )


def hinge(position: Any, axis: Any = ACROSS, shape: Any = None) -> Any:
    """The node of a motor on a hinge joint."""
    bounds = node("Pose", children=[node("Cylinder")]) if shape is None else shape
    joint = node(
        "HingeJoint",
        parent=node("Robot"),
        jointParameters=node("HingeJointParameters", axis=axis),
        endPoint=node("Solid", position, boundingObject=bounds),
    )
    return node("RotationalMotor", parent=joint)


def turned_in(nodes: dict[str, Any], **motor: Any) -> dict[str, tuple[str | None, str | None]]:
    """Quantity and side of each motor's speed, as the scene of these nodes shows it."""
    motors = {name: device("Motor", getType=0, **motor) for name in nodes}
    for tag, each in enumerate(motors.values()):
        each._tag = tag

    def node_of(tag: int) -> Any:
        return [*nodes.values()][tag]

    robot = SimpleNamespace(
        devices=motors, getSelf=lambda: node("Robot", [0.0, 0.0, 0.0]), getFromDevice=node_of
    )
    found = {said.name: said for said, _ in describe_devices(robot, is_supervisor=True)}
    named = {name: found[f"motors.{name}.target_velocity_rad_s"] for name in nodes}
    return {name: (each.quantity, each.side) for name, each in named.items()}


def test_four_wheels_have_the_side_on_which_they_are() -> None:
    places = {
        "a": [0.1, 0.2, 0.0],
        "b": [0.1, -0.2, 0.0],
        "c": [-0.1, 0.2, 0],
        "d": [-0.1, -0.2, 0],
    }
    found = turned_in({name: hinge(place) for name, place in places.items()})
    assert found == {
        "a": ("wheel speed", "left"), "b": ("wheel speed", "right"),
        "c": ("wheel speed", "left"), "d": ("wheel speed", "right"),
    }  # fmt: skip


def test_the_motor_of_a_propeller_is_no_wheel() -> None:
    motor = node("RotationalMotor", parent=node("Propeller"))
    assert turned_in({"a": motor}) == {"a": ("motor speed", None)}


@pytest.mark.parametrize(
    "others",
    [
        {"a": hinge([0.0, 0.2, 0.0])},  # it has no partner
        {"a": hinge([0.0, 0.2, 0.0], UP), "b": hinge([0.0, -0.2, 0.0], UP)},  # brushes, turrets
        {"a": hinge([0.0, 0.2, 0.0], ALONG), "b": hinge([0.0, -0.2, 0.0], ALONG)},
        {"a": hinge([0.0, 0.2, 0.0]), "b": hinge([0.5, -0.2, 0.0])},  # at another place
        {"a": hinge([0.0, 0.2, 0], shape=node("Box")), "b": hinge([0, -0.2, 0], shape=node("Box"))},
        {"a": hinge([float("nan"), 0.2, 0.0]), "b": hinge([0.0, -0.2, 0.0])},
        {"a": node("RotationalMotor"), "b": None},  # a PROTO hides the joint
        {"a": node("RotationalMotor", parent=node("HingeJoint"))},
    ],
)
def test_what_is_not_clearly_a_pair_of_wheels_is_left_to_names(others: dict[str, Any]) -> None:
    assert set(turned_in(others).values()) == {(None, None)}


def test_a_pair_far_above_the_wheels_is_none() -> None:
    low = {"a": hinge([0.0, 0.2, 0.0]), "b": hinge([0.0, -0.2, 0.0])}
    high = {"c": hinge([0.0, 0.2, 1.0]), "d": hinge([0.0, -0.2, 1.0])}
    found = turned_in({**low, **high})
    assert [found[name][0] for name in "abcd"] == ["wheel speed", "wheel speed", None, None]


def test_a_failure_is_counted_and_costs_no_value(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("WEBOTS_MCP_STRICT", raising=False)

    def fail(*_: Any, **__: Any) -> Any:
        raise sqlite3.Error("broken")

    monkeypatch.setattr("webots_mcp.bridge.device_meanings.describe_devices", fail)
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        robot.step(STEP_MS)
        assert bridge.auto_publish()["motors"]
        bridge.auto_publish()
        assert bridge.stats().failures == 1
