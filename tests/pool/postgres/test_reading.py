"""What is read from a pool in PostgreSQL."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.pool.postgres.shipped import rows_of, ship, uuid_of
from tests.postgres import Server
from tests.recordings.rover import Recorder, record_rover
from webots_mcp.errors import InvalidInputError, PoolError
from webots_mcp.plugins.pool import postgres_pool as reading
from webots_mcp.plugins.pool.pool_contents import pooled_runs, pooled_trial_sets
from webots_mcp.plugins.pool.pool_interface import Table, table, tables
from webots_mcp.plugins.pool.postgres_pool import PostgresPool
from webots_mcp.store.chunk_making import make_chunks

pytestmark = pytest.mark.slow

# What jsonb has not, or has otherwise; each comes back as it was, also where it is no JSON object.
ODD_OBJECTS = ["", "no JSON", '{"a":', '{"a": "\\u0000"}', '"\\ud800"', "NaN", "[1, 2.50]", "-0.0"]
VALUES = ['"text"', '"3"', "3", "true", "null", '{"a": 1}', '"\\u0000"', '["\\u0000"]', '"\\n\\""']


@pytest.fixture(scope="module")
def recording() -> Iterator[sqlite3.Connection]:
    """The known story, in chunks, with parameters, a trial set and odd values."""
    with memory_connection() as connection:
        record_rover(connection)
        assert make_chunks(connection, 100_000).done
        connection.execute("UPDATE run SET uuid = 'run ' || id, label = 'first' WHERE id < 3")
        recorder = Recorder(connection)
        recorder.run_id, recorder.run_start_s = 3, recorder.wall_s
        for number, text in enumerate(ODD_OBJECTS):
            recorder.insert("event", **recorder.at(float(number)), kind="odd", data=text)
        for text in VALUES:
            recorder.insert(
                "parameter_value", **recorder.at(1.0), name="p", value=text, is_default=0,
                set_by="code",
            )  # fmt: skip
        recorder.insert("trial_set", uuid="set", plan="{}", created_wall_time_s=5.0)
        for number, run_id in ((1, 2), (2, None), (3, 1)):
            recorder.insert(
                "trial", trial_set_id=1, uuid=f"trial {number}", number=number, parameters="{}",
                status="done", run_id=run_id,
            )  # fmt: skip
        yield connection


@pytest.fixture(scope="module")
def shipped_url(postgres: Server, pool_template: str, recording: sqlite3.Connection) -> str:
    pool = postgres.new_database(pool_template)
    ship(postgres, pool, recording)
    return postgres.url(pool)


@pytest.fixture
def pool(shipped_url: str) -> Iterator[PostgresPool]:
    with PostgresPool(shipped_url) as opened:
        yield opened


def parsed(table: Table, rows: list[tuple[Any, ...]]) -> list[list[Any]]:
    """JSON as the values that it stands for; what is none as it is."""
    return [
        [
            meant(value) if column in table.json_columns else value
            for column, value in zip(table.columns, row, strict=True)
        ]
        for row in rows
    ]


def meant(text: str | None) -> Any:
    try:
        return None if text is None else ("JSON", json.loads(text, parse_constant=lambda _: text))
    except ValueError:
        return text


@pytest.mark.parametrize("table", tables(), ids=lambda table: table.name)
def test_every_row_comes_back_as_it_was_recorded(
    pool: PostgresPool, recording: sqlite3.Connection, table: Table
) -> None:
    found = [row for batch in pool.rows(uuid_of(recording), table, {}) for row in batch.rows]
    found.sort(key=lambda row: str(row[: len(table.key)]).rjust(40))
    assert parsed(table, found) == parsed(table, rows_of(recording, table))


def test_rows_are_chosen_and_come_in_the_order_of_their_key(
    pool: PostgresPool, recording: sqlite3.Connection
) -> None:
    uuid, states, chunks = uuid_of(recording), table("state"), table("chunk")
    batches = list(pool.rows(uuid, states, {"run_id": [3, 2]}))
    ids = sorted(int(str(row[0])) for batch in batches for row in batch.rows)
    wanted = recording.execute("SELECT id FROM state WHERE run_id > 1 ORDER BY id").fetchall()
    assert ids == [row_id for (row_id,) in wanted]
    (signal_id,) = recording.execute("SELECT id FROM signal WHERE name = 'ir'").fetchone()
    where = {"run_id": [1], "signal_id": [signal_id], "group_id": [2, 1, 99]}
    places = [chunks.columns.index(each) for each in ("run_id", "signal_id", "group_id")]
    some = [row for batch in pool.rows(uuid, chunks, where) for row in batch.rows]
    keys = [tuple(row[at] for at in places) for row in some]
    assert keys == [(1, signal_id, 1)]
    assert list(pool.rows("00000000-0000-4000-8000-000000000000", states, {})) == []


def test_two_tables_can_be_read_at_once(pool: PostgresPool, recording: sqlite3.Connection) -> None:
    logs, events = (pool.rows(uuid_of(recording), table(name), {}) for name in ("log", "event"))
    first, second = next(logs), next(events)
    assert (len(first.rows), len(second.rows)) == (3, 4 + len(ODD_OBJECTS))


def test_what_is_there_is_listed(pool: PostgresPool, recording: sqlite3.Connection) -> None:
    runs = pooled_runs(pool)
    assert {(run.recording_uuid, run.robot) for run in runs} == {(uuid_of(recording), "rover")}
    assert [(run.run_id, run.uuid, run.label) for run in runs] == [
        (1, "run 1", "first"), (2, "run 2", "first"), (3, "", None)
    ]  # fmt: skip
    (trials,) = pooled_trial_sets(pool)
    uuid = uuid_of(recording)
    assert (trials.trials, sorted(trials.runs)) == (3, [(uuid, 1), (uuid, 2)])
    sizes = {size.table: size for size in pool.sizes()}
    assert (sizes["state"].rows, sizes["trial"].rows, sizes["picture"].rows) == (2050, 3, 0)
    assert (sizes["state"].size_bytes or 0) > 2050 * 100
    assert (sizes["chunk"].size_bytes or 0) > sizes["chunk"].rows * 50 > 0
    assert pool.progress(uuid) == {"shipped": 1}
    assert pool.picture(uuid, "camera/1.png") is None


def test_one_select_is_answered_up_to_its_limit(pool: PostgresPool) -> None:
    sql = "SELECT robot, mode, x_m FROM robot_trajectory WHERE mode LIKE 'cr%' ORDER BY state_id;"
    found = pool.select(sql, 2)
    assert found.columns == ("robot", "mode", "x_m")
    assert found.rows == (("rover", "cruise", 0.0), ("rover", "cruise", pytest.approx(0.02)))
    assert found.truncated == "only the first 2 rows; narrow the question, or count and aggregate"
    found = pool.select("SELECT 1.5 AS number, NULL, true -- and so on", 9)
    assert (found.columns[:2], found.rows) == (("number", "?column?"), ((1.5, None, True),))
    assert pool.select("SELECT 1; -- and so on\n /* or */", 9).rows == ((1,),)
    assert pool.select("SELECT '; -- no end'", 9).rows == (("; -- no end",),)
    numbers = pool.select("SELECT 1e400::numeric, '-inf'::numeric, 0.1::numeric", 9)
    assert numbers.rows == (("1.0000000000000000e+400", "-inf", 0.1),)
    ((uuid,),) = pool.select("SELECT recording_uuid FROM robot", 1).rows
    assert isinstance(uuid, str)


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("SELECT 1; DROP TABLE run", "multiple commands"),
        ("SELECT 1; COMMIT; DROP TABLE run", "multiple commands"),
        ("DROP TABLE run", "syntax error"),
        ("WITH gone AS (DELETE FROM run RETURNING id) SELECT * FROM gone", "WITH"),
        ("SELECT make_partition('state', 2031, 1)", "read-only"),
        ("SELECT nothing FROM run", 'column "nothing" does not exist'),
        ("SELECT 1 / 0", "division by zero"),
        ("SELECT $1", r"a parameter such as \$1 has no value here"),
        ("", "syntax error"),
    ],
)
def test_anything_else_than_a_select_is_refused(pool: PostgresPool, sql: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        pool.select(sql, 10)
    assert pool.select("SELECT count(*) FROM run", 1).rows == ((3,),)


def test_nothing_that_a_select_makes_stays(pool: PostgresPool) -> None:
    pool.select("SELECT lo_from_bytea(0, 'made')", 1)
    assert pool.select("SELECT count(*) FROM pg_largeobject_metadata", 1).rows == ((0,),)


def test_the_role_of_the_page_reads_the_pool_and_nothing_else(
    postgres: Server, pool_template: str
) -> None:
    pool = postgres.new_database(pool_template)
    page = (Path(__file__).parents[3] / "docs" / "pool.md").read_text("utf-8")
    found = re.search(r"```postgresql\n(CREATE ROLE reader.*?)```", page, re.DOTALL)
    assert found
    postgres.execute(pool, found[1])
    with PostgresPool(postgres.url(pool, user="reader")) as opened:
        assert opened.select("SELECT count(*) FROM run", 1).rows == ((0,),)
        with pytest.raises(InvalidInputError, match="permission denied for function pg_read_file"):
            opened.select("SELECT pg_read_file('/etc/passwd')", 1)


def test_a_select_that_takes_too_long_is_ended(
    pool: PostgresPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "SELECT_S", 0.1)
    with pytest.raises(InvalidInputError, match="timeout"):
        pool.select("SELECT pg_sleep(60)", 1)
    with pytest.raises(InvalidInputError, match="timeout"):  # while rows are fetched, too
        pool.select("SELECT pg_sleep(0.06) FROM generate_series(1, 900)", 900)


def test_an_empty_database_is_no_pool(postgres: Server, database: str) -> None:
    with (
        pytest.raises(PoolError, match="nothing was shipped"),
        PostgresPool(postgres.url(database)),
    ):
        pass


def test_a_server_that_is_not_there_is_said(tmp_path: Path) -> None:
    with (
        pytest.raises(PoolError, match="does not answer"),
        PostgresPool(f"postgresql:///robots?host={tmp_path}"),
    ):
        pass
