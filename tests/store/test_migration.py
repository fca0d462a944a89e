"""A database of the first schema comes forward with its data."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from webots_mcp.connection import connect
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.schema import create_schema, require_current
from webots_mcp.store.migrate import downgrade, upgrade

FIRST_DATA = (
    "INSERT INTO robot (name, kind, first_seen_wall_time_s, last_seen_wall_time_s) "
    "VALUES ('rover', 'Robot', 1.0, 2.0)",
    "INSERT INTO session (robot_id, pid, host, instance, supervisor, started_wall_time_s, "
    "last_seen_wall_time_s) VALUES (1, 7, 'here', 'i', 0, 1.0, 2.0)",
    "INSERT INTO run (session_id, robot_id, start_reason, started_wall_time_s, "
    "started_sim_time_s, last_wall_time_s, last_sim_time_s) VALUES (1, 1, 'start', 1, 0, 2, 1)",
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (1, 0.5, 1.5, '{\"x\": 1}')",
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


def statements(connection: sqlite3.Connection) -> set[str]:
    rows = connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")
    return {str(sql).rstrip() for (sql,) in rows}
