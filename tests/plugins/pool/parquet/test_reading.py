"""A pool of several recordings, asked by SQL, answers as the tools do of each recording."""

from __future__ import annotations

import re
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.plugins.pool.parquet import bucket
from tests.plugins.pool.parquet.conftest import RECORDINGS, ROBOTS, Many
from tests.plugins.pool.rows import ship, uuid_of
from webots_mcp.database.connection import connect
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.trends import trends
from webots_mcp.plugins.pool import duckdb_statement as asking
from webots_mcp.plugins.pool.parquet_pool import ParquetPool
from webots_mcp.plugins.pool.pool_contents import pooled_runs
from webots_mcp.plugins.pool.storage import Storage
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.runs import list_runs
from webots_mcp.store.sql import FOLDER

pytestmark = pytest.mark.slow
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
    return dict(map(_told, many.databases))


def _told(database: Path) -> tuple[str, Told]:
    near = EventOptions(kinds=("condition",), where="front_m < 0.3")
    with closing(connect(database, "reader")) as connection:
        whole = find_range(connection, Scope(run_id=1))
        (run,) = trends(connection, whole, ("front_m",)).runs
        events = find_events(connection, whole, near, limit=200, group=False).events
        rows, uuid = list_runs(connection).runs[0].row_count, uuid_of(connection)
    mean = run.numbers[0].mean
    assert mean is not None
    return uuid, Told(rows, mean, [event.start_s for event in events])


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


def test_what_is_there_is_listed(pool: ParquetPool, told: dict[str, Told]) -> None:
    runs = pooled_runs(pool)
    assert {run.recording_uuid: run.row_count for run in runs} == {
        uuid: each.rows for uuid, each in told.items()
    }
    assert [run.started_wall_time_s for run in runs] == sorted(
        run.started_wall_time_s for run in runs
    )
    assert {(run.robot, run.label, run.row_count) for run in runs} == {
        (f"rover_{n % ROBOTS}", "lab", 200 + 3 * n) for n in range(RECORDINGS)
    }


def test_an_object_store_is_asked_as_a_folder_is(reader: sqlite3.Connection) -> None:
    url = bucket.empty()
    ship(reader, url)
    # In this process, which alone has this store.
    found = asking.select(Storage(url), "SELECT run_id, count(*) AS n FROM state GROUP BY 1", 10)
    (counted,) = reader.execute("SELECT count(*) FROM state").fetchone()
    assert found.columns == ("run_id", "n")
    assert sum(int(str(row[1])) for row in found.rows) == counted


def test_a_wall_time_can_be_asked_as_a_time(pool: ParquetPool) -> None:
    sql = "SELECT to_timestamp(1.5) AS moment, id, id FROM run ORDER BY id"
    found = pool.select(sql, 1)
    assert found.columns[:2] == ("moment", "id")
    assert found.rows == (("1970-01-01 00:00:01.5+00", 1, 1),)


def test_a_day_is_a_date(pool: ParquetPool) -> None:
    found = pool.select("SELECT day, count(DISTINCT recording_uuid) FROM state GROUP BY 1", 9).rows
    assert sorted(found) == [
        ("2023-11-14", 8),
        ("2023-11-15", RECORDINGS - 8),
    ]


@pytest.mark.parametrize("sql", ["COPY (SELECT 1) TO '{pool}/x.csv'", "SELECT * FROM '{outside}'"])
def test_no_file_beside_the_pool_is_read_and_none_is_written(
    pool: ParquetPool, many: Many, sql: str
) -> None:
    with pytest.raises(InvalidInputError, match=r"only one SELECT|Permission Error"):
        pool.select(sql.format(pool=many.pool, outside=many.databases[0]), 10)
    assert not (many.pool / "x.csv").exists()


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
    with pytest.raises(InvalidInputError, match=r"no answer within 2 s|of memory would be needed"):
        pool.select(sql, 1)
    assert not (FOLDER / ".tmp").exists()


GREEDY = {
    "rows of long texts": "SELECT sum(length(repeat('x' || range, 400000000))) FROM range(20)",
    "one long text": "SELECT length(repeat('km', 850000000))",
    "format": "SELECT format('{:1900000000d}', 3)",
    "printf": "SELECT length(printf('%1800000000d', 7))",
}


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process has no limit there")
@pytest.mark.parametrize("sql", GREEDY.values(), ids=GREEDY.keys())
def test_a_statement_has_so_much_memory_and_no_more(pool: ParquetPool, sql: str) -> None:
    with pytest.raises(InvalidInputError, match=r"of memory would be needed"):
        pool.select(sql, 1)


def test_a_statement_is_watched_where_a_system_has_no_limit(
    pool: ParquetPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("resource")
    unlimited = "import resource, runpy; resource.setrlimit = lambda *_: None; "
    unlimited += f"runpy.run_module({asking.__name__!r}, run_name='__main__')"
    monkeypatch.setattr(asking, "_LINE", (sys.executable, "-c", unlimited))
    monkeypatch.setattr(asking, "_MOST_RESIDENT_BYTES", 300_000_000)
    with pytest.raises(InvalidInputError, match=r"of memory would be needed"):
        pool.select(GREEDY["rows of long texts"], 1)


def test_a_statement_has_half_a_minute_with_all_that_is_around_it() -> None:
    assert asking.DEADLINE_S <= 20


# -- the recipes of docs/pool.md, each run as it stands, beside a pool --------------------------

FILE = Path(__file__).parents[4] / "docs" / "pool.md"


def answer(section: str, many: Many) -> str:
    """What the code of a section prints."""
    body = re.search(rf"(?ms)^### {section}$(.*?)(?=^##|\Z)", FILE.read_text("utf-8"))
    assert body is not None, f"there is no section {section}"
    (code,) = re.findall(r"(?ms)^```python\n(.*?)^```$", body[1])
    line = [sys.executable, "-c", code]
    done = subprocess.run(
        line, cwd=many.pool.parent, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_recipe_for_duckdb_counts_the_states_of_each_robot(many: Many) -> None:
    pytest.importorskip("duckdb", reason="duckdb is not installed")
    counts = re.findall(r"rover_(\d) *│ *(\d+)", answer("DuckDB", many))
    expected = {n: sum(200 + 3 * k for k in range(n, RECORDINGS, ROBOTS)) for n in range(ROBOTS)}
    assert {int(name): int(count) for name, count in counts} == expected


def test_the_recipe_for_polars_counts_the_warnings_of_the_runs(many: Many) -> None:
    pytest.importorskip("polars", reason="polars is not installed")
    assert re.search(rf"lab +┆ {RECORDINGS}\b", answer("Polars", many))
