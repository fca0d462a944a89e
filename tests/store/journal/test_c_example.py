"""The e-puck of the examples in C answers as the one in Python: same sensors, same questions."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
from pathlib import Path
from typing import Any

import anyio
import pytest

from webots_mcp import MCPBridge
from webots_mcp.contract import C_HEADER, bundled
from webots_mcp.questions import all_questions
from webots_mcp.standin import InProcessRobot
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.slow

E_PUCK = bundled("examples") / "e_puck"
CONTROLLERS = E_PUCK / "controllers"
QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("webots_find_events", {"what": "timeline"}),
    ("webots_find_events", {"kinds": ["stuck", "standstill", "change"]}),
    ("webots_get_trends", {}),
    ("webots_query_history", {"signals": ["odom.x_m", "proximity.*"]}),
    ("webots_list_signals", {}),
    ("webots_get_sensors", {}),
]
# What differs by who recorded, and when; a journal has no devices.
OF_ITSELF = ("age_s", "status", "why", "hint", "next", "devices_not_named_in_state")


def record_in_python(folder: Path) -> tuple[list[list[float]], list[list[float]]]:
    """What the robot senses in each step, and the speeds that it sets."""
    robot = InProcessRobot(world=E_PUCK / "worlds" / "e_puck.wbt")
    bridge = MCPBridge(robot, data_dir=folder)
    program = CONTROLLERS / "e_puck_avoid" / "e_puck_avoid.py"
    e_puck = runpy.run_path(str(program))["EPuck"](robot, bridge)
    sensed: list[list[float]] = []
    speeds: list[list[float]] = []
    while robot.getTime() < 30.0 and robot.step(32) != -1:
        wheels = [encoder.getValue() for encoder in e_puck.encoders]
        sensed.append([robot.getTime(), *wheels, *(eye.getValue() for eye in e_puck.eyes)])
        bridge.publish(e_puck.sense())
        e_puck.decide()
        e_puck.act()
        speeds.append([*e_puck.wheel_speeds()])
    bridge.close()
    return sensed, speeds


def record_in_c(folder: Path, sensed: list[list[float]], program: Path) -> list[list[float]]:
    """The speeds that it sets where it senses the same."""
    text = "".join(" ".join(map(repr, line)) + "\n" for line in sensed)
    environment = os.environ | {"WEBOTS_MCP_DATA_DIR": str(folder)}
    run = subprocess.run(
        [program], input=text, env=environment, capture_output=True, text=True, check=True
    )
    return [[float(number) for number in line.split()] for line in run.stdout.splitlines()]


def record_in_real_time(folder: Path) -> None:
    """Give the rows wall times that no machine's speed decides."""
    recording = RecordingAccess(folder / "webots.db", folder)
    recording.ingest()
    with recording.writer() as connection, connection:
        connection.execute("UPDATE state SET wall_time_s = 1.7e9 + sim_time_s")


def answers(folder: Path) -> list[Any]:
    recording = RecordingAccess(folder / "webots.db", folder)
    found: list[Any] = []
    for name, arguments in QUESTIONS:
        question = next(each for each in all_questions() if each.name == name)
        valid = question.arguments.model_validate(arguments)
        given = {each: getattr(valid, each) for each in type(valid).model_fields}
        reply = anyio.run(question.ask, recording, given, None)
        found.append({k: v for k, v in (reply.data or {}).items() if k not in OF_ITSELF})
    return found


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
def test_the_e_puck_in_c_answers_as_the_one_in_python(tmp_path: Path) -> None:
    program = tmp_path / "e_puck_avoid_c"
    source = CONTROLLERS / program.name / f"{program.name}.c"
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
    folders = [f"-I{C_HEADER.parent}", f"-I{Path(__file__).parent}"]
    subprocess.run(["gcc", *flags, *folders, source, "-o", program, "-lm"], check=True)
    sensed, speeds = record_in_python(tmp_path / "python")
    assert record_in_c(tmp_path / "c", sensed, program) == speeds
    for folder in ("c", "python"):
        record_in_real_time(tmp_path / folder)
    ours, theirs = answers(tmp_path / "c"), answers(tmp_path / "python")
    for (name, _), mine, other in zip(QUESTIONS, ours, theirs, strict=True):
        assert mine == other, name
