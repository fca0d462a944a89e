"""Transactions, and what errors of SQLite mean."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.memory import memory_connection
from webots_mcp.connection import connect, is_busy, is_damage, transaction

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


def test_an_error_that_ended_the_transaction_itself_is_the_one_that_is_told() -> None:
    with memory_connection() as connection:
        connection.execute(LEASE, ("a",))
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


def test_a_file_that_is_no_database_is_damage_and_not_busy(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    file.write_bytes(b"something else entirely, and locked " * 100)
    with pytest.raises(sqlite3.DatabaseError) as refused:
        connect(file, "writer", create=True)
    assert is_damage(refused.value)
    assert not is_busy(refused.value)
