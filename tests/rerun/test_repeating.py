"""Unchanged code repeats its run to the last digit, or the answer says why it does not."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.rerun.taping import (
    AVOID,
    EXAMPLES,
    WORLD,
    data_dir_of,
    project,
    record,
    recorded,
    rerun_of,
    taped_run,
    tapes,
)
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.errors import NothingRecordedError
from webots_mcp.rerun.running import current_file, find_taped_run, newest_taped_run, rerun

pytestmark = pytest.mark.slow

FIVE = [
    ("", "arena.wbt"),
    ("", "arena_referee.wbt"),
    ("e_puck", "e_puck.wbt"),
    ("tag", "tag.wbt"),
    ("youbot", "youbot.wbt"),
    ("gymnasium", "goal.wbt"),
]


@pytest.mark.parametrize(("folder", "world"), FIVE)
def test_each_controller_of_the_examples_repeats_its_run(
    tmp_path: Path, folder: str, world: str
) -> None:
    copied = tmp_path / "project"
    for part in ("worlds", "controllers"):
        shutil.copytree(EXAMPLES / folder / part, copied / part)
    record(copied / "worlds" / world, data_dir_of(copied), 10.0, tape="images")
    data_dir = data_dir_of(copied)
    found = tapes(copied)
    assert found
    for run_id in range(1, len(found) + 1):
        taped = find_taped_run(data_dir / DATABASE_NAME, data_dir, run_id)
        answer = rerun(taped, current_file(taped))
        assert answer.outcome == "equal", answer.text
        assert answer.is_unchanged
        assert answer.rounds > 100


def test_a_controller_that_is_attached_repeats_its_run(tmp_path: Path) -> None:
    controller = recorded(tmp_path)
    answer = rerun_of(tmp_path, controller)
    assert answer.text == (
        "equal for 501 rounds until 8.000 s: the unchanged code commands the same to the last digit"
    )
    assert not answer.began_late


def test_a_run_without_a_tape_says_how_to_record_one(tmp_path: Path) -> None:
    recorded(tmp_path, tape="")
    data_dir = data_dir_of(tmp_path)
    with pytest.raises(NothingRecordedError, match="WEBOTS_MCP_TAPE=1") as raised:
        newest_taped_run(data_dir / DATABASE_NAME, data_dir)
    assert "--tape" in str(raised.value)


def test_the_tape_has_code_devices_and_ends_as_the_controller_did(tmp_path: Path) -> None:
    controller = recorded(tmp_path)
    (tape,) = tapes(tmp_path)
    assert tape.sources() == {"controllers/rover/rover.py": controller.read_text("utf-8")}
    assert tape.head["devices"]["ds_left"] == "DistanceSensor"
    rounds = list(tape.rounds())
    assert [each.number for each in rounds[:3]] == [0, 1, 2]
    assert tape.end == "finished"


@pytest.mark.parametrize(
    ("line", "cause"),
    [
        ("import random; SPEED = random.uniform(4, 6)", "random numbers without a seed"),
        ("import time; SPEED = 4 + time.time() % 1", "the wall clock"),
        ("import datetime; SPEED = 4 + datetime.datetime.now().microsecond / 1e6", "wall clock"),
        ("SPEED = 3 + hash('speed') % 1000 / 500", "the order of a set"),
        ("import numpy as np; SPEED = 4 + np.random.rand()", "random numbers without a seed"),
        (
            "import datetime, random; datetime.date(2026, 1, 1).strftime('%Y'); "
            "SPEED = random.uniform(4, 6)",
            "Likely cause: random numbers without a seed",
        ),
        ("import uuid; SPEED = 4 + uuid.uuid4().int % 100 / 100", "random numbers"),
    ],
)
def test_code_that_does_not_repeat_itself_is_told_its_likely_cause(
    tmp_path: Path, line: str, cause: str
) -> None:
    code = AVOID.replace("SPEED = 5.0", line)
    controller = recorded(tmp_path, code, 2.0)
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "not repeatable"
    assert cause in answer.text
    assert "does not repeat itself from 0.016 s on" in answer.text
    assert not answer.first_differences


def test_a_seed_makes_chance_repeat(tmp_path: Path) -> None:
    code = AVOID.replace(
        "SPEED = 5.0",
        "import random\nrandom.seed(7)\nimport numpy\nrng = numpy.random.default_rng(3)\n"
        "SPEED = random.uniform(4, 6) + float(rng.normal())",
    )
    controller = recorded(tmp_path, code, 2.0)
    assert rerun_of(tmp_path, controller).outcome == "equal"


def test_threads_that_command_are_named(tmp_path: Path) -> None:
    code = AVOID.replace(
        "turning = 0\n",
        "import threading, time\nturning = 0\nshared = [0.0]\n"
        "def count():\n    while True:\n        shared[0] += 1.0\n        time.sleep(0.0007)\n"
        "threading.Thread(target=count, daemon=True).start()\n",
        1,
    ).replace("motor.setVelocity(speed)", "motor.setVelocity(speed + shared[0] % 7 / 10)")
    controller = recorded(tmp_path, code, 4.0)
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "not repeatable"
    assert "another thread" in answer.text


RESETS = """\
from math import inf

from controller import Supervisor

from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot)
step_ms = int(robot.getBasicTimeStep())
motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
gps = robot.getDevice("gps")
gps.enable(step_ms)
resets = rounds = 0
for motor in motors:
    motor.setPosition(inf)
while robot.step(step_ms) != -1:
    rounds += 1
    if bridge.detect_reload():
        resets += 1
        for motor in motors:
            motor.setPosition(inf)
    bridge.publish({"rounds": rounds, "resets": resets})
    x_m = gps.getValues()[0]
    for motor in motors:
        motor.setVelocity(3.0 + resets + x_m % 1)
    if robot.getTime() > 1.0 and resets < 2:
        robot.simulationReset()
"""


def test_a_later_run_of_a_process_is_replayed_from_its_start(tmp_path: Path) -> None:
    controller = recorded(tmp_path, RESETS, 6.0)
    second, third = taped_run(tmp_path, 2), taped_run(tmp_path, 3)
    assert (second.number, third.number) == (1, 2)
    assert second.tape.file == third.tape.file
    answer = rerun(second, controller, until_s=0.5)
    assert (answer.outcome, answer.until_s) == ("equal", pytest.approx(0.5, abs=0.02))
    assert rerun(third, controller).outcome == "equal"
    controller.write_text(RESETS.replace("x_m % 1)", "x_m % 1 + (resets == 2))"), "utf-8")
    assert rerun(second, controller).outcome == "equal"
    answer = rerun(third, controller)
    assert answer.outcome == "differs"
    assert answer.until_s < 0.1
    controller.write_text(RESETS.replace("3.0 +", "3.5 +"), "utf-8")
    assert "of an earlier run of the same process" in rerun(third, controller).text


def test_a_crash_is_replayed_up_to_its_line(tmp_path: Path) -> None:
    code = AVOID.replace("        turning = 20", "        turning = 20 / 0")
    controller = project(tmp_path, code)
    with pytest.raises(AssertionError, match="ZeroDivisionError"):
        record(tmp_path / "worlds" / "arena.wbt", data_dir_of(tmp_path), 8.0)
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "equal"
    assert "then it ended by ZeroDivisionError: division by zero at controllers/" in answer.text
    controller.write_text(AVOID, "utf-8")
    assert rerun_of(tmp_path, controller).outcome == "equal"


def test_a_killed_controller_can_be_replayed(tmp_path: Path) -> None:
    code = AVOID.replace("turning = 0\n", "import os, signal\nturning = 0\n", 1).replace(
        "        turning = 20", "        os.kill(os.getpid(), signal.SIGKILL)"
    )
    controller = project(tmp_path, code)
    with pytest.raises(AssertionError):
        record(tmp_path / "worlds" / "arena.wbt", data_dir_of(tmp_path), 8.0)
    controller.write_text(AVOID, "utf-8")
    taped = taped_run(tmp_path)
    assert taped.tape.end is None
    answer = rerun(taped, controller, until_s=2.0)
    assert answer.outcome == "equal"
    assert answer.rounds == 125


SEARCHES_FOLDERS = """\
import sys
import threading

from math import inf

from controller import Robot

from webots_mcp import MCPBridge

robot = Robot()
bridge = MCPBridge.attach(robot)
searched = []


def note(event, arguments):
    if event in ("os.listdir", "os.scandir", "os.walk", "glob.glob"):
        if threading.current_thread() is threading.main_thread():
            searched.append(str(arguments[0]))


sys.addaudithook(note)
step_ms = int(robot.getBasicTimeStep())
motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
for motor in motors:
    motor.setPosition(inf)
for number in range(60):
    robot.step(step_ms)
    if number == 30:
        import late
    motors[0].setVelocity(1.0)
open("searched.txt", "w").write(chr(10).join(each for each in searched if "rover" in each))
"""


def test_the_loop_searches_no_folder_and_the_tape_has_what_is_near_and_imported(
    tmp_path: Path,
) -> None:
    controller = project(tmp_path, SEARCHES_FOLDERS)
    (controller.parent / "late.py").write_text("GAIN = 2\n", "utf-8")
    (controller.parent / "parts").mkdir()
    (controller.parent / "parts" / "near.py").write_text("GAIN = 3\n", "utf-8")
    record(tmp_path / "worlds" / WORLD.name, data_dir_of(tmp_path), 0.9)
    (tape,) = tapes(tmp_path)
    assert {name.rpartition("/")[2] for name in tape.sources()} == {
        "rover.py",
        "late.py",
        "near.py",
    }
    searched = (controller.parent / "searched.txt").read_text("utf-8").splitlines()
    assert len(searched) <= 1  # by the import itself
    assert rerun_of(tmp_path, controller).outcome == "equal"
