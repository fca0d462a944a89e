"""Fixtures that several folders share: databases, empty or filled, and the rover."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import record_rover
from tests.recordings.rows import Recorded
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading import frame_summary


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    recording = Recorded(tmp_path / "webots.db")
    yield recording
    recording.close()


@pytest.fixture(params=["file", "memory"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    if request.param == "file":
        yield tmp_path / "webots.db"
        return
    memory = MemoryDatabase()
    yield memory
    memory.close()


@pytest.fixture
def empty() -> Iterator[sqlite3.Connection]:
    """A database of the current schema without a row."""
    with memory_connection() as connection:
        yield connection


@pytest.fixture(scope="session")
def rover_recordings() -> Iterator[dict[str, sqlite3.Connection]]:
    with memory_connection() as raw, memory_connection() as chunked:
        for connection in (raw, chunked):
            record_rover(connection)
        with pytest.MonkeyPatch.context() as patched:
            _shorten_chunks(patched)
            assert make_chunks(chunked, 100_000).done
        yield {"raw": raw, "chunked": chunked}


CHUNK_ROWS = 100


def _shorten_chunks(patched: pytest.MonkeyPatch) -> None:
    patched.setattr(chunk_making, "GROUP_ROWS", CHUNK_ROWS)


@pytest.fixture(params=["values", "chunks"])
def looked_at(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Answers from every value; and from chunks of 100 rows, as of a long range."""
    if request.param == "chunks":
        _shorten_chunks(monkeypatch)
        monkeypatch.setattr(frame_summary, "FULL_ROWS", 0)
    return request.param


@pytest.fixture(params=["raw", "chunked"])
def rover(
    request: pytest.FixtureRequest, rover_recordings: dict[str, sqlite3.Connection]
) -> sqlite3.Connection:
    """The known recording; every answer has to be the same before and after chunks were made."""
    return rover_recordings[request.param]
