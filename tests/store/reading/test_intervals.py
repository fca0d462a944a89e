"""Where something held for so long: in every row of that time, however the rows were read."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.reading.ranges import Scope, find_range


def record(
    connection: sqlite3.Connection, states: Sequence[dict[str, Any]], every_s: float
) -> None:
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for step, state in enumerate(states):
        recorder.publish(round(step * every_s, 6), {"row": step, **state})
    connection.execute("COMMIT")


def spans(connection: sqlite3.Connection, where: str) -> list[tuple[float, float]]:
    found = find_events(
        connection,
        find_range(connection, Scope()),
        EventOptions(kinds=("condition",), where=where),
        limit=10_000,
        around=(),
    )
    return sorted((each.start_s, each.end_s) for each in found.events)


def test_what_holds_throughout_is_one_span_across_every_border(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    record(empty, [{"alt_m": 0.0 if step in (5, 333) else 9.0} for step in range(500)], 0.1)
    assert spans(empty, "alt_m > 5 for 1") == [(1.6, 33.2), (34.4, 49.9)]


LEVELS = st.sampled_from([0.0, 10.0, None, ()])  # the last: the row does not hold the signal
STRETCHES = st.lists(st.tuples(LEVELS, st.integers(1, 12)), min_size=1, max_size=30)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(STRETCHES)
def test_chunks_and_rows_tell_the_same_spans(stretches: list[tuple[Any, int]]) -> None:
    levels = [level for level, rows in stretches for _ in range(rows)]
    states = [{} if level == () else {"alt_m": level} for level in levels]
    states += [{"alt_m": 0.0}]
    asked = ("alt_m > 5 for 1", "alt_m < 5 for 1")
    with memory_connection() as connection, pytest.MonkeyPatch.context() as patch:
        record(connection, states, 1.0)
        from_rows = [spans(connection, where) for where in asked]
        patch.setattr(chunk_making, "GROUP_ROWS", 3)
        assert chunk_whole_run(connection, 1)
        assert [spans(connection, where) for where in asked] == from_rows
