"""What sensors show, when, and what their wrappers refuse."""

from __future__ import annotations

from math import inf, isnan, nan
from pathlib import Path

import pytest
from controller import GPS, Camera, DistanceSensor, Lidar, Motor, Node

from tests.standin.placing import STEP_MS, drive, enabled, place, steps
from webots_mcp.standin import InProcessSupervisor


@pytest.fixture
def robot() -> InProcessSupervisor:
    return InProcessSupervisor()


def test_devices_come_in_the_order_of_the_scene_tree(robot: InProcessSupervisor) -> None:
    names = [robot.getDeviceByIndex(i).getName() for i in range(robot.getNumberOfDevices())]
    assert names == [
        *("left wheel motor", "left wheel sensor", "right wheel motor", "right wheel sensor"),
        *("ds_left", "ds_right", "camera", "gps", "inertial unit", "lidar"),
    ]
    assert [*robot.devices] == names
    assert isinstance(robot.devices["gps"], GPS)
    assert robot.getDevice("gps") is robot.devices["gps"]
    assert robot.getDevice("gps").getNodeType() == Node.GPS != Node.LIDAR
    assert {type(device).__module__.split(".")[0] for device in robot.devices.values()} == {
        "controller"
    }


def test_the_first_value_comes_when_the_period_has_passed(robot: InProcessSupervisor) -> None:
    gps, wheel = enabled(robot, "gps", 64), enabled(robot, "left wheel sensor", 64)
    for _ in range(3):
        steps(robot, 1)
        assert all(isnan(value) for value in gps.getValues())
        assert isnan(wheel.getValue())
        assert isnan(gps.getSpeed())
    steps(robot, 1)
    assert gps.getValues() == pytest.approx([-1.2, 0.0, 0.09])
    assert wheel.getValue() == 0.0


def test_an_inertial_unit_shows_plausible_nonsense_first(robot: InProcessSupervisor) -> None:
    unit = enabled(robot, "inertial unit")
    assert unit.getRollPitchYaw() != [0.0, 0.0, 0.0]
    steps(robot, 1)
    assert unit.getRollPitchYaw() == [0.0, 0.0, 0.0]
    assert unit.getQuaternion() == [0.0, 0.0, 0.0, 1.0]


def test_a_distance_sensor_looks_along_its_ray(robot: InProcessSupervisor) -> None:
    sensor: DistanceSensor = enabled(robot, "ds_left")
    place(robot, 1.44, 1.5, -0.4)  # the left eye looks 0.4 rad to the left: straight east
    steps(robot, 1)
    eye_x = 1.44 + 0.06 * 0.92106 + 0.04 * 0.38942
    assert sensor.getValue() == pytest.approx(2.0 - eye_x, abs=1e-4)
    assert (sensor.getMinValue(), sensor.getMaxValue()) == (0.0, 1.0)
    place(robot, -1.2, 0.0)
    steps(robot, 1)
    assert sensor.getValue() == 1.0


def test_gps_and_speed_follow_the_robot(robot: InProcessSupervisor) -> None:
    gps: GPS = enabled(robot, "gps")
    drive(robot, 5.0, 5.0, 50)
    assert gps.getSpeed() == pytest.approx(0.2)
    assert gps.getSpeedVector() == pytest.approx([0.2, 0.0, 0.0])
    assert gps.getValues()[0] == pytest.approx(-1.2 + 0.2 * 0.8)


def test_the_lidar_sees_walls_and_nothing_beyond_its_range(robot: InProcessSupervisor) -> None:
    lidar: Lidar = enabled(robot, "lidar", 2 * STEP_MS)
    steps(robot, 1)
    assert not lidar.range_image
    with pytest.raises(ValueError, match="NULL pointer"):
        lidar.getRangeImage()
    steps(robot, 1)
    ranges = lidar.getRangeImage()
    assert lidar.range_image[3] == pytest.approx(ranges[3])
    assert len(ranges) == lidar.getHorizontalResolution() == 180
    assert ranges[45] == pytest.approx(2.0, abs=0.01)  # left: the wall in the north
    assert ranges[0] == pytest.approx(0.8, abs=0.01)  # behind: the wall in the west
    assert min(ranges) > 0.1
    place(robot, -1.9, -1.9, 0.78)
    steps(robot, 2)
    assert lidar.getRangeImage()[90] == inf  # the diagonal is longer than 3.5 m


def test_a_level_lidar_looks_over_what_is_low(robot: InProcessSupervisor) -> None:
    lidar: Lidar = enabled(robot, "lidar")
    sensor: DistanceSensor = enabled(robot, "ds_left")
    place(robot, -0.3 - 0.5, 0.9 - 0.04, -0.4)  # the crate is 12 cm high, the lidar at 14
    steps(robot, 1)
    assert sensor.getValue() < 0.5
    assert lidar.getRangeImage()[90 - 11] > 0.5


def test_a_camera_shows_what_is_in_front_of_it(robot: InProcessSupervisor) -> None:
    camera: Camera = enabled(robot, "camera")
    with pytest.raises(ValueError, match="NULL pointer"):
        camera.getImage()
    place(robot, 0.2, -0.6)  # the green pillar is ahead
    steps(robot, 1)
    image = camera.getImage()
    assert isinstance(image, bytes)
    assert len(image) == 4 * 160 * 120
    middle = [get(image, 160, 80, 60) for get in (Camera.imageGetRed, Camera.imageGetGreen)]
    assert middle[1] > 2 * middle[0]
    assert image[:4] == bytes((230, 191, 153, 255))  # blue, green, red, alpha of the sky
    assert len(camera.getImageArray()) == 160
    camera.disable()
    with pytest.raises(ValueError, match="NULL pointer"):
        camera.getImage()


def test_a_camera_writes_its_picture_itself(robot: InProcessSupervisor, tmp_path: Path) -> None:
    camera: Camera = enabled(robot, "camera")
    steps(robot, 1)
    assert camera.saveImage(str(tmp_path / "x.png"), 90) == 0
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert camera.saveImage(str(tmp_path / "x.txt"), 90) == -1


def test_a_picture_shows_the_moment_it_was_taken(robot: InProcessSupervisor) -> None:
    camera: Camera = enabled(robot, "camera", 4 * STEP_MS)
    steps(robot, 4)
    first = camera.getImage()
    place(robot, 0.2, -0.6)
    steps(robot, 1)
    assert camera.getImage() == first
    steps(robot, 3)
    assert camera.getImage() != first


def test_motors_tell_what_was_commanded(robot: InProcessSupervisor) -> None:
    motor: Motor = robot.getDevice("left wheel motor")
    assert motor.getVelocity() == motor.getMaxVelocity() == 12.0
    motor.setVelocity(-1.0)  # refused: the target position is finite
    assert motor.getVelocity() == 12.0
    motor.setPosition(inf)
    motor.setVelocity(-1)
    motor.setVelocity(nan)  # refused
    assert (motor.target_velocity, motor.getTargetPosition()) == (-1.0, inf)
    sensor = motor.getPositionSensor()
    assert sensor is not None and sensor.getName() == "left wheel sensor"
