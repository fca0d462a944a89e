"""docs/my-robot.md: each symptom is recorded, and each answer is what a command prints."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from docs import walkthrough
from tests.cases import problems
from tests.cases.situations import PROBLEMS, record
from tests.documentation.test_tutorial import form
from tests.judging.checks import labelled
from webots_mcp.contract import DATABASE_NAME, PROJECT_DATA_FOLDER
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema

assert problems.__doc__  # it registers the situations

PAGE = Path(__file__).parents[2] / "docs" / "my-robot.md"
SECTIONS = dict(re.findall(r"(?ms)^## (.+?)\n(.*?)(?=^## |\Z)", PAGE.read_text("utf-8")))
ARENA = Path(__file__).parents[2] / "examples" / "worlds" / "arena.wbt"
LAUNCH = "webots-mcp launch --stand-in worlds/arena.wbt"
CONTROLLER = """
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot)
speed = 0.0

def plan():
    while {hangs} and robot.getTime() > 1:
        pass

while robot.step(32) != -1:
    speed += 0.01
    x, y, _ = robot.getSelf().getPosition()
    bridge.publish({{"x_m": x, "y_m": y, "speed": speed}}, force=True)
    bridge.get_command()
    plan()
"""


@contextmanager
def situation(name: str, folder: Path) -> Generator[walkthrough.Terminal]:
    with closing(_new_database(folder)) as connection:
        record(connection, *PROBLEMS[name].columns())
    yield walkthrough.Terminal(folder)


@contextmanager
def slow(folder: Path) -> Generator[walkthrough.Terminal]:
    rng = np.random.default_rng(1)
    with closing(_new_database(folder)) as connection:
        labelled.record(connection, labelled.healthy(rng), labelled.WRITTEN["slow"][0])
    yield walkthrough.Terminal(folder)


def _new_database(folder: Path) -> sqlite3.Connection:
    data_dir = folder / PROJECT_DATA_FOLDER
    data_dir.mkdir()
    (folder / "worlds").mkdir()
    (folder / "worlds" / ARENA.name).write_text(ARENA.read_text("utf-8"), "utf-8")
    connection = connect(data_dir / DATABASE_NAME, "writer", create=True)
    create_schema(connection)
    return connection


@contextmanager
def driving(folder: Path, hangs: bool = False) -> Generator[walkthrough.Terminal]:
    for file, text in (
        ("worlds/arena.wbt", ARENA.read_text("utf-8")),
        ("controllers/rover/rover.py", CONTROLLER.format(hangs=hangs)),
    ):
        (folder / file).parent.mkdir(parents=True)
        (folder / file).write_text(text, "utf-8")
    terminal = walkthrough.Terminal(folder)
    terminal.environment["WEBOTS_MCP_HANG_AFTER_S"] = "1" if hangs else "0"
    with terminal.running(LAUNCH, "records: run 1"):
        while hangs and "silent for" not in terminal.run("webots-mcp status")[1]:
            pass  # the hang is noticed after a second
        yield terminal


SYMPTOMS: dict[str, Callable[[Path], AbstractContextManager[walkthrough.Terminal]]] = {
    "It does not move, or is stuck": lambda folder: situation(
        "a robot is held; its command is a target speed", folder
    ),
    "It spins": lambda folder: situation("a robot turns in place for 90 s", folder),
    "It oscillates": lambda folder: situation("a roll oscillation grows for a minute", folder),
    "It falls": lambda folder: situation("a walking robot tips over", folder),
    "It is slow": slow,
    "It hangs": lambda folder: driving(folder, hangs=True),
    "It behaves differently after a reset": driving,
    "A sensor is NaN": lambda folder: situation("half of the rays of a lidar are NaN", folder),
    "A sensor drops out": lambda folder: situation(
        "every seventh reading of a range sensor is 0", folder
    ),
}


def test_each_symptom_of_the_page_is_recorded() -> None:
    assert list(SECTIONS) == list(SYMPTOMS)


@pytest.mark.slow
@pytest.mark.parametrize("symptom", SYMPTOMS)
def test_the_answer_to_a_symptom_is_what_the_command_prints(symptom: str, tmp_path: Path) -> None:
    with SYMPTOMS[symptom](tmp_path) as terminal:
        printed, shown = "", 0
        for step in walkthrough.steps(SECTIONS[symptom]):
            if step.language == "sh":
                printed = "".join(terminal.run(line)[1] for line in step.text.splitlines())
            else:
                assert form(step.text) in form(printed)
                shown += 1
    assert shown
