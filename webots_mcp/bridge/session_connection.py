"""The connection on which a session records: opening, checking and closing it."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar

from webots_mcp.bridge.connection_lock import BETWEEN_TRIES_S
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.log_watch import LogWatch
from webots_mcp.bridge.opening import open_session, why_readers_block
from webots_mcp.bridge.registration import (
    Registration,
    deregister,
    describe_robot,
    describe_session,
)
from webots_mcp.bridge.run import Run
from webots_mcp.connection import identify_files, is_busy
from webots_mcp.contract import Database, new_uuid
from webots_mcp.waiting_file import STATEMENTS, Kind, Values, bind

Result = TypeVar("Result")

_PATIENCE_S: Final = 0.001  # how long to wait for another writer, whose commit takes 50 us
_RUN_ID: Final = "SELECT id FROM run WHERE uuid = ?"
_GO_ON: Final = "UPDATE run SET end_reason = NULL, ended_wall_time_s = NULL WHERE id = ?"

_of_parents: list[sqlite3.Connection | None] = []


class SessionConnection:
    """A connection to the database and the ids to record under; both None while it is not open.

    Attributes:
        run: The run that is being recorded.
        actions: Docstrings of the registered custom actions, by name.
        new_database_entries: Called when a new database is begun. Each returns the entries that
            it needs to know the session: kind, whether it belongs to the run, and values.
    """

    def __init__(
        self, database: Database, identity: Identity, run: Run, errors: ErrorReport
    ) -> None:
        self.database = database
        self.uuid = new_uuid()
        self.run = run
        self.actions: dict[str, str] = {}
        self.new_database_entries: list[Callable[[], Iterable[tuple[Kind, bool, Values]]]] = []
        self.connection: sqlite3.Connection | None = None
        self.registration: Registration | None = None
        self._identity = identity
        self._errors = errors
        self._files: tuple[int, ...] = ()
        self._log_watch: LogWatch | None = None

    @property
    def opened(self) -> tuple[sqlite3.Connection, Registration]:
        """Connection and ids, for a caller that knows that it is open."""
        assert self.connection is not None
        assert self.registration is not None
        return self.connection, self.registration

    def open(self, *, patient: bool) -> None:
        """Open or create the database, and enter or continue the session.

        Raises:
            DatabaseError, sqlite3.Error, OSError: As `open_session`.
        """
        session = (self._identity, self.uuid, self.actions_text())
        self.connection, self.registration = open_session(self.database, *session, patient=patient)
        self._files = identify_files(self.database)
        if isinstance(self.database, Path):
            self._log_watch = LogWatch(f"{self.database}-wal")
        if (why := why_readers_block(self.connection)) is not None:
            self._errors.warn("journal", f"{self.database} {why}")

    def close(self) -> None:
        """Close the connection; the session's row stays as it is."""
        if self.registration is not None:
            deregister(self.registration.session_id)
        connection, self.connection, self.registration = self.connection, None, None
        if connection is not None:
            connection.close()

    def abandon(self) -> None:
        """In a forked child: the connection belongs to the parent."""
        # Kept for ever, so that it is never closed: SQLite forbids any use after a fork.
        _of_parents.append(self.connection)
        self.connection = self.registration = None

    def find_fault(self) -> str | None:
        """Why written rows would be lost: deleted files still accept them. None if all is well."""
        if self._files != identify_files(self.database):
            return "the database file or its write-ahead log was deleted or replaced"
        if self._log_watch is not None and not self._log_watch.is_whole():
            return "the database's write-ahead log was truncated"
        return None

    def execute(self, statement: str, values: Values) -> int:
        """Run a statement, trying again for a moment while another writer has the lock."""
        connection = self.connection
        assert connection is not None
        try:
            return connection.execute(statement, values).rowcount
        except sqlite3.OperationalError as error:
            if not is_busy(error):
                raise
        return patiently(lambda: connection.execute(statement, values).rowcount)

    def enter_run(self, run: Run) -> None:
        """Write the run's row, or continue the existing one."""
        connection, registration = self.opened
        values = bind(None, registration.session_id, run.describe(self._identity))
        entered = self.execute(STATEMENTS["run"], values)
        ((run_id,),) = connection.execute(_RUN_ID, (run.uuid,)).fetchall()
        if not entered and run is self.run:
            self.execute(_GO_ON, (run_id,))
        run.id = run_id

    def describe_run(self, run: Run) -> dict[str, Any]:
        """The values of a run's own row."""
        return run.describe(self._identity)

    def describe_session(self) -> dict[str, Any]:
        """The values of robot and session, for a database that does not have this session."""
        name = self.registration.robot_name if self.registration else self._identity.robot_name
        return {
            "robot": describe_robot(self._identity, name),
            "session": describe_session(self._identity, self.uuid, self.actions_text()),
        }

    def actions_text(self) -> str:
        """The custom actions as the session's row has them: JSON."""
        return json.dumps(self.actions, ensure_ascii=False)


def patiently(act: Callable[[], Result]) -> Result:
    """Call `act`, and again for a millisecond while another writer has the lock."""
    until_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return act()
        except sqlite3.OperationalError as error:
            if not is_busy(error) or time.monotonic() >= until_s:
                raise
        time.sleep(BETWEEN_TRIES_S)
