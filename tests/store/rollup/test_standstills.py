"""Standstills that are stored with coarse rollups are those that the rows show."""

from __future__ import annotations

import math
import random
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import Recorder
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.questions.events import find_events
from webots_mcp.store.reading import rows
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention.policy import Limit, Retention
from webots_mcp.store.retention.purge import prune
from webots_mcp.store.rollup import findings
from webots_mcp.store.rollup.rolling import roll

STEP_S = 0.1
END_S = 2300.0
# In a bucket of 500 s, about the border of two, over a whole one, and about the last that is over.
STANDS_S = ((100.0, 112.0), (497.8, 503.0), (730.0, 1620.0), (1990.0, 2040.0), (2200.0, 2210.0))
TURNS_S = (1100.0, 1110.0)  # within the long one


@pytest.fixture(scope="module")
def _long() -> Iterator[sqlite3.Connection]:
    with memory_connection() as connection:
        with pytest.MonkeyPatch.context() as patch:
            _shorten(patch)
            _record(connection)
        yield connection


@pytest.fixture
def long(
    _long: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> Iterator[sqlite3.Connection]:
    """2300 s, of which four coarse buckets are over, with 2 mm of noise."""
    _shorten(monkeypatch)
    with memory_connection(_long) as connection:
        yield connection


def _shorten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(rows, "RAW_ROWS", 1000)
    patch.setattr(findings, "STRETCH_ROWS", 1500)


def _record(connection: sqlite3.Connection) -> None:
    recorder = Recorder(connection)
    robot_id = recorder.robot("rover")
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    x_m, draw = 0.0, random.Random(1)
    for step in range(round(END_S / STEP_S)):
        time_s = step * STEP_S
        stands = any(start_s <= time_s < end_s for start_s, end_s in STANDS_S)
        x_m += 0.0 if stands else 0.2 * STEP_S
        recorder.publish(time_s, state(time_s, x_m + draw.gauss(0.0, 0.002), stands))
    connection.execute("UPDATE run SET last_sim_time_s = ?", (END_S,))
    while not roll(connection, 100_000).done:
        pass


def state(time_s: float, x_m: float, stands: bool) -> dict[str, Any]:
    """It is told to go ahead whenever it stands but from 1990 s on; in the long stay it turns."""
    turned = 0.5 * (min(max(time_s, TURNS_S[0]), TURNS_S[1]) - TURNS_S[0])
    heading = math.remainder(turned, math.tau)
    mode = "wait" if 1990 <= time_s < 2040 else "go"
    return {
        "pose": [x_m, 0.0, heading],
        "mode": mode,
        "commanded_m_s": 0.0 if mode == "wait" else 0.2,
    }


def ask(
    connection: sqlite3.Connection, kinds: tuple[str, ...] = ("still", "stuck"), **asked: Any
) -> list[Event]:
    options = EventOptions(kinds=kinds, **asked)
    asked_range = find_range(connection, Scope())
    found = find_events(connection, asked_range, options, deadline_s=60.0, group=False)
    return sorted(found.events, key=lambda each: (each.start_s, each.kind))


def forget(connection: sqlite3.Connection) -> None:
    """Leave coarse rollups as older versions did."""
    connection.execute("UPDATE coarse_rollup SET standstills = NULL")


def rows_read(connection: sqlite3.Connection, **asked: Any) -> int:
    """How many statements read values of rows."""
    statements: list[str] = []
    connection.set_trace_callback(statements.append)
    ask(connection, **asked)
    connection.set_trace_callback(None)
    return sum("json_extract(" in each for each in statements)


def test_stored_standstills_are_told_as_the_rows_tell_them(long: sqlite3.Connection) -> None:
    stored, few = ask(long), rows_read(long)
    forget(long)
    read, many = ask(long), rows_read(long)
    assert few < many
    stuck = [each for each in stored if each.kind == "stuck"]
    assert [(round(each.start_s), round(each.end_s)) for each in stuck] == [
        (100, 112), (498, 503), (730, 1099), (1111, 1620), (2200, 2210)
    ]  # fmt: skip
    assert [each.kind for each in stored] == [each.kind for each in read]
    for one, other in zip(stored, read, strict=True):
        # Of a long one samples tell from when on it was stuck.
        close_s = 0.21 if one.end_s - one.start_s < 60 else 3.0
        ends = pytest.approx((other.start_s, other.end_s), abs=close_s)
        assert (one.start_s, one.end_s) == ends
        assert one.details["mode"] == other.details["mode"]
        assert "within_s" not in one.details


def test_a_standstill_over_several_stretches_is_one_with_all_that_its_rows_show(
    long: sqlite3.Connection,
) -> None:
    (still,) = (each for each in ask(long, kinds=("still",)) if each.end_s - each.start_s > 60)
    assert (still.start_s, still.end_s) == pytest.approx((730.0, 1620.0), abs=0.2)
    assert still.details["turned_rad"] == pytest.approx(5.0, abs=0.01)


def test_a_standstill_that_is_asked_for_otherwise_is_looked_for_in_the_rows(
    long: sqlite3.Connection,
) -> None:
    assert rows_read(long, stuck_s=4.0) > rows_read(long)
    assert rows_read(long, moving_modes=("go",)) <= rows_read(long)
    stuck = ask(long, kinds=("stuck",), moving_modes=(), min_commanded=0.5)
    assert stuck == []


def test_whoever_names_the_position_is_told_what_is_stored_of_it(
    long: sqlite3.Connection,
) -> None:
    named = ("pose.0", "pose.1")
    assert ask(long, position=named) == ask(long)
    assert rows_read(long, position=named) == rows_read(long)
    assert rows_read(long, position=named[::-1]) > rows_read(long)


def test_stored_standstills_outlast_the_rows(long: sqlite3.Connection, tmp_path: Path) -> None:
    before = [(each.kind, each.start_s, each.end_s) for each in ask(long)]
    long.execute("UPDATE run SET ended_wall_time_s = last_wall_time_s")
    prune(long, tmp_path, Retention(state=Limit(rows=4000), outlive=0), rest=False)
    assert long.execute("SELECT count(*) FROM state").fetchone()[0] < 5000
    assert [(each.kind, each.start_s, each.end_s) for each in ask(long)] == before


def test_where_a_part_was_not_looked_in_the_rows_are_read(long: sqlite3.Connection) -> None:
    whole, few = [each.kind for each in ask(long)], rows_read(long)
    long.execute("UPDATE coarse_rollup SET standstills = NULL WHERE bucket = 1")
    assert [each.kind for each in ask(long)] == whole
    assert rows_read(long) > few
