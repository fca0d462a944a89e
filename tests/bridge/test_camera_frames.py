"""Small camera frames are held with the last seconds, and kept where those are kept."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge.camera_frames import LONGEST_SIDE_PX, MOST_FRAMES, scale_down
from webots_mcp.contract import KEEP_AFTER_S, KEEP_LAST_S
from webots_mcp.standin import InProcessSupervisor

STEP_S = STEP_MS / 1000
INTERVAL_S = 0.2
Make = Callable[..., MCPBridge]

FRAMES = (
    "SELECT sim_time_s, device, path, width, height, size_bytes FROM image WHERE kind = 'kept' "
    "ORDER BY sim_time_s"
)
STRETCHES = "SELECT start_sim_time_s, end_sim_time_s FROM kept_stretch ORDER BY id"
WARNINGS = "SELECT message FROM log WHERE level = 'warning'"


@pytest.fixture
def make(robot: InProcessSupervisor, database: MemoryDatabase, data_dir: Path) -> Iterator[Make]:
    made: list[MCPBridge] = []

    def new(**options: Any) -> MCPBridge:
        given = dict[str, Any](throttle_interval=10, database=database, data_dir=data_dir)
        made.append(MCPBridge(robot, **given | options))
        return made[-1]

    yield new
    for bridge in made:
        bridge.close()


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def camera(robot: InProcessSupervisor) -> Any:
    camera = robot.getDevice("camera")
    camera.enable(STEP_MS)
    robot.step(2 * STEP_MS)
    return camera


@pytest.fixture
def bridge(make: Make, camera: Any) -> MCPBridge:
    bridge = make()
    bridge.keep_camera(camera)
    return bridge


def drive(robot: InProcessSupervisor, bridge: MCPBridge, numbers: range) -> None:
    for number in numbers:
        assert robot.step(STEP_MS) != -1
        bridge.publish({"n": number})
        eager(bridge)


@pytest.mark.parametrize("throttle_interval", [1, 10])
def test_a_hit_keeps_frames_of_the_seconds_around_and_one_of_its_very_step(
    robot: InProcessSupervisor,
    make: Make,
    camera: Any,
    recording: Recording,
    throttle_interval: int,
) -> None:
    bridge = make(throttle_interval=throttle_interval)
    bridge.keep_camera(camera)
    bridge.breakpoint("n == 501", "keep")

    drive(robot, bridge, range(900))

    ((start_s, end_s),) = recording.rows(STRETCHES)
    hit_s = robot.getTime() - 398 * STEP_S
    times = [row[0] for row in recording.rows(FRAMES)]
    assert any(time_s == pytest.approx(hit_s) for time_s in times)
    assert start_s <= times[0] < start_s + INTERVAL_S + STEP_S
    assert end_s - INTERVAL_S - STEP_S < times[-1] <= end_s
    assert len(times) == pytest.approx((KEEP_LAST_S + KEEP_AFTER_S) / INTERVAL_S, rel=0.1)


def test_a_kept_frame_is_a_picture_of_what_the_camera_saw_then(
    robot: InProcessSupervisor, bridge: MCPBridge, camera: Any, recording: Recording, data_dir: Path
) -> None:
    bridge.breakpoint("n == 100", "keep")
    drive(robot, bridge, range(101))
    seen, hit_s = camera.getImage(), robot.getTime()
    drive(robot, bridge, range(101, 140))

    rows = {round(row[0], 3): row for row in recording.rows(FRAMES)}
    _, device, path, width, height, size = rows[round(hit_s, 3)]
    assert (device, width, height) == ("camera", 160, 120)
    assert size == (data_dir / path).stat().st_size
    with Image.open(data_dir / path) as picture:
        assert (
            picture.convert("RGB").tobytes()
            == Image.frombytes("RGBA", (160, 120), seen, "raw", "BGRA").convert("RGB").tobytes()
        )


def test_nothing_is_written_before_something_is_kept(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, data_dir: Path
) -> None:
    drive(robot, bridge, range(500))

    assert recording.rows(FRAMES) == []
    assert not list(data_dir.glob("camera/*"))


def test_frames_are_written_one_with_each_call(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    drive(robot, bridge, range(400))
    bridge.keep("a look")
    for number in range(5):
        assert len(recording.rows(FRAMES)) == number
        bridge.get_command()


def test_a_reset_begins_without_frames_of_the_run_before(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    drive(robot, bridge, range(200))
    robot.simulationReset()
    drive(robot, bridge, range(60))
    bridge.keep("a look")
    drive(robot, bridge, range(60, 100))

    rows = recording.rows("SELECT run_id, sim_time_s FROM image WHERE kind = 'kept'")
    assert {run_id for run_id, _ in rows} == {2}
    assert len(rows) == pytest.approx(100 * STEP_S / INTERVAL_S, abs=2)


@pytest.mark.slow
def test_memory_holds_a_bounded_number_of_frames(
    robot: InProcessSupervisor, make: Make, camera: Any, recording: Recording
) -> None:
    bridge = make(keep_last_s=600)
    bridge.keep_camera(camera, frames_per_s=100)
    drive(robot, bridge, range(MOST_FRAMES + 100))
    bridge.keep("a look")
    bridge.close()

    times = [row[0] for row in recording.rows(FRAMES)]
    assert len(times) == MOST_FRAMES
    assert times[-1] == pytest.approx(robot.getTime())


def test_a_camera_is_looked_at_no_more_often_than_it_takes_pictures(
    robot: InProcessSupervisor, make: Make, recording: Recording
) -> None:
    camera = robot.getDevice("camera")
    camera.enable(5 * STEP_MS)
    bridge = make()
    bridge.keep_camera(camera, frames_per_s=100)
    drive(robot, bridge, range(100))
    bridge.keep("a look")
    bridge.close()

    assert len(recording.rows(FRAMES)) == pytest.approx(100 / 5, abs=2)


def test_auto_publish_takes_frames_too(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    for _ in range(200):
        robot.step(STEP_MS)
        bridge.auto_publish()
    bridge.keep("a look")
    bridge.close()

    assert len(recording.rows(FRAMES)) == pytest.approx(200 * STEP_S / INTERVAL_S, abs=2)


class Broken:
    """A camera that is asked for what it does not have, as Webots' answers it or worse."""

    def __init__(self, image: Any, name: str = "broken") -> None:
        self._image, self._name = image, name

    def getName(self) -> str:
        return self._name

    def getSamplingPeriod(self) -> int:
        return STEP_MS

    def getWidth(self) -> int:
        return 40

    def getHeight(self) -> int:
        return 30

    def getImage(self) -> Any:
        if isinstance(self._image, Exception):
            raise self._image
        return self._image


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (None, "has no image yet"),
        (b"", "has no image yet"),
        (ValueError("NULL pointer access"), "has no image yet"),
        (bytes(7), "7 bytes are not an image of 40 x 30 pixels"),
        (OSError("gone"), "gone"),
    ],
    ids=repr,
)
def test_a_camera_without_an_image_costs_its_frames_and_nothing_else(
    robot: InProcessSupervisor, make: Make, recording: Recording, image: Any, said: str
) -> None:
    bridge = make(throttle_interval=1)
    bridge.keep_camera(Broken(image))
    bridge.breakpoint("n == 30", "keep")
    drive(robot, bridge, range(60))

    assert bridge.stats().frames_missed >= 4
    assert bridge.stats().failures == 0
    (told,) = recording.rows(WARNINGS)
    assert re.search(re.escape(said), told)
    assert recording.rows("SELECT count(*) FROM state") == [60]
    assert recording.rows(FRAMES) == []


def test_cameras_whose_names_are_no_file_names_keep_pictures_of_their_own(
    robot: InProcessSupervisor, make: Make, recording: Recording, data_dir: Path
) -> None:
    bridge, names = make(), ("a/b", "a:b", "a_b", "x" * 300, f"{'x' * 300}y", "")
    reds = {name: 40 * number for number, name in enumerate(names)}
    for name, red in reds.items():
        camera = Broken(bytes((0, 0, red, 255)) * 1200, name)
        bridge.keep_camera(camera)
        bridge.save_camera_frame(camera)
    drive(robot, bridge, range(60))
    bridge.keep("a look")
    bridge.close()

    rows = recording.rows("SELECT device, kind, path FROM image")
    assert {(device, kind) for device, kind, _ in rows} == set(product(names, ("camera", "kept")))
    for device, _, path in rows:
        with Image.open(data_dir / path) as picture:
            assert picture.getpixel((0, 0)) == (reds[device], 0, 0), path
    assert "camera/rover.a_b.000001.png" in {path for *_, path in rows}


@pytest.mark.skipif(os.name == "nt", reason="no limits and no modes of this kind")
def test_pictures_are_their_owners_alone_and_a_full_disk_leaves_no_halves(
    robot: InProcessSupervisor, make: Make, data_dir: Path
) -> None:
    import resource

    bridge, camera = make(), Broken(os.urandom(4800))
    bridge.keep_camera(camera)
    drive(robot, bridge, range(60))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        bridge.save_camera_frame(camera)
        bridge.keep("a look")
        drive(robot, bridge, range(60, 80))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(data_dir.glob("camera/*")) == []
    assert "File too large" in str(bridge.stats().last_error)
    bridge.save_camera_frame(camera)
    (file,) = data_dir.glob("camera/*")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    ("device", "frames_per_s", "said"),
    [
        (None, 5.0, "a Camera is needed, and NoneType has no getName"),
        ("lidar", 5.0, "a Camera is needed, and Lidar has no getWidth, getHeight, getImage"),
        ("camera", 0, "frames_per_s must be above 0 and at most 100: 0"),
        ("camera", float("nan"), "at most 100: nan"),
    ],
)
def test_what_is_not_a_camera_is_said_once_and_raises_nothing(
    robot: InProcessSupervisor,
    make: Make,
    capfd: pytest.CaptureFixture[str],
    device: str | None,
    frames_per_s: float,
    said: str,
) -> None:
    bridge = make()
    for _ in range(2):
        bridge.keep_camera(device and robot.getDevice(device), frames_per_s)

    assert said in str(bridge.stats().last_error)
    assert bridge.stats().failures == 2
    assert capfd.readouterr().err.count(said) == 1


def test_without_a_ring_buffer_no_frame_is_taken_and_it_is_said(
    robot: InProcessSupervisor, make: Make, camera: Any, recording: Recording
) -> None:
    bridge = make(keep_last_s=0)
    bridge.keep_camera(camera)
    drive(robot, bridge, range(50))
    bridge.keep("a look")

    assert "keep_last_s is 0" in str(bridge.stats().last_error)
    assert recording.rows(FRAMES) == []


@pytest.mark.skipif(os.name == "nt", reason="a folder that nobody may write to")
def test_frames_that_cannot_be_written_are_counted_and_the_rows_are_there(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, data_dir: Path
) -> None:
    drive(robot, bridge, range(100))
    data_dir.mkdir(exist_ok=True)
    (data_dir / "camera").write_text("no folder")
    bridge.keep("a look")
    drive(robot, bridge, range(100, 120))
    bridge.close()

    assert bridge.stats().frames_missed >= 8
    assert "keep_camera failed" in str(bridge.stats().last_error)
    assert recording.rows(FRAMES) == []
    assert recording.rows("SELECT count(*) FROM all_state") == [120]


@pytest.mark.parametrize("size", [(640, 480), (1921, 7), (3, 500), (160, 160), (161, 1)])
def test_a_frame_is_the_image_at_each_nth_pixel(size: tuple[int, int]) -> None:
    width, height = size
    image = os.urandom(4 * width * height)
    scaled_width, scaled_height, scaled = scale_down(image, width, height)

    step = -(-max(size) // LONGEST_SIDE_PX)
    picture = Image.frombytes("RGBA", size, image)
    expected = [
        picture.getpixel((x, y)) for y in range(0, height, step) for x in range(0, width, step)
    ]
    assert max(scaled_width, scaled_height) <= LONGEST_SIDE_PX
    small = Image.frombytes("RGBA", (scaled_width, scaled_height), scaled)
    found = [small.getpixel((x, y)) for y in range(scaled_height) for x in range(scaled_width)]
    assert found == expected
