"""Signals, their history and trends, asked by a client of a recording whose story is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.server.conftest import ask
from tests.server.history.conftest import EVERY, STORY, tell
from tests.server.story import client_on, copy_of, rows_of
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.chunk_making import make_chunks

pytestmark = pytest.mark.anyio


@pytest.mark.slow
async def test_every_answer_says_about_which_robot_and_run_and_as_of_when(story: Path) -> None:
    for tool, arguments in EVERY:
        answer = await tell(story, tool, **arguments)
        assert (answer["robot"], answer["run_id"], answer["sim_time_s"]) == ("rover", 3, 59.9), tool
        assert answer["status"].startswith("stopped "), tool
        assert answer["age_s"] > 0, tool


async def test_an_extreme_is_never_lost_in_a_bucket(story: Path) -> None:
    answer = await tell(story, "webots_query_history", signals=["ir"], run_id=STORY, max_points=4)
    (run,) = answer["runs"]
    assert len(run["sim_time_s"]) <= 4
    assert max(run["numbers"]["ir"]["max"]) == 5.0
    whole = run["numbers"]["ir"]["whole"]
    assert (whole["max"], whole["max_at_s"]) == (5.0, 70.0)
    assert run["recording_gaps"] == [[89.9, 95.0]]
    assert sum(run["count"]) == run["row_count"] == 1150


async def test_numbers_too_large_to_reckon_with_are_not_called_silent(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    supervisor = InProcessSupervisor("rover")
    with MCPBridge(supervisor, throttle_interval=1, database=file) as bridge:
        for _ in range(5):
            bridge.publish({"big": 1e301})
            supervisor.step(8)
    answer = await tell(file, "webots_query_history", signals=["big"])
    assert answer["runs"][0]["numbers"]["big"] == {"replaced": {"beyond 1e100": 5}}


@pytest.mark.slow
async def test_raw_rows_come_in_pages_that_neither_repeat_nor_miss_one(story: Path) -> None:
    times: list[float] = []
    cursor: int | None = 0
    async with client_on(story) as client:
        while cursor is not None:
            answer = await ask(
                client, "webots_query_history",
                signals=["pose.0"], raw=True, max_points=250, cursor=cursor, run_id=STORY,
            )  # fmt: skip
            times += answer["raw"]["sim_time_s"]
            cursor = answer.get("cursor")
    assert len(times) == len(set(times)) == 1150


async def test_trends_say_in_one_line_what_a_person_would_notice(story: Path) -> None:
    answer = await tell(story, "webots_get_trends", run_id=STORY)
    (run,) = answer["runs"]
    says = {row["signal"]: row["says"] for row in rows_of(run["numbers"])}
    assert "rises from 0 to 12.78" in says["pose.0"]
    assert "period 2 s" in says["heading"]
    assert "1 spike, the largest 5 at 70 s" in says["ir"]
    assert "no value in 40 of 1150 rows" in says["sensors.front"]
    modes = {row["signal"]: row for row in rows_of(run["states"])}
    assert modes["mode"]["time_by_value_s"]["back_up"] == pytest.approx(8.0, abs=0.2)
    assert run["numbers"]["columns"] == ["signal", "says", "last", "mean", "deviation"]
    told = run["constant"].split(", ")
    assert "target 3" in told and len(told) == 4
    assert not says.keys() & {each.split(" ")[0] for each in told}


@pytest.mark.slow
async def test_answers_are_the_same_before_and_after_chunks_are_made(
    story: Path, tmp_path: Path
) -> None:
    chunked = copy_of(story, tmp_path / "webots.db")
    with connect(chunked, "writer") as connection:
        assert make_chunks(connection, 100_000).done
    connection.close()
    for tool, arguments in (
        ("webots_list_signals", {"run_id": STORY}),
        ("webots_query_history", {"signals": ["*"], "run_id": STORY}),
        ("webots_get_trends", {"run_id": STORY}),
        ("webots_find_events", {"run_id": STORY}),
    ):
        before, after = [await tell(file, tool, **arguments) for file in (story, chunked)]
        changing = ("age_s", "status")
        assert {k: v for k, v in before.items() if k not in changing} == {
            k: v for k, v in after.items() if k not in changing
        }, tool


async def test_signals_come_in_pages_and_by_pattern(story: Path) -> None:
    first = await tell(story, "webots_list_signals", limit=10)
    second = await tell(story, "webots_list_signals", limit=10, cursor=first["cursor"])
    names = [row["signal"] for part in (first, second) for row in rows_of(part["signals"])]
    assert names == sorted(set(names))
    assert len(names) == first["total"] == 15
    assert "cursor" not in second
    part = await tell(story, "webots_list_signals", pattern="lidar.*")
    assert part["total"] == 5
