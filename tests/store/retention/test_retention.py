"""What is kept, and what goes."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.runs import ROW_S, Recorded, states
from webots_mcp.connection import connect
from webots_mcp.errors import InvalidInputError, UnknownRunError
from webots_mcp.schema import create_schema
from webots_mcp.settlement import end_session
from webots_mcp.store.retention import Limit, Retention, mark_kept, plan
from webots_mcp.store.retention.purge import purge
from webots_mcp.store.rollup.buckets import buckets
from webots_mcp.store.rollup.rolling import roll

TABLES = ("state", "rollup", "change", "log", "event", "image", "command", "run", "session")
NO_LIMIT = Retention(Limit(), Limit(), Limit(), Limit(), Limit(), outlive=0)


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    with memory_connection() as connection:
        yield Recorded(connection, tmp_path)


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


def test_rows_go_in_the_order_in_which_they_were_recorded_whatever_their_run(
    recorded: Recorded,
) -> None:
    first = recorded.add_run(0, end=None)
    second = recorded.add_run(0, robot_id=recorded.robot("other"), end=None)
    for i in range(40):
        recorded.run_id = (first, second)[i % 2]
        recorded.publish(i * ROW_S, {"x": i})
    recorded.prune(states(rows=10))
    assert recorded.connection.execute("SELECT min(id), count(*) FROM state").fetchone() == (31, 10)
    assert recorded.rows() == {first: 5, second: 5}


def test_a_size_and_a_number_of_rows_hold_for_the_current_run_too(recorded: Recorded) -> None:
    recorded.add_run(100)
    recorded.add_run(100, end=None)
    recorded.prune(states(rows=30, spared_rows=50))
    assert recorded.rows() == {2: 30}


def test_the_newest_rows_of_all_runs_together_do_not_go_because_of_their_age(
    recorded: Recorded,
) -> None:
    other = recorded.robot("other")
    for _ in range(2):
        recorded.add_run(20, robot_id=other)
        recorded.add_run(20)
    limits = states(age_s=0, spared_rows=30)
    (spared,) = plan(recorded.connection, limits, recorded.wall_s + 1).spared
    assert (spared.table, spared.rows) == ("state", 30)
    assert spared.why == "too old, but among the newest 30"
    recorded.prune(limits, recorded.wall_s + 1)
    assert recorded.rows() == {3: 10, 4: 20}
    again = plan(recorded.connection, limits, recorded.wall_s + 1)
    assert (again.rows, [each.rows for each in again.spared]) == (0, [30])


@pytest.mark.parametrize("column", ["started_wall_time_s", "last_wall_time_s"])
def test_a_run_whose_times_are_no_numbers_stays_and_holds_up_nothing(
    recorded: Recorded, column: str
) -> None:
    for _ in range(3):
        recorded.add_run(50)
    recorded.connection.execute(f"UPDATE run SET {column} = 'x' WHERE id = 2")
    recorded.prune(states(rows=60, spared_rows=0))
    assert recorded.rows() == {1: 10, 2: 50, 3: 50}


def test_what_stays_beyond_a_limit_is_told_with_the_reason(recorded: Recorded) -> None:
    for _ in range(2):
        recorded.add_run(20)
    roll(recorded.connection, 1000)
    mark_kept(recorded.connection, [1])
    limits = Retention(Limit(), Limit(rows=0), Limit(), Limit(), Limit(), outlive=0)
    wanted = plan(recorded.connection, limits, recorded.wall_s)
    assert wanted.kept_run_ids == (1,) and wanted.kept_bytes > 1000
    (rolled,) = wanted.spared
    assert (rolled.table, rolled.why) == ("rollup", "of runs that go on or have states left")
    assert (
        rolled.rows
        == recorded.connection.execute(
            "SELECT (SELECT count(*) FROM rollup WHERE run_id = 2) "
            "+ (SELECT count(*) FROM change WHERE run_id = 2)"
        ).fetchone()[0]
    )


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


def bytes_by_name(connection: sqlite3.Connection) -> dict[str, int]:
    try:
        sizes = connection.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name").fetchall()
    except sqlite3.OperationalError as error:
        pytest.skip(f"this SQLite does not tell the size of a table: {error}")
    return dict(sizes)


def mixed(low: int, high: int) -> list[int]:
    return [low + number * 7919 % (high - low) for number in range(97)]


@pytest.mark.parametrize(
    "lengths",
    [
        *([length] for length in (100, 300, 700, 1000, 1300, 1500, 2000, 2500, 3000)),
        *([length] for length in (4000, 4050, 5000, 8000, 12_000, 20_000)),
        [1300, 2500],
        [100] * 20 + [20_000],
        mixed(200, 3000),
        mixed(1300, 9000),
    ],
    ids=lambda lengths: f"{min(lengths)} to {max(lengths)} bytes",
)
@pytest.mark.parametrize("runs", [1, 6])
def test_what_states_take_is_known_within_a_twentieth_of_what_sqlite_says(
    tmp_path: Path, lengths: list[int], runs: int
) -> None:
    with closing(connect(tmp_path / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        connection.execute("BEGIN")
        run_ids = [recorded.add_run(0) for _ in range(runs)]
        for i in range(2000):
            recorded.run_id = run_ids[i % runs]
            text = "t" * (lengths[i % len(lengths)] - len('{"text": ""}'))
            recorded.publish(i * 0.016, {"text": text})
        connection.execute("COMMIT")
        sizes = bytes_by_name(connection)
        on_disk = sizes["state"] + sizes["ix_state_run_id_sim_time_s"]
        held = plan(connection, NO_LIMIT).held_bytes["state"]
    assert held == pytest.approx(on_disk, rel=0.05)


@pytest.mark.parametrize("length", [1300, 1500, 2500, 3000, 6000])
def test_the_file_of_long_rows_shrinks_to_the_limit(tmp_path: Path, length: int) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        connection.execute("BEGIN")
        run_ids = [recorded.add_run(0) for _ in range(6)]
        for i in range(2400):
            recorded.run_id = run_ids[i % 6]
            recorded.publish(i // 6 * 0.016, {"text": "t" * length})
        connection.execute("COMMIT")
        roll(connection, 10_000)
        states_bytes = 2_000_000
        recorded.prune(states(size_bytes=states_bytes))
        rest_bytes = sum(
            size for name, size in bytes_by_name(connection).items()
            if name not in ("state", "ix_state_run_id_sim_time_s")
        )  # fmt: skip
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert file.stat().st_size - rest_bytes == pytest.approx(states_bytes, rel=0.05)


def test_a_size_budget_is_met_within_a_tenth(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        empty_bytes = file.stat().st_size
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
    assert file.stat().st_size - empty_bytes == pytest.approx(2_000_000, rel=0.1)


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
    for table in ("rollup", "change", "log", "event", "image", "parameter_value"):
        sql = f"SELECT count(DISTINCT run_id), min(run_id) FROM {table}"
        assert recorded.connection.execute(sql).fetchone() == (11, 3)
    assert recorded.connection.execute("PRAGMA foreign_key_check").fetchall() == []


def test_rollups_stay_when_their_rows_go(recorded: Recorded) -> None:
    recorded.add_run(100)
    recorded.add_run(1)
    recorded.prune(states(rows=1))
    assert recorded.rows() == {2: 1}
    signals = dict(recorded.connection.execute("SELECT name, id FROM signal").fetchall())
    summaries = [part for _, part in buckets(recorded.connection, 1, signals["x"], range(100))]
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
    left = dict[int, int]()
    for number, _ in enumerate(purge(recorded.connection, wanted, recorded.folder)):
        if number == 1:
            mark_kept(recorded.connection, [1])
            left = recorded.rows()
    assert 0 < left[1] < 1200
    assert recorded.rows() == {1: left[1]}


def test_marking_is_for_runs_that_exist(recorded: Recorded) -> None:
    recorded.add_run(1)
    with pytest.raises(UnknownRunError, match="no run 9"):
        mark_kept(recorded.connection, [1, 9])
    assert recorded.connection.execute("SELECT keep FROM run").fetchone() == (0,)


def test_where_one_run_cannot_be_marked_none_is(recorded: Recorded) -> None:
    connection = recorded.connection
    for _ in range(2):
        recorded.add_run(1)
    connection.execute(
        "CREATE TRIGGER no_more BEFORE UPDATE ON run WHEN NEW.id = 2 "
        "BEGIN SELECT raise(ABORT, 'the disk is full'); END"
    )
    with pytest.raises(sqlite3.Error, match="the disk is full"):
        mark_kept(connection, [1, 2])
    assert connection.execute("SELECT keep FROM run").fetchall() == [(0,), (0,)]
    assert not connection.in_transaction


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
    with memory_connection() as connection:
        recorded = Recorded(connection, tmp_path)
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
