"""What the tools about the past answer to bad questions, and where there is nothing."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from mcp import MCPError

from tests.recordings.rows import Recorded
from tests.server.conftest import ask
from tests.server.history.conftest import EVERY, refuse, tell
from tests.server.story import client_on

pytestmark = pytest.mark.anyio


async def test_sql_reads_and_the_schema_is_a_resource(story: Path) -> None:
    async with client_on(story) as client:
        sql = "SELECT run_id, count(*) AS rows FROM state GROUP BY run_id"
        answer = await ask(client, "webots_query_sql", sql=sql)
        assert answer["result"] == {"columns": ["run_id", "rows"],
                                    "rows": [[1, 1150], [2, 300], [3, 600]]}  # fmt: skip
        (content,) = (await client.read_resource("webots://schema")).contents
        assert "sim_time_s" in getattr(content, "text", "")


async def test_the_schema_is_told_before_anything_was_recorded(tmp_path: Path) -> None:
    async with client_on(tmp_path / "webots.db") as client:
        (content,) = (await client.read_resource("webots://schema")).contents
    assert "table state:" in getattr(content, "text", "")
    assert list(tmp_path.iterdir()) == []


async def test_the_schema_of_a_refused_recording_is_refused_by_name(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "webots.db")) as other, other:
        other.execute("CREATE TABLE tune (name TEXT)")
    async with client_on(tmp_path / "webots.db") as client:
        with pytest.raises(MCPError, match="belongs to another application"):
            await client.read_resource("webots://schema")


@pytest.mark.parametrize(
    ("tool", "arguments", "words"),
    [
        ("webots_find_events", {"start_s": 3, "end_s": 3}, "empty"),
        ("webots_find_events", {"where": "x > 1", "kinds": ["jump"]}, "which kinds does not name"),
        ("webots_get_trends", {"since_wall_time": "yesterday"}, "ISO 8601"),
        (
            "webots_get_trends",
            {"since_wall_time": 1700000100, "until_wall_time": 1.7e9},
            "until_wall_time=1700000000",
        ),
        ("webots_get_timeline", {"cursor": "xyz"}, "is not a cursor"),
        ("webots_compare_runs", {"run_ids": [1, 99]}, "No run 99"),
        ("webots_plot", {"signals": ["nope"]}, "No signal 'nope'"),
        ("webots_query_sql", {"sql": "SELECT 1; SELECT 2"}, "Only one statement"),
        ("webots_query_sql", {"sql": "SELECT sim_time FROM state"}, "sim_time_s"),
        ("webots_query_sql", {"sql": "SELECT * FROM stat"}, "state"),
    ],
)
async def test_bad_input_is_an_error_with_the_next_step(
    story: Path, tool: str, arguments: dict[str, Any], words: str
) -> None:
    assert words in await refuse(story, tool, **arguments)


async def test_a_run_without_a_row_says_so_in_every_tool(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    recorded.robot().log(0.0, "hello")
    async with client_on(tmp_path / "webots.db") as client:
        for tool, arguments in EVERY:
            if tool not in ("webots_list_runs", "webots_query_sql"):
                answer = await ask(client, tool, **arguments)
                assert (answer["robot"], answer["run_id"]) == ("rover", 1), tool
                assert answer["hint"], tool
    recorded.close()


async def test_empty_answers_say_why_and_what_to_try(story: Path) -> None:
    for tool, arguments, words in (
        ("webots_get_trends", {"start_s": 500}, "leave the range out"),
        ("webots_query_history", {"signals": ["*"], "start_s": 500}, "leave the range out"),
        ("webots_get_trends", {"since_wall_time": "2035-01-01"}, "webots_list_runs"),
        ("webots_query_sql", {"sql": "SELECT 1 WHERE 0"}, "webots_get_trends"),
    ):
        assert words in (await tell(story, tool, **arguments))["hint"], tool
