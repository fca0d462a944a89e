"""A server's open connections answer from the file that is there."""

from __future__ import annotations

import gc
import sqlite3
import threading
import warnings
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import DatabaseError, NoDatabaseError
from webots_mcp.store.recording import OpenConnections, RecordingAccess


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[RecordingAccess]:
    make(tmp_path / "webots.db", "first")
    connections = OpenConnections()
    yield RecordingAccess(tmp_path / "webots.db", tmp_path, connections=connections)
    connections.close()


def make(file: Path, name: str) -> None:
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("UPDATE recording SET uuid = ?", (name,))


def uuid_of(connection: sqlite3.Connection) -> str:
    return connection.execute("SELECT uuid FROM recording").fetchone()[0]


def ask(recording: RecordingAccess) -> str:
    with recording.reader() as connection:
        return uuid_of(connection)


def test_a_file_that_is_deleted_while_it_is_asked_is_missing_then_and_no_connection_is_left(
    recording: RecordingAccess, tmp_path: Path
) -> None:
    with recording.reader() as connection:
        (tmp_path / "webots.db").unlink()
        assert uuid_of(connection) == "first"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(3):
            with pytest.raises(NoDatabaseError):
                ask(recording)
        gc.collect()
    assert told == []


def test_a_file_that_is_replaced_while_it_is_asked_is_the_one_that_the_next_question_reads(
    recording: RecordingAccess, tmp_path: Path
) -> None:
    make(tmp_path / "other.db", "second")
    with recording.reader() as connection:
        for ending in ("", "-wal", "-shm"):
            (tmp_path / f"webots.db{ending}").unlink(missing_ok=True)
        (tmp_path / "other.db").replace(tmp_path / "webots.db")
        assert uuid_of(connection) == "first"
    assert ask(recording) == "second"


def test_a_file_that_was_damaged_is_opened_anew(recording: RecordingAccess, tmp_path: Path) -> None:
    assert ask(recording) == "first"
    (tmp_path / "webots.db").write_bytes(b"")
    with pytest.raises(NoDatabaseError, match="empty"):
        ask(recording)


def test_what_is_in_use_when_the_server_ends_is_closed_when_it_is_given_back(
    recording: RecordingAccess,
) -> None:
    assert recording.connections is not None
    with recording.reader() as connection:
        recording.connections.close()
    with pytest.raises(sqlite3.ProgrammingError):
        connection.execute("SELECT 1")


def test_many_at_once_are_answered_each_by_a_connection_of_its_own(
    recording: RecordingAccess,
) -> None:
    answers = list[str]()
    threads = [
        threading.Thread(target=lambda: answers.extend(ask(recording) for _ in range(20)))
        for _ in range(10)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == ["first"] * 200


def rename(recording: RecordingAccess, name: str) -> sqlite3.Connection:
    with recording.brief_writer() as connection:
        connection.execute("UPDATE recording SET uuid = ?", (name,))
        return connection


def test_a_connection_to_write_with_is_used_again_and_its_rows_are_seen_at_once(
    recording: RecordingAccess,
) -> None:
    first = rename(recording, "second")
    assert ask(recording) == "second"
    assert rename(recording, "third") is first
    assert ask(recording) == "third"


def test_a_file_that_is_replaced_takes_the_next_write(
    recording: RecordingAccess, tmp_path: Path
) -> None:
    rename(recording, "second")
    make(tmp_path / "other.db", "other")
    for ending in ("", "-wal", "-shm"):
        (tmp_path / f"webots.db{ending}").unlink(missing_ok=True)
    (tmp_path / "other.db").replace(tmp_path / "webots.db")
    rename(recording, "third")
    with closing(connect(tmp_path / "webots.db", "reader")) as connection:
        assert uuid_of(connection) == "third"


def test_a_transaction_that_is_left_open_is_undone_and_locks_nobody_out(
    recording: RecordingAccess,
) -> None:
    with recording.brief_writer() as connection:
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("UPDATE recording SET uuid = 'never'")
    assert ask(recording) == "first"
    assert rename(recording, "second") is not connection


def test_a_connection_on_which_a_write_failed_is_closed(recording: RecordingAccess) -> None:
    with (
        pytest.raises(DatabaseError),
        recording.brief_writer() as connection,
    ):
        connection.execute("INSERT INTO run (id) VALUES (NULL)")
    with pytest.raises(sqlite3.ProgrammingError):
        connection.execute("SELECT 1")
    rename(recording, "second")
    assert ask(recording) == "second"
