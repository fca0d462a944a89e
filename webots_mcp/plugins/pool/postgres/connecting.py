"""Connections to PostgreSQL, and its errors as ours: what is wrong, and whether to try again."""

from __future__ import annotations

import re
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final, TypeAlias

import psycopg

from webots_mcp.errors import PoolError, PoolUnavailableError

Connection: TypeAlias = "psycopg.Connection[tuple[Any, ...]]"

# A server that went away is noticed within a minute, on both sides.
_CLIENT: Final[dict[str, Any]] = {
    "connect_timeout": 10, "keepalives_idle": 30, "keepalives_interval": 10, "keepalives_count": 3,
    "tcp_user_timeout": 60_000, "client_encoding": "UTF8",
}  # fmt: skip
_SERVER: Final = """
    SET tcp_keepalives_idle = 30; SET tcp_keepalives_interval = 10; SET tcp_keepalives_count = 3;
    SET idle_in_transaction_session_timeout = '60s'; SET lock_timeout = '30s';
    SET synchronous_commit = on"""
# What is said of a connection that is not made for reasons that last.
_LASTING: Final = re.compile(
    "password|authentication|does not exist|permission denied|pg_hba|certificate|"
    "definition of service|invalid|not allowed|no encryption",
    re.IGNORECASE,
)
# Classes of SQLSTATE, and some of their members, after which the same may succeed.
_PASSING: Final = ("08", "40", "53", "57", "58", "55P03", "25P03", "XX")
_PRIVILEGE: Final = "42501"
_READ_ONLY: Final = "25006"
_FULL: Final = "53100"


def connect(url: str, address: str, *, autocommit: bool = True) -> Connection:
    """Connect to the database of a URL; libpq looks for passwords where it always does.

    Raises:
        PoolUnavailableError: Nobody answers.
        PoolError: Who answers does not let us in.
    """
    connection = _connected(url, address)
    if isinstance(connection, PoolError):
        raise connection
    with clear_errors(address):
        connection.execute(_SERVER.encode())
    connection.autocommit = autocommit
    return connection


def _connected(url: str, address: str) -> Connection | PoolError:
    """A connection, or why there is none.

    That is not raised here, as psycopg's error would go with it, which holds the password.
    """
    try:
        return psycopg.connect(
            url, autocommit=True, fallback_application_name="webots-mcp", **_CLIENT
        )
    except psycopg.Error as error:
        return _refusal(error, address)


def _refusal(error: psycopg.Error, address: str) -> PoolError:
    said = one_line(str(error))
    asked = error.pgconn
    if asked is not None and asked.needs_password:
        return PoolError(
            f"{address} asks for a password: give it in PGPASSWORD, ~/.pgpass or a service file"
        )
    if isinstance(error, psycopg.ProgrammingError) or _LASTING.search(said):
        return PoolError(f"{address} refuses the connection: {said}")
    return PoolUnavailableError(f"{address} does not answer: {said}")


@contextmanager
def clear_errors(address: str) -> Generator[None]:
    """Inside the block, errors of PostgreSQL are ours; their texts hold no values of rows."""
    try:
        yield
    except psycopg.Error as error:
        raise told(error, address) from None


def told(error: psycopg.Error, address: str) -> PoolError:
    """An error of PostgreSQL as ours."""
    state = error.sqlstate or ""
    said = one_line(error.diag.message_primary or str(error))
    if state == _PRIVILEGE:
        return PoolError(f"{address} forbids it: {said}; see docs/pool.md for what to grant")
    if state == _READ_ONLY:
        return PoolError(
            f"{address} is read-only ({said}): a standby, or a database or role that is set so; "
            "give the URL of the primary, and a role that may write"
        )
    if state == _FULL:
        return PoolUnavailableError(f"the disk of {address} is full: {said}")
    if state.startswith(_PASSING) or _is_lost(error, state):
        return PoolUnavailableError(f"{address} could not do it now: {said}")
    return PoolError(f"{address} refused it: {said}")


def _is_lost(error: psycopg.Error, state: str) -> bool:
    """Whether the connection ended, which has no SQLSTATE."""
    return not state and isinstance(error, psycopg.OperationalError)


def one_line(text: str) -> str:
    """A text without line breaks, and without the advice for beginners that libpq indents."""
    lines = (line for line in text.splitlines() if not line.startswith("\t"))
    return " ".join(" ".join(lines).split())
