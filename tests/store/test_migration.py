"""A database of an older schema comes forward with its data."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator
from contextlib import closing
from pathlib import Path

import pytest

from webots_mcp.connection import connect
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.schema import create_schema, require_current
from webots_mcp.store.migrate import downgrade, upgrade
from webots_mcp.store.trials import fetch_trial_set, trials_of

FIRST_DATA = (
    "INSERT INTO robot (name, kind, first_seen_wall_time_s, last_seen_wall_time_s) "
    "VALUES ('rover', 'Robot', 1.0, 2.0)",
    "INSERT INTO session (robot_id, pid, host, instance, supervisor, started_wall_time_s, "
    "last_seen_wall_time_s) VALUES (1, 7, 'here', 'i', 0, 1.0, 2.0)",
    "INSERT INTO run (session_id, robot_id, start_reason, started_wall_time_s, "
    "started_sim_time_s, last_wall_time_s, last_sim_time_s) VALUES (1, 1, 'start', 1, 0, 2, 1)",
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (1, 0.5, 1.5, '{\"x\": 1}')",
)

FIFTH_DATA = (
    *FIRST_DATA,
    "INSERT INTO rollup (run_id, signal_id, bucket, rows, first) VALUES (1, 1, 0, 3, 0.5)",
    "INSERT INTO recent_rollup (run_id, signal_id, bucket, rows, first) VALUES (1, 1, 1, 2, 0.7)",
    "INSERT INTO coarse_rollup (run_id, signal_id, bucket, rows, first) VALUES (1, 1, 0, 5, 0.5)",
    "INSERT INTO trial_set (uuid, plan, created_wall_time_s) VALUES ('s', '{}', 1.0)",
    "INSERT INTO trial (trial_set_id, uuid, number, parameters, status, run_id) "
    "VALUES (1, 't', 1, '{}', 'waiting', 1)",
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) "
    'VALUES (1, 0.6, 1.6, \'{"x_cm": 250, "y_cm": 50}\')',
)


def test_a_database_of_the_first_schema_comes_forward_with_its_data(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    upgrade(file, "0001")
    connection = connect(file, "writer")
    for statement in FIRST_DATA:
        connection.execute(statement)

    assert upgrade(file) == (1, SCHEMA_VERSION)

    require_current(connection)
    assert connection.execute("SELECT data FROM state").fetchall() == [('{"x": 1}',)]
    assert connection.execute("SELECT count(*) FROM rollup").fetchone() == (0,)
    connection.close()


@pytest.fixture
def fifth(tmp_path: Path) -> Generator[sqlite3.Connection, None, None]:
    """A database of schema 5, which knew neither kept stretches nor the largest step."""
    file = tmp_path / "webots.db"
    assert upgrade(file, "0005") == (0, 5)
    with closing(connect(file, "writer")) as connection:
        for statement in FIFTH_DATA:
            connection.execute(statement)
        yield connection


def test_a_database_of_schema_5_comes_forward_with_its_trials_and_rollups(
    fifth: sqlite3.Connection, tmp_path: Path
) -> None:
    assert upgrade(tmp_path / "webots.db") == (5, SCHEMA_VERSION)

    require_current(fifth)
    trial_set = fetch_trial_set(fifth, 1)
    assert (trial_set.uuid, trial_set.robot_id, trial_set.stop_reason) == ("s", None, None)
    assert [(trial.uuid, trial.run_id) for trial in trials_of(fifth, 1)] == [("t", 1)]
    rollups = fifth.execute("SELECT rows, first, largest_step FROM all_rollup ORDER BY bucket")
    assert rollups.fetchall() == [(3, 0.5, None), (2, 0.7, None)]
    coarse = fifth.execute("SELECT rows, first, largest_step FROM coarse_rollup")
    assert coarse.fetchall() == [(5, 0.5, None)]
    states = fifth.execute("SELECT state_id, sim_time_s FROM every_state")
    assert states.fetchall() == [(1, 0.5), (2, 0.6)]
    assert fifth.execute("SELECT * FROM robot_kept").fetchall() == []
    assert fifth.execute("SELECT x_m, y_m FROM robot_now").fetchall() == [(2.5, 0.5)]


def test_a_trial_set_that_came_forward_forgets_a_robot_that_is_deleted(
    fifth: sqlite3.Connection, tmp_path: Path
) -> None:
    upgrade(tmp_path / "webots.db")
    fifth.execute("UPDATE trial_set SET robot_id = 1, session_id = 1")
    fifth.execute("DELETE FROM robot")
    kept = fifth.execute("SELECT robot_id, session_id FROM trial_set").fetchall()
    assert kept == [(None, None)]


def test_schema_5_is_the_same_after_going_forward_and_back(
    fifth: sqlite3.Connection, tmp_path: Path
) -> None:
    before = columns(fifth)
    upgrade(tmp_path / "webots.db")
    assert downgrade(tmp_path / "webots.db", "0005") == (SCHEMA_VERSION, 5)
    assert columns(fifth) == before
    assert fifth.execute("SELECT count(*) FROM trial").fetchone() == (1,)


def test_going_back_deletes_only_what_the_older_schema_lacks(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    upgrade(file, "0002")
    connection = connect(file, "writer")
    for statement in FIRST_DATA:
        connection.execute(statement)

    assert downgrade(file, "0001") == (2, 1)

    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    assert not tables & {"signal", "rollup", "change", "watermark"}
    assert connection.execute("SELECT count(*) FROM state").fetchone() == (1,)
    connection.close()


def test_the_generated_schema_equals_what_the_migrations_make(tmp_path: Path) -> None:
    made, migrated = tmp_path / "made.db", tmp_path / "migrated.db"
    upgrade(migrated)
    with closing(connect(made, "writer", create=True)) as connection:
        create_schema(connection)
        generated = statements(connection)
    with closing(connect(migrated, "reader")) as connection:
        assert statements(connection) == generated


def columns(connection: sqlite3.Connection) -> set[tuple[str, str, str]]:
    """Every table, view and index with the names of its columns; of a view also its text."""
    rows = connection.execute(
        "SELECT m.name, i.name, iif(m.type = 'view', m.sql, '') FROM sqlite_master m "
        "LEFT JOIN pragma_table_info(m.name) i"
    )
    return set(rows)


def statements(connection: sqlite3.Connection) -> set[str]:
    rows = connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")
    return {str(sql).rstrip() for (sql,) in rows}
