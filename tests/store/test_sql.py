"""SQL may read, shortly; everything else is refused with the reason, and nothing changes."""

from __future__ import annotations

import sqlite3
import sys
from contextlib import closing, suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recordings.rover import record_rover
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.sql import describe_schema, query_sql


def test_a_select_answers_with_columns_and_rows(rover: sqlite3.Connection) -> None:
    result = query_sql(rover, "SELECT id, label FROM run ORDER BY id")
    assert result.columns == ("id", "label")
    assert result.rows == ((1, None), (2, None), (3, None))
    assert (result.truncated, result.shortened) == (None, 0)


@pytest.mark.parametrize(
    "statement",
    [
        "WITH a(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM a WHERE n < 5) SELECT max(n) FROM a",
        "SELECT json_extract(data, '$.pose[0]') FROM state LIMIT 1",
        "SELECT key, value FROM state, json_each(data) WHERE state.id = 1",
        "-- a comment\n /* and another */ SELECT 1",
        "VALUES (1), (2)",
        "EXPLAIN QUERY PLAN SELECT * FROM state WHERE run_id = 1 AND sim_time_s > 5",
        "SELECT avg(mean) OVER (ORDER BY start_s) FROM robot_statistics WHERE run_id = 1",
        "SELECT 1;",
    ],
)
def test_reading_in_any_form_is_allowed(rover: sqlite3.Connection, statement: str) -> None:
    assert query_sql(rover, statement).columns


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM state",
        "INSERT INTO robot (name) VALUES ('x')",
        "UPDATE run SET label = 'x'",
        "DROP TABLE state",
        "CREATE TABLE x (y)",
        "CREATE TEMP TABLE x (y)",
        "WITH a AS (SELECT 1) DELETE FROM state",
        "WITH a AS (SELECT 1) INSERT INTO run (id) SELECT * FROM a",
        "EXPLAIN DELETE FROM state",
        "ATTACH 'other.db' AS other",
        "PRAGMA journal_mode = DELETE",
        "PRAGMA user_version",
        "SELECT * FROM pragma_journal_mode('delete')",
        "VACUUM INTO 'copy.db'",
        "SELECT load_extension('x')",
        "SELECT length(zeroblob(1000000000))",
        "BEGIN IMMEDIATE",
        "SELECT 1; DELETE FROM state",
        "",
        "   ",
        "-- nothing",
    ],
)
def test_all_but_reading_is_refused_and_changes_nothing(tmp_path: Path, statement: str) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("INSERT INTO lease VALUES ('x', 'y', 1.0)")
        before = file.read_bytes(), connection.total_changes
        with pytest.raises(InvalidInputError):
            query_sql(connection, statement)
        assert (file.read_bytes(), connection.total_changes) == before
        assert not connection.in_transaction
        connection.execute("DELETE FROM lease")  # afterwards the connection may write again
    assert {path.name for path in tmp_path.iterdir()} <= {
        "webots.db",
        "webots.db-wal",
        "webots.db-shm",
    }


def test_a_recursion_without_end_is_cut(rover: sqlite3.Connection) -> None:
    with pytest.raises(InvalidInputError, match=r"no row within 0\.2 s"):
        query_sql(
            rover,
            "WITH a(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM a) SELECT max(n) FROM a",
            deadline_s=0.2,
        )
    assert query_sql(rover, "SELECT 1").rows == ((1,),)


def test_endless_rows_are_truncated_and_say_so(rover: sqlite3.Connection) -> None:
    endless = "WITH a(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM a) SELECT n FROM a"
    result = query_sql(rover, endless, max_rows=10)
    assert len(result.rows) == 10 and "first 10 rows" in (result.truncated or "")
    result = query_sql(rover, "SELECT data FROM state", max_rows=1000, max_bytes=2000)
    assert len(result.rows) < 20 and "too long" in (result.truncated or "")


def test_long_values_and_blobs_are_shortened(rover: sqlite3.Connection) -> None:
    result = query_sql(rover, "SELECT data, CAST('abc' AS BLOB) FROM state LIMIT 1")
    text, blob = result.rows[0]
    assert str(text).endswith("characters)") and len(str(text)) < 230
    assert blob == "<blob of 3 bytes>" and result.shortened == 1


@pytest.mark.skipif(sys.version_info < (3, 11), reason="sqlite3 limits came with Python 3.11")
def test_a_value_of_gigabytes_is_refused(rover: sqlite3.Connection) -> None:
    doubling = "WITH a(n, x) AS (SELECT 1, 'x' UNION ALL SELECT n + 1, x || x FROM a WHERE n < 30)"
    with pytest.raises(InvalidInputError, match="too big"):
        query_sql(rover, f"{doubling} SELECT max(length(x)) FROM a")


@pytest.mark.parametrize(
    ("statement", "offer"),
    [
        ("SELECT sim_time FROM state", "Columns of state, the nearest first: sim_time_s"),
        ("SELECT s.walltime_s FROM state s", "wall_time_s"),
        ("SELECT * FROM states", "state"),
        ("SELECT battery_v FROM state", "json_extract"),
        ("SELEC 1", "begins with 'SELEC'"),
        (" ", "The statement is empty. Give one"),
        ("SELECT FROM", "syntax error"),
        ("SELECT * FROM state WHERE run_id = :run", "Write the values into the SELECT"),
    ],
)
def test_an_error_offers_what_was_perhaps_meant(
    rover: sqlite3.Connection, statement: str, offer: str
) -> None:
    with pytest.raises(InvalidInputError, match=offer.replace("(", r"\(")):
        query_sql(rover, statement)


@given(st.text(max_size=40))
def test_no_text_at_all_writes_or_crashes(text: str) -> None:
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.execute("CREATE TABLE t (x)")
        before = connection.total_changes
        for statement in (text, f"SELECT {text}", f"WITH a AS (SELECT 1) {text}"):
            with suppress(InvalidInputError):
                query_sql(connection, statement, deadline_s=0.5)
        assert connection.total_changes == before


def test_the_schema_describes_itself(empty: sqlite3.Connection) -> None:
    record_rover(empty)
    text = describe_schema(empty)
    assert "table state: id, run_id, sim_time_s" in text
    assert "data [JSON object]" in text
    assert "logger [name of the Python logger" in text  # a column that was added later
    assert "view robot_statistics: " in text
    assert "alembic" not in text
    assert len(text) < 9_000
