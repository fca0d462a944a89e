"""Transactions, and what errors of SQLite mean."""

from __future__ import annotations

import signal
import sqlite3
import stat
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.memory import memory_connection
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.database.transactions import AtomicStatements, is_busy, is_damage, transaction

LEASE = "INSERT INTO lease (name, holder, until_wall_time_s) VALUES (?, 'somebody', 0)"
COUNT = "SELECT count(*) FROM lease"


def test_a_transaction_stores_everything_or_nothing() -> None:
    with memory_connection() as connection:
        with transaction(connection):
            connection.execute(LEASE, ("a",))
        with pytest.raises(KeyError), transaction(connection):
            connection.execute(LEASE, ("b",))
            raise KeyError
        assert not connection.in_transaction
        assert connection.execute(COUNT).fetchone() == (1,)
        # What has ended the transaction itself is what is told.
        with pytest.raises(sqlite3.IntegrityError), transaction(connection):
            connection.execute(LEASE.replace("INSERT", "INSERT OR ROLLBACK"), ("a",))
        assert not connection.in_transaction


def test_a_transaction_beside_another_is_busy_and_runs_nothing(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with (
        closing(connect(file, "writer", create=True)) as first,
        closing(connect(file, "writer", patient=False)) as second,
        transaction(first),
        pytest.raises(sqlite3.OperationalError) as refused,
        transaction(second),
    ):
        pytest.fail("two transactions wrote at once")
    assert is_busy(refused.value)
    assert not is_damage(refused.value)


@pytest.mark.skipif(sys.platform == "win32", reason="a timer that interrupts, of POSIX")
def test_a_signal_is_handled_while_the_lock_is_waited_for(tmp_path: Path) -> None:
    with (
        closing(connect(tmp_path / "x.db", "writer", create=True)) as holder,
        closing(connect(tmp_path / "x.db", "writer")) as connection,
    ):
        create_schema(holder)
        connection.execute("PRAGMA busy_timeout=2000")
        holder.execute("BEGIN IMMEDIATE")

        def release(_number: int, _frame: object) -> None:
            holder.execute("ROLLBACK")

        before = signal.signal(signal.SIGALRM, release)
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.05)
            with transaction(connection):
                connection.execute(LEASE, ("a",))
        finally:
            signal.signal(signal.SIGALRM, before)
        assert connection.execute("PRAGMA busy_timeout").fetchone() == (2000,)


def test_a_step_stores_everything_or_is_called_off_or_fails_and_stores_nothing() -> None:
    step = AtomicStatements(
        "take_two",
        ("one", "other"),
        LEASE.replace("?", "NEW.one"),
        LEASE.replace("?", "NEW.other"),
        unless="NEW.one = 'nobody'",
    )
    with memory_connection() as connection:
        assert step.run(connection, "a", "b")
        assert not step.run(connection, "nobody", "c")
        with pytest.raises(sqlite3.IntegrityError, match="UNIQUE"):
            step.run(connection, "d", "a")
        assert step.run(connection, "e", "f")
        assert connection.execute(COUNT).fetchone() == (4,)
        assert not connection.in_transaction


def test_a_file_that_is_no_database_is_damage_and_not_busy(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    file.write_bytes(b"something else entirely, and locked " * 100)
    with pytest.raises(sqlite3.DatabaseError) as refused:
        connect(file, "writer", create=True)
    assert is_damage(refused.value)
    assert not is_busy(refused.value)


def test_a_reader_writes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
    with closing(connect(file, "reader")) as reader:
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            reader.execute(LEASE, ("a",))
        assert reader.execute(COUNT).fetchone() == (0,)


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
def test_what_is_made_is_its_owners_alone_and_what_was_there_keeps_its_mode(tmp_path: Path) -> None:
    file = tmp_path / "project" / "mcp_data" / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        made = [file.with_name(f"{file.name}{suffix}") for suffix in ("", "-wal", "-shm")]
        assert [stat.S_IMODE(each.stat().st_mode) for each in made] == [0o600] * 3
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    shared = tmp_path / "shared"
    shared.mkdir(mode=0o755)
    (shared / "webots.db").touch(mode=0o644)
    with closing(connect(shared / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
    assert stat.S_IMODE(shared.stat().st_mode) == 0o755
    assert stat.S_IMODE((shared / "webots.db").stat().st_mode) == 0o644
