"""Commands: what each one does, and what it answers."""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor


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


def test_an_error_in_a_library_names_the_own_line_that_called_it_first(
    bridge: MCPBridge, recording: Recording
) -> None:
    def fail(command: dict[str, Any]) -> None:
        statistics.mean([])

    bridge.register_command("grip", fail)
    sent = recording.send("grip")
    eager(bridge)
    error = recording.fate(sent)[2]
    line = fail.__code__.co_firstlineno + 1
    assert error is not None
    assert f"(test_commands.py, line {line}; raised in statistics.py, line " in error


def test_a_result_that_json_cannot_hold_is_answered_and_says_what_was_replaced(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("read", lambda _: {"range": float("inf"), "raw": object(), "n": 1})
    sent = recording.send("read")
    eager(bridge)
    status, result, replaced = recording.fate(sent)
    assert (status, result) == ("done", {"range": None, "raw": None, "n": 1})
    assert replaced is not None and "range (inf), raw (unsupported: object)" in replaced
    assert recording.rows("SELECT level, message FROM log") == [
        ("warning", f"command {sent} (read): {replaced}")
    ]


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (SpeechlessError(), "SpeechlessError: (no text: its str() raised RuntimeError)"),
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


@pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt(), GeneratorExit()])
def test_a_handler_that_ends_the_controller_fails_its_command_and_ends_it(
    bridge: MCPBridge, recording: Recording, error: BaseException
) -> None:
    def leave(command: dict[str, Any]) -> None:
        raise error

    bridge.register_command("leave", leave)
    bridge.on_reload(lambda: leave({}))
    for action in ("leave", "reset_state"):
        sent = recording.send(action)
        with pytest.raises(type(error)):
            eager(bridge)
        status, _, reason = recording.fate(sent)
        assert (status, (reason or "").split(":")[0]) == ("failed", type(error).__name__)


def test_a_handler_that_closes_the_bridge_is_answered_before(
    bridge: MCPBridge, recording: Recording
) -> None:
    def leave(_: dict[str, Any]) -> str:
        bridge.close()
        return "closed"

    bridge.register_command("leave", leave)
    sent = recording.send("leave")
    eager(bridge)
    assert recording.fate(sent) == ("done", "closed", None)
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]


def test_a_long_reason_is_cut_and_says_so(bridge: MCPBridge, recording: Recording) -> None:
    def fail(command: dict[str, Any]) -> None:
        raise ValueError("x" * 1_000_000)

    bridge.register_command("grip", fail)
    sent = recording.send("grip")
    eager(bridge)
    error = recording.fate(sent)[2]
    assert error is not None and len(error) < 3000
    assert "... (cut: it had 1000000 characters) (test_commands.py, line " in error


def test_a_large_result_is_cut_and_says_what(bridge: MCPBridge, recording: Recording) -> None:
    bridge.register_command("map", lambda _: {"n": 1, "grid": [[0] * 1000 for _ in range(1000)]})
    sent = recording.send("map")
    eager(bridge)
    status, result, replaced = recording.fate(sent)
    assert (status, result) == ("done", {"n": 1, "grid": None})
    assert replaced is not None and "grid (too large)" in replaced


def test_an_unknown_action_is_refused_with_the_known_ones(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("set_speed", lambda _: None)
    sent = recording.send("setspeed")
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "no action 'setspeed'; this robot has set_speed, " in error
    sent = recording.send("stop")
    eager(bridge)
    assert "no action 'stop'; this robot has pause, " in (recording.fate(sent)[2] or "")


def test_a_loop_without_registered_actions_gets_every_command_and_none_of_them_looks_like_success(
    bridge: MCPBridge, recording: Recording
) -> None:
    sent = recording.send("dance", style="waltz")
    command = eager(bridge)
    assert command is not None
    assert (command["action"], command["style"]) == ("dance", "waltz")
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "has registered none (bridge.register_command)" in error
    assert "the bridge does not know whether the loop handled it" in error


def test_an_expired_command_never_runs(bridge: MCPBridge, recording: Recording) -> None:
    bridge.register_command("move", lambda _: pytest.fail("an expired command ran"))
    sent = recording.send("move", time_to_live_s=-1)
    assert eager(bridge) is None
    assert recording.fate(sent)[0] in ("pending", "expired")


NO_PARAMS = {
    "nested too deep": b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "no UTF-8": b'{"a": "\xff"}',
    "only bytes": b"\xff\xfe\xfd",
    "empty": b"",
}


@pytest.mark.parametrize("params", NO_PARAMS.values(), ids=NO_PARAMS)
@pytest.mark.parametrize("kind", ["TEXT", "BLOB"])
def test_whatever_stands_in_a_command_it_gets_a_final_status(
    bridge: MCPBridge, recording: Recording, database: MemoryDatabase, params: bytes, kind: str
) -> None:
    bridge.register_command("move", lambda _: pytest.fail("a malformed command ran"))
    sent = recording.send("move")
    connection = connect(database, "writer")
    connection.execute(f"UPDATE command SET params = CAST(? AS {kind})", (params,))
    connection.close()
    assert eager(bridge) is None
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and error.startswith("params must be a JSON object, got ")


def test_an_action_that_is_no_text_is_refused_like_an_unknown_one(
    bridge: MCPBridge, recording: Recording, database: MemoryDatabase
) -> None:
    bridge.register_command("move", lambda _: pytest.fail("another command ran"))
    sent = recording.send("move")
    connection = connect(database, "writer")
    connection.execute("UPDATE command SET action = CAST(? AS TEXT)", (b"mo\xffve",))
    connection.close()
    eager(bridge)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "no action 'mo\ufffdve'; this robot has move" in error


async def later(command: dict[str, Any]) -> None: ...


@pytest.mark.parametrize(
    ("name", "handler", "said"),
    [
        *((name, print, "the name of an action must be a text") for name in (b"x", 5, None)),
        *(
            (name, print, "choose a name of 1 to 100 printable characters")
            for name in ("", "lone \udcff", "null \0", "two\nlines", "x" * 101)
        ),
        ("later", later, "must be a plain function"),
        ("later", None, "must be a plain function"),
        ("pause", print, "'pause' is built in"),
    ],
)
def test_what_cannot_be_registered_is_refused(
    bridge: MCPBridge, recording: Recording, name: Any, handler: Any, said: str
) -> None:
    with pytest.raises((TypeError, ValueError), match=said):
        bridge.register_command(name, handler)
    bridge.register_command("größe", lambda _: None)
    assert recording.rows("SELECT actions FROM session") == ['{"größe": ""}']


@pytest.mark.parametrize(
    ("doc", "told"),
    [("lone \udcff", "lone ?"), (5, ""), ("x" * 5000, "x" * 4000 + "... (cut: it had 5000")],
)
def test_a_handlers_docstring_never_stops_the_registration(
    bridge: MCPBridge, recording: Recording, doc: Any, told: str
) -> None:
    def wave(command: dict[str, Any]) -> None: ...

    wave.__doc__ = doc
    bridge.register_command("wave", wave)
    (actions,) = recording.rows("SELECT actions FROM session")
    assert json.loads(actions)["wave"].startswith(told)


def test_a_function_for_what_is_built_in_is_never_called_which_is_said_once_and_stops_no_loop(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    recording: Recording,
    capfd: pytest.CaptureFixture[str],
) -> None:
    calls: list[str] = []
    with MCPBridge(robot, database=database) as bridge:
        for _ in range(3):  # as a loop may
            bridge.register_command("fast", lambda _: calls.append("fast"))
        sent = recording.send("fast")
        eager(bridge)
        assert bridge.stats().failures == 1
    assert recording.fate(sent)[0] == "done"
    assert (robot.simulationGetMode(), calls) == (robot.SIMULATION_MODE_FAST, [])
    (said,) = recording.rows("SELECT message FROM log WHERE level = 'warning'")
    assert said.startswith("action 'fast' is built in") and "'my_fast'" in said
    assert capfd.readouterr().err.count("is built in") == 1
    assert recording.rows("SELECT actions FROM session") == ["{}"]


def test_a_function_for_reset_state_is_run_in_place_of_the_callbacks_which_is_said_once(
    bridge: MCPBridge, recording: Recording
) -> None:
    calls: list[object] = []
    bridge.on_reload(lambda: calls.append("callback"))
    for _ in range(2):
        bridge.register_command("reset_state", lambda command: calls.append(command["action"]))
    sent = recording.send("reset_state")
    eager(bridge)
    assert calls == ["reset_state"]
    assert recording.fate(sent) == ("done", None, None)
    (said,) = recording.rows("SELECT message FROM log")
    assert "'reset_state'" in said and "instead of the callbacks" in said


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


class LateSupervisor(InProcessSupervisor):
    """As with Webots, an answer has the mode from before the change that was asked for with it."""

    _answered: int | None = None

    def simulationSetMode(self, mode: int) -> None:
        self._answered = super().simulationGetMode()
        super().simulationSetMode(mode)

    def simulationGetMode(self) -> int:
        return super().simulationGetMode() if self._answered is None else self._answered

    def step(self, time_step: int | None = None) -> int:
        self._answered = None
        return super().step(time_step)


def test_what_sets_the_mode_answers_with_that_mode_though_webots_last_answer_has_the_one_before(
    database: MemoryDatabase, recording: Recording
) -> None:
    robot = LateSupervisor()
    with MCPBridge(robot, database=database) as bridge:
        robot.step(16)
        sent = [recording.send(name) for name in ("pause", "fast", "pause", "resume")]
        while recording.fate(sent[-1])[0] != "done":
            bridge.get_command()
            robot.step(16)
        modes = [recording.fate(each)[1]["mode"] for each in sent]
    assert modes == ["pause", "fast", "pause", "real_time"]
