"""How what is beyond the limits goes: in small steps, beside robots, with its space."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.runs import ROW_S, Recorded, states
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.purge import Upkeep, prune, purge
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.retention_plan import plan


@pytest.fixture
def filed(tmp_path: Path) -> Iterator[tuple[Path, Recorded]]:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        connection.execute("BEGIN")
        recorded.add_run(0)
        recorded.run(1, recorded.robot_id)
        for i in range(5000):
            recorded.publish(i * ROW_S, {"x": i, "text": "t" * 400})
        connection.execute("COMMIT")
        yield file, recorded


def summed_up(recorded: Recorded) -> None:
    """Nothing is left to do for the maker of chunks: what a purge does is to delete."""
    for run_id in recorded.rows():
        chunk_whole_run(recorded.connection, run_id)


def test_purging_gives_the_space_back_to_the_disk(filed: tuple[Path, Recorded]) -> None:
    file, recorded = filed
    recorded.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    before = file.stat().st_size
    done = recorded.prune(states(rows=500, spared_rows=0))
    recorded.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert file.stat().st_size < before / 3
    assert done.freed_bytes == pytest.approx(before - file.stat().st_size, rel=0.2)


def test_progress_ends_with_everything_that_was_planned(filed: tuple[Path, Recorded]) -> None:
    _, recorded = filed
    told: list[tuple[int, int]] = []
    prune(
        recorded.connection,
        recorded.folder,
        states(rows=1000, spared_rows=0),
        rest=False,
        progress=lambda done, of: told.append((done, of)),
    )
    assert told[0] == (0, 4096)
    assert told[-1] == (4096, 4096)
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_two_that_carry_out_the_same_plan_delete_no_more_than_one(
    filed: tuple[Path, Recorded],
) -> None:
    file, recorded = filed
    summed_up(recorded)
    wanted = plan(recorded.connection, states(rows=2000, spared_rows=0))
    with closing(connect(file, "writer")) as other:
        first = purge(recorded.connection, wanted, recorded.folder)
        second = purge(other, wanted, recorded.folder)
        for _ in first:
            next(second, None)
        total = next(purge(other, wanted, recorded.folder))  # what is left of it: nothing
    assert total.rows == Counter()
    assert recorded.rows() == {2: 1928}
    assert recorded.connection.execute("SELECT purged_rows FROM run").fetchall() == [(0,), (3072,)]


def test_a_lock_that_another_holds_is_waited_for_without_waiting(
    filed: tuple[Path, Recorded],
) -> None:
    file, recorded = filed
    summed_up(recorded)
    recorded.connection.execute("PRAGMA busy_timeout=0")
    wanted = plan(recorded.connection, states(rows=4000, spared_rows=0))
    work = purge(recorded.connection, wanted, recorded.folder)
    with closing(connect(file, "writer")) as other:
        other.execute("BEGIN IMMEDIATE")
        for _ in range(5):  # each comes back while the lock is still held
            assert next(work).rows == Counter()
        other.execute("COMMIT")
    assert [done.rows.total() for done in work][-1] == 1024


def test_a_maintainer_purges_a_little_in_each_round(filed: tuple[Path, Recorded]) -> None:
    _, recorded = filed
    summed_up(recorded)
    upkeep = Upkeep(recorded.folder, lambda _: states(rows=1000, spared_rows=0), budget_s=0.0)
    upkeep(recorded.connection)
    left = [recorded.rows()[2]]
    for _ in range(3):
        upkeep(recorded.connection)
        left.append(recorded.rows()[2])
    assert left == sorted(left, reverse=True)
    assert 904 < left[-1] < left[0]  # some went, and not all
    while recorded.rows() != {2: 904}:
        upkeep(recorded.connection)


@pytest.mark.slow
def test_a_maintainer_checks_once_a_minute_and_at_once_where_the_limits_change(
    filed: tuple[Path, Recorded],
) -> None:
    _, recorded = filed
    summed_up(recorded)
    limits = [states(rows=1000)]
    upkeep = Upkeep(recorded.folder, lambda _: limits[-1], budget_s=60)
    upkeep(recorded.connection)
    assert recorded.rows() == {2: 904}
    for i in range(200):
        recorded.publish(2501.0 + i, {})
    upkeep(recorded.connection)
    assert recorded.rows() == {2: 1104}
    limits.append(states(rows=0))
    upkeep(recorded.connection)
    assert recorded.rows() == {}


def test_a_maintainer_that_reconnects_begins_with_a_new_plan(filed: tuple[Path, Recorded]) -> None:
    file, recorded = filed
    summed_up(recorded)
    limits = states(rows=1000, spared_rows=0)
    upkeep = Upkeep(recorded.folder, lambda _: limits, interval_s=0, budget_s=0.0)
    with closing(connect(file, "writer")) as first:
        upkeep(first)
        upkeep(first)
    before = recorded.rows()[2]
    assert before < 5000
    upkeep(recorded.connection)
    upkeep(recorded.connection)
    assert recorded.rows()[2] < before


def test_tables_take_turns_so_that_none_grows_while_another_is_purged(
    filed: tuple[Path, Recorded],
) -> None:
    _, recorded = filed
    summed_up(recorded)
    for _ in range(200):
        recorded.add_picture(recorded.run_id)
    few = Limit(rows=10)
    limits = Retention(state=few, image=few, outlive=0)
    work = purge(recorded.connection, plan(recorded.connection, limits), recorded.folder)
    seen = [dict(done.rows) for done in work]
    assert seen[2]["image"] > 0 and seen[2]["state"] > 0
    all_gone = {table: [rows.get(table) for rows in seen].index(n) for table, n in seen[-1].items()}
    assert all_gone["image"] < all_gone["state"]


def test_a_purge_goes_in_small_writes_and_space_goes_back_while_rows_still_go(
    filed: tuple[Path, Recorded],
) -> None:
    """A thousand rows at once would hold the lock for 10 ms; of each write a row at least."""
    _, recorded = filed
    summed_up(recorded)
    wanted = plan(recorded.connection, states(rows=100))
    freed = [done.freed_bytes for done in purge(recorded.connection, wanted, recorded.folder)
             if done.rows["state"] < 4096]  # fmt: skip
    assert len(freed) > 10
    assert 0 < freed[len(freed) // 2] < freed[-1]


@pytest.mark.slow
def test_a_robot_that_records_meanwhile_loses_no_row(filed: tuple[Path, Recorded]) -> None:
    file, recorded = filed
    recorded.end_run("finished")
    recorded.connection.execute("UPDATE run SET row_count = 5000 WHERE id = 2")
    robot, steps = InProcessSupervisor("other"), 0
    line = [sys.executable, "-m", "webots_mcp", "prune", "--keep-states", "0rows"]
    with MCPBridge(robot, throttle_interval=1, database=file) as bridge:
        command = subprocess.Popen([*line, "--database", str(file)], stdout=subprocess.PIPE)
        while is_running(command):
            robot.step(16)
            bridge.publish({"x": steps})
            steps += 1
        said = command.communicate()[0].decode()
        assert command.returncode == 0
        assert bridge.stats().rows_dropped == 0
    assert any(line.split()[:1] == ["state"] for line in said.splitlines())
    rows = recorded.connection.execute(
        "SELECT row_count, purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) "
        "FROM run"
    ).fetchall()
    assert rows == [(0, 0), (5000, 5000), (steps, steps)]
    assert recorded.connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def is_running(command: subprocess.Popen[bytes]) -> bool:
    """Whether it runs on; asked at the pace of a robot."""
    try:
        command.wait(timeout=0.002)
    except subprocess.TimeoutExpired:
        return True
    return False
