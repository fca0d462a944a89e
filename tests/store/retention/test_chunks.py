"""The values of deleted states lie in chunks, which have a limit of their own."""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.answers import answers
from tests.recordings.rounds import PART, record_rounds
from tests.recordings.runs import ROW_S, Recorded, states
from tests.store.retention.test_size import bytes_by_name
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.signals import register as signal_register
from webots_mcp.store.chunk_making import GROUP_ROWS, make_chunks
from webots_mcp.store.purge import prune, purge
from webots_mcp.store.reading.catalogue import list_signals
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import Segment, whole_run
from webots_mcp.store.reading.segment import Deadline
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.retention_plan import plan

NO_STATES = Limit(rows=0, spared_rows=0)


def framed(connection: sqlite3.Connection, run_id: int = 1) -> Frame:
    segment = whole_run(connection, run_id)
    assert segment is not None
    return read_frame(connection, segment, Deadline(60))


def contents(connection: sqlite3.Connection, run_id: int = 1) -> dict[str, Any]:
    frame = framed(connection, run_id)
    names = ("x", "mode", "lamp", "sometimes", "nowhere")
    return {
        "times": frame.times.tolist(),
        "walls": frame.wall_times.tolist(),
        "ids": frame.ids.tolist(),
        "replaced": frame.replaced("x"),
        "unread": frame.unread,
        **{name: frame.values(name) for name in names},
    }


def record(recorded: Recorded, rows: int) -> int:
    run_id = recorded.add_run(0)
    recorded.connection.execute("BEGIN")
    for step in range(rows):
        state: dict[str, Any] = {"x": step / 8, "mode": "ab"[step // 100 % 2], "lamp": step % 3 > 0}
        if step % 7:
            state["sometimes"] = None if step % 5 == 0 else step
        recorded.publish(step * ROW_S, state, {"x": "nan"} if step == 77 else None)
    recorded.connection.execute("COMMIT")
    recorded.connection.execute(
        "UPDATE run SET last_sim_time_s = ?, row_count = ? WHERE id = ?",
        (rows * ROW_S, rows, run_id),
    )
    return run_id


@pytest.mark.parametrize("rows", [1, 100, GROUP_ROWS + 100, 3 * GROUP_ROWS])
def test_numbers_flags_and_texts_are_read_as_before_where_all_states_are_gone(
    recorded: Recorded, rows: int
) -> None:
    record(recorded, rows)
    before = contents(recorded.connection)
    recorded.prune(Retention(state=NO_STATES, outlive=0))
    assert recorded.rows() == {}
    assert contents(recorded.connection) == before
    assert recorded.connection.execute("SELECT purged_rows FROM run").fetchone() == (rows,)


def test_states_go_by_whole_groups_and_nothing_is_read_twice(recorded: Recorded) -> None:
    record(recorded, 3 * GROUP_ROWS)
    before = contents(recorded.connection)
    recorded.prune(states(rows=GROUP_ROWS * 5 // 2))
    assert recorded.rows() == {1: 2 * GROUP_ROWS}
    assert contents(recorded.connection) == before


def test_where_half_of_a_group_is_left_in_state_nothing_is_read_twice(recorded: Recorded) -> None:
    record(recorded, 2 * GROUP_ROWS)
    before = contents(recorded.connection)
    make_chunks(recorded.connection, 10_000)
    limits = states(rows=0)
    wanted = plan(recorded.connection, limits, recorded.wall_s)
    for done in purge(recorded.connection, wanted, recorded.folder):
        if done.rows["state"] > GROUP_ROWS // 2:  # as after a kill
            break
    assert 0 < recorded.rows()[1] < 2 * GROUP_ROWS
    assert contents(recorded.connection) == before
    recorded.prune(limits)
    assert recorded.rows() == {}
    assert contents(recorded.connection) == before


def test_chunks_go_oldest_first_after_their_states_and_what_is_lost_is_not_said_to_be_read(
    recorded: Recorded,
) -> None:
    record(recorded, 4 * GROUP_ROWS)
    before = contents(recorded.connection)
    half = Limit(rows=2 * GROUP_ROWS, spared_rows=0)
    done = recorded.prune(Retention(state=NO_STATES, chunk=half, outlive=0))
    assert done.rows["chunk"] == 2 * GROUP_ROWS
    frame = framed(recorded.connection)
    assert frame.values("x") == before["x"][2 * GROUP_ROWS :]
    (lost,) = frame.unread
    assert (lost.start_s, lost.end_s) == (0.0, 2 * GROUP_ROWS * ROW_S)
    assert lost.why == "deleted by retention"
    assert recorded.connection.execute(
        "SELECT count(*) FROM chunk WHERE group_id NOT IN (SELECT id FROM row_group)"
    ).fetchone() == (0,)


def test_a_run_of_which_nothing_is_left_is_wholly_unread(recorded: Recorded) -> None:
    run_id = record(recorded, 100)
    nothing = Retention(state=NO_STATES, chunk=Limit(rows=0, spared_rows=0), outlive=0)
    recorded.prune(nothing)  # puts the rows into chunks
    recorded.prune(nothing)
    frame = read_frame(recorded.connection, Segment(run_id, 0, 50), Deadline(60))
    assert len(frame) == 0 and [each.why for each in frame.unread] == ["deleted by retention"]


def test_a_state_is_deleted_only_once_it_is_in_a_chunk_also_of_a_run_that_goes_on(
    recorded: Recorded,
) -> None:
    run_id = recorded.add_run(0, end=None)
    for step in range(60):
        recorded.publish(step * ROW_S, {"x": step})
        if step % 20 == 19:
            recorded.prune(states(rows=0))
    assert recorded.rows() == {}
    frame = framed(recorded.connection, run_id)
    assert frame.numbers("x").tolist() == list(range(60))
    assert frame.unread == ()


def test_a_damaged_group_is_made_anew_before_its_rows_are_deleted(recorded: Recorded) -> None:
    record(recorded, 2 * GROUP_ROWS)
    make_chunks(recorded.connection, 10_000)
    before = contents(recorded.connection)
    recorded.connection.execute("UPDATE chunk SET numbers = x'00' WHERE group_id = 1")
    recorded.prune(Retention(state=NO_STATES, outlive=0))
    assert contents(recorded.connection) == before


@pytest.mark.slow
@pytest.mark.parametrize("signals", [10, 60])
def test_what_chunks_take_is_known_within_a_twentieth_of_what_sqlite_says(
    tmp_path: Path, signals: int
) -> None:
    with closing(connect(tmp_path / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorded, noise = Recorded(connection, tmp_path), random.Random(3)
        recorded.add_run(0)
        connection.execute("BEGIN")
        for step in range(16 * GROUP_ROWS):
            numbers = {f"s{i}": round(noise.gauss(i, 0.1), 3) for i in range(signals)}
            recorded.publish(step * ROW_S, numbers)
        connection.execute("COMMIT")
        make_chunks(connection, 10**9)
        held = plan(connection).held_bytes["chunk"]
        on_disk = sum(size for name, size in bytes_by_name(connection).items() if "chunk" in name)
    assert held == pytest.approx(on_disk, rel=0.05)


def test_what_chunks_cannot_hold_of_a_state_is_counted(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal_register, "MAX_SIGNALS", 8)
    recorded.add_run(0)
    held = {"x": 1.5, "ok": True, "text": "t" * 200, "whole": 2**53}
    lost = {"x": 1.5, "text": "t" * 201, "whole": 2**53 + 1, "ok": True, "scan": [0.5] * 17}
    for step, state in enumerate([held, lost, lost | {"beyond": 1}]):
        recorded.publish(step * ROW_S, state)
    recorded.prune(Retention(state=NO_STATES, outlive=0))
    assert recorded.connection.execute("SELECT lost_value_count FROM row_group").fetchall() == [
        (2 * 3 + 2 + 1,)  # of a scan argmin is beyond the limit as well
    ]


ASKED = (
    "trends", "trends of a part", "history", "events", "events of a part", "timeline", "comparison",
)  # fmt: skip


@pytest.mark.slow
def test_questions_are_answered_after_a_purge_as_before_it(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    record_rounds(file)
    with closing(connect(file, "writer")) as connection:
        before = answers(connection, 1, PART)
        listed = list_signals(connection, run_id=1)
        prune(connection, tmp_path, Retention(state=NO_STATES, outlive=0), rest=False)
        assert connection.execute("SELECT count(*) FROM state").fetchone() == (0,)
        after = answers(connection, 1, PART)
        assert list_signals(connection, run_id=1) == listed
        (run,) = after["comparison"]["groups"][0]["runs"]
        assert run.pop("purged_rows") == run["row_count"]
        assert before["comparison"]["groups"][0]["runs"][0].pop("purged_rows") == 0
        for question in ASKED:
            assert after[question] == before[question], question
