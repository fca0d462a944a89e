"""Movies and animations of the scene: begun and ended by commands, made by the simulator."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.bridge.conftest import STEP_MS, Recording, eager
from tests.waiting import wait_for
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessRobot, InProcessSupervisor


class Scene:
    """A supervisor that drives, and sends itself the command `record_scene`."""

    def __init__(self, robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording) -> None:
        self.robot, self.bridge, self.recording = robot, bridge, recording
        for side in ("left", "right"):
            motor: Any = robot.getDevice(f"{side} wheel motor")
            motor.setPosition(float("inf"))
            motor.setVelocity(3.0)

    def drive(self, steps: int) -> None:
        for _ in range(steps):
            assert self.robot.step(STEP_MS) != -1
            self.bridge.publish({"mode": "cruise"})
            eager(self.bridge)

    def ask(self, action: str = "record_scene", **params: object) -> tuple[str, Any, str]:
        """Send a command and drive until it is final."""
        sent = self.recording.send(action, 60, **params)

        def is_final() -> bool:
            self.drive(1)
            return self.recording.fate(sent)[0] not in ("pending", "claimed")

        wait_for(is_final)
        status, result, error = self.recording.fate(sent)
        return status, result, error or ""


@pytest.fixture
def scene(robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording) -> Scene:
    return Scene(robot, bridge, recording)


def pictures_in(movie: bytes) -> list[Image.Image]:
    """The pictures of a movie, by the tables of its sizes and places."""
    sizes_at = movie.index(b"stsz") + 12
    count = int.from_bytes(movie[sizes_at : sizes_at + 4], "big")
    words = [movie[sizes_at + 4 + 4 * i : sizes_at + 8 + 4 * i] for i in range(count)]
    place = movie.index(b"stco") + 12
    begin = int.from_bytes(movie[place : place + 4], "big")
    pictures: list[Image.Image] = []
    for size in (int.from_bytes(word, "big") for word in words):
        pictures.append(Image.open(io.BytesIO(movie[begin : begin + size])))
        begin += size
    return pictures


def test_a_movie_is_done_when_its_file_is_written(scene: Scene) -> None:
    status, begun, _ = scene.ask(do="start", width=320, height=240)
    assert (status, begun["kind"]) == ("done", "movie")
    scene.drive(50)
    status, ended, error = scene.ask(do="stop")
    assert status == "done", error
    file = scene.bridge.data_dir / ended["path"]
    assert (ended["path"], ended["size_bytes"]) == (begun["path"], file.stat().st_size)
    assert ended["to_s"] - ended["from_s"] >= 50 * STEP_MS / 1000
    pictures = pictures_in(file.read_bytes())
    assert len(pictures) == pytest.approx((ended["to_s"] - ended["from_s"]) / 0.048, abs=2)
    assert {picture.size for picture in pictures} == {(320, 240)}
    assert pictures[0].tobytes() != pictures[-1].tobytes()


def test_an_animation_holds_what_moved_and_names_all_of_its_files(scene: Scene) -> None:
    assert scene.ask(do="start", kind="animation")[0] == "done"
    scene.drive(50)
    status, ended, error = scene.ask(do="stop")
    assert status == "done", error
    page = scene.bridge.data_dir / ended["path"]
    assert ended["also"] == [page.with_suffix(".json").name]
    frames = json.loads(page.with_suffix(".json").read_text("utf-8"))["frames"]
    moved = {update["id"] for frame in frames for update in frame["updates"]}
    assert len(moved) == 1
    assert [frame["time"] for frame in frames] == sorted(frame["time"] for frame in frames)
    assert json.dumps(frames[-1]) in page.read_text("utf-8")


def test_both_are_noted_as_events(scene: Scene) -> None:
    scene.ask(do="start", width=32, height=32)
    scene.drive(10)
    scene.ask(do="stop")
    rows = scene.recording.rows("SELECT data FROM event WHERE kind = 'record_scene' ORDER BY id")
    assert [json.loads(row)["do"] for row in rows] == ["start", "stop"]


def test_an_animation_of_what_stands_still_fails_and_says_why(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    scene = Scene(robot, bridge, recording)
    for side in ("left", "right"):
        motor: Any = robot.getDevice(f"{side} wheel motor")
        motor.setVelocity(0.0)
    scene.ask(do="start", kind="animation")
    status, _, error = scene.ask(do="stop")
    assert status == "failed"
    assert "nothing moved" in error


def test_a_movie_of_a_pause_fails_as_nothing_is_rendered(
    scene: Scene, recording: Recording
) -> None:
    pause, start, stop = (
        recording.send("pause"),
        recording.send("record_scene", do="start", width=64, height=64),
        recording.send("record_scene", do="stop"),
    )
    resume = recording.send("resume")
    scene.drive(3)
    assert [recording.fate(each)[0] for each in (pause, start, stop, resume)] == [
        "done", "done", "failed", "done",
    ]  # fmt: skip
    assert "nothing was rendered" in str(recording.fate(stop)[2])
    assert scene.ask(do="start")[0] == "done", "a failed movie does not stand in the way"


def test_one_recording_is_possible_at_a_time(scene: Scene) -> None:
    scene.ask(do="start", width=32, height=32)
    for kind in ("movie", "animation"):
        status, _, error = scene.ask(do="start", kind=kind)
        assert status == "failed"
        assert "one recording is possible at a time" in error
        assert "action='stop'" in error
    assert "is being recorded, not an animation" in scene.ask(do="stop", kind="animation")[2]
    scene.drive(5)
    assert scene.ask(do="stop")[0] == "done"
    assert "nothing is being recorded" in scene.ask(do="stop")[2]


def test_a_movie_that_the_controller_itself_records_is_left_alone(
    scene: Scene, tmp_path: Path
) -> None:
    scene.robot.movieStartRecording(str(tmp_path / "own.mp4"), 64, 64, 0, 90, 1, False)
    assert "this controller has not started" in scene.ask(do="start")[2]
    assert not scene.robot.movieIsReady()


@pytest.mark.parametrize("action", ["reload", "quit", "load_world"])
def test_what_would_discard_the_recording_is_refused_until_it_is_stopped(
    scene: Scene, action: str
) -> None:
    is_load = action == "load_world"
    params: dict[str, Any] = {"world": scene.robot.getWorldPath()} if is_load else {}
    scene.ask(do="start", width=32, height=32)
    status, _, error = scene.ask(action, **params)
    assert status == "failed"
    assert "would discard the movie" in error
    scene.ask(do="stop")
    scene.recording.send(action, **params)
    eager(scene.bridge)
    assert any(scene.robot.step(STEP_MS) == -1 for _ in range(2))


def test_a_reset_keeps_the_recording(scene: Scene) -> None:
    scene.drive(20)
    scene.ask(do="start", width=32, height=32)
    assert scene.ask("reset")[0] == "done"
    scene.drive(5)
    status, ended, error = scene.ask(do="stop")
    assert status == "done", error
    assert ended["note"] == "simulation time went back meanwhile"


def test_the_end_of_the_controller_ends_the_recording(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        scene = Scene(robot, bridge, recording)
        path = scene.ask(do="start", width=32, height=32)[1]["path"]
        scene.drive(5)
    wait_for(robot.movieIsReady)
    assert not robot.movieFailed()
    assert len(pictures_in((bridge.data_dir / path).read_bytes())) > 0
    lines = recording.rows("SELECT message FROM log WHERE level = 'warning'")
    assert any("the movie was stopped because the controller ends" in line for line in lines)


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({}, "do"),
        ({"do": "pause"}, "do must be start or stop"),
        ({"do": "start", "kind": "gif"}, "kind must be movie or animation"),
        ({"do": "start", "width": 0}, "width must be a whole number from 16"),
        ({"do": "start", "speed": 1.5}, "speed must be a whole number"),
        ({"do": "start", "size": 3}, "size"),
    ],
)
def test_what_cannot_be_meant_is_refused(scene: Scene, params: dict[str, Any], said: str) -> None:
    status, _, error = scene.ask(**params)
    assert status == "failed"
    assert said in error


def test_a_failure_of_webots_is_named(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(file: str) -> int:
        return 0

    monkeypatch.setattr(scene.robot, "animationStartRecording", refuse)
    assert "could not begin the animation" in scene.ask(do="start", kind="animation")[2]
    scene.ask(do="start", width=32, height=32)
    scene.drive(5)
    monkeypatch.setattr(scene.robot, "movieFailed", lambda: True)
    assert "failed to make the movie" in scene.ask(do="stop")[2]


def test_the_loop_goes_on_while_webots_encodes(
    scene: Scene, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.ask(do="start", width=32, height=32)
    scene.drive(5)
    is_encoded = False
    monkeypatch.setattr(scene.robot, "movieIsReady", lambda: is_encoded)
    sent = recording.send("record_scene", do="stop")
    before_s = scene.robot.getTime()
    scene.drive(50)
    assert recording.fate(sent)[0] == "claimed"
    assert scene.robot.getTime() == pytest.approx(before_s + 50 * STEP_MS / 1000)
    is_encoded = True

    def is_over() -> bool:
        scene.drive(1)
        return recording.fate(sent)[0] != "claimed"

    monkeypatch.undo()
    wait_for(is_over)
    assert recording.fate(sent)[0] == "done"


def test_a_plain_robot_cannot(database: MemoryDatabase, recording: Recording) -> None:
    with MCPBridge(InProcessRobot("rover"), database=database) as bridge:
        sent = recording.send("record_scene", do="start")
        eager(bridge)
    assert "record_scene needs a Supervisor" in str(recording.fate(sent)[2])
