"""A pool of fifty recordings, asked by SQL, answers as the tools do of each recording."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.pool.parquet import bucket
from tests.pool.parquet.conftest import RECORDINGS, Many
from tests.pool.parquet.rows import batch, pooled, rows_of, ship, shipping, uuid_of
from webots_mcp.connection import connect
from webots_mcp.errors import InvalidInputError, PoolError
from webots_mcp.plugins.pool import duckdb_statement as asking
from webots_mcp.plugins.pool.parquet_files import Storage
from webots_mcp.plugins.pool.parquet_pool import ParquetPool
from webots_mcp.plugins.pool.pool_contents import pooled_runs, pooled_trial_sets
from webots_mcp.plugins.pool.pool_interface import table
from webots_mcp.store.detection.events import find_events
from webots_mcp.store.detection.kinds import EventOptions
from webots_mcp.store.questions.runs import list_runs
from webots_mcp.store.questions.sql import FOLDER
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.ranges import Scope, find_range

COUNTS = "SELECT recording_uuid, count(*) FROM state GROUP BY recording_uuid"
MEANS = """
    SELECT recording_uuid, avg(CAST(data ->> '$.front_m' AS DOUBLE)) FROM state
    GROUP BY recording_uuid
"""
MEANS_OF_VALUES = "SELECT recording_uuid, avg(front_m) FROM value GROUP BY recording_uuid"
WALLS = """
    WITH seen AS (
        SELECT recording_uuid, sim_time_s, CAST(data ->> '$.front_m' AS DOUBLE) < 0.3 AS is_near
        FROM state
    ), begun AS (
        SELECT *, is_near AND NOT coalesce(lag(is_near) OVER (
            PARTITION BY recording_uuid ORDER BY sim_time_s), false) AS begins
        FROM seen
    )
    SELECT recording_uuid, list(sim_time_s ORDER BY sim_time_s) FROM begun WHERE begins
    GROUP BY recording_uuid
"""


@pytest.fixture(scope="module")
def pool(many: Many) -> Iterator[ParquetPool]:
    with ParquetPool(str(many.pool)) as opened:
        yield opened


def asked(pool: ParquetPool, sql: str) -> dict[str, object]:
    return {str(name): value for name, value in pool.select(sql, 1000).rows}


class Told(NamedTuple):
    """What the tools answer of a recording."""

    rows: int
    mean_front_m: float
    near_walls_s: list[float]


@pytest.fixture(scope="module")
def told(many: Many) -> dict[str, Told]:
    """By recording."""
    return {uuid_of(database): _told(database) for database in many.databases}


def _told(database: Path) -> Told:
    near = EventOptions(kinds=("condition",), where="front_m < 0.3")
    with closing(connect(database, "reader")) as connection:
        whole = find_range(connection, Scope(run_id=1))
        (run,) = trends(connection, whole, ("front_m",)).runs
        events = find_events(connection, whole, near, limit=200, group=False).events
        rows = list_runs(connection).runs[0].row_count
    mean = run.numbers[0].mean
    assert mean is not None
    return Told(rows, mean, [event.start_s for event in events])


def test_as_many_states_as_the_tools_count(pool: ParquetPool, told: dict[str, Told]) -> None:
    assert len(told) == RECORDINGS
    assert asked(pool, COUNTS) == {uuid: each.rows for uuid, each in told.items()}


@pytest.mark.parametrize("sql", [MEANS, MEANS_OF_VALUES])
def test_the_means_of_a_signal_are_those_of_the_tools(
    pool: ParquetPool, told: dict[str, Told], sql: str
) -> None:
    expected = {uuid: each.mean_front_m for uuid, each in told.items()}
    assert asked(pool, sql) == pytest.approx(expected, rel=1e-5)  # as they round it


def test_events_are_those_that_the_tools_find(pool: ParquetPool, told: dict[str, Told]) -> None:
    assert all(each.near_walls_s for each in told.values())
    assert asked(pool, WALLS) == {uuid: str(each.near_walls_s) for uuid, each in told.items()}


def test_what_is_there_is_listed(pool: ParquetPool, many: Many) -> None:
    runs = pooled_runs(pool)
    assert {run.recording_uuid for run in runs} == {uuid_of(file) for file in many.databases}
    assert [run.started_wall_time_s for run in runs] == sorted(
        run.started_wall_time_s for run in runs
    )
    assert {(run.robot, run.label, run.row_count) for run in runs} == {
        (f"rover_{n % 10}", "lab", 200 + 3 * n) for n in range(RECORDINGS)
    }
    (own,) = (run for run in runs if run.recording_uuid == uuid_of(many.databases[7]))
    assert (own.row_count, own.end_reason) == (221, "finished")


def test_sizes_are_those_of_the_rows_and_of_the_files(pool: ParquetPool, many: Many) -> None:
    sizes = {each.table: each for each in pool.sizes()}
    assert sizes["state"].rows == sum(200 + 3 * n for n in range(RECORDINGS))
    assert sizes["trial"].rows == 0
    for name, size in sizes.items():
        files = many.pool.rglob(f"table={name}/**/*.parquet")
        assert size.size_bytes == sum(file.stat().st_size for file in files)


def test_trial_sets_are_told_with_their_runs(tmp_path: Path) -> None:
    trial_set = {"id": 2, "uuid": "set", "plan": "{}", "created_wall_time_s": 5.0}
    trial = {"trial_set_id": 2, "parameters": "{}", "status": "done"}
    with shipping(tmp_path) as shipment:
        trials = [trial | {"id": n, "uuid": f"t{n}", "number": n, "run_id": n} for n in (1, 2)]
        waiting = trial | {"id": 3, "uuid": "t3", "number": 3, "status": "waiting"}
        shipment.write([batch("trial_set", trial_set), batch("trial", *trials, waiting)], {})
    with ParquetPool(str(tmp_path)) as pool:
        (told,) = pooled_trial_sets(pool)
    assert (told.uuid, told.trials, [run for _, run in told.runs]) == ("set", 3, [1, 2])


def test_the_rows_of_some_runs_come_back(bridge_recording: Path) -> None:
    url = bucket.empty()
    ship(bridge_recording, url)
    for name in ("state", "event", "image"):
        each = table(name)
        at = each.columns.index("run_id")
        expected = [row for row in rows_of(bridge_recording, each) if row[at] == 2]
        assert expected
        assert pooled(url, uuid_of(bridge_recording), name, {"run_id": (2,)}) == expected
        assert pooled(url, uuid_of(bridge_recording), name, {"run_id": (99,)}) == []
        assert pooled(url, uuid_of(bridge_recording), name, {"run_id": ()}) == []


def test_an_object_store_is_asked_as_a_folder_is(bridge_recording: Path) -> None:
    url = bucket.empty()
    ship(bridge_recording, url)
    # In this process, which alone has this store.
    found = asking.select(Storage(url), "SELECT run_id, count(*) AS n FROM state GROUP BY 1", 10)
    counted = len(rows_of(bridge_recording, table("state")))
    assert found.columns == ("run_id", "n")
    assert sum(int(str(row[1])) for row in found.rows) == counted


def test_a_table_without_rows_can_be_asked(pool: ParquetPool) -> None:
    assert pool.select("SELECT count(*) FROM trial", 1).rows == ((0,),)
    found = pool.select("SELECT recording_uuid, plan FROM trial_set", 1)
    assert (found.columns, found.rows) == (("recording_uuid", "plan"), ())


def test_only_so_many_rows_come(pool: ParquetPool) -> None:
    assert len(pool.select("SELECT * FROM state", 7).rows) == 7


def test_a_wall_time_can_be_asked_as_a_time(pool: ParquetPool) -> None:
    sql = "SELECT to_timestamp(1.5) AS moment, id, id FROM run ORDER BY id"
    found = pool.select(sql, 1)
    assert found.columns[:2] == ("moment", "id")
    assert found.rows == (("1970-01-01 00:00:01.5+00", 1, 1),)


def test_a_day_is_a_date(pool: ParquetPool) -> None:
    found = pool.select("SELECT day, count(DISTINCT recording_uuid) FROM state GROUP BY 1", 9).rows
    assert sorted(found) == [
        ("2023-11-14", 22),
        ("2023-11-15", RECORDINGS - 22),
    ]


@pytest.mark.parametrize(
    ("sql", "text"),
    [
        ("COPY (SELECT 1) TO '{pool}/x.csv'", "only one SELECT is allowed, this has COPY"),
        ("SELECT 1; SELECT 2", "this has SELECT, SELECT"),
        ("", "no statement"),
        ("CREATE TABLE x (y INT)", "this has CREATE"),
        ("SELECT * FROM read_csv('/etc/passwd')", "DuckDB says: Permission Error"),
        ("SELECT * FROM '{outside}'", "DuckDB says: Permission Error"),
        ("SELEC 1", "DuckDB says: Parser Error"),
        ("SELECT nothing FROM run", "DuckDB says: Binder Error"),
    ],
)
def test_what_is_no_question_to_the_pool_is_refused(
    pool: ParquetPool, many: Many, sql: str, text: str
) -> None:
    outside = many.databases[0]
    with pytest.raises(InvalidInputError, match=text):
        pool.select(sql.format(pool=many.pool, outside=outside), 10)
    assert not (many.pool / "x.csv").exists()


def test_a_question_that_takes_too_long_is_ended(
    pool: ParquetPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asking, "DEADLINE_S", 0.05)
    with pytest.raises(InvalidInputError, match=r"no answer within 0.05 s: narrow it"):
        pool.select("SELECT sum(a.range * b.range) FROM range(1000000) a, range(1000000) b", 1)


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT levenshtein(repeat('ab', 200000), repeat('ba', 200000))",
        "SELECT count(*) FROM (SELECT DISTINCT range FROM range(3000000000))",
    ],
)
def test_what_no_deadline_of_the_engine_ends_is_ended_and_writes_nothing(
    pool: ParquetPool, monkeypatch: pytest.MonkeyPatch, sql: str
) -> None:
    monkeypatch.setattr(asking, "DEADLINE_S", 2.0)
    with pytest.raises(InvalidInputError, match=r"no answer within 2 s|Out of Memory"):
        pool.select(sql, 1)
    assert not (FOLDER / ".tmp").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="no such limit there")
def test_a_statement_has_so_much_memory_and_no_more(pool: ParquetPool) -> None:
    with pytest.raises(InvalidInputError, match=r"(?i)memory"):
        pool.select("SELECT sum(length(repeat('x' || range, 700000000))) FROM range(20)", 1)


def test_a_folder_without_a_pool_is_told(tmp_path: Path) -> None:
    with (
        pytest.raises(PoolError, match=r"there is no pool in .*nowhere"),
        ParquetPool(str(tmp_path / "nowhere")),
    ):
        pass


def test_values_of_json_are_text_with_what_was_published(pool: ParquetPool) -> None:
    ((data,),) = pool.select("SELECT data FROM state WHERE id = 1 LIMIT 1", 1).rows
    assert math.isfinite(json.loads(str(data))["front_m"])
