"""Accelerometer, gyro, compass, light and touch sensors show what physics says."""

from __future__ import annotations

import ctypes
from math import cos, isnan, pi, sin, sqrt
from pathlib import Path

import pytest
from controller import LED, TouchSensor
from controller.surface import NotInStandInError

from tests.standin.placing import STEP_MS, drive, enabled, place
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD

LIGHTS_OF_THE_ARENA = (
    "DirectionalLight {\n  ambientIntensity 1\n  direction 0.4 0.3 -1\n  intensity 2\n}"
)


def rover_with(devices: str, tmp_path: Path, lights: str = "") -> InProcessSupervisor:
    """The arena's rover with more devices, under other lights."""
    text = DEFAULT_WORLD.read_text(encoding="utf-8")
    at = text.index("children [", text.index("DEF ROVER Robot")) + len("children [")
    world = tmp_path / "arena.wbt"
    text = f"{text[:at]}\n{devices}\n{text[at:]}"
    assert LIGHTS_OF_THE_ARENA in text
    world.write_text(text.replace(LIGHTS_OF_THE_ARENA, lights), encoding="utf-8")
    return InProcessSupervisor(world=world)


def test_an_accelerometer_shows_gravity_and_what_moves_it(tmp_path: Path) -> None:
    robot = rover_with("Accelerometer { }", tmp_path)
    sensor = enabled(robot, "accelerometer")
    assert all(isnan(value) for value in sensor.getValues())
    drive(robot, 0.0, 0.0, 1)
    assert sensor.getValues() == sensor.value == [0.0, 0.0, 9.81]
    for side in ("left", "right"):
        robot.getDevice(f"{side} wheel motor").setAcceleration(10.0)
    drive(robot, 5.0, 5.0, 10)  # 10 rad/s² on wheels of 4 cm: 0.4 m/s²
    assert sensor.getValues() == pytest.approx([0.4, 0.0, 9.81])
    drive(robot, 5.0, 5.0, 40)
    assert sensor.getValues() == pytest.approx([0.0, 0.0, 9.81])


def test_an_accelerometer_off_the_middle_feels_the_turn(tmp_path: Path) -> None:
    robot = rover_with("Accelerometer { translation 0.1 0 0 }", tmp_path)
    sensor, gyro = enabled(robot, "accelerometer"), 0.0
    drive(robot, -2.0, 2.0, 20)
    gyro = robot.getSelf().getVelocity()[5]
    assert gyro > 0.5
    felt = sensor.getValues()
    assert felt[0] == pytest.approx(-(gyro**2) * 0.1, rel=0.02)  # towards the middle
    assert felt[1] == pytest.approx(0.0, abs=0.02)


def test_a_turned_sensor_feels_along_its_own_axes(tmp_path: Path) -> None:
    robot = rover_with(f"Accelerometer {{ rotation 0 1 0 {pi / 2} }}", tmp_path)
    sensor = enabled(robot, "accelerometer")
    drive(robot, 0.0, 0.0, 1)
    assert sensor.getValues() == pytest.approx([-9.81, 0.0, 0.0])  # its x axis points down


def test_a_gyro_shows_how_fast_the_robot_turns(tmp_path: Path) -> None:
    robot = rover_with("Gyro { xAxis FALSE lookupTable [ -10 -1000 0 10 1000 0 ] }", tmp_path)
    gyro = enabled(robot, "gyro")
    drive(robot, -2.0, 2.0, 5)
    x, y, z = gyro.getValues()
    assert isnan(x) and y == 0.0
    assert z == pytest.approx(100.0 * robot.getSelf().getVelocity()[5])
    assert gyro.getLookupTable() == [-10.0, -1000.0, 0.0, 10.0, 1000.0, 0.0]


def test_a_compass_shows_where_the_y_axis_of_the_world_is(tmp_path: Path) -> None:
    robot = rover_with("Compass { }", tmp_path)
    compass = enabled(robot, "compass")
    place(robot, 0.0, 0.0, 0.7)
    robot.step(STEP_MS)
    assert compass.getValues() == pytest.approx([sin(0.7), cos(0.7), 0.0])


def test_a_light_sensor_adds_up_the_lights_that_it_faces(tmp_path: Path) -> None:
    raw = "lookupTable [ ] "
    devices = f"""LightSensor {{ name "ahead" {raw} }}
        LightSensor {{ name "behind" rotation 0 0 1 {pi} {raw} }}
        LightSensor {{ name "up" rotation 0 1 0 {-pi / 2} {raw} colorFilter 1 0 0 }}"""
    lights = """DirectionalLight { direction -1 0 -1 intensity 3 ambientIntensity 0.5 }
        PointLight { location -1.2 0 1.04 intensity 2 attenuation 0 0 1 }
        PointLight { location 5 5 5 on FALSE }"""
    robot = rover_with(devices, tmp_path, lights)
    ahead, behind, up = (enabled(robot, name) for name in ("ahead", "behind", "up"))
    robot.step(STEP_MS)
    assert ahead.getValue() == ahead.value == pytest.approx(0.5 + 3.0 / sqrt(2.0))
    assert behind.getValue() == pytest.approx(0.5)
    assert up.getValue() == pytest.approx((0.5 + 3.0 / sqrt(2.0) + 2.0) / 3.0)  # red alone


BUMPERS = """
TouchSensor { name "front" translation 0.1 0 0 boundingObject Box { size 0.02 0.16 0.05 } }
TouchSensor { name "back" translation -0.1 0 0 boundingObject Box { size 0.02 0.16 0.05 } }
"""


def test_a_bumper_is_pressed_where_the_robot_runs_into_something(tmp_path: Path) -> None:
    robot = rover_with(BUMPERS, tmp_path)
    front, back = enabled(robot, "front"), enabled(robot, "back")
    place(robot, 1.85, 1.5)  # the wall in the east is ahead
    drive(robot, 5.0, 5.0, 30)
    assert (front.getValue(), back.getValue()) == (1.0, 0.0)
    drive(robot, -5.0, -5.0, 5)
    assert (front.getValue(), back.getValue()) == (0.0, 0.0)
    assert front.getType() == TouchSensor.BUMPER
    drive(robot, 5.0, 5.0, 10)
    assert front.getValue() == 1.0
    robot.simulationReset()
    robot.step(STEP_MS)
    assert front.getValue() == 0.0


def test_a_touch_sensor_that_measures_force_is_refused(tmp_path: Path) -> None:
    robot = rover_with('TouchSensor { type "force" }', tmp_path)
    with pytest.raises(NotInStandInError, match="no TouchSensor of type 'force'"):
        robot.getDevice("touch sensor").getValue()


def test_a_lamp_remembers_what_it_was_told(tmp_path: Path) -> None:
    robot = rover_with("LED { }", tmp_path)
    led = robot.getDevice("led")
    assert isinstance(led, LED)
    assert led.get() == 0
    led.set(1)
    assert led.get() == led.value == 1
    with pytest.raises(ctypes.ArgumentError):
        led.set(1.0)  # type: ignore[arg-type]
