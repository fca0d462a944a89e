"""The write path: when `record` returns, the row survives the process, however that ends.

One recorded row is one statement and so one short transaction into the write-ahead log: a
controller that is killed the next instant loses nothing. The control loop hardly waits: where
another writer holds the lock for longer than a millisecond, the disk is full, or the database is
read-only or missing, the row goes into a file of the session next to the database, and into memory
only where that fails too. Waiting rows are written, in order, with the next call, or by the next
process that opens the database. Beyond the limits of the backlog the oldest rows in memory are
dropped, and so is a row that the database will never accept; dropped rows are counted, and reported
as an event as soon as one can be written.

A KeyboardInterrupt may come between any two lines, and nothing here relies on the lines after it: a
statement is either written or not, the next call rolls back an open transaction, waiting rows are
recognised by their number, and the connection lock is free when the call that took it has ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from webots_mcp.bridge.backlog import Backlog, Row
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.connection_lock import ConnectionLock, this_call
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.recovery import Recovery
from webots_mcp.bridge.row_counts import RowCounts
from webots_mcp.bridge.row_writer import RowWriter
from webots_mcp.bridge.run import Run
from webots_mcp.bridge.session_connection import SessionConnection, patiently
from webots_mcp.connection import in_transaction
from webots_mcp.contract import Database
from webots_mcp.liveness import LoopStatus, RecordingStatus, write_heartbeat
from webots_mcp.signal_register import Seen
from webots_mcp.waiting_file import Kind, Values, WaitingFile, waiting_path

_LOCK_PATIENCE_S: Final = 0.001  # how long to wait for another thread of this process

Result = TypeVar("Result")


class Recorder:
    """All writes and reads of a session.

    The loop's thread, the maintainer's and all threads that log share the connection, one at a
    time.

    Attributes:
        session: The connection, the session and the current run.
        counts: Rows that were written and dropped.
        errors: Receives each failure.
    """

    def __init__(
        self, database: Database, identity: Identity, clock: Clock, errors: ErrorReport
    ) -> None:
        self.errors = errors
        self.counts = RowCounts(errors)
        self.session = SessionConnection(database, identity, clock.run, errors)
        self.last_use_s = time.monotonic()
        self._lock = ConnectionLock()
        self._backlog = Backlog(self._waiting_file(), self.session.describe_run, self.counts)
        parts = (self.session, self._backlog)
        self._recovery = Recovery(*parts, self.counts, self.errors, clock)
        self._writer = RowWriter(*parts, self._recovery, self.counts, clock)
        self._recovery.open(patient=True)

    @property
    def rows_waiting(self) -> int:
        """Rows that the database could not take yet."""
        return self._backlog.rows

    @property
    def rows_in_memory(self) -> int:
        """Of those that wait, the ones that a killed process would lose."""
        return self._backlog.rows_in_memory

    # -- rows ----------------------------------------------------------------------------------

    def record(self, kind: Kind, run: Run | None, values: Values) -> int | None:
        """Write a row now, or keep it until it can be written.

        Args:
            kind: What is written.
            run: The run that the row belongs to; its id may not be known yet.
            values: The values of the statement, see `entries.STATEMENTS`.

        Returns:
            How many rows the statement changed, or None where it was deferred.
        """
        self.last_use_s = time.monotonic()
        if not self._lock.acquire(this_call(), _LOCK_PATIENCE_S):
            self._backlog.put(Row(kind, run, values))
            return None
        try:
            return self._writer.write(kind, run, values)
        except BaseException:
            if run is not None:
                run.counted = False  # an interrupt may have come between the row and its count
            raise
        finally:
            self._lock.release()

    def record_together(self, kind: Kind, run: Run, rows: Sequence[tuple[Any, ...]]) -> None:
        """Write rows of one kind in one transaction, or keep them until they can be written."""
        self.last_use_s = time.monotonic()
        if not self._lock.acquire(this_call(), _LOCK_PATIENCE_S):
            for values in rows:
                self._backlog.put(Row(kind, run, values))
            return
        try:
            self._writer.write_together(kind, run, rows)
        finally:
            self._lock.release()

    def fetch(self, statement: str, values: Values) -> Sequence[Any] | None:
        """The rows that a statement reads or returns; None while that is not possible."""
        if self.session.connection is None:
            return None
        return self._locked(lambda: self._writer.fetch(statement, values))

    def enter_signals(self, seen: Mapping[str, Seen]) -> bool:
        """Enter names into the register of signals; False where that has to wait."""
        if self._backlog.waits or self.session.connection is None:
            return False
        return self._locked(lambda: self._writer.enter_signals(seen)) is True

    def flush(self) -> bool:
        """Write waiting rows, for as long as one call may; True if none are left."""
        return self._locked(lambda: self._writer.catch_up(None)) is True

    def _locked(self, act: Callable[[], Result]) -> Result | None:
        """Call `act` with the connection lock; None where another thread has it, or it fails."""
        if not self._lock.acquire(this_call()):
            return None
        try:
            return act()
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._recovery.put_off(error)
            return None
        finally:
            self._lock.release()

    # -- the session ---------------------------------------------------------------------------

    def beat(self, loop: LoopStatus) -> None:
        """Write a heartbeat. Skipped while rows wait: a late heartbeat would be misleading."""
        self._locked(lambda: self._beat(loop))

    def _beat(self, loop: LoopStatus) -> None:
        self._recovery.look_after_files()
        run = self.session.run
        if not self._writer.is_ready(run):
            return
        connection, registration = self.session.opened
        status = RecordingStatus(self.rows_waiting, self.counts.dropped, self.errors.last_error)
        ids = (registration.session_id, run.id, run.rows)
        patiently(
            lambda: in_transaction(
                connection, lambda: write_heartbeat(connection, loop, status, *ids)
            )
        )

    def update_actions(self) -> None:
        """Store the names and docstrings of the registered custom actions."""
        if self.session.registration is not None:
            self.record("actions", None, {"actions": self.session.actions_text()})

    def end_run(self, reason: str, sim_time_s: float) -> None:
        """End the current run, at the simulation time that was seen last."""
        run = self.session.run
        # The count is given only where it is certain; else the statement counts the rows itself.
        rows = run.rows if run.counted and not self._backlog.waits else None
        values = {"reason": reason, "now": time.time(), "sim_time": sim_time_s, "rows": rows}
        self.record("run end", run, values)

    def end(self, reason: str, sim_time_s: float) -> None:
        """End run and session; what is recorded until `close` still belongs to them."""
        self.end_run(reason, sim_time_s)
        times = {"now": time.time(), "monotonic": time.monotonic()}
        status = {"dropped": self.counts.dropped, "error": self.errors.last_error}
        self.record("session end", None, {"reason": reason, **times, **status})

    def close(self, reason: str, sim_time_s: float) -> None:
        """End run and session, write the waiting rows (for up to a second), and disconnect."""
        if self._recovery.off is None:
            self.end(reason, sim_time_s)
        until_s = time.monotonic() + 1
        while not self.flush() and self.session.connection and time.monotonic() < until_s:
            time.sleep(0.005)
        self._lock.acquire(this_call(), 1.0)
        try:
            self.session.close()
            self._leave_waiting()
            self._recovery.off = self._recovery.off or "the bridge is closed"
        finally:
            self._lock.release()

    def abandon(self) -> None:
        """In a forked child: leave connection and session to the parent, which continues."""
        self.session.abandon()
        self._lock = ConnectionLock()  # the thread that may have had it was not forked
        self._backlog.abandon()
        self._recovery.off = "a forked process does not record for its parent"

    # -- waiting rows --------------------------------------------------------------------------

    def _waiting_file(self) -> WaitingFile | None:
        """The file for waiting rows; None for a database in memory, which no process outlives."""
        if not isinstance(self.session.database, Path):
            return None
        path = waiting_path(self.session.database, self.session.uuid)
        return WaitingFile(path, self.session.describe_session)

    def _leave_waiting(self) -> None:
        """Leave the rows in the file for the next process; drop those that are only in memory."""
        why = self._backlog.why
        self._backlog.save()
        self._backlog.drop_rows_in_memory(why)
        rows = self.rows_waiting
        if (path := self._backlog.close()) is not None:
            self.errors.warn(
                "waiting",
                f"{rows} rows are still in {path}, because {why}; the next bridge or server that "
                "opens the database adds them to it",
            )
