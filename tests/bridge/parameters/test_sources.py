"""Parameters whose values come from elsewhere than the code, and parameters in trouble."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bridge.conftest import STEP_MS, Recording, catch_up, eager, heartbeat_now
from tests.bridge.parameters.conftest import VALUES, ask
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import PARAMETERS_VARIABLE
from webots_mcp.standin import InProcessSupervisor

# -- start values from the environment ---------------------------------------------------------


def test_the_environment_wins_over_the_code(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(PARAMETERS_VARIABLE, '{"kp": 3, "ki": 1.0, "rover": {"ki": 0.25}}')
    with MCPBridge(robot, database=database) as bridge:
        kp, ki = bridge.parameter("kp", 2.0), bridge.parameter("ki", 0.5)
        bridge.get_command()
        assert (kp.value, ki.value) == (3.0, 0.25)
        assert bridge.stats().last_error is None
    assert recording.rows(VALUES) == [
        (1, "kp", "3.0", 0, "environment", None),
        (1, "ki", "0.25", 0, "environment", None),
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("kp=3", "it is not JSON"),
        ("[3]", "it is a list, not an object"),
        ("[" * 100_000, "it is not JSON"),
        ('{"kp": 11}', "'kp' must be a number up to 10, not 11 (int); it begins with 2.0"),
        ('{"kp": "3"}', "not '3' (str)"),
        ('{"kp": NaN}', "not nan"),
        ('{"kp": {"deep": 1}}', "not {'deep': 1} (dict)"),
        ('{"rover": {"kp": null}}', "not None"),
        ('{"kq": 3.0}', "the controller declares no parameter 'kq'"),
    ],
)
def test_what_the_environment_says_wrong_is_warned_of_once_and_the_code_counts(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    text: str,
    said: str,
) -> None:
    monkeypatch.setenv(PARAMETERS_VARIABLE, text)
    with MCPBridge(robot, database=database) as bridge:
        kp = bridge.parameter("kp", 2.0, high=10)
        ki = bridge.parameter("ki", 0.5)
        for _ in range(3):
            robot.step(STEP_MS)
            eager(bridge)
        assert (kp.value, ki.value) == (2.0, 0.5)
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1
    assert PARAMETERS_VARIABLE in lines[0] and said in lines[0]


def test_robots_of_one_process_have_parameters_of_their_own(
    database: MemoryDatabase, recording: Recording
) -> None:
    robots = [InProcessSupervisor(name) for name in ("rover", "writer")]
    bridges = [MCPBridge(robot, database=database) for robot in robots]
    ours, theirs = (bridge.parameter("kp", 2.0) for bridge in bridges)
    ours.set(3.0)
    bridges[0].get_command()
    assert (ours.value, theirs.value) == (3.0, 2.0)
    sql = "SELECT robot, run_id, name, value, set_by FROM robot_parameter ORDER BY run_id, since_s"
    assert recording.rows(sql) == [
        ("rover", 1, "kp", 2.0, "code"),
        ("rover", 1, "kp", 3.0, "code"),
        ("writer", 2, "kp", 2.0, "code"),
    ]
    for bridge in bridges:
        bridge.close()


# -- trouble -----------------------------------------------------------------------------------


def test_a_database_that_was_replaced_is_told_of_all_parameters(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=file) as bridge:
        bridge.parameter("kp", 2.0, high=10)
        ask(filed, bridge, values={"kp": 3.0})
        ask(filed, bridge, values={"kp": 4.0}, when="reset")
        for path in file.parent.glob(f"{file.name}*"):
            path.unlink()
        heartbeat_now(bridge)
        catch_up(bridge)
        robot.step(STEP_MS)
        bridge.publish({"x": 1})
        assert filed.rows("SELECT name, high, next_value FROM parameter") == [("kp", 10.0, "4.0")]
        assert filed.rows(VALUES) == [(1, "kp", "3.0", 0, "command", None)]


KILLED = """
import os, signal, sys
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.bridge import recorder
from webots_mcp.standin import InProcessSupervisor

robot = InProcessSupervisor("rover")
bridge = MCPBridge(robot, throttle_interval=1, database=sys.argv[1])
kp = bridge.parameter("kp", 2.0)
record = recorder.Recorder.record

def die_with_the_answer(self, kind, run, values):
    if kind == "command finished":
        os.kill(os.getpid(), signal.SIGKILL)
    return record(self, kind, run, values)

recorder.Recorder.record = die_with_the_answer
print("ready", flush=True)
while robot.step(16) != -1:
    bridge.publish({"kp": kp.value})
    bridge.get_command()
"""
