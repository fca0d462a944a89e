"""A server's open readers answer from the file that is there."""

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
from webots_mcp.errors import NoDatabaseError
from webots_mcp.store.recording import OpenReaders, RecordingAccess


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[RecordingAccess]:
    make(tmp_path / "webots.db", "first")
    readers = OpenReaders()
    yield RecordingAccess(tmp_path / "webots.db", tmp_path, readers=readers)
    readers.close()


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
    assert recording.readers is not None
    with recording.reader() as connection:
        recording.readers.close()
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
