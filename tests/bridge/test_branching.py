"""Saving the world in motion, and what a controller in a branch continues with."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import RESTORED_VARIABLE
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD


class Saving:
    """A rover in motion on a world of its own, which sends itself commands."""

    def __init__(self, world: Path, database: MemoryDatabase) -> None:
        self.world = world
        self.recording = Recording(database)
        self.simulation = InProcessSimulation(world)
        self.robot = InProcessSupervisor("rover", world=self.simulation)
        self.bridge = MCPBridge(self.robot, throttle_interval=3, database=database)
        for side, speed in (("left", 4.0), ("right", 3.0)):
            motor: Any = self.robot.getDevice(f"{side} wheel motor")
            motor.setPosition(float("inf"))
            motor.setVelocity(speed)
        self.drive(20)

    def drive(self, steps: int) -> None:
        for _ in range(steps):
            assert self.robot.step(STEP_MS) != -1
            self.bridge.publish({"mode": "cruise"})

    def save(self, name: object, *, paused: bool = True) -> tuple[str, Any, str | None]:
        """Save the world as a file; what came of it."""
        if paused:
            self.recording.send("pause")
        sent = self.recording.send("save_world", name=name)
        if paused:
            self.recording.send("resume")
        eager(self.bridge)
        self.drive(1)  # where a row was to be recorded first
        eager(self.bridge)
        return self.recording.fate(sent)


@pytest.fixture
def saving(tmp_path: Path, database: MemoryDatabase) -> Iterator[Saving]:
    (tmp_path / "worlds").mkdir()
    world = tmp_path / "worlds" / "arena.wbt"
    shutil.copy(DEFAULT_WORLD, world)
    found = Saving(world, database)
    yield found
    found.bridge.close()


def test_a_saved_world_continues_with_all_digits_and_its_origin_is_not_touched(
    saving: Saving,
) -> None:
    before = saving.world.read_bytes()
    status, result, error = saving.save("copy.wbt")
    assert status == "done", error
    copy = saving.world.with_name("copy.wbt")
    assert (result["file"], result["world"]) == (str(copy), str(saving.world))
    assert saving.world.read_bytes() == before
    again = InProcessSimulation(copy)
    (old,), (new,) = saving.simulation.simulator.robots, again.simulator.robots
    robot: Any = InProcessSupervisor("rover", world=again)
    for side, speed in (("left", 4.0), ("right", 3.0)):
        motor = robot.getDevice(f"{side} wheel motor")
        motor.setPosition(float("inf"))
        motor.setVelocity(speed)
    steps = round((saving.simulation.time_s - result["sim_time_s"]) / (STEP_MS / 1000))
    saving.drive(30)
    for _ in range(steps + 30):
        robot.step(STEP_MS)
    assert (new.position, new.yaw_rad) == (old.position, old.yaw_rad)
    assert [each.position_rad for each in new.vehicle.joints] == [
        each.position_rad for each in old.vehicle.joints
    ]
    assert result["calls"] == round(result["sim_time_s"] / (STEP_MS / 1000))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("arena.wbt", "exists, and no file is overwritten"),
        ("../arena2.wbt", "without a folder"),
        ("arena.txt", "ends with .wbt"),
        (5, "ends with .wbt"),
    ],
)
def test_no_file_is_overwritten_and_none_is_written_elsewhere(
    saving: Saving, name: object, said: str
) -> None:
    before = saving.world.read_bytes()
    status, _, error = saving.save(name)
    assert status == "failed"
    assert said in (error or "")
    assert [*saving.world.parent.iterdir()] == [saving.world]
    assert saving.world.read_bytes() == before
    assert [*saving.world.parent.parent.glob("*.wbt")] == []


def test_time_must_stand_still(saving: Saving) -> None:
    status, _, error = saving.save("copy.wbt", paused=False)
    assert status == "failed"
    assert "it runs. Pause it first" in (error or "")


def test_a_world_of_an_old_release_is_refused(saving: Saving) -> None:
    text = saving.world.read_text("utf-8")
    saving.world.write_text(text.replace(text.partition("\n")[0], "#VRML_SIM R2021b utf8"), "utf-8")
    status, _, error = saving.save("copy.wbt")
    assert status == "failed"
    assert "worlds from before R2022a have other axes" in (error or "")


def test_the_proto_files_that_the_world_declares_are_declared_in_the_copy(saving: Saving) -> None:
    first, _, rest = saving.world.read_text("utf-8").partition("\n")
    declared = 'EXTERNPROTO "../protos/Sign.proto"\nIMPORTABLE EXTERNPROTO "Lamp.proto"'
    saving.world.write_text(f"{first}\n{declared}\n{rest}", "utf-8")
    assert saving.save("copy.wbt")[0] == "done"
    assert (
        saving.world.with_name("copy.wbt").read_text("utf-8").startswith(f"{first}\n\n{declared}")
    )


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_named(saving: Saving) -> None:
    saving.world.parent.chmod(0o500)
    status, _, error = saving.save("copy.wbt")
    assert status == "failed"
    assert "the world cannot be saved as" in (error or "")


@pytest.mark.skipif(os.name != "posix", reason="limits of a process")
def test_half_a_world_is_not_left_behind(saving: Saving) -> None:
    import resource
    import signal

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handled = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        status, _, error = saving.save("copy.wbt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handled)
    assert status == "failed"
    assert "the world cannot be saved as" in (error or "")
    assert [*saving.world.parent.iterdir()] == [saving.world]


# -- in the branch --


def moment(tmp_path: Path, **robots: Any) -> str:
    file = tmp_path / "moment.json"
    file.write_text(json.dumps({"world": "/home/me/worlds/arena.wbt", "robots": robots}))
    return str(file)


ROVER = {
    "run_id": 7, "sim_time_s": 1.28, "state": {"mode": "search"}, "parameters": {"kp": 2.0},
    "calls": 2,
}  # fmt: skip


def test_a_controller_reads_the_moment_and_that_is_recorded_once(
    tmp_path: Path, robot: InProcessSupervisor, database: MemoryDatabase,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv(RESTORED_VARIABLE, moment(tmp_path, rover=ROVER))
    recording = Recording(database)
    with MCPBridge(robot, throttle_interval=3, database=database) as bridge:
        for _ in range(2):
            assert bridge.restored is not None
            assert bridge.restored.state == {"mode": "search"}
            assert bridge.restored[1:] == ({"kp": 2.0}, 1.28, 7)
        for count in range(4):
            assert robot.step(STEP_MS) != -1
            bridge.publish({"count": count})
    assert recording.rows("SELECT data FROM event WHERE kind = 'restored'") == [
        '{"run_id":7,"at_s":1.28}'
    ]
    assert recording.rows("SELECT world FROM run") == ["/home/me/worlds/arena.wbt"]
    counts = [state["count"] for state in recording.states()]
    assert counts == [0, 3], "the third call of its origin is due, and then each third"


def test_outside_of_a_branch_nothing_is_restored(bridge: MCPBridge) -> None:
    assert bridge.restored is None


def test_a_robot_that_was_not_recorded_begins_anew(
    tmp_path: Path, robot: InProcessSupervisor, database: MemoryDatabase,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv(RESTORED_VARIABLE, moment(tmp_path, other=ROVER))
    with MCPBridge(robot, database=database) as bridge:
        assert bridge.restored is None


def of_rover(**changed: Any) -> str:
    return json.dumps({"world": "x", "robots": {"rover": ROVER | changed}})


@pytest.mark.parametrize(
    "text",
    [
        "{", "[]", '{"world": "x", "robots": {"rover": {}}}', '{"world": "x", "robots": []}',
        '{"world": "x", "robots": {"rover": "a"}}', of_rover(calls=float("inf")),
        of_rover(calls="two"), of_rover(state=None), of_rover(state=["mode"]),
        of_rover(parameters=1), of_rover(sim_time_s=None), of_rover(run_id="a"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_warned_of_and_the_controller_begins(
    text: str, tmp_path: Path, robot: InProcessSupervisor, database: MemoryDatabase,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    file = tmp_path / "moment.json"
    file.write_text(text)
    monkeypatch.setenv(RESTORED_VARIABLE, str(file))
    with MCPBridge(robot, database=database) as bridge:
        assert bridge.restored is None
    assert "begins without bridge.restored" in capsys.readouterr().err
