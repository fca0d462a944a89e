"""A value that no bridge has written costs its row, named in the answer, and never the tool."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from mcp import Client

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail, text_of
from tests.server.malformed import Damage, Damaged, damages, record
from webots_mcp.server.mcp_server import create_server

pytestmark = pytest.mark.anyio

# Of each column one in turn, and of the tools each twelfth: `python -m tests.server.malformed`
# tries all there are.
TRIED = (b"\x00\xff\x01", '{"x": ', "[1, 2]", '{"x": "\\ud800"}')
TABLES = ("robot", "session", "run", "state", "event", "command", "log", "image", "signal",
          "breakpoint", "parameter", "parameter_value", "trial_set", "trial", "kept_stretch",
          "kept_state", "console_line", "recording", "retention_limit", "row_group", "chunk",
          "watermark", "request", "meaning")  # fmt: skip
KEPT_BY_OTHERS = {"alembic_version", "lease"}  # of Alembic; of who maintains, tested there


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("base")
    record(folder / "webots.db")
    return folder


def test_every_table_is_tried(base: Path) -> None:
    with closing(sqlite3.connect(base / "webots.db")) as connection:
        found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        names = {name for (name,) in found if not name.startswith("sqlite_")}
    assert names - KEPT_BY_OTHERS == set(TABLES)


@pytest.mark.slow
@pytest.mark.parametrize("table", TABLES)
async def test_a_wrong_value_anywhere_leaves_every_tool_with_an_answer(
    base: Path, tmp_path: Path, table: str
) -> None:
    by_column: dict[str, list[Damage]] = {}
    for damage in damages(base / "webots.db"):
        if damage.table == table and damage.value in TRIED:
            by_column.setdefault(damage.column, []).append(damage)
    assert by_column
    damaged = Damaged(base, tmp_path / "copy")
    async with damaged.client:
        for number, tried in enumerate(by_column.values()):
            damage = tried[number % len(tried)]
            asked = slice(number % 12, None, 12)
            assert (await damaged.unusable_answers(damage, asked))[1] == []


async def test_trials_of_a_robot_that_cannot_be_read_are_told(base: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(base, folder)
    with closing(sqlite3.connect(folder / "webots.db")) as connection, connection:
        Damage("robot", "name", b"\xff").apply(connection)
    async with Client(create_server(folder / "webots.db", folder)) as client:
        answer = await ask(client, "webots_get_trials")
    assert answer["trial_set"] == 1


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (Damage("state", "data", "nonsense"), "state 2: data holds no valid JSON"),
        (Damage("state", "sim_time_s", "late"), "state 2: sim_time_s holds no valid number"),
        (Damage("state", "replaced", "[]"), "state 2: replaced holds no valid JSON"),
    ],
)
async def test_a_row_that_is_left_out_is_named_and_the_others_are_told(
    recorded: Recorded, connect: Connect, damage: Damage, said: str
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    robot.state(2.0, {"x": 2})
    damage.apply(recorded.connection)
    async with connect(read_only=True) as client:
        answer = await ask(client, "webots_get_full_state")
        assert answer["left_out"] == [said]
        assert answer["state"] == {"x": 2 if damage.column == "replaced" else 1}
        recorded.connection.execute("DELETE FROM state WHERE id = 2")
        assert "left_out" not in await ask(client, "webots_get_full_state")


async def test_where_nothing_is_left_the_answer_names_what_was_left_out(
    recorded: Recorded, connect: Connect
) -> None:
    robot = recorded.robot()
    Damage("run", "last_wall_time_s", "x").apply(recorded.connection)
    said = f"run {robot.run_id}: last_wall_time_s holds no valid number"
    async with connect() as client:
        assert said in (await ask(client, "webots_get_world_info"))["left_out"]
        assert said in text_of(await client.call_tool("webots_get_camera", {}))
        assert said in await fail(client, "webots_annotate_run", run_id=robot.run_id, label="x")
