"""What is exported from chunks is what is exported row by row, to the last value."""

from __future__ import annotations

import io
import json
import math
import random
import sqlite3
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.exploring import attempts
from tests.memory import memory_connection
from tests.recordings.rover import Recorder, record_rover, start_run
from tests.store.export.test_purged_rows import NAMES, STATES, purged
from webots_mcp.bridge.encoding import encode
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.export import StateTable, export
from webots_mcp.store.reading.ranges import Scope, find_range

parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'parquet' is not installed")

ROWS = 300
GROUP_ROWS = 205  # so that these rows are a group and a part of one


def publish(recorder: Recorder, time_s: float, state: dict[str, Any]) -> None:
    encoded = encode(state)
    replaced = json.dumps(encoded.replaced) if encoded.replaced else None
    recorder.insert("state", **recorder.at(time_s), data=encoded.text, replaced=replaced)


def table(connection: sqlite3.Connection, **wanted: Any) -> tuple[Any, str]:
    sink = io.BytesIO()
    wanted.setdefault("run_id", 1)
    export(connection, find_range(connection, Scope(**wanted)), "parquet", sink)
    found = parquet.read_table(sink)
    return found.schema, repr(found.to_pylist())  # NaN equals none, but its text does


def is_by_column(connection: sqlite3.Connection, **wanted: Any) -> bool:
    wanted.setdefault("run_id", 1)
    segments = find_range(connection, Scope(**wanted)).segments
    return StateTable.of(connection, segments, 2, None).by_column() is not None


def by_rows(_: StateTable) -> None:
    """As where chunks do not hold all."""


def assert_alike(connection: sqlite3.Connection, **wanted: Any) -> None:
    found = table(connection, **wanted)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(StateTable, "by_column", by_rows)
        assert found == table(connection, **wanted)


@pytest.fixture(autouse=True)
def few_rows_in_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", GROUP_ROWS)


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with memory_connection() as connection:
        yield start_run(connection)


def story(step: int) -> dict[str, Any]:
    """Nulls, missing keys, texts, flags, replaced values, arrays, and numbers of both kinds."""
    state: dict[str, Any] = {
        "n": step,
        "x": step * 0.25 if step % 2 else step,
        "mode": ("go", "turn", None)[step % 3],
        "lamp": step % 7 == 1,
        "pose": [step * 0.1, -0.0, [1, 2.5]],
        "range": math.inf if step % 5 == 0 else math.nan if step % 5 == 1 else 0.5,
        "beams": [math.nan if step % 4 == each else each * 1.5 for each in range(4)],
        "nothing": None,
        "empty": {},
        "sim_time_s": step,
    }
    if step % 3:
        state["deep"] = {"er": {"é": step}, "flag": None if step % 2 else True}
    if step > 180:
        state["late_comer"] = None if step % 5 == 0 else float(step)
    return state


def record(recorder: Recorder, steps: Any, of: Callable[[int], dict[str, Any]] = story) -> None:
    recorder.connection.execute("BEGIN")
    for step in steps:
        publish(recorder, round(step * 0.1, 6), of(step))
    recorder.connection.execute("COMMIT")


@pytest.mark.parametrize("ended", [True, False])
def test_a_run_is_the_same_from_its_chunks(recorder: Recorder, ended: bool) -> None:
    record(recorder, range(ROWS))
    if ended:
        recorder.end_run("finished")
    connection = recorder.connection
    before = table(connection)
    assert make_chunks(connection, 10_000).done
    assert is_by_column(connection)
    assert table(connection) == before
    assert_alike(connection)
    assert_alike(connection, start_s=10.05, end_s=24.0)


def test_runs_of_different_signals_are_one_table(recorder: Recorder) -> None:
    record(recorder, range(ROWS))
    recorder.end_run("reset")
    recorder.run(1, 1, "reset")
    record(recorder, range(ROWS), lambda step: {"z": step, "nothing": 0.5, "n": step * 0.5})
    recorder.end_run("finished")
    make_chunks(recorder.connection, 10_000)
    wanted = {"run_id": None, "robot": "rover", "since_wall_time": 0}
    assert is_by_column(recorder.connection, **wanted)
    assert_alike(recorder.connection, **wanted)


def test_signals_are_in_the_order_of_the_run_not_of_the_register(recorder: Recorder) -> None:
    record(recorder, range(ROWS), lambda step: {"a": step, "b": step})
    recorder.end_run("reset")
    recorder.run(1, 1, "reset")
    record(recorder, range(ROWS), lambda step: {"b": step, "c": 1, "a": step})
    recorder.end_run("finished")
    make_chunks(recorder.connection, 10_000)
    assert is_by_column(recorder.connection, run_id=2)
    assert table(recorder.connection, run_id=2)[0].names[4:] == ["b", "c", "a"]


@pytest.mark.parametrize(
    "odd",
    [
        {"x": "a text"}, {"x": True}, {"n": 2**53}, {"n": 2**60}, {"n": -(2**53)},
        {"mode": "long " * 60}, {"scan": list(range(40))}, {"mode": math.nan}, {"lamp": 1},
        {"a": {"*": math.nan, "0": None}}, {"a": {"min": None, "0": math.nan}},
        {"a.b": 1, "a": {"b": 2}}, {"replaced": 1, "state.replaced": 2}, {"n": 10**400},
    ],
    ids=lambda odd: ascii(odd)[:40],
)  # fmt: skip
def test_a_run_with_one_row_that_chunks_do_not_hold_is_the_same(
    recorder: Recorder, odd: dict[str, Any]
) -> None:
    record(recorder, range(ROWS), lambda step: story(step) | (odd if step == 140 else {}))
    recorder.end_run("finished")
    make_chunks(recorder.connection, 10_000)
    assert_alike(recorder.connection)


def test_late_and_purged_rows_are_the_same(recorder: Recorder) -> None:
    late = set(random.Random(1).sample(range(1, 200), 20))
    record(recorder, (step for step in range(ROWS) if step not in late))
    make_chunks(recorder.connection, 10_000)
    record(recorder, sorted(late))
    assert_alike(recorder.connection)
    make_chunks(recorder.connection, 10_000)
    recorder.end_run("finished")
    make_chunks(recorder.connection, 10_000)
    assert_alike(recorder.connection)
    purged(recorder.connection, rows=100)
    assert_alike(recorder.connection)
    purged(recorder.connection)
    assert_alike(recorder.connection)


def test_the_known_recording_with_its_scans_is_the_same() -> None:
    with memory_connection() as connection:
        record_rover(connection)
        make_chunks(connection, 10_000)
        for run_id in (1, 2, 3):
            assert_alike(connection, run_id=run_id)


def test_where_a_chunk_is_damaged_the_rows_are_exported(recorder: Recorder) -> None:
    record(recorder, range(ROWS))
    recorder.end_run("finished")
    make_chunks(recorder.connection, 10_000)
    damage = "UPDATE chunk SET numbers = x'0000000001' WHERE signal_id = 1 AND numbers IS NOT NULL"
    assert recorder.connection.execute(damage).rowcount
    assert_alike(recorder.connection)
    make_chunks(recorder.connection, 10_000)
    assert is_by_column(recorder.connection), "made anew, since the export read it"
    assert_alike(recorder.connection)


@settings(
    max_examples=attempts(30, exploring=60),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(st.lists(STATES | st.dictionaries(NAMES, st.integers(), max_size=3), min_size=1, max_size=9))
def test_whatever_was_published_is_the_same(states: list[dict[str, Any]]) -> None:
    with memory_connection() as connection, pytest.MonkeyPatch.context() as patched:
        patched.setattr(chunk_making, "GROUP_ROWS", 3)
        recorder = start_run(connection)
        for step, state in enumerate(states):
            publish(recorder, float(step), state)
        recorder.end_run("finished")
        chunk_whole_run(connection, 1)
        assert_alike(connection)


def test_progress_comes_to_the_number_of_rows(recorder: Recorder) -> None:
    record(recorder, range(ROWS))
    recorder.end_run("finished")
    make_chunks(recorder.connection, 10_000)
    said: list[tuple[int, int]] = []
    wanted = find_range(recorder.connection, Scope(run_id=1))
    export(
        recorder.connection, wanted, "parquet", io.BytesIO(),
        lambda done, of: said.append((done, of)),
    )  # fmt: skip
    assert said[-1] == (ROWS, ROWS)
