"""Connections to PostgreSQL, and its errors as those of a pool."""

from __future__ import annotations

import re
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final, TypeAlias

import psycopg

from webots_mcp.errors import PoolError, PoolUnavailableError

Connection: TypeAlias = "psycopg.Connection[tuple[Any, ...]]"
# Both sides notice within a minute that the other one has disappeared.
_CLIENT: Final[dict[str, Any]] = {
    "connect_timeout": 10, "keepalives_idle": 30, "keepalives_interval": 10, "keepalives_count": 3,
    "tcp_user_timeout": 60_000, "client_encoding": "UTF8",
    "fallback_application_name": "webots-mcp",
}  # fmt: skip
_SERVER: Final = """
    SET tcp_keepalives_idle = 30; SET tcp_keepalives_interval = 10; SET tcp_keepalives_count = 3;
    SET idle_in_transaction_session_timeout = '60s'; SET lock_timeout = '30s';
    SET synchronous_commit = on"""
# Words in errors of a connection that fails for a lasting reason.
_LASTING: Final = re.compile(
    "password|authentication|does not exist|permission denied|pg_hba|certificate|"
    "definition of service|invalid|not allowed|no encryption",
    re.IGNORECASE,
)


def connect(url: str, address: str) -> Connection:
    """Connect to the database of a URL. libpq finds passwords in its usual places.

    Raises:
        PoolUnavailableError: The server does not answer.
        PoolError: The server refuses the connection.
    """
    connection = _connected(url, address)
    if isinstance(connection, PoolError):
        raise connection
    with clear_errors(address):
        connection.execute(_SERVER.encode())
    return connection


def _connected(url: str, address: str) -> Connection | PoolError:
    """Return a connection, or the error.

    The error is not raised here, because psycopg's error, which contains the password, would become
    its context.
    """
    try:
        return psycopg.connect(url, autocommit=True, **_CLIENT)
    except psycopg.Error as error:
        said = one_line(str(error))
        if error.pgconn is not None and error.pgconn.needs_password:
            return PoolError(
                f"{address} asks for a password: give it in PGPASSWORD, ~/.pgpass or a service file"
            )
        if isinstance(error, psycopg.ProgrammingError) or _LASTING.search(said):
            return PoolError(f"{address} refuses the connection: {said}")
        return PoolUnavailableError(f"{address} does not answer: {said}")


@contextmanager
def clear_errors(address: str) -> Generator[None]:
    """Convert errors of PostgreSQL within the block to PoolError, without values of rows."""
    try:
        yield
    except psycopg.Error as error:
        raise _explained(error, address) from None


def _explained(error: psycopg.Error, address: str) -> PoolError:
    state = error.sqlstate or ""
    said = one_line(error.diag.message_primary or str(error))
    is_lost = not state and isinstance(error, psycopg.OperationalError)  # The connection was lost.
    if state == "42501":  # insufficient_privilege
        return PoolError(
            f"{address} forbids it: {said}; see 'webots-mcp help pool' for what to grant"
        )
    # The table or the function exists already.
    if state in ("42P07", "42723"):
        return PoolError(
            f"{address} holds tables of something else that are called as those of a pool ({said}):"
            " give a database of its own, or a schema of its own by "
            "'?options=-csearch_path%3DNAME' in the URL"
        )
    # A retry may succeed after errors with these SQLSTATEs or in these classes.
    if state.startswith(("08", "40", "53", "57", "58", "55P03", "25P03", "XX")) or is_lost:
        return PoolUnavailableError(f"{address} could not do it now: {said}")
    return PoolError(f"{address} refused it: {said}")


def one_line(text: str) -> str:
    """Return a text in one line, without the advice that libpq indents."""
    lines = (line for line in text.splitlines() if not line.startswith("\t"))
    return " ".join(" ".join(lines).split())
