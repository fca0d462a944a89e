"""Which rows are kept, and which go."""

from __future__ import annotations

import sqlite3
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.runs import ROW_S, Recorded, states
from tests.store.retention.conftest import TABLES
from webots_mcp.database.session_cleanup import end_session
from webots_mcp.errors import InvalidInputError, UnknownRunError
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.purge import purge
from webots_mcp.store.retention_limits import Limit, Retention, mark_kept
from webots_mcp.store.retention_plan import plan


@pytest.fixture
def short_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups of ten rows."""
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 10)
    monkeypatch.setattr(chunk_making, "MIN_ROWS_AT_END", 10)


def test_the_oldest_groups_go_first_until_the_rest_fits(
    short_groups: None, recorded: Recorded
) -> None:
    for rows in (100, 50, 30):
        recorded.add_run(rows)
    recorded.prune(states(rows=105, spared_rows=0))
    assert recorded.rows() == {1: 20, 2: 50, 3: 30}
    oldest = recorded.connection.execute("SELECT min(sim_time_s) FROM state WHERE run_id = 1")
    assert oldest.fetchone() == (80 * ROW_S,)
    counts = "SELECT row_count, purged_rows FROM robot_run ORDER BY run_id"
    assert recorded.connection.execute(counts).fetchall() == [(100, 80), (50, 0), (30, 0)]


def test_a_crashed_run_is_counted_with_its_purged_rows(recorded: Recorded) -> None:
    recorded.add_run(100, end=None)
    recorded.connection.execute("UPDATE session SET host = 'elsewhere'")
    recorded.prune(states(rows=0, spared_rows=0))
    end_session(recorded.connection, 1, "crashed")
    sql = "SELECT row_count, purged_rows FROM run"
    assert recorded.connection.execute(sql).fetchone() == (100, 100)


def test_groups_go_in_the_order_in_which_they_were_recorded_whatever_their_run(
    short_groups: None, recorded: Recorded
) -> None:
    first = recorded.add_run(0, end=None)
    second = recorded.add_run(0, robot_id=recorded.robot("other"), end=None)
    for i in range(40):
        recorded.run_id = (first, second)[i % 2]
        recorded.publish(i * ROW_S, {"x": i})
    recorded.prune(states(rows=20))
    assert recorded.connection.execute("SELECT min(id), count(*) FROM state").fetchone() == (21, 20)
    assert recorded.rows() == {first: 10, second: 10}


def test_a_size_and_a_number_of_rows_hold_for_the_current_run_too(
    short_groups: None, recorded: Recorded
) -> None:
    recorded.add_run(100)
    recorded.add_run(100, end=None)
    recorded.prune(states(rows=30, spared_rows=50))
    assert recorded.rows() == {2: 30}


def test_of_a_limit_below_the_size_of_a_group_the_newest_group_stays_but_of_0_none(
    short_groups: None, recorded: Recorded
) -> None:
    recorded.add_run(100, end=None)
    recorded.prune(states(rows=1))
    assert recorded.rows() == {1: 10}
    recorded.prune(states(size_bytes=1))
    assert recorded.rows() == {1: 10}
    recorded.prune(states(size_bytes=0))
    assert recorded.rows() == {}


def test_the_newest_rows_of_all_runs_together_do_not_go_because_of_their_age(
    short_groups: None, recorded: Recorded
) -> None:
    other = recorded.robot("other")
    for _ in range(2):
        recorded.add_run(20, robot_id=other)
        recorded.add_run(20)
    make_chunks(recorded.connection)
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
    short_groups: None, recorded: Recorded, column: str
) -> None:
    for _ in range(3):
        recorded.add_run(50)
    recorded.connection.execute(f"UPDATE run SET {column} = 'x' WHERE id = 2")
    recorded.prune(states(rows=60, spared_rows=0))
    assert recorded.rows() == {1: 10, 2: 50, 3: 50}


@pytest.mark.parametrize(
    "change", ["sim_time_s = 'x'", "wall_time_s = 'x'", "data = x'ff'", "data = '[1'"]
)
@pytest.mark.parametrize("rows", [50, 1200])
def test_a_row_that_no_chunk_can_take_holds_up_nothing(
    recorded: Recorded, change: str, rows: int
) -> None:
    for _ in range(2):
        recorded.add_run(rows)
    last_id = recorded.count("state")
    recorded.connection.execute(f"UPDATE state SET {change} WHERE id IN (20, {last_id})")
    recorded.prune(states(rows=10, spared_rows=0))
    recorded.prune(states(rows=0, spared_rows=0))
    left = recorded.connection.execute("SELECT id FROM state").fetchall()
    assert set(left) <= {(20,)}  # in the midst of a group it goes with its run
    assert plan(recorded.connection, states(rows=0, spared_rows=0), recorded.wall_s).rows == 0


def test_what_stays_beyond_a_limit_is_told_with_the_reason(recorded: Recorded) -> None:
    for _ in range(2):
        chunk_whole_run(recorded.connection, recorded.add_run(20))
    mark_kept(recorded.connection, [1])
    limits = Retention(chunk=Limit(rows=0), outlive=0)
    wanted = plan(recorded.connection, limits, recorded.wall_s)
    assert wanted.kept_run_ids == (1,) and wanted.kept_bytes > 1000
    (chunks,) = wanted.spared
    assert (chunks.table, chunks.rows, chunks.why) == ("chunk", 20, "the states are still there")


@pytest.mark.parametrize("mark", ["label = 'best'", "note = 'look'", "keep = 1"])
def test_a_run_that_was_named_described_or_marked_loses_nothing(
    recorded: Recorded, mark: str
) -> None:
    recorded.add_run(50)
    recorded.add_run(50)
    recorded.add_run(50, end=None)
    recorded.connection.execute("UPDATE run SET label = '', note = ''")  # which keep nothing
    recorded.connection.execute(f"UPDATE run SET {mark} WHERE id = 1")
    nothing = Limit(rows=0, spared_rows=0)
    recorded.prune(Retention(nothing, nothing, nothing, nothing, nothing, outlive=1))
    assert recorded.rows() == {1: 50}
    assert (recorded.folder / "camera" / "1.png").exists()
    assert not (recorded.folder / "camera" / "2.png").exists()


def test_groups_go_by_age_also_within_a_run(short_groups: None, recorded: Recorded) -> None:
    recorded.add_run(100, end=None)
    start_s = recorded.connection.execute("SELECT min(wall_time_s) FROM state").fetchone()[0]
    kept_s = 40 * ROW_S * 0.5  # wall time passes half as fast as simulation time here
    now_s = start_s + 99 * ROW_S * 0.5
    recorded.prune(states(age_s=kept_s, spared_rows=0), now_s)
    assert recorded.rows() == {1: 50}  # 41 are young enough, and the rest of their group stays


def test_a_run_that_is_marked_after_the_plan_was_made_loses_nothing_more(
    recorded: Recorded,
) -> None:
    recorded.add_run(1200)
    recorded.add_run(1)
    wanted = plan(recorded.connection, states(rows=0, spared_rows=0), recorded.wall_s)
    left = dict[int, int]()
    for number, _ in enumerate(purge(recorded.connection, wanted, recorded.folder)):
        if number == 1:
            mark_kept(recorded.connection, [1])
            left = recorded.rows()
    assert 0 < left[1] < 1200
    assert recorded.rows() == {1: left[1]}


def test_where_one_run_cannot_be_marked_none_is(recorded: Recorded) -> None:
    connection = recorded.connection
    for _ in range(2):
        recorded.add_run(1)
    with pytest.raises(UnknownRunError, match="No run 9"):
        mark_kept(connection, [1, 9])
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


@pytest.mark.slow
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
            # Beforehand: a plan cannot know how many chunks there will be.
            chunk_whole_run(connection, run_id)
        make_chunks(connection)
        mark_kept(recorded.connection, kept)
        before = Counter({table: recorded.count(table) for table in TABLES})
        whole = recorded.of_runs(kept)
        now_s = recorded.wall_s

        wanted = plan(recorded.connection, retention, now_s)
        done = recorded.prune(retention, now_s)

        assert done.rows == +wanted.rows_by_table()
        after = Counter({table: recorded.count(table) for table in TABLES})
        for table in ("state", "log", "event", "image", "command", "run"):
            assert after[table] == before[table] - done.rows[table]
        assert recorded.of_runs(kept) == whole
        # What fewer rows than fill a page take is not known to the row.
        again = plan(recorded.connection, retention, now_s).rows_by_table()["state"]
        assert again <= (0 if retention.state.size_bytes is None else 2)
        assert recorded.connection.execute("PRAGMA foreign_key_check").fetchall() == []
