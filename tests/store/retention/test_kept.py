"""Kept stretches outlive the states around them, as a whole, and have a limit of their own."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.connection import connect
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.questions.series import query_history
from webots_mcp.store.reading.ranges import resolve_range
from webots_mcp.store.retention import Limit, Retention, prune

NONE = Limit(rows=0)
ALL = Limit()


@pytest.fixture(params=[1, 10])
def connection(request: pytest.FixtureRequest) -> Iterator[sqlite3.Connection]:
    """A recording with two kept stretches; of each call, or of one in ten."""
    database = MemoryDatabase()
    robot = InProcessSupervisor("rover")
    with MCPBridge(robot, throttle_interval=request.param, database=database) as bridge:
        for number in range(3000):
            robot.step(16)
            bridge.publish({"n": number})
            if number in (600, 2000):
                bridge.keep(f"look {number}")
    with closing(connect(database, "writer")) as connection:
        yield connection
    database.close()


def kept(connection: sqlite3.Connection) -> list[list[int]]:
    sql = (
        "SELECT json_extract(data, '$.n') FROM every_state WHERE run_id = ? "
        "AND sim_time_s BETWEEN ? AND ? ORDER BY sim_time_s"
    )
    stretches = connection.execute(
        "SELECT run_id, start_sim_time_s, end_sim_time_s FROM kept_stretch ORDER BY id"
    ).fetchall()
    return [[n for (n,) in connection.execute(sql, stretch)] for stretch in stretches]


def test_they_stay_whole_where_all_states_go(
    connection: sqlite3.Connection, tmp_path: Path
) -> None:
    before = kept(connection)
    assert [len(each) for each in before] == [438, 438]
    prune(connection, tmp_path, Retention(state=NONE, kept_state=ALL), rest=False)
    assert connection.execute("SELECT count(*) FROM state").fetchone() == (0,)
    assert kept(connection) == before
    start_s, end_s = connection.execute(
        "SELECT start_sim_time_s, end_sim_time_s + 0.001 FROM kept_stretch LIMIT 1"
    ).fetchone()
    asked = resolve_range(connection, start_s=start_s, end_s=end_s)
    (run,) = query_history(connection, asked, ["n"], max_points=500).runs
    assert run.rows == 438
    assert run.numbers[0].last == [float(n) for n in before[0]]


def test_their_own_limit_takes_the_oldest_and_what_loses_a_row_is_no_stretch_any_more(
    connection: sqlite3.Connection, tmp_path: Path
) -> None:
    before = kept(connection)
    prune(connection, tmp_path, Retention(state=NONE, kept_state=ALL), rest=False)
    prune(connection, tmp_path, Retention(state=NONE, kept_state=Limit(rows=500)), rest=False)
    assert connection.execute("SELECT count(*) FROM kept_state").fetchone() == (500,)
    assert kept(connection) == before[1:]
    prune(connection, tmp_path, Retention(state=NONE, kept_state=NONE), rest=False)
    assert kept(connection) == []
    assert connection.execute("SELECT count(*) FROM kept_state").fetchone() == (0,)
