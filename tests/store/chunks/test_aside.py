"""A recording that is only read gets its chunks in a temporary file of the process, once."""

from __future__ import annotations

import math
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from tests import unprivileged
from tests.recordings.long import build
from webots_mcp.database.connection import connect
from webots_mcp.judging.trends import trends
from webots_mcp.store.chunk_making import MIN_ROWS_ON_DEMAND, make_missing_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.recording import OpenConnections, RecordingAccess
from webots_mcp.store.retention_limits import Limit, Retention

pytestmark = pytest.mark.slow

ROWS = 3 * MIN_ROWS_ON_DEMAND


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("long") / "webots.db"
    build(file, ROWS, chunked=False)
    with closing(connect(file, "writer")) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return file


@pytest.fixture
def recording(built: Path, tmp_path: Path) -> Iterator[RecordingAccess]:
    shutil.copy(built, tmp_path / "webots.db")
    connections = OpenConnections()
    yield RecordingAccess(tmp_path / "webots.db", tmp_path, read_only=True, connections=connections)
    connections.close()


def in_chunks(recording: RecordingAccess) -> int:
    with recording.reader() as connection:
        return connection.execute("SELECT total(row_count) FROM row_group").fetchone()[0]


def noted(told: list[tuple[int, int]]) -> Callable[[int, int], object]:
    return lambda done, of: told.append((done, of))


def test_readers_see_chunks_that_the_file_has_not(recording: RecordingAccess) -> None:
    assert isinstance(recording.database, Path)
    before = recording.database.read_bytes()
    with recording.reader() as connection:
        expected = trends(connection, find_range(connection, Scope()), deadline_s=600)
    told: list[tuple[int, int]] = []
    assert make_missing_chunks(recording, noted(told), write=False) == ""
    assert told[-1] == (ROWS, ROWS)
    assert in_chunks(recording) == ROWS
    assert recording.database.read_bytes() == before
    with recording.reader() as connection:
        assert trends(connection, find_range(connection, Scope()), deadline_s=600) == expected
        with pytest.raises(sqlite3.OperationalError):
            connection.execute("DELETE FROM aside.chunk")


def test_they_are_made_once_and_what_broke_off_goes_on(recording: RecordingAccess) -> None:
    assert "ask again" in make_missing_chunks(recording, called_off=lambda: True, write=False)
    assert MIN_ROWS_ON_DEMAND <= in_chunks(recording) < ROWS
    assert make_missing_chunks(recording, write=False) == ""
    assert in_chunks(recording) == ROWS
    told: list[tuple[int, int]] = []
    assert make_missing_chunks(recording, noted(told), write=False) == ""
    assert told == []


@pytest.mark.skipif(not unprivileged.POSSIBLE, reason="permissions do not stop this user here")
def test_a_question_of_the_command_line_makes_them_where_nothing_can_be_written(
    recording: RecordingAccess, tmp_path: Path
) -> None:
    command = ["-m", "webots_mcp", "trends", "--database", str(recording.database)]
    with unprivileged.unwritable(tmp_path):
        done = subprocess.run(
            unprivileged.line(*command), capture_output=True, text=True, check=False
        )
    assert done.returncode == 0, done.stderr
    assert "in no chunk yet" not in done.stderr


def test_what_a_server_purges_that_begins_later_is_read_from_its_chunks(
    recording: RecordingAccess, tmp_path: Path
) -> None:
    def values() -> Sequence[object]:
        with recording.reader() as connection:
            frame = read_frame(connection, Segment(1, -math.inf, math.inf), Deadline(60))
            return frame.values("x")

    make_missing_chunks(recording, write=False)
    before = values()
    with closing(connect(recording.database, "writer")) as server:
        server.execute(
            "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) SELECT run_id, "
            "sim_time_s + 1e6, wall_time_s, data FROM state WHERE run_id = 1"
        )
        prune(server, tmp_path, Retention(state=Limit(rows=10)), rest=False)
    assert values() == [*before, *before]


def test_chunks_of_a_recording_that_is_gone_are_not_those_of_the_next(
    recording: RecordingAccess,
) -> None:
    make_missing_chunks(recording, write=False)
    with closing(connect(recording.database, "writer")) as connection:
        connection.execute("UPDATE recording SET uuid = 'another'")
        connection.execute("DELETE FROM state WHERE id > 10")
    recording.connections.close()  # type: ignore[union-attr]
    assert in_chunks(recording) == 0
