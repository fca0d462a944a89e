"""What auto_publish reads of each class of devices that Webots has, and what it never does to one.

The devices have the methods of Webots' package, R2023b and R2025a alike, and no others
(surface.txt of the stand-in); they answer in the shapes that it answers in.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge.devices import MOST_OBJECTS, RULES, read_devices
from webots_mcp.standin import LIBRARY, InProcessSupervisor

SURFACE = (LIBRARY / "controller" / "surface.txt").read_text("utf-8")
PERIODS = re.compile(r"get\w*SamplingPeriod")


def methods_of_devices() -> dict[str, set[str]]:
    """Class of devices to its methods."""
    classes = re.findall(r"^(\w+):([^\n]*)\n((?:  [^\n]*\n)*)", SURFACE, re.MULTILINE)
    return {
        name: set(re.findall(r"^  (\w+)\(", members, re.MULTILINE))
        for name, bases, members in classes
        if "Device" in bases.split()
    }


METHODS = methods_of_devices()
BLIND = {"Brake", "Display", "Emitter", "Skin", "Speaker"}  # they only take orders


DUCK_COLORS = (ctypes.c_double * 6)(1.0, 1.0, 0.0, 1.0, 0.5, 0.0)


def recognised(number: int, x_m: float, model: str = "can") -> Any:
    return SimpleNamespace(
        getId=lambda: number,
        getModel=lambda: model,
        getPosition=lambda: (ctypes.c_double * 3)(x_m, 0.0, 0.0),
        getNumberOfColors=lambda: 2 if model == "duck" else 0,
        getColors=lambda: ctypes.cast(DUCK_COLORS, ctypes.POINTER(ctypes.c_double)),
    )


def target(distance: float) -> Any:
    return SimpleNamespace(distance=distance, speed=-2.0, azimuth=0.5, receiver_power=-60.0)


VECTOR = [1.0, 2.0, 3.0]
RANGES = (ctypes.c_float * 4)(2.0, 0.5, 4.0, 8.0)
SCAN = {"range_image": RANGES, "getRangeImage": [*RANGES]}
SUMMARY = {"count": 4, "min_m": 0.5, "min_index": 1, "sector_min_m": [2.0, 0.5, 4.0, 8.0]}
ENABLED = {"getSamplingPeriod": 32}

# Class: what the device answers while it is enabled; group and value in the published state.
TABLE: dict[str, tuple[dict[str, Any], str, Any]] = {
    "Accelerometer": ({**ENABLED, "getValues": VECTOR}, "sensors", VECTOR),
    "Altimeter": ({**ENABLED, "getValue": 0.25}, "sensors", 0.25),
    "Camera": (
        {
            **ENABLED,
            "hasRecognition": True,
            "getRecognitionSamplingPeriod": 64,
            "getRecognitionNumberOfObjects": 2,
            "getRecognitionObjects": [recognised(7, 2.0), recognised(9, 0.5, "duck")],
        },
        "sensors",
        {
            "count": 2,
            "min_m": 0.5,
            "nearest": [
                {
                    "model": "duck",
                    "id": 9,
                    "distance_m": 0.5,
                    "position_m": [0.5, 0.0, 0.0],
                    "colors": [*DUCK_COLORS],
                },
                {
                    "model": "can",
                    "id": 7,
                    "distance_m": 2.0,
                    "position_m": [2.0, 0.0, 0.0],
                    "colors": [],
                },
            ],
        },
    ),
    "Compass": ({**ENABLED, "getValues": VECTOR}, "sensors", VECTOR),
    "Connector": (
        {"isLocked": False, "getPresenceSamplingPeriod": 32, "getPresence": 1},
        "actuators",
        {"locked": False, "presence": 1},
    ),
    "DistanceSensor": ({**ENABLED, "getValue": 0.25}, "sensors", 0.25),
    "GPS": ({**ENABLED, "getValues": VECTOR}, "sensors", VECTOR),
    "Gyro": ({**ENABLED, "getValues": VECTOR}, "sensors", VECTOR),
    "InertialUnit": ({**ENABLED, "getRollPitchYaw": VECTOR}, "sensors", VECTOR),
    "LED": ({"get": 1}, "actuators", 1),
    "Lidar": ({**ENABLED, **SCAN, "getHorizontalResolution": 4}, "sensors", SUMMARY),
    "LightSensor": ({**ENABLED, "getValue": 0.25}, "sensors", 0.25),
    "Motor": (
        {
            "getType": 0,
            "getTargetPosition": 1.5,
            "getVelocity": 2.0,
            "getTorqueFeedbackSamplingPeriod": 32,
            "getTorqueFeedback": 0.1,
        },
        "motors",
        {
            "target_position_rad": 1.5,
            "target_velocity_rad_s": 2.0,
            "torque_feedback_nm": 0.1,
        },
    ),
    "PositionSensor": ({**ENABLED, "getValue": 0.25}, "sensors", 0.25),
    "Radar": (
        {**ENABLED, "getNumberOfTargets": 1, "getTargets": [target(12.0)]},
        "sensors",
        {
            "count": 1,
            "min_m": 12.0,
            "nearest": [
                {
                    "distance_m": 12.0,
                    "speed_m_s": -2.0,
                    "azimuth_rad": 0.5,
                    "receiver_power": -60.0,
                }
            ],
        },
    ),
    "RangeFinder": ({**ENABLED, **SCAN, "getWidth": 4}, "sensors", SUMMARY),
    "Receiver": ({**ENABLED, "getQueueLength": 3}, "sensors", {"queue_length": 3}),
    "TouchSensor": ({**ENABLED, "getType": 0, "getValue": 1.0}, "sensors", 1.0),
    "VacuumGripper": (
        {"isOn": True, "getPresenceSamplingPeriod": 32, "getPresence": True},
        "actuators",
        {"on": True, "presence": True},
    ),
}
# What may be asked of a device that nobody has enabled, and what is published of it.
DISABLED: dict[str, tuple[dict[str, Any], Any]] = {
    "Connector": ({"isLocked": True}, {"locked": True}),
    "LED": ({"get": 0}, 0),
    "Motor": (
        {"getType": 1, "getTargetPosition": 0.1, "getVelocity": 0.2},
        {"target_position_m": 0.1, "target_velocity_m_s": 0.2},
    ),
    "VacuumGripper": ({"isOn": False}, {"on": False}),
}


def device_of(kind: str, answers: dict[str, Any], *, enabled: bool = True) -> Any:
    """A device of a class; what has no answer here must not be asked."""

    def ask(self: Any, name: str) -> Any:
        if name.isupper():
            return {"ROTATIONAL": 0, "LINEAR": 1, "FORCE3D": 2}[name]
        if name == "range_image":
            return answers[name]
        assert name in METHODS[kind], f"{kind} of Webots has no {name}"
        return lambda: answer(name)

    def answer(name: str) -> Any:
        if not enabled and (PERIODS.fullmatch(name) or name == "hasRecognition"):
            return 0
        assert name in answers, f"{kind}.{name} must not be called here"
        return answers[name]

    return type(kind, (), {"__getattr__": ask})()


def raising(_name: str, error: Exception) -> None:
    raise error


def published(device: Any, failed: Callable[[str, Exception], Any] = raising) -> dict[str, Any]:
    said = read_devices(SimpleNamespace(devices={"it": device}), failed)
    return {group: value["it"] for group, value in said.items() if value}  # type: ignore[index]


def test_each_class_of_devices_is_read_or_only_takes_orders() -> None:
    assert TABLE.keys() == RULES.keys()
    assert TABLE.keys() | BLIND == METHODS.keys()


@pytest.mark.parametrize("kind", TABLE)
def test_an_enabled_device_is_read_in_the_way_of_its_class(kind: str) -> None:
    answers, group, value = TABLE[kind]
    assert published(device_of(kind, answers)) == {group: value}


@pytest.mark.parametrize("kind", METHODS)
def test_a_device_that_nobody_enabled_is_asked_for_no_measurement(kind: str) -> None:
    answers, value = DISABLED.get(kind, ({}, None))
    group = TABLE[kind][1] if kind in TABLE else ""
    expected = {group: value} if kind in DISABLED else {}
    assert published(device_of(kind, answers, enabled=False)) == expected


def test_a_camera_is_no_reason_to_read_its_picture() -> None:
    camera = device_of("Camera", {**ENABLED, "hasRecognition": False})
    assert published(camera) == {}


def test_what_nobody_recognises_has_no_objects_behind_its_pointer() -> None:
    answers = TABLE["Camera"][0] | {"getRecognitionNumberOfObjects": 0}
    del answers["getRecognitionObjects"]
    assert published(device_of("Camera", answers))["sensors"] == {
        "count": 0,
        "min_m": None,
        "nearest": [],
    }


@pytest.mark.parametrize("kind", ["Camera", "Radar"])
def test_of_many_objects_the_nearest_are_told_and_all_are_counted(kind: str) -> None:
    many = {
        "Camera": {
            "getRecognitionNumberOfObjects": 500,
            "getRecognitionObjects": [recognised(i, 100.0 - i % 50) for i in range(500)],
        },
        "Radar": {"getNumberOfTargets": 500, "getTargets": [target(500.0 - i) for i in range(500)]},
    }[kind]
    said = published(device_of(kind, TABLE[kind][0] | many))["sensors"]
    assert said["count"] == 500
    assert len(said["nearest"]) == MOST_OBJECTS
    distances = [each["distance_m"] for each in said["nearest"]]
    assert distances == sorted(distances)
    assert said["min_m"] == distances[0]


def test_a_linear_motor_gives_its_force_in_newtons() -> None:
    answers = {
        "getType": 1,
        "getTargetPosition": 0.1,
        "getVelocity": 0.2,
        "getForceFeedbackSamplingPeriod": 32,
        "getForceFeedback": 4.0,
    }
    assert published(device_of("Motor", answers))["motors"]["force_feedback_n"] == 4.0


def test_a_device_that_cannot_be_read_is_named_and_the_others_are_read() -> None:
    failures: list[str] = []
    robot = SimpleNamespace(
        devices={
            "radar": device_of("Radar", {**ENABLED, "getNumberOfTargets": 1, "getTargets": 0}),
            "gyro": device_of("Gyro", TABLE["Gyro"][0]),
        }
    )
    said = read_devices(robot, lambda name, _: failures.append(name))
    assert said == {"sensors": {"gyro": VECTOR}}
    assert failures == ["radar"]


def test_the_battery_is_read_where_its_sensor_is_enabled() -> None:
    def robot(period_ms: int) -> Any:
        return SimpleNamespace(
            devices={},
            batterySensorGetSamplingPeriod=lambda: period_ms,
            batterySensorGetValue=lambda: 99.5,
        )

    assert read_devices(robot(64), raising)["battery_j"] == 99.5
    assert "battery_j" not in read_devices(robot(0), raising)


@pytest.mark.parametrize(("system", "pose"), [(0, [1.0, 2.0, 3.0]), (1, None)])
def test_degrees_of_latitude_are_no_pose(system: int, pose: list[float] | None) -> None:
    devices = {
        "gps": device_of("GPS", TABLE["GPS"][0] | {"getCoordinateSystem": system}),
        "imu": device_of("InertialUnit", TABLE["InertialUnit"][0]),
    }
    assert read_devices(SimpleNamespace(devices=devices), raising).get("pose") == pose


def test_keyboard_and_mouse_keep_their_events(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[object] = []
    robot.keyboard.enable(STEP_MS)
    monkeypatch.setattr(type(robot.keyboard), "getKey", taken.append)
    with MCPBridge(robot, database=database, throttle_interval=1) as bridge:
        robot.step(STEP_MS)
        bridge.auto_publish()
    assert not taken
