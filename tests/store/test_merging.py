"""A recording takes in another one: once, whole, and without what is still going on."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.runs import Recorded
from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.merging import merge, settled
from webots_mcp.store.trial_sets import (
    TrialResult,
    create_trial_set,
    fetch_trial_set,
    find_trial_set,
    finish_trial,
    lay_down,
    take_up,
    trials_of,
)

TABLES = ("session", "run", "state", "log", "event", "image", "parameter_value", "command")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Two sessions of one run each, with pictures, commands and parameters."""
    folder = tmp_path / "there"
    folder.mkdir()
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, folder)
        recorded.add_run(10)
        recorded.add_run(6)
        for table in ("session", "run"):
            for (key,) in connection.execute(f"SELECT id FROM {table}").fetchall():
                connection.execute(f"UPDATE {table} SET uuid = ? WHERE id = ?", (new_uuid(), key))
        connection.execute("UPDATE parameter_value SET command_id = 2 WHERE run_id = 2")
    return folder / "webots.db"


@pytest.fixture
def target(tmp_path: Path) -> Iterator[sqlite3.Connection]:
    """With a run of its own."""
    folder = tmp_path / "here"
    folder.mkdir()
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        Recorded(connection, folder).add_run(3)
        yield connection


def counts(connection: sqlite3.Connection) -> dict[str, int]:
    return {
        table: connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in TABLES
    }


def of_run(connection: sqlite3.Connection, run_id: int) -> list[Any]:
    wanted = "sim_time_s, wall_time_s"
    tables = {"state": "data", "log": "message", "event": "kind", "parameter_value": "value"}
    return [
        connection.execute(
            f"SELECT {wanted}, {column} FROM {table} WHERE run_id = ? ORDER BY id", (run_id,)
        ).fetchall()
        for table, column in tables.items()
    ]


def test_all_of_a_recording_comes_in_and_comes_in_once(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    merged = merge(target, tmp_path / "here", source)
    after = counts(target)

    assert list(merged.values()) == [2, 3]
    with closing(connect(source, "reader")) as there:
        assert [of_run(target, run_id) for run_id in (2, 3)] == [of_run(there, 1), of_run(there, 2)]
    assert merge(target, tmp_path / "here", source) == merged
    assert counts(target) == after
    (command,) = target.execute(
        "SELECT command_id FROM parameter_value WHERE run_id = 3"
    ).fetchone()
    assert target.execute("SELECT session_id FROM command WHERE id = ?", (command,)).fetchone() == (
        target.execute("SELECT session_id FROM run WHERE id = 3").fetchone()
    )
    for (path,) in target.execute("SELECT path FROM image WHERE run_id > 1").fetchall():
        assert (tmp_path / "here" / path).read_bytes() == b"picture"


def test_its_rows_are_put_into_chunks_here(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    assert make_chunks(target, 100_000).done
    merge(target, tmp_path / "here", source)

    assert chunk_whole_run(target, 2)
    in_chunks = (
        "SELECT sum(c.row_count) FROM chunk c JOIN signal s ON s.id = c.signal_id "
        "WHERE s.name = 'x' AND c.run_id = 2"
    )
    assert target.execute(in_chunks).fetchone() == (10,)


def test_what_broke_off_is_not_there_at_all(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    before = counts(target)
    target.execute(
        "CREATE TEMP TRIGGER full BEFORE INSERT ON main.image "
        "BEGIN SELECT raise(ABORT, 'the disk is full'); END"
    )
    with pytest.raises(sqlite3.Error, match="the disk is full"):
        merge(target, tmp_path / "here", source)
    assert counts(target) == before

    target.execute("DROP TRIGGER full")
    assert len(merge(target, tmp_path / "here", source)) == 2


@pytest.mark.parametrize(("silent_s", "open_sessions"), [(11.0, 0), (5.0, 1)])
def test_a_session_of_another_host_is_over_once_its_last_heartbeat_is_old(
    source: Path, silent_s: float, open_sessions: int
) -> None:
    """Of a computer that lost its power: no process ends it, and none here can be asked."""
    is_open = "UPDATE {} SET ended_wall_time_s = NULL, end_reason = NULL WHERE {} = 2"
    with closing(connect(source, "writer")) as connection:
        connection.execute(is_open.format("session", "id"))
        connection.execute(is_open.format("run", "session_id"))
        beat = "UPDATE session SET host = 'elsewhere', last_seen_wall_time_s = ? WHERE id = 2"
        connection.execute(beat, (time.time() - silent_s,))
    with settled(source).reader() as connection:
        for table in ("session", "run"):
            left = f"SELECT count(*) FROM {table} WHERE ended_wall_time_s IS NULL"
            assert connection.execute(left).fetchone() == (open_sessions,)


def test_a_robot_that_records_here_just_now_keeps_its_name_for_itself(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    target.execute("UPDATE session SET ended_wall_time_s = NULL")

    merge(target, tmp_path / "here", source)

    robots = "SELECT DISTINCT name FROM robot JOIN run ON robot_id = robot.id WHERE run.id > 1"
    assert target.execute(robots).fetchall() == [("rover#2",)]


def test_no_command_that_waits_in_another_recording_is_run_here(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    with closing(connect(source, "writer")) as there:
        there.execute("UPDATE command SET status = 'pending', expires_wall_time_s = 1e12")

    merge(target, tmp_path / "here", source)

    waiting = "SELECT count(*) FROM command WHERE status = 'pending'"
    assert target.execute(waiting).fetchone() == (0,)


def test_what_goes_on_is_refused(target: sqlite3.Connection, source: Path, tmp_path: Path) -> None:
    with closing(connect(source, "writer")) as there:
        there.execute("UPDATE session SET ended_wall_time_s = NULL WHERE id = 2")
    before = counts(target)

    with pytest.raises(InvalidInputError, match="still records"):
        merge(target, tmp_path / "here", source)

    assert counts(target) == before


def trials_in_both(target: sqlite3.Connection, source: Path, folder: Path) -> list[int]:
    """Ids here of a set of three trials that was merged while the last one was still to come."""
    with closing(connect(source, "writer")) as connection:
        asked = [{"kp": 1.0}, {"kp": 2.0}, {"kp": 3.0}]
        set_id = create_trial_set(connection, '{"score": "duration"}', asked)
        finish_trial(connection, trials_of(connection, set_id)[0], TrialResult(1, 1.5, None))
    merge(target, folder, source)
    with closing(connect(source, "writer")) as connection:
        finish_trial(connection, trials_of(connection, set_id)[1], TrialResult(2, 4.5, None))
    found = find_trial_set(target)
    assert found is not None
    return [each.id for each in trials_of(target, found)]


def test_a_trial_that_waits_here_and_was_run_there_takes_the_result(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    ids = trials_in_both(target, source, tmp_path / "here")
    with closing(connect(source, "writer")) as connection:
        (uuid,) = connection.execute("SELECT uuid FROM run WHERE id = 2").fetchone()
    for _ in range(2):
        runs = merge(target, tmp_path / "here", source)
        first, second, third = trials_of(target, 1)
        assert [each.id for each in (first, second, third)] == ids
        assert (first.status, first.score) == ("done", 1.5)
        assert (second.status, second.score, second.run_id) == ("done", 4.5, runs[uuid])
        assert third.status == "waiting"


def test_what_was_tried_here_or_is_about_to_be_stays_what_it_is_here(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    trials_in_both(target, source, tmp_path / "here")
    lease = take_up(target, 1)
    merge(target, tmp_path / "here", source)
    second = trials_of(target, 1)[1]
    assert second.status == "waiting"

    finish_trial(target, second, TrialResult(None, 7.0, None))
    lay_down(target, 1, lease)
    merge(target, tmp_path / "here", source)
    assert trials_of(target, 1)[1].score == 7.0


def test_trial_sets_come_with_their_runs_once_and_without_who_worked_on_them(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    with closing(connect(source, "writer")) as connection:
        set_id = create_trial_set(connection, '{"score": "duration"}', [{"kp": 1.0}, {"kp": 2.0}])
        take_up(connection, set_id)
        first, _ = trials_of(connection, set_id)
        finish_trial(connection, first, TrialResult(2, 4.5, None))
        (uuid,) = connection.execute("SELECT uuid FROM run WHERE id = 2").fetchone()
    for _ in range(2):
        runs = merge(target, tmp_path / "here", source)
        found = find_trial_set(target)
        assert found is not None
        assert fetch_trial_set(target, found).pid is None
        done, waiting = trials_of(target, found)
        assert (done.run_id, done.score, done.values) == (runs[uuid], 4.5, {"kp": 1.0})
        assert (waiting.status, waiting.run_id) == ("waiting", None)


def test_trial_sets_come_in_the_order_in_which_they_were_begun(
    target: sqlite3.Connection, source: Path, tmp_path: Path
) -> None:
    plans = [f'{{"score": "{number}"}}' for number in range(8)]
    with closing(connect(source, "writer")) as connection:
        for plan in plans:
            create_trial_set(connection, plan, [{"kp": 1.0}])
    merge(target, tmp_path / "here", source)
    taken = target.execute("SELECT plan FROM trial_set ORDER BY id").fetchall()
    assert taken == [(plan,) for plan in plans]
