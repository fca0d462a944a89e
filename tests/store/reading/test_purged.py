"""What is said of a run whose first rows, or all of them, were purged: its chunks stay."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.signal_history import RunHistory, query_history


def overview(connection: sqlite3.Connection, start_s: float | None = None) -> RunHistory:
    wanted = find_range(connection, Scope(run_id=1, start_s=start_s))
    return query_history(connection, wanted, ["pose.0", "mode"], max_points=12).runs[0]


def keep_rows(connection: sqlite3.Connection, folder: Path, rows: int) -> None:
    limits = Retention(state=Limit(rows=rows), outlive=0)
    prune(connection, folder, limits, rest=False)


@pytest.fixture
def rover(rover_recordings: dict[str, sqlite3.Connection]) -> Iterator[sqlite3.Connection]:
    with memory_connection(rover_recordings["chunked"]) as connection:
        yield connection


def test_an_overview_is_the_same_after_a_purge(rover: sqlite3.Connection, tmp_path: Path) -> None:
    before = overview(rover)
    keep_rows(rover, tmp_path, 1500)
    after = overview(rover)
    assert (after.start_s, after.end_s, after.rows) == (before.start_s, before.end_s, before.rows)
    assert after.numbers[0].max == before.numbers[0].max
    assert after.numbers[0].count == before.numbers[0].count
    assert after.changes == before.changes


def test_a_run_without_a_row_left_still_has_an_overview(
    rover: sqlite3.Connection, tmp_path: Path
) -> None:
    keep_rows(rover, tmp_path, 900)
    assert rover.execute("SELECT count(*) FROM state WHERE run_id = 1").fetchone() == (0,)
    run = overview(rover)
    assert run.numbers[0].count == [*[100] * 9, 50, 100, 100]
    assert run.age_s > 0


def test_a_range_of_which_only_chunks_are_left_has_nothing_to_say(
    rover: sqlite3.Connection, tmp_path: Path
) -> None:
    keep_rows(rover, tmp_path, 1500)
    assert find_range(rover, Scope(run_id=1, start_s=10.0, end_s=20.0)).notes == ()


def test_wall_time_reaches_into_what_was_purged(rover: sqlite3.Connection, tmp_path: Path) -> None:
    keep_rows(rover, tmp_path, 1500)
    start, end = WALL_START_S + 10, WALL_START_S + 40
    found = find_range(rover, Scope(run_id=1, since_wall_time=start, until_wall_time=end))
    (segment,) = found.segments
    assert (segment.start_s, segment.end_s) == (
        pytest.approx(20, abs=0.2), pytest.approx(80, abs=0.2),
    )  # fmt: skip
    (run,) = query_history(rover, found, ["pose.0"], max_points=500).runs
    assert run.sim_time_s[0] <= 30.0


@pytest.mark.parametrize("rows", [900, 1500])
def test_what_a_run_that_lost_rows_came_to_is_the_same(
    rover: sqlite3.Connection, tmp_path: Path, rows: int
) -> None:
    before = compare_runs(rover, [1, 3])
    keep_rows(rover, tmp_path, rows)
    after = compare_runs(rover, [1, 3])
    assert (after.measures, after.unknown) == (before.measures, before.unknown)
