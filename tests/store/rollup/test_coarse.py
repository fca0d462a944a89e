"""Coarse rollups change nothing but how long it takes: they are what the rows come to."""

from __future__ import annotations

import sqlite3
import threading
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from webots_mcp.store.reading.rollups import Pieces, read_pieces
from webots_mcp.store.rollup.buckets import COARSE, COARSE_BUCKETS, COARSE_S, FINE, by_grain
from webots_mcp.store.rollup.rolling import forget, roll

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from webots_mcp.connection import connect
from webots_mcp.schema import create_schema
from webots_mcp.store.analysis.summary import Summary, summarise
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.retention.policy import Limit, Retention
from webots_mcp.store.retention.purge import prune
from webots_mcp.store.signals.registry import registered

Row = tuple[float, dict[str, Any]]
state = st.fixed_dictionaries(
    {"time": st.floats(0, 1e6)},
    optional={
        "speed": st.floats(-1e6, 1e6) | st.integers(-3, 3) | st.none(),
        "yaw": st.floats(-3.1, 3.1),
        "on": st.booleans(),
    },
)
rows = st.lists(st.tuples(st.floats(0.0, 300.0), state), min_size=5, max_size=60)


@settings(max_examples=40, deadline=None)
@given(rows, st.booleans(), st.integers(1, 400), st.data())
def test_pieces_of_any_stretch_are_what_its_rows_come_to(
    steps: list[Row], ended: bool, budget: int, data: st.DataObject
) -> None:
    with memory_connection() as connection:
        recorded = record(connection, steps, ended=ended)
        while not roll(connection, budget).done:
            pass
        ends = data.draw(st.tuples(st.floats(0, 1), st.floats(0, 1)))
        start_s, end_s = sorted(share * recorded[-1][0] for share in ends)
        check(connection, recorded, start_s, end_s)
        check(connection, recorded, 0.0, recorded[-1][0] + 1)
        coarse_end = connection.execute("SELECT coarse_end FROM run").fetchone()[0]
        over = range((coarse_end or 0) * COARSE_BUCKETS)
        assert [grain for grain, _ in by_grain(connection, 1, over)] == [COARSE if over else FINE]


def record(connection: sqlite3.Connection, steps: list[Row], *, ended: bool = True) -> list[Row]:
    recorder = start_run(connection)
    recorded: list[Row] = []
    time_s = 0.0
    for step_s, published in steps:
        time_s += step_s
        recorder.publish(time_s, published)
        recorded.append((time_s, published))
    if ended:
        recorder.end_run("finished")
    else:
        connection.execute("UPDATE run SET last_sim_time_s = ?", (time_s,))
    return recorded


def check(
    connection: sqlite3.Connection, recorded: list[Row], start_s: float, end_s: float
) -> None:
    pieces = read(connection, start_s, end_s)
    within = [(time_s, published) for time_s, published in recorded if start_s <= time_s < end_s]
    by_piece: defaultdict[int, list[Row]] = defaultdict(list)
    for row in within:
        by_piece[int(row[0] // COARSE_S)].append(row)
    for name in registered(connection, 1):
        found = dict(pieces.of(name))
        assert found.keys() == by_piece.keys()
        for piece, some in by_piece.items():
            assert same(found[piece], summary_of(name, some)), (name, piece)
        assert same(pieces.summaries(name).whole(), summary_of(name, within)), name


def read(connection: sqlite3.Connection, start_s: float, end_s: float) -> Pieces:
    signals = list(registered(connection, 1).values())
    return read_pieces(connection, Segment(1, start_s, end_s), signals, Deadline(60), COARSE_S)


def summary_of(name: str, some: list[Row]) -> Summary:
    values = [published.get(name) for _, published in some]
    return summarise([time_s for time_s, _ in some], values, angle=name == "yaw")


def same(merged: Summary, whole: Summary) -> bool:
    """Exactly, but for the sums, which depend on the order of adding."""
    scale = max(1.0, abs(whole.sum or 0), whole.squares or 0)
    return merged[:11] == whole[:11] and all(
        (a is None) == (b is None) and abs((a or 0) - (b or 0)) <= 1e-9 * scale
        for a, b in zip(merged[11:], whole[11:], strict=True)
    )


STEPS: list[Row] = [(5.0, {"time": 5.0 * i, "on": i % 7 < 3, "yaw": i % 6 - 3}) for i in range(500)]


def test_a_row_that_comes_late_into_merged_buckets_is_in_at_once_and_merged_again(
    empty: sqlite3.Connection,
) -> None:
    recorded = record(empty, STEPS)
    finish(empty)
    assert empty.execute("SELECT coarse_end FROM run").fetchone() == (5,)
    late = (1209.0, {"time": 77.0})
    insert_at(empty, *late)
    recorded = sorted([*recorded, late], key=lambda row: row[0])
    roll(empty, 1)
    assert empty.execute("SELECT coarse_end FROM run").fetchone() == (2,)
    check(empty, recorded, 0.0, 3000.0)
    finish(empty)
    assert empty.execute("SELECT coarse_end FROM run").fetchone() == (5,)
    check(empty, recorded, 0.0, 3000.0)


def insert_at(connection: sqlite3.Connection, time_s: float, published: dict[str, Any]) -> None:
    recorder = Recorder(connection)
    recorder.run_id, recorder.run_start_s = 1, recorder.wall_s
    recorder.publish(time_s, published)


def finish(connection: sqlite3.Connection) -> None:
    while not roll(connection, 5000).done:
        pass


def test_an_older_recording_is_merged_a_little_at_a_time_and_answers_are_right_meanwhile(
    empty: sqlite3.Connection,
) -> None:
    recorded = record(empty, STEPS)
    finish(empty)
    empty.execute("DELETE FROM coarse_rollup")
    empty.execute("UPDATE run SET coarse_end = NULL")
    calls = 0
    while not roll(empty, 100).done:
        calls += 1
        check(empty, recorded, 3.0, 2400.0)
    assert calls == 4  # a coarse bucket each, the last one with the fifth call
    check(empty, recorded, 3.0, 2400.0)


def test_while_a_run_goes_on_only_what_is_over_is_merged(empty: sqlite3.Connection) -> None:
    recorded = record(empty, STEPS[:299], ended=False)
    finish(empty)
    assert empty.execute("SELECT coarse_end FROM run").fetchone() == (2,)
    assert empty.execute("SELECT max(bucket) FROM coarse_rollup").fetchone() == (1,)
    check(empty, recorded, 0.0, 1505.0)


def test_a_run_that_waits_for_years_has_no_buckets_in_between(empty: sqlite3.Connection) -> None:
    recorded = record(empty, [*STEPS[:3], (9e8, {"time": 1.0}), (600.0, {"time": 2.0})])
    finish(empty)
    assert empty.execute("SELECT count(*) FROM coarse_rollup").fetchone()[0] <= 6
    check(empty, recorded, 0.0, 1e9)


def test_two_callers_at_once_merge_every_bucket_right(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = record(connection, STEPS)
        threads = [threading.Thread(target=roll_all, args=(file,)) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        finish(connection)
        assert connection.execute("SELECT coarse_end FROM run").fetchone() == (5,)
        check(connection, recorded, 0.0, 3000.0)


def roll_all(file: Path) -> None:
    with closing(connect(file, "writer")) as connection:
        while not roll(connection, 70).done:
            pass


def test_rollups_that_went_on_meanwhile_are_not_merged_as_they_were(
    tmp_path: Path,
) -> None:
    file = tmp_path / "webots.db"
    late = (1209.0, {"time": -1.0})
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = record(connection, STEPS)
        finish(connection)
        connection.execute("UPDATE run SET coarse_end = NULL")

        def come_late(statement: str) -> None:
            if statement.startswith("INSERT INTO temp.new_coarse"):
                connection.set_trace_callback(None)
                with closing(connect(file, "writer")) as other:
                    insert_at(other, *late)
                    roll(other, 1)

        connection.set_trace_callback(come_late)
        roll(connection, 5000)
        check(connection, sorted([*recorded, late], key=lambda row: row[0]), 0.0, 3000.0)


@pytest.mark.parametrize("column", ["sum", "min", "rows"])
def test_a_rollup_that_no_server_wrote_costs_itself_and_not_the_maintenance(
    empty: sqlite3.Connection, column: str, capsys: pytest.CaptureFixture[str]
) -> None:
    record(empty, STEPS)
    finish(empty)
    before = empty.execute("SELECT * FROM coarse_rollup WHERE bucket > 0").fetchall()
    empty.execute("UPDATE run SET coarse_end = NULL")
    empty.execute(f"UPDATE rollup SET {column} = 'much' WHERE bucket = 3 AND signal_id = 1")
    finish(empty)
    assert f"rollup 1/1/3: {column} holds no valid" in capsys.readouterr().err
    assert empty.execute("SELECT * FROM coarse_rollup WHERE bucket > 0").fetchall() == before
    assert empty.execute("SELECT coarse_end FROM run").fetchone() == (5,)


def test_an_end_that_no_server_wrote_is_found_anew(empty: sqlite3.Connection) -> None:
    recorded = record(empty, STEPS)
    finish(empty)
    empty.execute("UPDATE run SET coarse_end = 'far'")
    check(empty, recorded, 0.0, 3000.0)
    finish(empty)
    assert empty.execute("SELECT coarse_end FROM run").fetchone() == (5,)


def test_purging_the_rows_of_a_run_leaves_its_coarse_rollups(
    tmp_path: Path,
) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = record(connection, STEPS)
        second = Recorder(connection)
        second.run(second.session(1, "y"), 1)
        second.publish(0.0, {"time": 0.0})
        finish(connection)
        prune(connection, tmp_path, Retention(state=Limit(rows=1), outlive=0), rest=False)
        assert connection.execute("SELECT count(*) FROM state").fetchone() == (1,)
        whole = read(connection, 0.0, 3000.0).summaries("time").whole()
        assert same(whole, summary_of("time", recorded))


def test_rollups_that_are_rebuilt_are_merged_again(empty: sqlite3.Connection) -> None:
    recorded = record(empty, STEPS)
    finish(empty)
    forget(empty)
    assert empty.execute("SELECT count(*) FROM coarse_rollup").fetchone() == (0,)
    check(empty, recorded, 0.0, 3000.0)
    finish(empty)
    check(empty, recorded, 0.0, 3000.0)
