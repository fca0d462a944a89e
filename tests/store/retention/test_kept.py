"""Kept stretches outlive the states around them, as a whole, and have a limit of their own."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.recording import view_robot
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.retention_plan import plan
from webots_mcp.store.run_rows import newest_state
from webots_mcp.store.signal_history import query_history

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
        "SELECT json_extract(data, '$.n') FROM all_state WHERE run_id = ? "
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
    asked = find_range(connection, Scope(start_s=start_s, end_s=end_s))
    (run,) = query_history(connection, asked, ["n"], max_points=500).runs
    assert run.rows == 438
    assert run.numbers[0].last == [float(n) for n in before[0]]


def test_they_are_not_told_as_the_newest_state_of_a_run_whose_later_rows_are_deleted(
    connection: sqlite3.Connection, tmp_path: Path
) -> None:
    """The robot was said to be where it was in the stretch, at that time and so long ago."""
    newest = newest_state(connection, 1)
    assert newest is not None
    prune(connection, tmp_path, Retention(state=NONE, kept_state=ALL), rest=False)
    assert newest_state(connection, 1) is None
    assert view_robot(connection, None).header()["sim_time_s"] == pytest.approx(
        newest.sim_time_s, abs=1
    )


def test_their_own_limit_takes_the_oldest_and_what_loses_a_row_is_no_stretch_any_more(
    connection: sqlite3.Connection, tmp_path: Path
) -> None:
    before = kept(connection)
    prune(connection, tmp_path, Retention(state=NONE, kept_state=ALL), rest=False)
    prune(connection, tmp_path, Retention(state=NONE, kept_state=Limit(rows=500)), rest=False)
    (left,) = connection.execute("SELECT count(*) FROM kept_state").fetchone()
    assert 438 <= left <= 500
    assert kept(connection) == before[1:]
    prune(connection, tmp_path, Retention(state=NONE, kept_state=NONE), rest=False)
    assert kept(connection) == []
    assert connection.execute("SELECT count(*) FROM kept_state").fetchone() == (0,)


@pytest.fixture(params=[1, 10])
def filmed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[sqlite3.Connection]:
    """Three runs, with a kept stretch of camera frames each, and saved frames beside them."""
    database = tmp_path / "webots.db"
    robot = InProcessSupervisor("rover")
    camera = robot.getDevice("camera")
    camera.enable(16)
    with MCPBridge(robot, throttle_interval=request.param, database=database) as bridge:
        bridge.keep_camera(camera)
        for _ in range(3):
            for number in range(300):
                robot.step(16)
                bridge.publish({"n": number})
                if number % 100 == 50:
                    bridge.save_camera_frame(camera)
                if number == 150:
                    bridge.keep("a look")
            robot.simulationReset()
    with closing(connect(database, "writer")) as connection:
        yield connection


def frames(connection: sqlite3.Connection, kind: str) -> dict[int, int]:
    sql = "SELECT run_id, count(*) FROM image WHERE kind = ? GROUP BY run_id"
    return dict(connection.execute(sql, (kind,)).fetchall())


def files(folder: Path) -> set[str]:
    return {f"camera/{file.name}" for file in (folder / "camera").iterdir()}


def paths(connection: sqlite3.Connection) -> set[str]:
    return {path for (path,) in connection.execute("SELECT path FROM image")}


def test_camera_frames_of_a_stretch_do_not_count_as_pictures_and_stay_with_it(
    filmed: sqlite3.Connection, tmp_path: Path
) -> None:
    before = frames(filmed, "kept")
    assert set(before) == {1, 2, 3} and min(before.values()) > 10
    nothing = Limit(rows=0, spared_rows=0)
    retention = Retention(state=NONE, image=nothing, kept_state=ALL, outlive=0)
    wanted = plan(filmed, retention)
    assert wanted.rows_by_table()["image"] == 9
    prune(filmed, tmp_path, retention, rest=False)
    assert frames(filmed, "camera") == {}
    assert frames(filmed, "kept") == before
    assert files(tmp_path) == paths(filmed)
    prune(filmed, tmp_path, Retention(image=Limit(age_s=0, spared_rows=0)), now_s=9e9, rest=False)
    assert frames(filmed, "kept") == before


def test_camera_frames_go_with_their_stretch_and_count_with_it(
    filmed: sqlite3.Connection, tmp_path: Path
) -> None:
    before = frames(filmed, "kept")
    prune(filmed, tmp_path, Retention(state=NONE, kept_state=ALL, outlive=0), rest=False)
    ((pictures_bytes,),) = filmed.execute("SELECT sum(size_bytes) FROM image WHERE kind = 'kept'")
    held_bytes = plan(filmed, Retention(outlive=0)).held_bytes["kept_state"]
    assert held_bytes > pictures_bytes > 0
    two = Limit(size_bytes=held_bytes * 5 // 6)
    purged = prune(filmed, tmp_path, Retention(kept_state=two, outlive=0), rest=False)
    assert frames(filmed, "kept") == {2: before[2], 3: before[3]}
    assert frames(filmed, "camera") == {1: 3, 2: 3, 3: 3}
    assert files(tmp_path) == paths(filmed)
    assert purged.files == before[1]


def test_a_run_that_is_forgotten_leaves_no_file_of_a_camera_frame(
    filmed: sqlite3.Connection, tmp_path: Path
) -> None:
    one = Limit(rows=1, spared_rows=0)
    prune(filmed, tmp_path, Retention(state=one, chunk=one, kept_state=ALL, outlive=1), rest=False)
    runs = [run_id for (run_id,) in filmed.execute("SELECT id FROM run")]
    assert 1 not in runs
    assert set(frames(filmed, "kept")) <= set(runs)
    assert files(tmp_path) == paths(filmed)
