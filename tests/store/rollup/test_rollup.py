"""Rolling up changes nothing: the rollup is what its rows come to, however they came in."""

from __future__ import annotations

import json
import sqlite3
import threading
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from webots_mcp.store.rollup.buckets import BUCKET_S
from webots_mcp.store.rollup.rolling import forget, roll, watermark
from webots_mcp.store.rollup.tables import Addition, held, store

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, record_rover, start_run
from webots_mcp.connection import connect
from webots_mcp.naming import flatten
from webots_mcp.schema import create_schema
from webots_mcp.store.analysis.summary import Summary, merge, summarise
from webots_mcp.store.questions.series import query_history
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.pages import query_rows
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signals.catalogue import list_signals
from webots_mcp.transactions import never_wait

Rows = list[tuple[float, dict[str, Any]]]
finite = st.floats(-1e9, 1e9, allow_nan=False) | st.integers(-1000, 1000)
angle = st.floats(-3.2, 3.2, allow_nan=False)
state: st.SearchStrategy[dict[str, Any]] = st.fixed_dictionaries(
    {},
    optional={
        "speed": finite | st.none(),
        "yaw": angle,
        "offsets": st.lists(finite, max_size=4),
        "mode": st.sampled_from(["cruise", "turn", None]),
        "nested": st.fixed_dictionaries({"bumper": st.booleans()}),
        "lidar": st.lists(finite, min_size=15, max_size=19),
    },
)
steps = st.tuples(st.floats(0.0, 8.0), state)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.lists(steps, max_size=25), min_size=1, max_size=3), st.integers(1, 9))
def test_rolling_in_any_pieces_equals_computing_from_the_rows(
    runs: list[list[tuple[float, dict[str, Any]]]], budget_rows: int
) -> None:
    with memory_connection() as connection:
        recorder = Recorder(connection)
        robot_id = recorder.robot("r")
        session_id = recorder.session(robot_id, "x")
        recorded = [_record(recorder, session_id, robot_id, run) for run in runs]
        while not roll(connection, budget_rows).done:
            pass
        rolled = _stored_rollups(connection)
        expected = {
            (run_id, *key): summary
            for run_id, rows in recorded
            for key, summary in _computed(rows).items()
        }
        assert rolled.keys() == expected.keys()
        for key, summary in expected.items():
            assert _same(rolled[key], summary), key


def _record(
    recorder: Recorder, session_id: int, robot_id: int, run: list[tuple[float, dict[str, Any]]]
) -> tuple[int, Rows]:
    recorder.run(session_id, robot_id)
    rows: Rows = []
    time_s = 0.0
    for step_s, published in run:
        time_s += step_s
        recorder.publish(time_s, published)
        rows.append((time_s, published))
    return recorder.run_id, rows


def _stored_rollups(connection: sqlite3.Connection) -> dict[tuple[int, str, int], Summary]:
    columns = ", ".join(f"u.{name}" for name in Summary._fields)
    rows = connection.execute(
        f"SELECT run_id, name, bucket, {columns} FROM all_rollup u "
        "JOIN signal s ON s.id = signal_id"
    )
    return {(row[0], row[1], row[2]): Summary._make(row[3:]) for row in rows}


def _computed(rows: Rows) -> dict[tuple[str, int], Summary]:
    points: defaultdict[tuple[str, int], list[tuple[float, Any]]] = defaultdict(list)
    for time_s, published in rows:
        for name, value in flatten(json.loads(json.dumps(published))).items():
            points[name, int(time_s // BUCKET_S)].append((time_s, value))
    return {
        key: summarise(*zip(*pairs, strict=True), angle=key[0] == "yaw")
        for key, pairs in points.items()
    }


@given(st.lists(finite | st.none(), min_size=1, max_size=60), st.data())
def test_merging_the_parts_of_a_stretch_equals_summarising_it_whole(
    values: list[float | None], data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(values)))
    times = [float(index) for index in range(len(values))]
    parts = [summarise(times[:cut], values[:cut]), summarise(times[cut:], values[cut:])]
    assert _same(merge(parts), summarise(times, values))


def _same(merged: Summary, whole: Summary) -> bool:
    """Exactly, but for the sums, which depend on the order of adding."""
    scale = max(1.0, abs(whole.sum or 0), whole.squares or 0)
    return merged[:11] == whole[:11] and all(
        (a is None) == (b is None) and abs((a or 0) - (b or 0)) <= 1e-9 * scale
        for a, b in zip(merged[11:], whole[11:], strict=True)
    )


def test_two_callers_at_once_take_every_row_in_once(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        record_rover(connection)
        threads = [threading.Thread(target=_roll_all, args=(file,)) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        rows = connection.execute("SELECT count(*) FROM state").fetchone()[0]
        counted = connection.execute("SELECT row_count FROM signal WHERE name = 'mode'").fetchone()[
            0
        ]
        assert counted == rows
        assert watermark(connection) == rows


def _roll_all(file: Path) -> None:
    with closing(connect(file, "writer")) as connection:
        while not roll(connection, 500).done:
            pass


def test_what_was_summed_up_from_rollups_that_went_on_meanwhile_is_not_stored(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"x": 1})
    before = held(empty, recorder.run_id, watermark(empty, recorder.run_id))
    roll(empty)
    whole = _everything(empty)
    late = (False, recorder.run_id, 0, 1, *Summary(rows=7))
    assert not store(empty, before, Addition([late], [], []), 1)
    assert _everything(empty) == whole


def test_a_batch_that_is_stored_in_part_is_finished_later_and_counted_once(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as writer:
        create_schema(writer)
        for name in ("a", "b", "c"):
            recorder = start_run(writer, name)
            for step in range(30):
                recorder.publish(float(step), {"x": step, "mode": "ab"[step % 2]})
        with closing(connect(file, "writer", patient=False)) as other:
            _lock_at(writer, other, "INSERT INTO store_rollups VALUES (2,")
            with pytest.raises(sqlite3.OperationalError, match="locked"):
                never_wait(writer)
                roll(writer)
            writer.set_trace_callback(None)
        runs = [watermark(writer, run_id) for run_id in (1, 2, 3)]
        assert watermark(writer) == 0 and runs[0] == 30 and runs[2] == 0
        for _ in range(2):
            for run_id in (1, 2, 3):
                (run,) = query_history(writer, find_range(writer, Scope(run_id=run_id)), ["x"]).runs
                assert run.numbers[0].whole.present == 30
                assert len(list_signals(writer, run_id=run_id).signals) == 2
            assert roll(writer).done
        assert [row[0] for row in writer.execute("SELECT row_count FROM signal")] == [30] * 6
        assert writer.execute("SELECT sum(rows) FROM all_rollup").fetchone() == (180,)


def _lock_at(writer: sqlite3.Connection, other: sqlite3.Connection, what: str) -> None:
    """Let another connection have the write lock when such a statement begins."""

    def look(statement: str) -> None:
        if statement.startswith(what) and not other.in_transaction:
            other.execute("BEGIN IMMEDIATE")

    writer.set_trace_callback(look)


def test_buckets_that_are_over_stand_by_signal_and_the_newest_side_by_side(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(35):
        recorder.publish(float(step), {"x": step})
        roll(empty)
    buckets_in = "SELECT bucket, rows FROM {} ORDER BY bucket"
    assert empty.execute(buckets_in.format("rollup")).fetchall() == [(0, 10), (1, 10), (2, 10)]
    assert empty.execute(buckets_in.format("recent_rollup")).fetchall() == [(3, 5)]
    recorder.end_run("crashed")
    roll(empty)
    assert len(empty.execute(buckets_in.format("rollup")).fetchall()) == 4
    recorder.publish(36.0, {"x": 36})  # adopted later
    recorder.publish(41.0, {"x": 41})
    roll(empty)
    assert empty.execute(buckets_in.format("rollup")).fetchall()[3:] == [(3, 6), (4, 1)]


@pytest.mark.parametrize("lose", ["DELETE FROM rollup", "DELETE FROM watermark"])
def test_lost_rollups_are_rebuilt_from_the_rows(empty: sqlite3.Connection, lose: str) -> None:
    record_rover(empty)
    roll(empty, 100_000)
    before = _everything(empty)
    empty.execute(lose)
    if "watermark" in lose:
        forget(empty)
    roll(empty, 100_000)
    assert _everything(empty) == before


def _everything(connection: sqlite3.Connection) -> list[list[Any]]:
    tables = ("all_rollup", "change", "signal", "watermark")
    return [connection.execute(f"SELECT * FROM {table}").fetchall() for table in tables]


def test_an_unreadable_row_costs_itself_and_not_the_rollup(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"x": 1})
    recorder.insert("state", **recorder.at(1.0), data='{"x": NaN')
    recorder.insert("state", **recorder.at(2.0), data="[1, 2]")
    recorder.publish(3.0, {"x": 3})
    assert roll(empty) == (4, True)
    assert empty.execute("SELECT row_count, min, max FROM signal").fetchall() == [(2, 1.0, 3.0)]


@pytest.mark.parametrize("power", [63, 64, 100, 1400])
def test_an_integer_beyond_64_bits_stops_neither_the_rollups_nor_an_answer(
    empty: sqlite3.Connection, power: int, tier: str
) -> None:
    number, usable = 2**power, power < 300
    recorder = start_run(empty)
    for step in range(200):
        recorder.publish(float(step), {"hash": number + step, "x": step, "array": [number] * 20})
    if tier == "rollups":
        assert roll(empty, 100_000).done
    for name, present in (("hash", 200), ("x", 200), ("array.mean", 200 * usable)):
        (run,) = query_history(empty, find_range(empty, Scope()), [name], max_points=10).runs
        whole = run.numbers[0].whole
        assert whole.present == present
        assert (whole.sum is not None) == (usable or name == "x")
    assert len(list_signals(empty).signals) == 7
    trends(empty, find_range(empty, Scope()))
    query_rows(empty, find_range(empty, Scope()), ["*"])


def test_a_row_that_cannot_be_stored_costs_itself_and_not_the_rollup(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(20):
        half_a_character = "\\ud800" if step in (7, 8) else "a"
        data = f'{{"x": {step}, "text": "{half_a_character}"}}'
        recorder.insert("state", **recorder.at(float(step)), data=data)
    while not roll(empty, 3).done:
        pass
    counted = empty.execute("SELECT name, row_count FROM signal ORDER BY name").fetchall()
    assert counted == [("text", 18), ("x", 18)]


def test_change_points_carry_on_across_batches(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for index, mode in enumerate(["a", "a", "b", "b", None, None, "a"]):
        recorder.publish(float(index), {"mode": mode, "on": index > 3})
    while not roll(empty, 2).done:
        pass
    changes = empty.execute(
        "SELECT name, sim_time_s, value FROM change JOIN signal s ON s.id = signal_id ORDER BY 1, 2"
    ).fetchall()
    assert changes == [
        ("mode", 0.0, "a"), ("mode", 2.0, "b"), ("mode", 4.0, None), ("mode", 6.0, "a"),
        ("on", 0.0, "false"), ("on", 4.0, "true"),
    ]  # fmt: skip


def test_a_heading_in_degrees_is_no_angle_in_radians(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"heading": 3.0, "yaw": 3.0})
    roll(empty)
    recorder.publish(1.0, {"heading": 270.0, "yaw": -3.0})
    roll(empty)
    kinds = dict(empty.execute("SELECT name, kind FROM signal").fetchall())
    assert kinds == {"heading": "num", "yaw": "angle"}


def test_a_robot_that_invents_names_for_ever_does_not_fill_the_register(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for index in range(30):
        recorder.publish(float(index), {f"key{index}_{i}": i for i in range(100)})
    roll(empty)
    assert empty.execute("SELECT count(*) FROM signal").fetchone()[0] == 2000


def test_rows_that_are_rolled_up_during_an_answer_are_counted_once(
    tmp_path: Path, long_ranges: None
) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as writer:
        create_schema(writer)
        record_rover(writer)

        def roll_in_between(statement: str) -> None:
            if "FROM all_rollup" in statement:
                roll(writer, 300)

        with closing(connect(file, "reader")) as reader:
            whole = find_range(reader, Scope(run_id=1))
            reader.set_trace_callback(roll_in_between)
            for _ in range(4):
                (run,) = query_history(reader, whole, ["battery_v", "mode"]).runs
                assert run.numbers[0].whole.present == 1150
                assert len(run.changes[0].points) == 4
        assert watermark(writer) > 300
