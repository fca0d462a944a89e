"""Wheels move the robot, and walls stop it."""

from __future__ import annotations

from math import cos, dist, hypot, inf, pi, sin
from pathlib import Path

import pytest

from tests.standin.placing import place
from webots_mcp.standin import InProcessRobot, InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD

STEP_MS = 16
RADIUS_M, TRACK_M = 0.04, 0.15


class Driver(InProcessSupervisor):
    """A rover with a steering wheel."""

    def drive(self, left: float, right: float, seconds: float) -> None:
        for name, speed in (("left wheel motor", left), ("right wheel motor", right)):
            self.getDevice(name).setPosition(inf)
            self.getDevice(name).setVelocity(speed)
        for _ in range(round(seconds * 1000 / STEP_MS)):
            assert self.step(STEP_MS) == 0

    @property
    def truth(self) -> tuple[float, float, float]:
        rover = self.simulation.robot("rover")
        return rover.position[0], rover.position[1], rover.yaw_rad


@pytest.mark.parametrize(
    ("asked_radps", "turned_radps"), [(5.0, 5.0), (-3.0, -3.0), (1000.0, 12.0)]
)
def test_wheels_turn_no_faster_than_their_motors_allow(
    asked_radps: float, turned_radps: float
) -> None:
    driver = Driver()
    driver.drive(asked_radps, asked_radps, 0.8)
    assert driver.truth == pytest.approx((-1.2 + turned_radps * RADIUS_M * 0.8, 0.0, 0.0))
    assert driver.getDevice("left wheel motor").getVelocity() == asked_radps


def test_a_motor_turns_to_a_position_and_stays_there() -> None:
    driver = Driver()
    for side in ("left", "right"):
        driver.getDevice(f"{side} wheel motor").setPosition(5.0)
    driver.step(100 * STEP_MS)
    assert driver.truth[0] == pytest.approx(-1.2 + 5.0 * RADIUS_M)


def test_unequal_wheels_drive_a_circle_of_the_right_size() -> None:
    driver = Driver()
    place(driver, 0.0, 1.3)
    driver.drive(2.0, 4.0, 3.2)
    yaw = (4.0 - 2.0) * RADIUS_M / TRACK_M * 3.2
    circle_m = TRACK_M / 2.0 * (4.0 + 2.0) / (4.0 - 2.0)
    expected = (circle_m * sin(yaw), 1.3 + circle_m * (1.0 - cos(yaw)), yaw)
    assert driver.truth == pytest.approx(expected, abs=1e-3)


def test_a_motor_limited_in_acceleration_needs_time_to_start() -> None:
    driver = Driver()
    for side in ("left", "right"):
        driver.getDevice(f"{side} wheel motor").setAcceleration(1.0)
    driver.drive(5.0, 5.0, 1.6)
    assert driver.truth[0] == pytest.approx(-1.2 + 0.5 * 1.6**2 * RADIUS_M, abs=2e-3)


def test_against_a_wall_the_wheels_spin_and_the_robot_stands() -> None:
    driver = Driver()
    place(driver, 1.7, 0.0)
    wheel = driver.getDevice("left wheel sensor")
    wheel.enable(STEP_MS)
    driver.drive(5.0, 5.0, 1.6)
    before, turned = driver.truth, wheel.getValue()
    driver.drive(5.0, 5.0, 1.6)
    assert driver.truth == before
    assert wheel.getValue() - turned == pytest.approx(8.0)
    assert driver.simulation.robot("rover").is_touching
    assert driver.simulation.robot("rover").collisions == 1


def test_a_robot_that_meets_a_wall_at_an_angle_slides_along_it() -> None:
    driver = Driver()
    place(driver, 1.7, 0.0, pi / 3)
    driver.drive(5.0, 5.0, 3.2)
    x, y, _ = driver.truth
    assert x < 2.0
    assert y == pytest.approx(5.0 * RADIUS_M * 3.2 * sin(pi / 3), abs=0.05)


def test_the_ball_gives_way_until_the_wall_stops_it() -> None:
    driver = Driver()
    place(driver, 0.0, -0.2)
    driver.drive(6.0, 6.0, 3.2)
    ball = driver.getFromDef("BALL")
    assert ball is not None
    pushed = ball.getPosition()
    assert pushed[0] > 0.7
    driver.drive(6.0, 6.0, 8.0)
    assert abs(ball.getPosition()[0]) < 2.0
    assert hypot(*driver.truth[:2]) < 2.0


def test_two_robots_do_not_drive_through_each_other(tmp_path: Path) -> None:
    simulation = InProcessSimulation(two_rovers(tmp_path))
    driver = Driver("rover", world=simulation)
    other = InProcessRobot("other", world=simulation)
    for _ in range(300):
        driver.drive(6.0, 6.0, STEP_MS / 1000)
        other.step(STEP_MS)
    here, there = simulation.robot("rover").position, simulation.robot("other").position
    assert dist(here, there) > 0.2
    assert there == (-0.4, 0.0, 0.04)


def two_rovers(folder: Path) -> Path:
    """The arena with a second rover in the first one's way."""
    text = DEFAULT_WORLD.read_text(encoding="utf-8")
    rover = text[text.index("DEF ROVER") :]
    second = rover.replace("ROVER", "OTHER").replace("-1.2 0 0.04", "-0.4 0 0.04")
    path = folder / "two.wbt"
    path.write_text(text + second.replace('name "rover"', 'name "other"'), encoding="utf-8")
    return path
