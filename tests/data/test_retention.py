"""What is kept, what goes, and how it goes."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.history.recording import Recorder
from webots_mcp import MCPBridge
from webots_mcp.connection import connect
from webots_mcp.contract import MemoryDatabase
from webots_mcp.errors import InvalidInputError, UnknownRunError
from webots_mcp.schema import create_schema
from webots_mcp.settlement import end_session
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.history.rollup import buckets, roll, watermark
from webots_mcp.store.retention import Limit, Retention, Upkeep, mark_kept, plan, prune
from webots_mcp.store.retention.purge import purge

TABLES = ("state", "rollup", "change", "log", "event", "image", "command", "run", "session")
NO_LIMIT = Retention(Limit(), Limit(), Limit(), Limit(), Limit(), outlive=0)
ROW_S = 0.5  # simulated and wall time between two rows of these recordings


class Recorded(Recorder):
    """Runs with a known number of rows of each kind, one after the other."""

    def __init__(self, connection: sqlite3.Connection, folder: Path) -> None:
        super().__init__(connection)
        self.folder = folder
        self.robot_id = self.robot("rover")

    def add_run(self, rows: int, end: str | None = "reset", robot_id: int | None = None) -> int:
        """A run with that many states, half as many events, log lines, a picture, a command."""
        owner = robot_id or self.robot_id
        session_id = self.session(owner, "a" * 64)
        run_id = self.run(session_id, owner)
        self.add_command(session_id, owner)
        for i in range(rows):
            time_s = i * ROW_S
            self.publish(time_s, {"x": i, "mode": "ab"[i % 2]})
            if i % 2:
                change = json.dumps({"from": "a", "to": "b"})
                self.insert("event", **self.at(time_s), kind="change", name="mode", data=change)
                self.insert(
                    "log", **self.at(time_s), level="info", source="controller", message="line"
                )
        self.add_picture(run_id)
        self.at(rows * ROW_S * 2)
        if end:
            self.connection.execute(
                "UPDATE run SET end_reason = ?, ended_wall_time_s = ?, last_wall_time_s = ?, "
                "last_sim_time_s = ?, rows = ? WHERE id = ?",
                (end, self.wall_s, self.wall_s, rows * ROW_S, rows, run_id),
            )
            self.connection.execute(
                "UPDATE session SET ended_wall_time_s = ?, end_reason = 'finished' WHERE id = ?",
                (self.wall_s, session_id),
            )
        return run_id

    def add_command(self, session_id: int, robot_id: int) -> None:
        self.insert(
            "command", robot_id=robot_id, action="a", params="{}", status="done",
            created_wall_time_s=self.wall_s + 0.01, expires_wall_time_s=self.wall_s + 10,
            session_id=session_id,
        )  # fmt: skip

    def add_picture(self, run_id: int) -> None:
        path = f"camera/{run_id}.png"
        file = self.folder / path
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"picture")
        self.insert(
            "image", **self.at(1.0), kind="camera", device="c", path=path, width=1, height=1,
            bytes=1000,
        )  # fmt: skip

    def rows(self) -> dict[int, int]:
        sql = "SELECT run_id, count(*) FROM state GROUP BY run_id"
        return dict(self.connection.execute(sql).fetchall())

    def count(self, table: str) -> int:
        return int(self.connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])

    def of_runs(self, run_ids: list[int]) -> list[Any]:
        """Everything that is recorded of these runs."""
        marks = ",".join(map(str, run_ids)) or "NULL"
        tables = ("state", "rollup", "change", "log", "event", "image")
        found: list[Any] = [
            self.connection.execute(f"SELECT * FROM {table} WHERE run_id IN ({marks})").fetchall()
            for table in tables
        ]
        found += self.connection.execute(f"SELECT * FROM run WHERE id IN ({marks})").fetchall()
        return found

    def prune(self, retention: Retention, now_s: float | None = None):
        return prune(self.connection, self.folder, retention, now_s=now_s or self.wall_s, pause_s=0)


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    yield from make_recording(tmp_path)


def make_recording(folder: Path) -> Iterator[Recorded]:
    database = MemoryDatabase()
    with closing(connect(database, "writer")) as connection:
        create_schema(connection)
        yield Recorded(connection, folder)
    database.close()


def states(**limits: Any) -> Retention:
    """Only state rows are limited."""
    return Retention(Limit(**limits), Limit(), Limit(), Limit(), Limit(), outlive=0)


# -- what goes ------------------------------------------------------------------------------------


def test_finished_runs_lose_their_oldest_rows_first(recorded: Recorded) -> None:
    for rows in (100, 50, 30):
        recorded.add_run(rows)
    recorded.prune(states(rows=100, spared_rows=0))
    assert recorded.rows() == {1: 20, 2: 50, 3: 30}
    oldest = recorded.connection.execute("SELECT min(sim_time_s) FROM state WHERE run_id = 1")
    assert oldest.fetchone() == (80 * ROW_S,)


def test_the_number_of_purged_rows_stays_visible_beside_the_number_recorded(
    recorded: Recorded,
) -> None:
    recorded.add_run(100)
    recorded.add_run(10)
    recorded.prune(states(rows=60, spared_rows=0))
    sql = "SELECT run_id, rows, purged_rows FROM robot_run ORDER BY run_id"
    assert recorded.connection.execute(sql).fetchall() == [(1, 100, 50), (2, 10, 0)]


def test_a_crashed_run_is_counted_with_its_purged_rows(recorded: Recorded) -> None:
    recorded.add_run(100, end=None)
    recorded.connection.execute("UPDATE session SET host = 'elsewhere'")
    recorded.prune(states(rows=40, spared_rows=0))
    end_session(recorded.connection, 1, "crashed")
    sql = "SELECT rows, purged_rows FROM run"
    assert recorded.connection.execute(sql).fetchone() == (100, 60)


def test_the_current_run_keeps_what_is_spared(recorded: Recorded) -> None:
    recorded.add_run(100)
    recorded.add_run(100, end=None)
    recorded.prune(states(rows=0, spared_rows=30))
    assert recorded.rows() == {2: 30}


def test_the_newest_run_of_each_robot_is_current_even_if_it_ended(recorded: Recorded) -> None:
    other = recorded.robot("other")
    recorded.add_run(20, robot_id=other)
    recorded.add_run(20)
    recorded.add_run(20)
    recorded.prune(states(rows=0, spared_rows=5))
    assert recorded.rows() == {1: 5, 3: 5}


@pytest.mark.parametrize("mark", ["label = 'best'", "note = 'look'", "keep = 1"])
def test_a_run_that_was_named_described_or_marked_loses_nothing(
    recorded: Recorded, mark: str
) -> None:
    recorded.add_run(50)
    recorded.add_run(50)
    recorded.add_run(50, end=None)
    recorded.connection.execute(f"UPDATE run SET {mark} WHERE id = 1")
    nothing = Limit(rows=0, spared_rows=0)
    recorded.prune(Retention(nothing, nothing, nothing, nothing, nothing, outlive=1))
    assert recorded.rows() == {1: 50}
    assert (recorded.folder / "camera" / "1.png").exists()
    assert not (recorded.folder / "camera" / "2.png").exists()


def test_an_empty_label_keeps_nothing(recorded: Recorded) -> None:
    recorded.add_run(50)
    recorded.add_run(1)
    recorded.connection.execute("UPDATE run SET label = '', note = ''")
    recorded.prune(states(rows=1))
    assert recorded.rows() == {2: 1}


def test_rows_go_by_age_also_within_a_run(recorded: Recorded) -> None:
    recorded.add_run(100, end=None)
    start_s = recorded.connection.execute("SELECT min(wall_time_s) FROM state").fetchone()[0]
    kept_s = 40 * ROW_S * 0.5  # wall time passes half as fast as simulation time here
    now_s = start_s + 99 * ROW_S * 0.5
    recorded.prune(states(age_s=kept_s, spared_rows=0), now_s)
    oldest_s = recorded.connection.execute("SELECT min(wall_time_s) FROM state").fetchone()[0]
    assert oldest_s >= now_s - kept_s
    assert recorded.rows() == {1: 41}


def test_a_size_budget_is_met_within_a_tenth(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        connection.execute("BEGIN")
        for _ in range(2):
            recorded.add_run(0)
        recorded.run(1, recorded.robot_id)
        for i in range(8000):
            recorded.publish(i * ROW_S, {"x": i, "text": "t" * (300 + i % 200)})
        connection.execute("COMMIT")
        recorded.prune(states(size_bytes=2_000_000, spared_rows=0))
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert file.stat().st_size == pytest.approx(2_000_000, rel=0.15)


def test_logs_events_and_pictures_have_limits_of_their_own(recorded: Recorded) -> None:
    for _ in range(3):
        recorded.add_run(40)
    before = Counter({table: recorded.count(table) for table in TABLES})
    few = Limit(rows=25, spared_rows=0)
    limits = Retention(Limit(), Limit(), few, few, Limit(rows=2, spared_rows=0), outlive=0)
    done = recorded.prune(limits)
    assert [recorded.count(table) for table in ("log", "event", "image")] == [25, 25, 2]
    assert done.rows == Counter(log=35, event=35, image=1)
    assert done.files == 1
    assert recorded.count("state") == before["state"]


def test_finished_commands_go_with_the_age_of_events(recorded: Recorded) -> None:
    for _ in range(3):
        recorded.add_run(10)
    recorded.connection.execute("UPDATE command SET status = 'pending' WHERE id = 1")
    recorded.connection.execute("UPDATE run SET keep = 1 WHERE id = 2")
    limits = Retention(Limit(), Limit(), Limit(), Limit(age_s=0), Limit(), outlive=0)
    recorded.prune(limits, recorded.wall_s + 1)
    rows = recorded.connection.execute("SELECT id FROM command").fetchall()
    assert rows == [(1,), (2,)]  # the one that waits, and the one of the run that is kept


def test_what_is_left_of_a_run_outlives_its_rows_ten_times(recorded: Recorded) -> None:
    for _ in range(13):
        recorded.add_run(10)
    roll(recorded.connection, 1000)
    limits = Retention(Limit(rows=10, spared_rows=0), Limit(), Limit(), Limit(), Limit())
    recorded.prune(limits)
    assert recorded.rows() == {13: 10}
    for table in ("run", "session", "command"):
        assert recorded.connection.execute(f"SELECT min(id) FROM {table}").fetchone() == (3,)
    for table in ("rollup", "change", "log", "event", "image"):
        sql = f"SELECT count(DISTINCT run_id), min(run_id) FROM {table}"
        assert recorded.connection.execute(sql).fetchone() == (11, 3)
    assert recorded.connection.execute("PRAGMA foreign_key_check").fetchall() == []


def test_rollups_stay_when_their_rows_go(recorded: Recorded) -> None:
    recorded.add_run(100)
    recorded.add_run(1)
    recorded.prune(states(rows=1))
    assert recorded.rows() == {2: 1}
    signals = dict(recorded.connection.execute("SELECT name, id FROM signal").fetchall())
    summaries = [part for _, part in buckets(recorded.connection, 1, signals["x"], 0, 100)]
    assert sum(part.rows for part in summaries) == 100
    assert max(part.max or 0 for part in summaries) == 99
    roll(recorded.connection)
    assert recorded.count("rollup") > 0


def test_rollups_go_only_after_the_rows_that_they_stand_for(recorded: Recorded) -> None:
    for _ in range(3):
        recorded.add_run(10)
    roll(recorded.connection, 1000)
    only_rollups = Limit(rows=0)
    recorded.prune(Retention(Limit(), only_rollups, Limit(), Limit(), Limit(), outlive=0))
    assert recorded.connection.execute("SELECT count(DISTINCT run_id) FROM rollup").fetchone() == (
        3,
    )
    recorded.prune(Retention(Limit(rows=10), only_rollups, Limit(), Limit(), Limit(), outlive=0))
    assert recorded.connection.execute("SELECT DISTINCT run_id FROM rollup").fetchall() == [(3,)]


def test_a_picture_whose_path_leads_out_of_the_folder_is_forgotten_but_not_deleted(
    recorded: Recorded, tmp_path_factory: pytest.TempPathFactory
) -> None:
    outside = tmp_path_factory.mktemp("elsewhere") / "mine.png"
    outside.write_bytes(b"mine")
    for _ in range(2):
        recorded.add_run(2)
    recorded.connection.execute("UPDATE image SET path = ? WHERE id = 1", (str(outside),))
    limits = Retention(Limit(), Limit(), Limit(), Limit(), Limit(rows=0, spared_rows=0), outlive=0)
    done = recorded.prune(limits)
    assert outside.exists()
    assert (done.rows["image"], done.files) == (2, 1)


def test_a_file_that_another_row_stands_for_stays(recorded: Recorded) -> None:
    for _ in range(2):
        recorded.add_run(2)
    recorded.connection.execute("UPDATE image SET path = 'camera/2.png'")
    limits = Retention(Limit(), Limit(), Limit(), Limit(), Limit(rows=1, spared_rows=0), outlive=0)
    assert recorded.prune(limits).files == 0
    assert (recorded.folder / "camera" / "2.png").exists()


def test_a_run_that_is_marked_after_the_plan_was_made_loses_nothing_more(
    recorded: Recorded,
) -> None:
    recorded.add_run(1200)
    recorded.add_run(1)
    roll(recorded.connection, 10_000)
    wanted = plan(recorded.connection, states(rows=0, spared_rows=0), recorded.wall_s)
    for number, _ in enumerate(purge(recorded.connection, wanted, recorded.folder)):
        if number == 1:
            mark_kept(recorded.connection, [1])
    assert recorded.rows() == {1: 700}


def test_marking_is_for_runs_that_exist(recorded: Recorded) -> None:
    recorded.add_run(1)
    with pytest.raises(UnknownRunError, match="no run 9"):
        mark_kept(recorded.connection, [1, 9])
    assert recorded.connection.execute("SELECT keep FROM run").fetchone() == (0,)


@pytest.mark.parametrize("limits", [{"rows": -1}, {"age_s": float("nan")}, {"size_bytes": -5}])
def test_absurd_limits_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(limits))):
        Limit(**limits)


# -- laws -----------------------------------------------------------------------------------------

LIMITS = st.builds(
    Limit,
    size_bytes=st.none() | st.integers(0, 20_000),
    rows=st.none() | st.integers(0, 60),
    age_s=st.none() | st.floats(0, 100),
    spared_rows=st.integers(0, 20),
)
RETENTIONS = st.builds(
    Retention, LIMITS, LIMITS, LIMITS, LIMITS, LIMITS, st.sampled_from([0.0, 1.0, 3.0])
)
RUNS = st.lists(st.tuples(st.integers(0, 30), st.booleans(), st.booleans()), max_size=5)


@settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(retention=RETENTIONS, runs=RUNS)
@example(states(size_bytes=668, spared_rows=0), [(11, False, False), (5, False, False)])
def test_what_was_planned_is_what_goes_and_kept_runs_stay_whole(
    tmp_path: Path, retention: Retention, runs: list[tuple[int, bool, bool]]
) -> None:
    for recorded in make_recording(tmp_path):
        others = recorded.robot("other")
        kept: list[int] = []
        for rows, keep, other in runs:
            run_id = recorded.add_run(rows, robot_id=others if other else None)
            if keep:
                kept.append(run_id)
        # Rolled up beforehand: a plan cannot know how many rollups there will be.
        roll(recorded.connection, 10_000)
        mark_kept(recorded.connection, kept)
        before = Counter({table: recorded.count(table) for table in TABLES})
        whole = recorded.of_runs(kept)
        now_s = recorded.wall_s

        wanted = plan(recorded.connection, retention, now_s)
        done = recorded.prune(retention, now_s)

        assert done.rows == +wanted.rows_by_table()
        after = Counter({table: recorded.count(table) for table in TABLES})
        for table in TABLES[:-1]:
            assert after[table] == before[table] - done.rows[table]
        assert recorded.of_runs(kept) == whole
        # Sizes are estimated from samples, of which a purge leaves others: a row or two remain.
        again = plan(recorded.connection, retention, now_s).rows_by_table()["state"]
        assert again <= (0 if retention.state.size_bytes is None else 2)
        assert recorded.connection.execute("PRAGMA foreign_key_check").fetchall() == []


# -- how it goes ----------------------------------------------------------------------------------


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
        started_s = time.monotonic()
        for _ in range(5):
            assert next(work).rows == Counter()
        assert time.monotonic() - started_s < 1
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
    line = [sys.executable, "-m", "webots_mcp", "prune", "--state", "0rows"]
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
