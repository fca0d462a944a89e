"""The recording whose story is known, and a way to record another one."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any, Protocol

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, record_rover
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range

State = Callable[[float], dict[str, Any]]


class Record(Protocol):
    """Records runs of a robot, each of so many rows; without any number one of 100 rows."""

    def __call__(self, state: State, *rows: int, interval_s: float = 0.1) -> sqlite3.Connection: ...


@pytest.fixture(scope="session")
def rover() -> Iterator[sqlite3.Connection]:
    """The story of tests.recordings.rover: runs 1 to 3 of one robot."""
    with memory_connection() as connection:
        record_rover(connection)
        make_chunks(connection, 100_000)
        yield connection


@pytest.fixture
def record() -> Iterator[Record]:
    """Record runs; their state is a function of the simulation time."""
    opened = ExitStack()

    def write(state: State, *rows: int, interval_s: float = 0.1) -> sqlite3.Connection:
        connection = opened.enter_context(memory_connection())
        recorder = Recorder(connection)
        connection.execute("BEGIN IMMEDIATE")
        robot_id = recorder.robot("spot")
        session_id = recorder.session(robot_id, "a" * 64)
        for count in rows or (100,):
            recorder.run(session_id, robot_id)
            for row in range(count):
                recorder.publish(round(row * interval_s, 6), state(row * interval_s))
        connection.execute("COMMIT")
        return connection

    with opened:
        yield write


def whole(connection: sqlite3.Connection, run_id: int = 1, **limits: Any) -> TimeRange:
    return find_range(connection, Scope(run_id=run_id, **limits))
