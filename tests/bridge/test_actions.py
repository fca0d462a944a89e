"""What the built-in actions do: pause, resume, step, fast, reset, reset_state, screenshot."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import BUILT_IN_ACTIONS
from webots_mcp.standin import InProcessRobot, InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD


def test_pause_holds_the_loop_and_resume_lets_it_go(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
) -> None:
    drive(2)
    at_s = robot.getTime()
    pause, resume = recording.send("pause"), recording.send("resume")
    drive(1)
    assert recording.fate(pause)[1] == {"mode": "pause", "sim_time_s": pytest.approx(at_s + 0.016)}
    assert recording.fate(resume)[1]["mode"] == "real_time"
    drive(1)
    kinds = recording.rows("SELECT kind FROM event WHERE kind IN ('pause', 'resume') ORDER BY id")
    assert kinds == ["pause", "resume"]


def test_step_runs_the_users_own_loop_so_often_and_pauses_again(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
) -> None:
    drive(1)
    pause, step = recording.send("pause"), recording.send("step", steps=5)
    drive(1)  # paused, then let go for five steps
    from_s = robot.getTime()
    drive(4)
    assert recording.fate(step)[0] == "claimed"
    assert robot.simulationGetMode() != robot.SIMULATION_MODE_PAUSE
    resume = recording.send("resume")
    drive(1)  # the fifth: held, until the resume is found
    status, result, _ = recording.fate(step)
    assert status == "done"
    assert result["steps"] == 5
    assert result["advanced_s"] == pytest.approx(5 * 0.016)
    assert result["sim_time_s"] == pytest.approx(from_s + 5 * 0.016)
    assert result["mode"] == "pause"
    assert [recording.fate(c)[0] for c in (pause, resume)] == ["done", "done"]


@pytest.mark.parametrize(("asked", "in_a_round", "of_rounds"), [(4, 2, 1), (3, 1, 5)])
def test_steps_are_those_of_the_simulation_however_often_the_loop_asks(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    asked: int,
    in_a_round: int,
    of_rounds: int,
) -> None:
    step = recording.send("step", steps=asked)
    eager(bridge)
    from_s = robot.getTime()
    resume: int | None = None
    for i in range(1, 11):
        robot.step(STEP_MS)
        bridge.publish({"n": i})
        if i >= asked and resume is None:
            resume = recording.send("resume")  # or the hold would last for ever
        if i % of_rounds == 0:
            for _ in range(in_a_round):
                bridge.get_command()
        if recording.fate(step)[0] == "done":
            break
    _, result, error = recording.fate(step)
    assert error is None
    assert result["steps"] == (asked if of_rounds == 1 else of_rounds)
    assert result["advanced_s"] == pytest.approx(result["steps"] * STEP_MS / 1000)
    assert result["sim_time_s"] == pytest.approx(from_s + result["advanced_s"])


def test_a_pause_in_the_middle_of_steps_says_that_they_were_interrupted(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None]
) -> None:
    step = recording.send("step", steps=100)
    drive(3)
    pause = recording.send("pause")
    recording.send("resume")
    drive(1)
    status, _, error = recording.fate(step)
    assert (status, error) == (
        "failed",
        f"interrupted by command {pause} (pause) after 3 of 100 steps",
    )


@pytest.mark.parametrize("steps", [0, -1, 2.5, "three", True, 1_000_000])
def test_a_step_count_out_of_bounds_is_refused(
    bridge: MCPBridge, recording: Recording, steps: object
) -> None:
    sent = recording.send("step", steps=steps)
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "steps must be a whole number from 1 to 100000" in error


def test_a_person_pressing_play_ends_the_hold(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("press_play", lambda _: robot.simulation.resume())
    recording.send("pause")
    recording.send("press_play")
    eager(bridge)
    assert robot.step(STEP_MS) == 0
    notes = recording.rows("SELECT data FROM event WHERE kind = 'resume'")
    assert "in Webots" in notes[0]


@pytest.mark.parametrize("paused", [False, True])
def test_reset_is_done_when_time_went_back_and_names_the_new_run(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
    paused: bool,
) -> None:
    drive(10)
    before = bridge.run_id
    if paused:
        recording.send("pause")
    sent = recording.send("reset")
    drive(2 if paused else 1)
    drive(1)
    status, result, _ = recording.fate(sent)
    assert status == "done"
    assert result["run_id"] == bridge.run_id != before
    assert robot.getTime() < 0.1


@pytest.mark.parametrize("steps", [0, 1, 5])
def test_a_loop_that_publishes_after_its_commands_sees_one_reset(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, steps: int
) -> None:
    for _ in range(steps):
        robot.step(STEP_MS)
        eager(bridge)
        bridge.publish({"n": 1})
    sent = recording.send("reset")
    for _ in range(4):
        eager(bridge)
        bridge.publish({"n": 2})
        robot.step(STEP_MS)
    eager(bridge)
    assert recording.fate(sent)[0] == "done"
    assert recording.rows("SELECT start_reason FROM run ORDER BY id") == ["start", "reset"]


@pytest.mark.parametrize("asked_again", [False, True])
def test_a_reset_at_the_first_step_begins_the_run_with_the_first_state_after_it(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None], asked_again: bool
) -> None:
    drive(1)
    sent = recording.send("reset")
    eager(bridge)
    if asked_again:
        eager(bridge)  # in the same round: no step has been made
        bridge.publish({"mode": "before the reset"})
    drive(2)
    assert recording.fate(sent)[0] == "done"
    times = "SELECT sim_time_s FROM state WHERE run_id = ? ORDER BY id"
    assert recording.rows(times, 1) == pytest.approx([0.016] * (2 if asked_again else 1))
    assert recording.rows(times, 2) == pytest.approx([0.016, 0.032])


def test_reset_state_runs_the_callbacks_or_says_that_there_are_none(
    bridge: MCPBridge, recording: Recording
) -> None:
    refused = recording.send("reset_state")
    eager(bridge)
    assert "registered no callback" in (recording.fate(refused)[2] or "")
    calls: list[int] = []
    bridge.on_reload(lambda: calls.append(1))
    sent = recording.send("reset_state")
    eager(bridge)
    assert calls == [1]
    assert recording.fate(sent)[:2] == ("done", {"callbacks": 1})


def test_reset_state_fails_where_a_callback_did(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    calls: list[int] = []
    with MCPBridge(robot, database=database) as bridge:
        bridge.on_reload(lambda: 1 // 0)
        bridge.on_reload(lambda: calls.append(1))
        sent = recording.send("reset_state")
        eager(bridge)
    status, _, error = recording.fate(sent)
    assert (status, calls) == ("failed", [1])
    assert error is not None
    assert error.startswith("1 of 2 callbacks failed: ZeroDivisionError: ")


def test_a_screenshot_is_done_when_its_file_is_complete(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None]
) -> None:
    sent = recording.send("screenshot")
    drive(3)
    status, result, _ = recording.fate(sent)
    assert status == "done"
    file = bridge.data_dir / result["path"]
    with Image.open(file) as picture:
        assert picture.size == (result["width"], result["height"])
    sql = "SELECT kind, path, size_bytes FROM image"
    assert recording.rows(sql) == [("screenshot", result["path"], file.stat().st_size)]


def test_a_plain_robot_refuses_what_needs_a_supervisor(
    database: MemoryDatabase, recording: Recording
) -> None:
    actions = ("pause", "resume", "fast", "step", "reset", "reload", "load_world", "quit",
               "screenshot")  # fmt: skip
    with MCPBridge(InProcessRobot("rover"), database=database) as bridge:
        for action in actions:
            sent = recording.send(action)
            eager(bridge)
            status, _, error = recording.fate(sent)
            assert status == "failed"
            assert error is not None
            assert error.startswith(f"{action} needs a Supervisor") and "Supervisor()" in error


@pytest.mark.parametrize(
    ("action", "params"), [("load_world", {"world": str(DEFAULT_WORLD)}), ("quit", {"status": 3})]
)
@pytest.mark.parametrize("paused", [False, True])
def test_what_ends_the_controller_is_done_when_it_has_ended(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
    action: str,
    params: dict[str, Any],
    paused: bool,
) -> None:
    drive(2)
    if paused:
        recording.send("pause")
    sent = recording.send(action, **params)
    while robot.step(STEP_MS) != -1:
        eager(bridge)
    bridge.close()
    assert recording.fate(sent)[:2] == ("done", {"controller": "it has ended"})
    assert robot.simulation.exit_status == (3 if action == "quit" else None)


@pytest.mark.parametrize("way", ["by its path", "by a link in the project"])
def test_a_world_of_another_project_is_not_loaded(
    database: MemoryDatabase, recording: Recording, tmp_path: Path, way: str
) -> None:
    for project in ("own", "foreign"):
        (tmp_path / project / "controllers").mkdir(parents=True)
        (tmp_path / project / "worlds").mkdir()
        shutil.copy(DEFAULT_WORLD, tmp_path / project / "worlds" / "arena.wbt")
    foreign, link = tmp_path / "foreign/worlds/arena.wbt", tmp_path / "own/worlds/link.wbt"
    link.symlink_to(foreign)
    robot = InProcessSupervisor("rover", world=tmp_path / "own/worlds/arena.wbt")
    with MCPBridge(robot, database=database) as bridge:
        sent = recording.send("load_world", world=str(foreign if way == "by its path" else link))
        eager(bridge)
        error = f"{foreign} lies outside of the project {tmp_path / 'own'}"
        assert recording.fate(sent) == ("failed", None, error)
        assert robot.step(STEP_MS) != -1


@pytest.mark.parametrize("world", ["a\0b.wbt", "x" * 5000, "~nobody/a.wbt", 3])
def test_what_is_no_name_of_a_world_is_refused_in_words(
    bridge: MCPBridge, recording: Recording, world: object
) -> None:
    sent = recording.send("load_world", world=world)
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed" and error is not None
    assert error == f"world must be the full path of a world file, not {world!r:.200}"


def test_each_action_that_the_server_offers_is_one_that_bridges_run(bridge: MCPBridge) -> None:
    known = bridge._session.control._actions  # pyright: ignore[reportPrivateUsage]
    assert {name: action.__name__ for name, action in known.items()} == {
        name: name for name in BUILT_IN_ACTIONS
    }


@pytest.mark.parametrize(
    "action", [name for name, each in BUILT_IN_ACTIONS.items() if each.parameters is not None]
)
def test_a_parameter_that_a_built_in_action_does_not_take_is_refused(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
    action: str,
) -> None:
    drive(1)
    command, at_s = recording.send(action, stepps=5), robot.getTime()
    drive(1)
    status, result, error = recording.fate(command)
    assert (status, result) == ("failed", None)
    assert error is not None
    assert f"action {action!r} takes no parameter 'stepps'" in error
    assert ("Did you mean 'steps'?" in error) == (action == "step")
    assert all(repr(name) in error for name in BUILT_IN_ACTIONS[action].parameters or ())
    assert robot.getTime() == pytest.approx(at_s + 0.016)
    assert robot.simulationGetMode() != robot.SIMULATION_MODE_PAUSE


@pytest.mark.parametrize(
    "action", [name for name, each in BUILT_IN_ACTIONS.items() if each.required]
)
def test_a_parameter_that_a_built_in_action_needs_is_named_where_it_is_missing(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None], action: str
) -> None:
    drive(1)
    command = recording.send(action)
    drive(1)
    status, result, error = recording.fate(command)
    assert (status, result) == ("failed", None)
    needed = BUILT_IN_ACTIONS[action].required
    assert error is not None and f"action {action!r} needs the parameter" in error
    assert all(repr(name) in error for name in needed)


def test_every_required_parameter_is_one_that_the_action_takes() -> None:
    assert all({*each.required} <= {*(each.parameters or ())} for each in BUILT_IN_ACTIONS.values())


@pytest.mark.parametrize(
    ("action", "params", "said"),
    [
        ("take_frame", {"camera": 5}, "camera must be the name of a device, not 5"),
        ("set_field", {"path": "BALL", "value": 1, "stop": "yes"}, "stop must be true or false"),
    ],
)
def test_a_parameter_of_another_type_is_refused_with_its_value(
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
    action: str,
    params: dict[str, Any],
    said: str,
) -> None:
    drive(1)
    command = recording.send(action, **params)
    drive(1)
    status, _, error = recording.fate(command)
    assert status == "failed"
    assert error is not None and said in error
