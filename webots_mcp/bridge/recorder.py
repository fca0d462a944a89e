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

import json
import sqlite3
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from threading import get_ident
from types import FrameType
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.bridge.backlog import Backlog, Row
from webots_mcp.bridge.error_report import ErrorReport, RowCounts
from webots_mcp.bridge.registration import (
    Identity,
    Registration,
    deregister,
    describe_robot,
    describe_session,
    register,
)
from webots_mcp.bridge.simulation import Clock, Run
from webots_mcp.connection import connect, identify_files, journal_mode
from webots_mcp.contract import DATABASE_NAME, Database, MemoryDatabase, new_uuid
from webots_mcp.entries import STATEMENTS, Kind, Values, bind
from webots_mcp.errors import (
    ForeignDatabaseError,
    ForkedProcessError,
    SchemaTooNewError,
    SchemaTooOldError,
    SessionGoneError,
)
from webots_mcp.liveness import LoopStatus, RecordingStatus, write_heartbeat
from webots_mcp.schema import create_schema, require_current, schema_version
from webots_mcp.signal_register import Seen, find_changes, write_changes
from webots_mcp.transactions import (
    FAILURES,
    in_transaction,
    is_busy,
    is_damage,
    never_wait,
    roll_back,
    text_of,
)
from webots_mcp.waiting_file import Taken, WaitingFile, adopt, is_unfit, take_in, waiting_path

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


_CATCH_UP_S: Final = 0.002  # per call: writing waiting rows must not stall the loop


class RowWriter:
    """Writes a row, or lets it wait. The caller must have the connection lock."""

    def __init__(
        self,
        session: SessionConnection,
        backlog: Backlog,
        recovery: Recovery,
        counts: RowCounts,
        clock: Clock,
    ) -> None:
        self._session = session
        self._backlog = backlog
        self._recovery = recovery
        self._counts = counts
        self._clock = clock

    def write(self, kind: Kind, run: Run | None, values: Values) -> int | None:
        """Write a row; returns how many rows the statement changed, or None if it was deferred."""
        session = self._session
        if self._is_behind(run) and not self.catch_up(run):
            self._keep(Row(kind, run, values))
            return None
        assert session.registration is not None
        bound = bind(run.id if run else None, session.registration.session_id, values)
        try:
            changed = session.execute(STATEMENTS[kind], bound)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._write_failed(Row(kind, run, values), error)
            return None
        self._counts.written += 1
        if kind == "state" and run is not None:
            run.rows += 1
        return changed

    def write_together(self, kind: Kind, run: Run, rows: Sequence[tuple[Any, ...]]) -> None:
        """Write rows of a run in one transaction; one by one where that fails."""
        if self._is_behind(run) and not self.catch_up(run):
            for values in rows:
                self._keep(Row(kind, run, values))
            return
        connection, registration = self._session.opened
        bound = [bind(run.id, registration.session_id, values) for values in rows]
        try:
            patiently(
                lambda: in_transaction(
                    connection, lambda: connection.executemany(STATEMENTS[kind], bound)
                )
            )
        except Exception:  # noqa: BLE001  (written one by one, each row fails by itself)
            for values in rows:
                self.write(kind, run, values)
            return
        self._counts.written += len(rows)

    def enter_signals(self, seen: Mapping[str, Seen]) -> bool:
        """Enter names into the register of signals; False where another writer has the lock.

        What fails for another reason is left to the maintainer.
        """
        if not self.is_ready(None):
            return False
        connection, registration = self._session.opened
        robot_id = registration.robot_id
        try:
            changes = find_changes(connection, robot_id, seen)
            if changes.new or changes.changed:
                write = partial(write_changes, connection, robot_id, changes)
                patiently(lambda: in_transaction(connection, write))
        except FAILURES as error:
            return not is_busy(error)
        return True

    def fetch(self, statement: str, values: Values) -> Sequence[Any] | None:
        """The rows that a statement reads or returns; None while waiting rows come first."""
        if not self.is_ready(None):
            return None
        connection, _ = self._session.opened
        # All rows are fetched: an UPDATE ... RETURNING keeps the write lock until its last row.
        return connection.execute(statement, values).fetchall()

    def is_ready(self, run: Run | None) -> bool:
        """Whether all rows that precede a new row of that run are written; tries to write them."""
        return not self._is_behind(run) or self.catch_up(run)

    def catch_up(self, run: Run | None) -> bool:
        """Write the waiting rows and the run's own row; False where some are still waiting."""
        if not self._recovery.is_connected():
            return False
        connection, _ = self._session.opened
        roll_back(connection)  # an interrupt may have left a transaction open
        try:
            self._take_in_waiting()
            if run is not None and run.id is None and not self._backlog.waits:
                self._session.enter_run(run)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.save()
            self._recovery.put_off(error)
            return False
        if self._backlog.waits:
            return False
        self._report_dropped()
        return not self._backlog.waits

    def _is_behind(self, run: Run | None) -> bool:
        connection = self._session.connection
        return (
            connection is None
            or self._backlog.waits
            or connection.in_transaction
            or (run is not None and run.id is None)
            or self._counts.unreported > 0
        )

    def _write_failed(self, row: Row, error: Exception) -> None:
        if is_unfit(error):
            self._counts.drop(1, str(error))
        else:
            self._keep(row)
            self._recovery.put_off(error)

    def _keep(self, row: Row) -> None:
        if self._recovery.off is not None:
            self._counts.drop(1, self._recovery.off)
        else:
            self._backlog.keep(row)

    def _take_in_waiting(self) -> None:
        connection, registration = self._session.opened
        until_s = time.monotonic() + _CATCH_UP_S
        while self._backlog.waits and (entries := self._backlog.next_entries()):
            taken = take_in(connection, registration.session_id, entries)
            self._backlog.forget(taken.number)
            self._count(taken)
            if time.monotonic() > until_s:
                break

    def _count(self, taken: Taken) -> None:
        run = self._session.run
        self._counts.written += sum(entry.kind != "run" for entry in taken.written)
        run.rows += sum(e.kind == "state" and e.run == run.uuid for e in taken.written)
        for why in taken.unfit:
            self._counts.drop(1, why)

    def _report_dropped(self) -> None:
        if self._counts.unreported:
            run, text = self._session.run, self._counts.report()
            now = (self._clock.newest_s(run), time.time())
            self.write("event", run, (*now, "dropped", None, text))


_RETRY_INTERVAL_S: Final = 1.0

# Errors that no later attempt can resolve.
_FOR_GOOD: Final = (
    ForeignDatabaseError, ForkedProcessError, SchemaTooNewError, SchemaTooOldError,
)  # fmt: skip


class Recovery:
    """Opens the database, and opens it again after a failure.

    Attributes:
        off: Why recording has ended for good; None while it has not.
    """

    def __init__(
        self,
        session: SessionConnection,
        backlog: Backlog,
        counts: RowCounts,
        errors: ErrorReport,
        clock: Clock,
    ) -> None:
        self._session = session
        self._backlog = backlog
        self._counts = counts
        self._errors = errors
        self._clock = clock
        self._retry_at_s = 0.0
        self.off: str | None = None

    def open(self, *, patient: bool) -> bool:
        """Open (or create) the database and enter a session; False, with a warning, on failure."""
        if self.off is not None:
            return False
        try:
            self._session.open(patient=patient)
        except _FOR_GOOD as error:
            self._give_up(str(error))
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.why = why = text_of(error)
            self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
            if is_damage(error):
                return self._replace_damaged(why)
            if not is_busy(error):
                self._errors.warn(f"open {type(error).__name__}", f"not recording yet: {why}")
        return self._session.connection is not None

    def is_connected(self) -> bool:
        """Whether a write may be tried now; tries to open a closed database once a second."""
        if self.off is not None or time.monotonic() < self._retry_at_s:
            return False
        return self._session.connection is not None or self.open(patient=False)

    def put_off(self, error: Exception) -> None:
        """Decide how to continue after a failed write: at once, in a second, or in a new file."""
        self._backlog.why = text = text_of(error)
        if is_busy(error):
            return  # another writer has the lock for the moment: the next call tries again
        self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
        if is_damage(error):
            self._replace_files(text)
        elif isinstance(error, SessionGoneError) or _misses_rows(text):
            self._start_over(f"the database lost this session ({text})")
        else:
            self._errors.warn(text, f"not recorded yet, trying again each second: {text}")

    def look_after_files(self) -> None:
        """Start over where the files of the open connection were deleted, replaced or truncated."""
        if self._session.connection is None:
            return
        if (fault := self._session.find_fault()) is not None:
            self._start_over(fault)
        else:
            self._counts.confirm()

    def _replace_files(self, why: str) -> None:
        """Rename a damaged database, and begin a new one."""
        database = self._session.database
        assert isinstance(database, Path)
        self._session.close()
        try:
            move_aside(database)
        except OSError as error:
            why = f"{database} is damaged and cannot be renamed: {error}; move it away by hand"
            self._errors.warn("damaged", why)
            return
        self._start_over(f"{database} was damaged ({why}) and moved aside")

    def _start_over(self, why: str) -> None:
        """Continue in a new database, which does not have this session yet."""
        self._session.close()
        self._retry_at_s = 0.0
        run = self._session.run
        before = run.uuid
        run.begin_anew()
        self._backlog.rename_run(before, run.uuid)
        moment = (self._clock.newest_s(run), time.time())
        self._backlog.keep(Row("event", run, (*moment, "storage", None, json.dumps({"why": why}))))
        entries = [each for make in self._session.new_database_entries for each in make()]
        for kind, of_run, values in entries:
            self._backlog.keep(Row(kind, run if of_run else None, values))
        self._counts.drop_unconfirmed(why)
        self._errors.warn("storage", f"{why}; recording continues in a new database")

    def _replace_damaged(self, why: str) -> bool:
        """Move a damaged database aside; a file that is not ours is left alone."""
        if not is_ours(self._session.database, why):
            self._give_up(f"{why}; choose another file")
            return False
        self._replace_files(why)
        return self._retry_at_s == 0 and self.open(patient=False)

    def _give_up(self, why: str) -> None:
        self.off = f"not recording into {self._session.database}: {why}"
        self._errors.warn("off", self.off)
        self._backlog.drop_rows_in_memory(self.off)


def _misses_rows(text: str) -> bool:
    """Whether SQLite's error says that a table, or a row that is referred to, is missing."""
    return "no such table" in text or "FOREIGN KEY" in text


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


this_call: Final = sys._getframe  # pyright: ignore[reportPrivateUsage]
_HOLDER: Final = "holder"
# Windows may sleep for 15 ms where less was asked for.
BETWEEN_TRIES_S: Final = 0.0 if sys.platform == "win32" else 0.0001


class ConnectionLock:
    """A lock that belongs to a function call, and is free again when that call has ended.

    A KeyboardInterrupt may come between any two instructions, so also between a lock's `acquire()`
    and the `try` that would release it: a `threading.Lock` would then stay locked for ever. Here
    taking the lock and naming its holder is one instruction (`dict.setdefault`), and the lock of a
    call that has ended is taken over by the next call of the same thread.
    """

    def __init__(self) -> None:
        self._held: dict[str, tuple[int, FrameType]] = {}

    def acquire(self, call: FrameType, patience_s: float = 0.0) -> bool:
        """Whether `call` has the lock now; then `release` follows.

        Args:
            call: The frame that calls `release`.
            patience_s: How long to wait for another thread.
        """
        mine = (get_ident(), call)
        held = self._held.setdefault(_HOLDER, mine)
        return held is mine or self._acquire_later(held, mine, time.monotonic() + patience_s)

    def release(self) -> None:
        """Free the lock for another call."""
        self._held.pop(_HOLDER, None)

    def _acquire_later(
        self, held: tuple[int, FrameType], mine: tuple[int, FrameType], until_s: float
    ) -> bool:
        while held is not mine:
            if held[0] == mine[0]:
                if _is_under_way(held[1]):
                    return False  # made from within the holder, by a signal handler: never wait
                self._held.pop(_HOLDER)
            elif time.monotonic() >= until_s:
                return False
            else:
                time.sleep(BETWEEN_TRIES_S)
            held = self._held.setdefault(_HOLDER, mine)
        return True


def _is_under_way(call: FrameType) -> bool:
    """Whether a call is still executing: Python refuses to clear the frame of one that is."""
    try:
        call.clear()
    except RuntimeError:
        return True
    return False


# -- the write-ahead log ---------------------------------------------------------------------------
# Detecting that the write-ahead log was truncated under an open connection.  SQLite keeps the
# length of the log in shared memory, and continues to read and write beyond the end of a truncated
# file: the missing part reads as zeros, and what is written afterwards is lost when the database
# is opened next. The log's format: sqlite.org/fileformat2.html, section 4.


_HEADER_BYTES: Final = 32
_FRAME_HEADER_BYTES: Final = 24
_MAGIC: Final = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")


class _Log(NamedTuple):
    """A log as it was at one moment: the salts of its generation, and its last frame."""

    salts: bytes
    size: int
    frame: int
    frame_salts: bytes


class LogWatch:
    """Compares a log with its state at the last call; a checkpoint that empties it is no fault.

    Args:
        log: The file.
    """

    def __init__(self, log: str) -> None:
        self._log = log
        self._seen: _Log | None = None

    def is_whole(self) -> bool:
        """Whether the log was not truncated since the last call, as far as can be known.

        An empty log could be either; it is judged at the next call, when it has frames again.
        """
        before, self._seen = self._seen, None
        try:
            with open(self._log, "rb", buffering=0) as file:  # noqa: PTH123  (at each heartbeat)
                header = file.read(_HEADER_BYTES)
                if len(header) < _HEADER_BYTES:
                    return True
                if header[:4] not in _MAGIC:
                    return False
                salts, page_bytes = header[16:24], int.from_bytes(header[8:12], "big")
                size = file.seek(0, 2)
                if before is not None and before.salts == salts:
                    file.seek(before.frame + 8)
                    if size < before.size or file.read(8) != before.frame_salts:
                        return False
                frame_bytes = _FRAME_HEADER_BYTES + page_bytes
                frames = max(1, (size - _HEADER_BYTES) // frame_bytes)
                frame = _HEADER_BYTES + (frames - 1) * frame_bytes
                file.seek(frame + 8)
                frame_salts = file.read(8)
        except OSError:
            return True
        if frame_salts == salts:  # else the frame is left over from the previous generation
            self._seen = _Log(salts, size, frame, frame_salts)
        return True


# -- opening ---------------------------------------------------------------------------------------


def open_session(
    database: Database, identity: Identity, session_uuid: str, actions: str, *, patient: bool
) -> tuple[sqlite3.Connection, Registration]:
    """Open or create the database, and enter a session of this process.

    Args:
        database: Where to record.
        identity: The robot and the process.
        session_uuid: The session's UUID; a session that the database knows is continued.
        actions: The registered custom actions as JSON text.
        patient: Wait for locks: at the start, not in the loop.

    Returns:
        A connection that never waits for a lock, and the ids to record under.

    Raises:
        DatabaseError, sqlite3.Error, OSError: It cannot be used, at least now.
    """
    connection = connect(database, "loop", create=True, patient=patient)
    try:
        if schema_version(connection) == 0:
            create_schema(connection)
        require_current(connection)
        if patient and isinstance(database, Path):  # in the loop it takes too long
            adopt(connection, database)
        registration = register(connection, identity, session_uuid, actions)
        never_wait(connection)
    except BaseException:
        connection.close()
        raise
    return connection, registration


def why_readers_block(connection: sqlite3.Connection) -> str | None:
    """Why readers block the writer at the database's location; None where they do not."""
    mode = journal_mode(connection)
    if mode in ("wal", "memory"):
        return None
    return (
        f"is on a drive where SQLite cannot share memory (journal mode {mode}: a network drive, or "
        "across Windows and WSL): rows will wait while others read; use a local data folder"
    )


def move_aside(database: Path) -> None:
    """Give a damaged file, its log and its index another name.

    Raises:
        OSError: It cannot be moved.
    """
    stamp = time.strftime("%Y%m%d-%H%M%S")
    for suffix in ("", "-wal", "-shm"):
        damaged = database.with_name(database.name + suffix)
        if damaged.exists():
            damaged.rename(f"{database}.damaged-{stamp}{suffix}")


def is_ours(database: Database, why: str) -> bool:
    """Whether a damaged file may be moved aside: it has our name, or the header of a database.

    The header is judged by SQLite's error text. Closing a file that was read here would drop the
    locks of this process on it, on which a maintainer's or another bridge's connection may depend
    (SQLite, How To Corrupt, 2.2).
    """
    if isinstance(database, MemoryDatabase):
        return False
    return database.name == DATABASE_NAME or "not a database" not in why
