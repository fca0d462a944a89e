"""What is said of a run whose first rows, or all of them, were purged: its chunks stay."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S, start_run
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.detection.events import Events, find_events
from webots_mcp.store.detection.kinds import EventOptions
from webots_mcp.store.purge import prune
from webots_mcp.store.questions.compare import compare_runs
from webots_mcp.store.questions.series import RunHistory, query_history
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention import Limit, Retention


def overview(connection: sqlite3.Connection, start_s: float | None = None) -> RunHistory:
    wanted = find_range(connection, Scope(run_id=1, start_s=start_s))
    return query_history(connection, wanted, ["pose.0", "mode"], max_points=12).runs[0]


def keep_rows(connection: sqlite3.Connection, folder: Path, rows: int) -> None:
    limits = Retention(state=Limit(rows=rows), outlive=0)
    prune(connection, folder, limits, rest=False)


@pytest.fixture
def rover(_recorded: dict[str, sqlite3.Connection]) -> Iterator[sqlite3.Connection]:
    with memory_connection(_recorded["chunked"]) as connection:
        yield connection


def test_an_overview_is_the_same_after_a_purge(rover: sqlite3.Connection, tmp_path: Path) -> None:
    before = overview(rover)
    keep_rows(rover, tmp_path, 1500)
    after = overview(rover)
    assert (after.start_s, after.end_s, after.rows) == (before.start_s, before.end_s, before.rows)
    assert after.numbers[0].max == before.numbers[0].max
    assert after.numbers[0].count == before.numbers[0].count
    assert after.changes == before.changes


def test_gaps_of_purged_rows_are_told_as_before(tmp_path: Path) -> None:
    with memory_connection() as connection:
        recorder = start_run(connection)
        for step in range(1000):
            if not 330 < step < 380 and not 430 < step < 610:
                recorder.publish(step / 10, {"x": 1.0})
        recorder.end_run("finished")
        for rows_left in (1000, 300, 0):
            keep_rows(connection, tmp_path, rows_left)
            found = gaps_of(connection)
            gaps = [(gap.start_s, gap.end_s) for gap in found.events]
            assert gaps == [(33.0, 38.0), (43.0, 61.0)]
            assert not found.verdicts.not_searched


def gaps_of(connection: sqlite3.Connection) -> Events:
    whole = find_range(connection, Scope(run_id=1))
    return find_events(connection, whole, EventOptions(kinds=("gap",)), limit=10, around=())


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


def test_a_run_of_which_only_chunks_are_left_is_found_by_wall_time(
    rover: sqlite3.Connection, tmp_path: Path
) -> None:
    keep_rows(rover, tmp_path, 900)
    found = find_range(
        rover, Scope(since_wall_time=WALL_START_S, until_wall_time=WALL_START_S + 30)
    )
    assert [segment.run_id for segment in found.segments] == [1]
    assert found.segments[0].end_s == pytest.approx(60, abs=0.2)
    whole = find_range(rover, Scope(run_id=1, since_wall_time=WALL_START_S - 9))
    (run,) = query_history(rover, whole, ["pose.0"]).runs
    assert run.rows == 1150


def test_where_rows_were_purged_events_are_looked_for_in_their_chunks(
    rover: sqlite3.Connection, tmp_path: Path
) -> None:
    before = find_events(rover, find_range(rover, Scope(run_id=1))).verdicts.not_searched
    keep_rows(rover, tmp_path, 1500)
    assert find_events(rover, find_range(rover, Scope(run_id=1))).verdicts.not_searched == before


@pytest.mark.parametrize("rows", [900, 1500])
def test_what_a_run_that_lost_rows_came_to_is_the_same(
    rover: sqlite3.Connection, tmp_path: Path, rows: int
) -> None:
    before = compare_runs(rover, [1, 3])
    keep_rows(rover, tmp_path, rows)
    after = compare_runs(rover, [1, 3])
    assert (after.measures, after.unknown) == (before.measures, before.unknown)


@pytest.fixture
def patrol(empty: sqlite3.Connection, tmp_path: Path) -> sqlite3.Connection:
    """Of 400 s only the last 50 s are left as rows; a mode that is a number changes at 83.5 s."""
    recorder = start_run(empty)
    empty.execute("BEGIN")
    for step in range(4000):
        time_s = round(step * 0.1, 6)
        state = {"x": 0.1 * time_s, "y": 0.0, "task": int(time_s >= 83.5)}
        front_m = None if 123.5 <= time_s < 200 else 3.0 if 233.5 <= time_s < 290 else 1 + step % 7
        recorder.publish(time_s, state | {"front_m": front_m})
    empty.execute("COMMIT")
    make_chunks(empty, 100_000)
    keep_rows(empty, tmp_path, 500)
    return empty


def events_of(connection: sqlite3.Connection, kind: str, **bounds: float) -> Events:
    found = find_range(connection, Scope(run_id=1, **bounds))  # pyright: ignore[reportArgumentType]
    options = EventOptions(kinds=(kind,), where="front_m > 2" if kind == "condition" else None)
    return find_events(connection, found, options)


def test_a_mode_that_is_a_number_changed_when_its_rows_said_before_they_were_purged(
    patrol: sqlite3.Connection,
) -> None:
    told = events_of(patrol, "change", end_s=300.0)
    assert [(each.name, each.start_s) for each in told.events] == [("task", 83.5)]
    assert "change" not in told.verdicts.not_searched


def test_a_silence_of_which_no_row_is_left_has_its_begin_and_end(
    patrol: sqlite3.Connection,
) -> None:
    (silent,) = events_of(patrol, "missing", end_s=300.0).events
    assert (silent.start_s, silent.end_s) == pytest.approx((123.5, 199.9))


def test_a_condition_of_which_no_row_is_left_is_asked_of_every_value(
    patrol: sqlite3.Connection,
) -> None:
    told = events_of(patrol, "condition", start_s=234.0, end_s=300.0)
    assert any(each.start_s <= 234.0 and each.end_s >= 289.9 for each in told.events)
    assert "condition" not in told.verdicts.not_searched


def test_trends_of_what_was_purged_are_those_of_its_values(patrol: sqlite3.Connection) -> None:
    purged = trends(patrol, find_range(patrol, Scope(run_id=1, start_s=20.0, end_s=120.0)))
    (front,) = (each for each in purged.runs[0].numbers if each.name == "front_m")
    assert (front.summary.present, front.resolution_s) == (1000, None)
    assert front.mean == pytest.approx(4.0, abs=0.01)
