"""The command `take_frame`: a picture of what an enabled device sees now, without the loop."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import pytest
from PIL import Image

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge
from webots_mcp.bridge.device_pictures import take_picture
from webots_mcp.bridge.picture_files import encode_png
from webots_mcp.standin import InProcessSupervisor

Drive = Callable[[int], None]
Pixel = tuple[int, int, int]
BLACK, WHITE = (0, 0, 0), (255, 255, 255)


def shown(picture: Any) -> Image.Image:
    return Image.open(io.BytesIO(encode_png(picture.bgra, picture.width, picture.height)))


def test_each_frame_of_a_pause_is_taken_while_it_lasts(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, drive: Drive
) -> None:
    robot.devices["camera"].enable(STEP_MS)  # type: ignore[attr-defined]
    drive(1)
    recording.send("pause")
    sent = [recording.send("take_frame") for _ in range(2)]
    recording.send("resume")
    eager(bridge)
    assert [recording.fate(each)[0] for each in sent] == ["done", "done"]
    paths = {recording.fate(each)[1]["path"] for each in sent}
    assert len(paths) == 2


@pytest.mark.parametrize(
    ("enabled", "camera", "said"),
    [
        ((), "camera", "robot.getDevice('camera').enable(time_step)"),
        ((), "", "disabled: 'camera' (Camera)"),
        (("camera",), "camera", "has no image yet"),
        (("lidar",), "lidar", "'lidar' has not measured anything yet"),
        ((), "gps", "'gps' is a GPS; devices with pictures: 'camera' (Camera), 'lidar' (Lidar)"),
        ((), "eye", "no device 'eye'; devices with pictures: 'camera' (Camera), 'lidar' (Lidar)"),
    ],
)
def test_a_device_without_a_picture_is_named_with_what_to_do(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Drive,
    enabled: tuple[str, ...],
    camera: str,
    said: str,
) -> None:
    drive(1)
    for name in enabled:
        robot.devices[name].enable(STEP_MS)  # type: ignore[attr-defined]
    sent = recording.send("take_frame", camera=camera)
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert said in str(error)


# -- distances -----------------------------------------------------------------------------------


class Ranger:
    """A device of Webots' package that measures distances (R2023b and R2025a)."""

    def __init__(self, ranges: list[float], columns: int) -> None:
        self.range_image = self.ranges = ranges
        self.columns = columns

    def getName(self) -> str:
        return "it"

    def getRangeImage(self) -> list[float]:
        return self.ranges

    def getMinRange(self) -> float:
        return 0.5

    def getMaxRange(self) -> float:
        return 10.0


class RangeFinder(Ranger):
    def getWidth(self) -> int:
        return self.columns

    def getHeight(self) -> int:
        return len(self.ranges) // self.columns


class Lidar(Ranger):
    fov_rad = 2 * math.pi

    def getHorizontalResolution(self) -> int:
        return self.columns

    def getNumberOfLayers(self) -> int:
        return len(self.ranges) // self.columns

    def getFov(self) -> float:
        return self.fov_rad

    def getVerticalFov(self) -> float:
        return 0.2


def test_depths_are_colours_from_red_to_blue() -> None:
    picture = take_picture(RangeFinder([0.5, 10.0, math.inf, math.nan], 2))
    assert picture.scale == "red 0.5 m, yellow, green, blue 10 m; black: nothing in range"
    image = shown(picture)
    near: Any = image.getpixel((0, 0))
    far: Any = image.getpixel((159, 0))
    assert near[0] > 200 > 100 > near[2]
    assert far[2] > 180 > 100 > far[0]
    assert {image.getpixel((0, 159)), image.getpixel((159, 159))} == {BLACK}


@pytest.mark.parametrize(("width", "height"), [(1, 1), (7, 3), (640, 480), (1000, 2), (321, 321)])
def test_a_picture_of_depths_of_any_size_is_within_bounds(width: int, height: int) -> None:
    picture = take_picture(RangeFinder([1.0] * (width * height), width))
    assert shown(picture).size == (picture.width, picture.height)
    assert 160 <= picture.width <= 320


def places_of(image: Image.Image, colour: Pixel) -> set[tuple[int, int]]:
    places = [(x, y) for x in range(image.width) for y in range(image.height)]
    return {place for place in places if image.getpixel(place) == colour}


def test_from_above_left_is_left_and_ahead_is_up() -> None:
    left, ahead = [math.inf] * 8, [math.inf] * 8
    left[2] = 2.0  # an eighth of the way round is 45 degrees: a quarter is to the left
    ahead[4] = 2.0
    of_left = places_of(shown(take_picture(Lidar(left, 8))), WHITE)
    of_ahead = places_of(shown(take_picture(Lidar(ahead, 8))), WHITE)
    assert of_left
    assert max(x for x, _ in of_left) < 100
    assert max(y for _, y in of_ahead) < 100


def test_rings_are_round_numbers_that_reach_beyond_the_farthest_point() -> None:
    picture = take_picture(Lidar([3.1] * 360, 360))
    assert picture.scale == "from above, up is ahead; a ring each 1 m, the last 4 m"
    far: set[float] = {math.dist(at, (180, 180)) for at in places_of(shown(picture), WHITE)}
    assert min(far) == pytest.approx(3.1 / 4 * 172, abs=3)
    assert max(far) == pytest.approx(3.1 / 4 * 172, abs=3)


def test_a_lidar_that_sees_nothing_is_drawn_with_its_range() -> None:
    picture = take_picture(Lidar([math.inf] * 8, 8))
    assert str(picture.scale).endswith("a ring each 5 m, the last 10 m")
    assert not places_of(shown(picture), WHITE)


def test_a_lidar_of_a_million_points_is_drawn_from_some_of_them() -> None:
    picture = take_picture(Lidar([2.0] * 1_000_000, 20_000))
    assert places_of(shown(picture), WHITE)
