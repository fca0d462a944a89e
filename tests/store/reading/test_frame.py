"""A frame says of a stretch what its rows say, wherever they are read from."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.chunks import decoded_of, statistics_of
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline, one_reading

VALUES = st.one_of(
    st.floats(-1e6, 1e6), st.integers(-1000, 1000), st.booleans(), st.none(), st.sampled_from("abc")
)
STATES = st.lists(
    st.dictionaries(st.sampled_from(["a", "b", "c"]), VALUES), min_size=1, max_size=40
)


@pytest.fixture
def short_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups of eight rows, so that a short recording has several."""
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 8)
    monkeypatch.setattr(chunk_making, "MIN_ROWS_AT_END", 8)


def recorded(connection: sqlite3.Connection, states: list[dict[str, Any]]) -> None:
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for step, state in enumerate(states):
        recorder.publish(round(0.1 * step, 3), state)
    connection.execute("COMMIT")


def framed(connection: sqlite3.Connection) -> Frame:
    segment = whole_run(connection, 1)
    assert segment is not None
    return read_frame(connection, segment, Deadline(60))


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(STATES, st.integers(0, 40), st.integers(0, 40))
def test_chunks_and_rows_say_the_same(
    short_groups: None, states: list[dict[str, Any]], start: int, stop: int
) -> None:
    with memory_connection() as connection:
        recorded(connection, states)
        before = framed(connection)
        made = make_chunks(connection, 1000)
        after = framed(connection)
        assert made.rows == len(states) // 8 * 8
        assert after.places([start / 10]) == np.searchsorted(before.times, [start / 10])
        pairs = [
            (before, after),
            (before.rows(start, stop), after.rows(start, stop)),
            (before.between(start / 10, stop / 10), after.between(start / 10, stop / 10)),
        ]
        for old, new in pairs:
            assert old.times.tolist() == new.times.tolist()
            assert old.wall_times.tolist() == new.wall_times.tolist()
            for name in ("a", "b", "c"):
                assert [*map(str, old.numbers(name))] == [*map(str, new.numbers(name))]
                assert [*map(repr, old.values(name))] == [*map(repr, new.values(name))]


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(STATES, st.integers(0, 40), st.integers(0, 40))
def test_zones_are_what_the_values_come_to(
    short_groups: None, states: list[dict[str, Any]], start: int, stop: int
) -> None:
    with memory_connection() as connection:
        recorded(connection, states)
        make_chunks(connection, 1000)
        frame = framed(connection).rows(start, stop)
        for name in ("a", "b", "c"):
            zones = frame.zone_map(name)
            assert int(zones.row_count.sum()) == len(frame)
            for number, first in enumerate(zones.first_row.tolist()):
                end = first + int(zones.row_count[number])
                assert zones.start_s[number] == frame.times[first]
                assert zones.end_s[number] == frame.times[end - 1]
                states_there = [s.get(name) for s in states[start : start + len(frame)]][first:end]
                expected = statistics_of(decoded_of(states_there))
                for field in ("first", "last", "min", "max", "sum", "largest_step"):
                    value = getattr(expected, field)
                    found = float(getattr(zones, field)[number])
                    assert np.isnan(found) if value is None else found == pytest.approx(value)
                assert zones.value_count[number] == expected.value_count


def test_a_damaged_chunk_costs_its_signal_in_its_segment_and_it_is_said(
    short_groups: None, empty: sqlite3.Connection
) -> None:
    recorded(empty, [{"a": 0.5 * step, "b": step} for step in range(20)])
    make_chunks(empty, 1000)
    empty.execute(
        f"UPDATE chunk SET numbers = x'00' WHERE group_id = 1 AND signal_id = {id_of_a(empty)}"
    )
    frame = framed(empty)
    assert np.isnan(frame.numbers("a")[:8]).all()
    assert frame.numbers("a")[8:].tolist() == [0.5 * step for step in range(8, 20)]
    assert frame.values("b") == list(range(20))
    assert [(part.start_s, part.end_s) for part in frame.unread] == [(0.0, 0.7)]
    assert frame.unread[0].why.startswith("the chunk of a is damaged")


@pytest.mark.parametrize("odd", range(1, 7))
def test_a_column_of_many_chunks_is_whole_wherever_one_holds_something_else_or_is_damaged(
    short_groups: None, empty: sqlite3.Connection, odd: int
) -> None:
    held: list[Any] = [0.5 * step for step in range(64)]
    held[8 * (odd - 1) + 3] = "off"
    recorded(empty, [{"a": value} if step >= 8 else {} for step, value in enumerate(held)])
    make_chunks(empty, 1000)
    damaged = odd + 1
    empty.execute(
        "UPDATE chunk SET numbers = x'00' WHERE group_id = ? AND signal_id = ?",
        (damaged, id_of_a(empty)),
    )
    held[:8] = held[8 * odd : 8 * damaged] = [None] * 8
    for start, stop in ((0, 64), (3, 61)):
        frame = framed(empty).rows(start, stop)
        assert frame.values("a") == held[start:stop]
        assert [part.start_s for part in frame.unread] == [round(0.8 * odd, 3)]


def id_of_a(connection: sqlite3.Connection) -> int:
    return connection.execute("SELECT id FROM signal WHERE name = 'a'").fetchone()[0]


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE chunk SET numbers = x'00' WHERE signal_id > 0",
        "UPDATE chunk SET numbers = x'00' WHERE signal_id = 0",
        "DELETE FROM chunk WHERE signal_id = -2",
    ],
)
def test_a_damaged_group_whose_rows_are_there_is_made_anew_after_it_was_read(
    short_groups: None, empty: sqlite3.Connection, damage: str
) -> None:
    recorded(empty, [{"a": 0.5 * step} for step in range(20)])
    make_chunks(empty, 1000)
    empty.execute(f"{damage} AND group_id = 1")
    before = framed(empty)
    assert len(before.times) == len(before.ids) == len(before.numbers("a"))
    assert len(before.unread) == 1
    make_chunks(empty, 1000)
    frame = framed(empty)
    assert frame.numbers("a").tolist() == [0.5 * step for step in range(20)]
    assert frame.ids.tolist() == list(range(1, 21))
    assert frame.unread == ()
    kept = "SELECT count(*), sum(row_count), min(is_complete) FROM row_group"
    assert empty.execute(kept).fetchone() == (2, 16, 1)
    assert empty.execute("PRAGMA foreign_key_check").fetchall() == []


def test_a_damaged_group_of_which_a_row_is_gone_stays_and_is_said(
    short_groups: None, empty: sqlite3.Connection
) -> None:
    recorded(empty, [{"a": 0.5 * step} for step in range(20)])
    make_chunks(empty, 1000)
    empty.execute("UPDATE chunk SET numbers = x'00' WHERE signal_id > 0 AND group_id = 1")
    empty.execute("DELETE FROM state WHERE id = 3")
    for _ in range(2):
        frame = framed(empty)
        assert np.isnan(frame.numbers("a")[:8]).all()
        assert "the chunk of a is damaged" in frame.unread[0].why
        make_chunks(empty, 1000)


@pytest.mark.parametrize("loss", ["DELETE FROM chunk", "UPDATE chunk SET numbers = x'00'"])
def test_rows_whose_times_are_lost_stay_in_order_and_it_is_said(
    short_groups: None, empty: sqlite3.Connection, loss: str
) -> None:
    recorded(empty, [{"a": 0.5 * step} for step in range(24)])
    make_chunks(empty, 1000)
    before = framed(empty)
    times, walls = before.times.tolist(), before.wall_times.tolist()
    empty.execute(f"{loss} WHERE signal_id <= 0 AND group_id = 2")
    frame = framed(empty)
    assert frame.times.tolist() == pytest.approx(times)
    assert frame.wall_times.tolist() == pytest.approx(walls)
    assert frame.ids[8:16].tolist() == [0] * 8
    assert {(part.start_s, part.end_s) for part in frame.unread} == {(0.8, 1.5)}
    said = " ".join(part.why for part in frame.unread)
    assert all(f"chunk of {what} is" in said for what in ("simulation times", "wall times"))


@pytest.mark.parametrize("rows", [10**12, 0, -5])
def test_a_group_with_a_count_of_rows_that_cannot_be_is_not_read_and_it_is_said(
    short_groups: None, empty: sqlite3.Connection, rows: int
) -> None:
    recorded(empty, [{"a": step} for step in range(24)])
    make_chunks(empty, 1000)
    empty.execute("UPDATE row_group SET row_count = ? WHERE id = 2", (rows,))
    frame = framed(empty)
    assert frame.values("a") == [*range(8), *range(16, 24)]
    assert [str(part) for part in frame.unread] == [
        "not read from 0.800 to 1.500 s: its row group is damaged"
    ]


def test_what_there_was_no_time_for_is_said(empty: sqlite3.Connection) -> None:
    recorded(empty, [{"a": step} for step in range(3000)])
    segment = whole_run(empty, 1)
    assert segment is not None
    frame = read_frame(empty, segment, Deadline(0.0))
    assert (len(frame), frame.cut_at_s) == (0, 0.0)
    assert frame.unread[0].why == "time limit reached"


def test_rows_in_no_chunk_are_in_order_whatever_came_late_or_was_deleted(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as writer:
        create_schema(writer)
        recorder = start_run(writer)
        for step in range(10):
            recorder.publish(0.1 * step, {"a": step})
        assert framed(writer).values("a") == list(range(10))
        for step in (12, 11, 10):  # two of them late
            recorder.publish(0.1 * step, {"a": step})
            assert framed(writer).values("a")[-1] == 12
        assert framed(writer).values("a") == list(range(13))
        make_chunks(writer, 1000)
        recorder.publish(1.3, {"a": 13})
        assert framed(writer).values("a") == list(range(14))
        writer.execute("DELETE FROM state")
        recorder.publish(1.4, {"a": 14})
        assert framed(writer).rows(0, 99).values("a")[-1] == 14


def test_frames_of_one_question_share_columns_and_each_notes_only_what_it_asked_for(
    short_groups: None, empty: sqlite3.Connection
) -> None:
    recorded(empty, [{"a": float(step), "b": 2.0 * step} for step in range(16)])
    make_chunks(empty, 100)
    empty.execute(
        "UPDATE chunk SET numbers = x'00', codes = x'00' WHERE group_id = 1 AND signal_id = "
        "(SELECT id FROM signal WHERE name = 'a')"
    )
    with one_reading(empty):
        one, other = framed(empty), framed(empty)
        assert np.isnan(one.numbers("a")[:8]).all() and len(one.unread) == 1
        assert other.numbers("b").tolist() == [2.0 * step for step in range(16)]
        assert other.unread == (), "it did not ask for the damaged signal"
        assert other.numbers("a") is one.numbers("a")
        assert other.unread == one.unread
        assert framed(empty).rows(8, 16).numbers("a").tolist() == list(map(float, range(8, 16)))
    assert framed(empty).numbers("b") is not other.numbers("b")
