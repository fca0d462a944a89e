"""Commands: what each one does, and what it answers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessRobot, InProcessSupervisor


def test_a_custom_command_gets_its_parameters_and_answers_by_its_return_value(
    bridge: MCPBridge, recording: Recording
) -> None:
    seen: list[dict[str, Any]] = []

    def set_speed(command: dict[str, Any]) -> dict[str, float]:
        """Set the wheel speed in rad/s."""
        seen.append(command)
        return {"speed": command["speed"]}

    bridge.register_command("set_speed", set_speed)
    sent = recording.send("set_speed", speed=3.5)
    handled = eager(bridge)
    assert handled == seen[0]
    assert seen == [{"id": sent, "action": "set_speed", "params": {"speed": 3.5}, "speed": 3.5}]
    assert recording.fate(sent) == ("done", {"speed": 3.5}, None)
    (actions,) = recording.rows("SELECT actions FROM session")
    assert json.loads(actions) == {"set_speed": "Set the wheel speed in rad/s."}


def test_parameters_cannot_hide_what_the_command_is(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("aim", lambda command: command["action"])
    sent = recording.send("aim", action="fire", id=7)
    eager(bridge)
    assert recording.fate(sent) == ("done", "aim", None)


def test_an_exception_in_a_handler_is_the_commands_error(
    bridge: MCPBridge, recording: Recording
) -> None:
    def fail(command: dict[str, Any]) -> None:
        raise ValueError("arm is folded")

    bridge.register_command("grip", fail)
    sent = recording.send("grip")
    eager(bridge)
    status, result, error = recording.fate(sent)
    assert (status, result) == ("failed", None)
    assert error is not None
    assert error.startswith("ValueError: arm is folded (test_commands.py, line ")


def test_a_result_that_json_cannot_hold_is_answered_and_says_what_was_replaced(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("read", lambda _: {"range": float("inf"), "raw": object(), "n": 1})
    sent = recording.send("read")
    eager(bridge)
    status, result, replaced = recording.fate(sent)
    assert (status, result) == ("done", {"range": None, "raw": None, "n": 1})
    assert replaced is not None and "range (inf), raw (type object)" in replaced
    assert recording.rows("SELECT level, message FROM log") == [
        ("warning", f"command {sent} (read): {replaced}")
    ]


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (SpeechlessError(), "SpeechlessError: (without words: its str() raised RuntimeError)"),
        (FileNotFoundError("/data/\udcff.txt"), "FileNotFoundError: /data/?.txt"),
    ],
)
def test_an_exception_that_cannot_be_written_as_it_is_still_fails_its_command(
    bridge: MCPBridge, recording: Recording, error: Exception, said: str
) -> None:
    def fail(command: dict[str, Any]) -> None:
        raise error

    bridge.register_command("grip", fail)
    sent = recording.send("grip")
    eager(bridge)
    status, _, text = recording.fate(sent)
    assert status == "failed"
    assert text is not None and text.startswith(said)


def test_an_unknown_action_is_refused_with_the_known_ones(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("set_speed", lambda _: None)
    sent = recording.send("setspeed")
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "no action 'setspeed'; this robot knows set_speed, pause" in error


def test_a_loop_without_registered_actions_gets_every_command_from_get_command(
    bridge: MCPBridge, recording: Recording
) -> None:
    sent = recording.send("dance", style="waltz")
    command = eager(bridge)
    assert command is not None
    assert (command["action"], command["style"]) == ("dance", "waltz")
    assert recording.fate(sent)[:2] == ("done", {"returned_by_get_command": True})


def test_an_expired_command_never_runs(bridge: MCPBridge, recording: Recording) -> None:
    bridge.register_command("move", lambda _: pytest.fail("an expired command ran"))
    sent = recording.send("move", time_to_live_s=-1)
    assert eager(bridge) is None
    assert recording.fate(sent)[0] in ("pending", "expired")


def test_parameters_that_are_no_object_fail_the_command(
    bridge: MCPBridge, recording: Recording, database: MemoryDatabase
) -> None:
    sent = recording.send("move")
    from webots_mcp.connection import connect

    connection = connect(database, "writer")
    connection.execute("UPDATE command SET params = '[1, 2'")
    connection.close()
    assert eager(bridge) is None
    assert recording.fate(sent)[::2] == ("failed", "params must be a JSON object, got '[1, 2'")


@pytest.mark.parametrize("name", ["", "pause", "reset_state"])
def test_a_name_that_is_built_in_or_empty_cannot_be_registered(
    bridge: MCPBridge, name: str
) -> None:
    with pytest.raises(ValueError, match="choose a name"):
        bridge.register_command(name, lambda _: None)


def test_a_coroutine_cannot_be_a_handler(bridge: MCPBridge) -> None:
    async def later(command: dict[str, Any]) -> None: ...

    with pytest.raises(TypeError, match="must be a plain function"):
        bridge.register_command("later", later)


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
    assert (status, error) == ("failed", f"interrupted by command {pause} (pause)")


@pytest.mark.parametrize("steps", [0, -1, 2.5, "three", True, 1_000_000])
def test_a_step_count_out_of_bounds_is_refused(
    bridge: MCPBridge, recording: Recording, steps: object
) -> None:
    sent = recording.send("step", steps=steps)
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "steps must be a whole number from 1 to 100000" in error


def test_fast_sets_the_fast_mode(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    robot.simulationSetMode(robot.SIMULATION_MODE_REAL_TIME)
    sent = recording.send("fast")
    eager(bridge)
    assert robot.simulationGetMode() == robot.SIMULATION_MODE_FAST
    assert recording.fate(sent)[1]["mode"] == "fast"


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


def test_a_reset_right_after_the_start_is_noticed_as_well(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None]
) -> None:
    drive(1)
    sent = recording.send("reset")
    drive(3)
    assert recording.fate(sent)[0] == "done"
    assert recording.rows("SELECT count(*) FROM run") == [2]


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


def test_a_callback_may_ask_for_commands_itself(bridge: MCPBridge, recording: Recording) -> None:
    bridge.on_reload(lambda: eager(bridge))
    bridge.register_command("greet", lambda _: "hello")
    sent, inside = recording.send("reset_state"), recording.send("greet")
    eager(bridge)
    assert recording.fate(sent) == ("done", {"callbacks": 1}, None)
    assert recording.fate(inside) == ("done", "hello", None)


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
    sql = "SELECT kind, path, bytes FROM image"
    assert recording.rows(sql) == [("screenshot", result["path"], file.stat().st_size)]


def test_a_plain_robot_refuses_what_needs_a_supervisor(
    database: MemoryDatabase, recording: Recording
) -> None:
    actions = ("pause", "resume", "fast", "step", "reset", "reload", "screenshot")
    with MCPBridge(InProcessRobot("rover"), database=database) as bridge:
        for action in actions:
            sent = recording.send(action)
            eager(bridge)
            status, _, error = recording.fate(sent)
            assert status == "failed"
            assert error is not None
            assert error.startswith(f"{action} needs a Supervisor") and "Supervisor()" in error


def test_camera_frames_are_kept_up_to_a_number(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    camera = robot.getDevice("camera")
    camera.enable(STEP_MS)
    robot.step(STEP_MS)
    robot.step(STEP_MS)
    saved = [bridge.save_camera_frame(camera, max_frames=2) for _ in range(4)]
    assert recording.rows("SELECT path FROM image ORDER BY id") == saved[2:]
    folder = bridge.data_dir / "camera"
    assert sorted(f"camera/{file.name}" for file in folder.iterdir()) == saved[2:]
    with Image.open(bridge.data_dir / str(saved[3])) as picture:
        bgra = camera.getImage()
        assert picture.size == (160, 120)
        assert picture.getpixel((0, 0)) == (bgra[2], bgra[1], bgra[0])


def test_a_disabled_camera_is_said_once_and_costs_no_row(
    robot: InProcessSupervisor, database: MemoryDatabase, capfd: pytest.CaptureFixture[str]
) -> None:
    with MCPBridge(robot, database=database) as bridge:
        assert bridge.save_camera_frame(robot.getDevice("camera")) is None
        assert bridge.save_camera_frame(robot.getDevice("camera")) is None
    assert capfd.readouterr().err.count("camera 'camera' is disabled") == 1


def test_an_idle_get_command_returns_none(bridge: MCPBridge) -> None:
    assert bridge.get_command() is None
    assert Path(bridge.data_dir).is_dir()
