"""Rows that retention has deleted come back from their chunks; what they lack is said."""

from __future__ import annotations

import io
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import record_rover, start_run
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge.encoding import encode
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.chunk_making import GROUP_ROWS, make_chunks
from webots_mcp.store.export import FOR_VIEWERS, export, export_for_viewers
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention_limits import Limit, Retention

NAMES = st.text('ab."\\[ é', min_size=1, max_size=3)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.text(max_size=8)
    | st.sampled_from([0.5, -1.25, 1e300, float("nan"), float("inf")]),
    lambda inner: st.lists(inner, min_size=1, max_size=4)
    | st.dictionaries(NAMES, inner, min_size=1, max_size=3),
    max_leaves=12,
)  # fmt: skip
STATES = st.dictionaries(NAMES, VALUES, min_size=1, max_size=4)


def purged(connection: sqlite3.Connection, rows: int = 0) -> None:
    limits = Retention(state=Limit(rows=rows), kept_state=Limit(), outlive=0)
    prune(connection, Path(), limits, rest=False)


def exported(connection: sqlite3.Connection, form: str, **wanted: Any) -> tuple[bytes, list[str]]:
    sink, notes = io.BytesIO(), list[str]()
    wanted.setdefault("run_id", 1)
    export(connection, find_range(connection, Scope(**wanted)), form, sink, notes=notes)
    return sink.getvalue(), notes


def lines(connection: sqlite3.Connection, **wanted: Any) -> list[dict[str, Any]]:
    return [json.loads(line) for line in exported(connection, "jsonl", **wanted)[0].splitlines()]


@pytest.fixture
def rover() -> Iterator[sqlite3.Connection]:
    """The known recording without its scans, which chunks reduce to five numbers."""
    with memory_connection() as connection:
        record_rover(connection)
        connection.execute("UPDATE state SET data = json_remove(data, '$.lidar')")
        connection.execute("DELETE FROM signal WHERE name GLOB 'lidar.*'")
        yield connection


@pytest.mark.parametrize("form", ["csv", "jsonl", "parquet"])
@pytest.mark.parametrize("left", [0, 200])
def test_an_export_after_a_purge_is_the_one_before_it(
    rover: sqlite3.Connection, form: str, left: int
) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow", reason="the extra 'parquet' is not installed")
    before = {run: exported(rover, form, run_id=run)[0] for run in (1, 2)}
    part = exported(rover, form, run_id=1, start_s=1.6, end_s=3.2)[0]
    make_chunks(rover, 10_000)
    purged(rover, left)
    assert {run: exported(rover, form, run_id=run)[0] for run in (1, 2)} == before
    assert exported(rover, form, run_id=1, start_s=1.6, end_s=3.2) == (part, [])


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(STATES)
def test_a_state_comes_back_as_it_was_whatever_its_names(state: dict[str, Any]) -> None:
    with memory_connection() as connection:
        recorder = start_run(connection)
        encoded = encode(state)
        data = {"data": encoded.text, "replaced": encoded.replaced_text}
        recorder.insert("state", **recorder.at(0.0), **data)
        (before,) = lines(connection)
        purged(connection)
        (after,) = lines(connection)
        assert after.pop("replaced", {}).keys() >= set()
        before.pop("replaced", None)
        assert after == before


def test_where_rows_are_left_and_where_late_ones_came_all_come_once_in_order() -> None:
    with memory_connection() as connection:
        recorder = start_run(connection)
        for step in range(2 * GROUP_ROWS):
            recorder.publish(step * 1.0, {"x": step})
        make_chunks(connection, 10_000)
        for step in range(300):
            recorder.publish(step * 3 + 0.5, {"x": -step})
        before = lines(connection)
        purged(connection, 1000)
        after = lines(connection)
        assert [line["sim_time_s"] for line in after] == sorted(
            line["sim_time_s"] for line in after
        )
        assert after == before


def test_what_chunks_could_not_hold_is_said() -> None:
    with memory_connection() as connection:
        recorder = start_run(connection)
        for step in range(3):
            recorder.publish(step * 1.0, {"scan": [0.5] * 20, "text": "t" * 300, "x": step})
        purged(connection)
        found, notes = exported(connection, "jsonl")
        first = json.loads(found.splitlines()[0])
        assert (first["scan.count"], first["scan.mean"], first["text"]) == (20, 0.5, "t" * 200)
        (note,) = notes
        assert note.startswith("6 values of run 1 are incomplete: their rows were deleted")


@pytest.mark.parametrize("form", FOR_VIEWERS)
def test_a_file_for_viewers_says_as_well_what_could_not_be_given_back(
    form: str, tmp_path: Path
) -> None:
    pytest.importorskip({"rrd": "rerun"}.get(form, form), reason="its extra is not installed")
    with memory_connection() as connection:
        recorder = start_run(connection)
        for step in range(3):
            recorder.publish(step * 1.0, {"scan": [0.5] * 20, "x": step})
        recorder.end_run("finished")
        purged(connection)
        connection.execute(
            "UPDATE chunk SET numbers = x'00112233445566' WHERE signal_id = "
            "(SELECT id FROM signal WHERE name = 'x')"
        )
        wanted = find_range(connection, Scope(run_id=1))
        file = tmp_path / f"run.{form}"
        assert [line["scan.mean"] for line in lines(connection)] == [0.5] * 3
        lost, damaged = export_for_viewers(connection, tmp_path, wanted, form, file).notes
    assert lost.startswith("3 values of run 1 are incomplete: their rows were deleted")
    assert "the chunk of x is damaged" in damaged


def test_of_chunks_that_are_deleted_too_the_time_is_said() -> None:
    with memory_connection() as connection:
        recorder = start_run(connection)
        for step in range(3 * GROUP_ROWS):
            recorder.publish(step * 1.0, {"x": step})
        recorder.end_run("finished")
        few = Retention(state=Limit(rows=0), chunk=Limit(rows=GROUP_ROWS), outlive=0)
        prune(connection, Path(), few, rest=False)
        found, notes = exported(connection, "jsonl")
        assert len(found.splitlines()) == GROUP_ROWS
        (note,) = notes
        assert note == f"not read from 0.000 to {2 * GROUP_ROWS}.000 s: deleted by retention"


def test_a_kept_stretch_comes_once() -> None:
    database = MemoryDatabase()
    robot = InProcessSupervisor("rover")
    with MCPBridge(robot, throttle_interval=5, database=database) as bridge:
        for number in range(3000):
            robot.step(16)
            bridge.publish({"n": number})
            if number == 600:
                bridge.keep("a look")
    with closing(connect(database, "writer")) as connection:
        before = lines(connection)
        purged(connection)
        after = lines(connection)
    assert [line["n"] for line in after] == [line["n"] for line in before]
    assert len(after) > 600
    database.close()


def test_a_row_that_a_stretch_of_a_single_moment_keeps_is_exported_once(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(50):
        recorder.publish(step * 0.1, {"x": step})
    recorder.end_run("finished")
    empty.execute(
        "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, reason, "
        "wall_time_s) SELECT 1, 'u', sim_time_s, sim_time_s, 'bumped', 0 FROM state WHERE id = 21"
    )
    purged(empty)
    assert [line["x"] for line in lines(empty)] == list(range(50))
