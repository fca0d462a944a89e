"""How what is beyond the limits goes: in small steps, beside robots, with its space."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.data.runs import ROW_S, Recorded, states
from webots_mcp import MCPBridge
from webots_mcp.connection import connect
from webots_mcp.schema import create_schema
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.history.rollup import roll, watermark
from webots_mcp.store.retention import Upkeep, plan, prune
from webots_mcp.store.retention.purge import purge


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


def test_purging_gives_the_space_back_to_the_disk(filed: tuple[Path, Recorded]) -> None:
    file, recorded = filed
    recorded.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    before = file.stat().st_size
    done = recorded.prune(states(rows=500, spared_rows=0))
    recorded.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert file.stat().st_size < before / 4
    assert done.freed_bytes == pytest.approx(before - file.stat().st_size, rel=0.2)


def test_rows_are_rolled_up_before_they_go(filed: tuple[Path, Recorded]) -> None:
    _, recorded = filed
    assert watermark(recorded.connection) == 0
    recorded.prune(states(rows=1000, spared_rows=0))
    assert watermark(recorded.connection) >= 4000
    assert recorded.connection.execute("SELECT max(rows) FROM signal").fetchone()[0] >= 4000


def test_progress_ends_with_everything_that_was_planned(filed: tuple[Path, Recorded]) -> None:
    _, recorded = filed
    told: list[tuple[int, int]] = []
    prune(
        recorded.connection,
        recorded.folder,
        states(rows=1000, spared_rows=0),
        pause_s=0,
        progress=lambda done, of: told.append((done, of)),
    )
    assert told[0] == (0, 4000)
    assert told[-1] == (4000, 4000)
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_two_that_carry_out_the_same_plan_delete_no_more_than_one(
    filed: tuple[Path, Recorded],
) -> None:
    file, recorded = filed
    wanted = plan(recorded.connection, states(rows=2000, spared_rows=0))
    with closing(connect(file, "writer")) as other:
        first = purge(recorded.connection, wanted, recorded.folder)
        second = purge(other, wanted, recorded.folder)
        for _ in first:
            next(second, None)
        total = next(purge(other, wanted, recorded.folder))  # what is left of it: nothing
    assert total.rows == Counter()
    assert recorded.rows() == {2: 2000}
    assert recorded.connection.execute("SELECT purged_rows FROM run").fetchall() == [(0,), (3000,)]


def test_a_lock_that_another_holds_is_waited_for_without_waiting(
    filed: tuple[Path, Recorded],
) -> None:
    file, recorded = filed
    roll(recorded.connection, 10_000)
    recorded.connection.execute("PRAGMA busy_timeout=0")
    wanted = plan(recorded.connection, states(rows=4000, spared_rows=0))
    work = purge(recorded.connection, wanted, recorded.folder)
    with closing(connect(file, "writer")) as other:
        other.execute("BEGIN IMMEDIATE")
        for _ in range(5):  # each comes back while the lock is still held
            assert next(work).rows == Counter()
        other.execute("COMMIT")
    assert [done.rows.total() for done in work][-1] == 1000


def test_a_maintainer_purges_a_little_in_each_round(filed: tuple[Path, Recorded]) -> None:
    _, recorded = filed
    roll(recorded.connection, 10_000)
    upkeep = Upkeep(recorded.folder, states(rows=1000, spared_rows=0), budget_s=0.0)
    upkeep(recorded.connection)
    assert recorded.rows() == {2: 5000}
    for left in (4500, 4000, 3500):
        upkeep(recorded.connection)
        assert recorded.rows() == {2: left}
    upkeep._budget_s = 10
    upkeep(recorded.connection)
    assert recorded.rows() == {2: 1000}
    recorded.publish(2501.0, {})
    upkeep(recorded.connection)  # the next plan is a minute away
    assert recorded.rows() == {2: 1001}


def test_a_maintainer_that_reconnects_begins_with_a_new_plan(filed: tuple[Path, Recorded]) -> None:
    file, recorded = filed
    roll(recorded.connection, 10_000)
    limits = states(rows=1000, spared_rows=0)
    upkeep = Upkeep(recorded.folder, limits, interval_s=0, budget_s=0.0)
    with closing(connect(file, "writer")) as first:
        upkeep(first)
        upkeep(first)
    upkeep(recorded.connection)
    upkeep(recorded.connection)
    assert recorded.rows() == {2: 4000}


def test_a_robot_that_records_meanwhile_loses_no_row(filed: tuple[Path, Recorded]) -> None:
    file, recorded = filed
    recorded.end_run("finished")
    recorded.run(1, recorded.robot_id)  # a robot's newest run would be spared
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
    assert said.splitlines()[1].split()[:2] == ["state", "5000"]
    rows = recorded.connection.execute(
        "SELECT run.rows, count(*) FROM state JOIN run ON run.id = run_id GROUP BY run_id"
    ).fetchall()
    assert rows == [(steps, steps)]
    assert recorded.connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def is_running(command: subprocess.Popen[bytes]) -> bool:
    """Whether it runs on; asked at the pace of a robot."""
    try:
        command.wait(timeout=0.002)
    except subprocess.TimeoutExpired:
        return True
    return False
