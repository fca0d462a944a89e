"""The write path: when `record` returns, the row survives the process, however that ends.

One recorded row is one statement and so one short transaction into the write-ahead log: a
controller that is killed the next instant loses nothing. The control loop hardly waits: where
another writer holds the lock for longer than a millisecond, the disk is full, or the database is
read-only or missing, the row goes into a file of the session next to the database, and into memory
only where that fails too (`backlog`). Waiting rows are written, in order, with the next call, or by
the next process that opens the database. Beyond the limits of the backlog the oldest rows in memory
are dropped, and so is a row that the database will never accept; dropped rows are counted, and
reported as an event as soon as one can be written.

A KeyboardInterrupt may come between any two lines, and no promise depends on the lines after it. A
statement is either written or not, the next call rolls back an open transaction, waiting rows are
recognised by their number, and the connection lock is free once the call that took it has ended.
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
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.registration import (
    Identity,
    Registration,
    deregister,
    describe_robot,
    describe_session,
    register,
)
from webots_mcp.bridge.simulation import Clock, CurrentRun
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.database.connection import connect, identify_files, journal_mode
from webots_mcp.database.heartbeat import NO_TIMES, LoopStatus, RecordingStatus, write_heartbeat
from webots_mcp.database.location import Database
from webots_mcp.database.schema import create_schema, require_current, schema_version
from webots_mcp.database.transactions import (
    FAILURES,
    in_transaction,
    is_busy,
    is_damage,
    never_wait,
    roll_back,
    text_of,
)
from webots_mcp.database.waiting_file import (
    STATEMENTS,
    Kind,
    Values,
    WaitingFile,
    adopt,
    bind,
    ingest,
    is_unfit,
    waiting_path,
)
from webots_mcp.errors import (
    ForeignDatabaseError,
    ForkedProcessError,
    SchemaTooNewError,
    SchemaTooOldError,
    SessionGoneError,
)
from webots_mcp.signals.register import Seen, find_changes, write_changes

_CLOSED: Final = "the bridge is closed"
# Windows may sleep for 15 ms where less was asked for.
_BETWEEN_TRIES_S: Final = 0.0 if sys.platform == "win32" else 0.0001
_INSERT_STATE: Final = STATEMENTS["state"]
_GO_ON: Final = "UPDATE run SET end_reason = NULL, ended_wall_time_s = NULL WHERE id = ?"

# Errors that no later attempt can resolve.
_FOR_GOOD: Final = (
    ForeignDatabaseError, ForkedProcessError, SchemaTooNewError, SchemaTooOldError,
)  # fmt: skip

_LOST: Final = ("no such table", "FOREIGN KEY")  # in SQLite's error if a table or a row was removed

Result = TypeVar("Result")

_of_parents: list[sqlite3.Connection | None] = []
_HOLDER: Final = "holder"


class RecorderPatience(NamedTuple):
    """How long a call of the recorder may wait, in seconds.

    Attributes:
        lock_s: For another thread of this process.
        writer_s: For another writer, whose commit takes 50 us.
        catch_up_s: For writing waiting rows in one call, which must not delay the loop.
        retry_s: Between two attempts after an error.
    """

    lock_s: float = 0.001
    writer_s: float = 0.001
    catch_up_s: float = 0.002
    retry_s: float = 1.0


_PATIENCE: Final = RecorderPatience()


class Recorder:
    """All writes and reads of a session.

    The loop's thread, the maintainer's and all threads that log share the connection, one at a
    time.

    Attributes:
        errors: Receives each failure.
        uuid: Of the session.
        run: The run that is being recorded.
        actions: Docstrings of the registered custom actions, by name.
        new_database_entries: Called when a new database is begun. Each returns the entries that
            it needs to know the session: kind, whether it belongs to the run, and values.
        connection: None while the database is not open.
        registration: The ids to record under; None while the database is not open.
        off: Why recording has ended for good; None while it has not.
        rows_written: Rows that the database took.
    """

    def __init__(
        self, database: Database, identity: Identity, clock: Clock, errors: ErrorReport
    ) -> None:
        self.database = database
        self.errors = errors
        self.uuid = new_uuid()
        self.run = clock.run
        self.actions: dict[str, str] = {}
        self.new_database_entries: list[Callable[[], Iterable[tuple[Kind, bool, Values]]]] = []
        self.connection: sqlite3.Connection | None = None
        self.registration: Registration | None = None
        self.off: str | None = None
        self._closing: int | None = None  # the thread that closes, or has closed
        self.rows_written = 0
        self._dropped: dict[int, int] = {}  # by thread: each counts its own
        self.last_use_s = time.monotonic()
        self._identity = identity
        self._clock = clock
        self._lock = ConnectionLock()
        self._backlog = Backlog(self._waiting_file(), self.describe_run, self._drop)
        self._files: tuple[int, ...] = ()
        self._retry_at_s = 0.0
        self._confirmed = 0  # rows that were written when the files were checked
        self._reported_dropped = 0  # by events in the database
        self._unreported = False  # there are dropped rows that none reports yet
        self._why_dropped = ""
        self._open(patient=True)

    @property
    def rows_waiting(self) -> int:
        """Rows that the database could not take yet."""
        return self._backlog.rows

    @property
    def rows_dropped(self) -> int:
        """Rows that will never be in the database."""
        return sum(tuple(self._dropped.values()))

    @property
    def rows_in_memory(self) -> int:
        """Of those that wait, the ones that a killed process would lose."""
        return self._backlog.rows_in_memory

    # -- rows ----------------------------------------------------------------------------------

    def record(self, kind: Kind, run: CurrentRun | None, values: Values) -> int | None:
        """Write a row now, or keep it until it can be written.

        Args:
            kind: What is written.
            run: The run that the row belongs to; its id may not be known yet.
            values: The values of the statement, see `waiting_file.STATEMENTS`.

        Returns:
            How many rows the statement changed, or None where it was deferred.
        """
        self.last_use_s = time.monotonic()
        if self._closing is not None and self._closing != get_ident():
            self._drop(1, _CLOSED)
            return None
        if not self._lock.acquire(this_call(), _PATIENCE.lock_s):
            self._put(Row(kind, run, values))
            return None
        try:
            connection = self.connection
            if (  # the usual case, in this call: each further one would slow the loop down
                kind == "state"
                and run is not None
                and run.id is not None
                and connection is not None
                and not self._backlog.waits
                and not connection.in_transaction
                and not self._unreported
            ):
                try:
                    connection.execute(_INSERT_STATE, (run.id, *values))
                except Exception:  # noqa: BLE001  (written again, and reported where it fails)
                    return self._write(kind, run, values)
                self.rows_written += 1
                run.rows += 1
                return 1
            return self._write(kind, run, values)
        except BaseException:
            if run is not None:
                run.counted = False  # an interrupt may have come between the row and its count
            raise
        finally:
            self._lock.release()

    def record_together(self, kind: Kind, run: CurrentRun, rows: Sequence[tuple[Any, ...]]) -> None:
        """Write rows of one kind in one transaction, or keep them until they can be written."""
        self.last_use_s = time.monotonic()
        if not self._lock.acquire(this_call(), _PATIENCE.lock_s):
            for values in rows:
                self._put(Row(kind, run, values))
            return
        try:
            if not self._write_together(kind, run, rows):
                for values in rows:
                    self._write(kind, run, values)
        finally:
            self._lock.release()

    def fetch(self, statement: str, values: Values) -> Sequence[Any] | None:
        """Return the rows that a statement reads or returns; None while that is not possible."""
        if self.connection is None:
            return None
        return self._locked(lambda: self._fetch(statement, values))

    def enter_signals(self, seen: Mapping[str, Seen]) -> bool:
        """Enter names into the register of signals; False where that has to wait."""
        if self._backlog.waits or self.connection is None:
            return False
        return self._locked(lambda: self._enter_signals(seen)) is True

    def flush(self) -> bool:
        """Write waiting rows, for as long as one call may; True if none are left."""
        return self._locked(lambda: self._catch_up(None)) is True

    def _locked(self, act: Callable[[], Result]) -> Result | None:
        """Call `act` with the connection lock; None where another thread has it, or it fails."""
        if self._closing is not None and self._closing != get_ident():
            return None
        if not self._lock.acquire(this_call()):
            return None
        try:
            return act()
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._put_off(error)
            return None
        finally:
            self._lock.release()

    # -- the session ---------------------------------------------------------------------------

    def beat(self, loop: LoopStatus) -> None:
        """Write a heartbeat. Skipped while rows wait: a late heartbeat would be misleading."""
        self._locked(lambda: self._beat(loop))

    def update_actions(self) -> None:
        """Store the names and docstrings of the registered custom actions."""
        if self.registration is not None:
            self.record("actions", None, {"actions": self._actions_text()})

    def end_run(self, reason: str, sim_time_s: float) -> None:
        """End the current run, at the simulation time that was seen last."""
        run = self.run
        # The count is given only where it is certain; else the statement counts the rows itself.
        rows = run.rows if run.counted and not self._backlog.waits else None
        values = {"reason": reason, "now": time.time(), "sim_time": sim_time_s, "rows": rows}
        times = self._clock.meter.times or NO_TIMES
        values |= dict(zip(("own", "step_wait", "steps"), times, strict=True))
        self.record("run end", run, values)

    def end(self, reason: str, sim_time_s: float) -> None:
        """End run and session; what is recorded until `close` still belongs to them."""
        self.end_run(reason, sim_time_s)
        times = {"now": time.time(), "monotonic": time.monotonic()}
        status = {"dropped": self.rows_dropped, "error": self.errors.last_error}
        self.record("session end", None, {"reason": reason, **times, **status})

    def close(self, reason: str, sim_time_s: float) -> None:
        """End run and session, write the waiting rows (for up to a second), and disconnect.

        Rows that other threads record from now on are dropped. A connection that one of them still
        uses after a second is left open: SQLite forbids to close it meanwhile.
        """
        self._closing = get_ident()
        self._locked(self._check_files)  # what went into a deleted file is counted as dropped
        if self.off is None:
            self.end(reason, sim_time_s)
        until_s = time.monotonic() + 1
        while not self.flush() and self.connection and time.monotonic() < until_s:
            time.sleep(0.005)
        is_free = self._lock.acquire(this_call(), 1.0)
        try:
            if is_free:
                self._disconnect()
            self._leave_waiting()
            self.off = self.off or _CLOSED
            self._backlog.drop_rows_in_memory(self.off)  # that a thread has put since
        finally:
            if is_free:
                self._lock.release()

    def abandon(self) -> None:
        """Leave connection and session of a forked child to the parent, which continues."""
        # Kept for ever, so that it is never closed: SQLite forbids any use after a fork.
        _of_parents.append(self.connection)
        self.connection = self.registration = None
        self._lock = ConnectionLock()  # the thread that may have had it was not forked
        self._backlog.abandon()
        self.off = "a forked process does not record for its parent"

    def run_uuid(self) -> str:
        """Return the identity of the run that is under way."""
        return self.run.uuid

    def describe_run(self, run: CurrentRun) -> dict[str, Any]:
        """Return the values of a run's own row."""
        return {
            "uuid": run.uuid,
            "world": self._identity.world,
            "step_ms": self._identity.basic_time_step_ms,
            "reason": run.start_reason,
            "wall_time": run.started_wall_time_s,
            "sim_time": run.started_sim_time_s,
        }

    # -- writing: the caller has the connection lock -------------------------------------------

    def _write(self, kind: Kind, run: CurrentRun | None, values: Values) -> int | None:
        """Write a row; return how many rows the statement changed, or None if it was deferred."""
        if not self._is_ready(run):
            self._keep(Row(kind, run, values))
            return None
        bound = bind(run.id if run else None, self._ids.session_id, values)
        try:
            changed = self._execute(STATEMENTS[kind], bound)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            if is_unfit(error):
                self._drop(1, str(error))
            else:
                self._keep(Row(kind, run, values))
                self._put_off(error)
            return None
        self.rows_written += 1
        if kind == "state" and run is not None:
            run.rows += 1
        return changed

    def _write_together(self, kind: Kind, run: CurrentRun, rows: Sequence[tuple[Any, ...]]) -> bool:
        """Write rows in one transaction; False if it fails: then they are written one by one."""
        if not self._is_ready(run):
            return False
        bound = [bind(run.id, self._ids.session_id, values) for values in rows]
        try:
            self._transact(lambda: self._opened.executemany(STATEMENTS[kind], bound))
        except Exception:  # noqa: BLE001  (see `is_busy`)
            return False
        self.rows_written += len(rows)
        return True

    def _fetch(self, statement: str, values: Values) -> Sequence[Any] | None:
        if not self._is_ready(None):
            return None
        # All rows are fetched: an UPDATE ... RETURNING keeps the write lock until its last row.
        return self._opened.execute(statement, values).fetchall()

    def _enter_signals(self, seen: Mapping[str, Seen]) -> bool:
        """Enter names; what fails for another reason than a lock is entered by the maintainer."""
        if not self._is_ready(None):
            return False
        connection, robot_id = self._opened, self._ids.robot_id
        try:
            changes = find_changes(connection, robot_id, seen)
            if changes.new or changes.changed:
                self._transact(partial(write_changes, connection, robot_id, changes))
        except FAILURES as error:
            return not is_busy(error)
        return True

    def _beat(self, loop: LoopStatus) -> None:
        self._check_files()
        run = self.run
        if self._is_ready(run):
            status = RecordingStatus(self.rows_waiting, self.rows_dropped, self.errors.last_error)
            ids = (self._ids.session_id, run.id, run.rows)
            self._transact(partial(write_heartbeat, self._opened, loop, status, *ids))

    def _is_ready(self, run: CurrentRun | None) -> bool:
        """Write what precedes a new row of that run; return whether all of it is written."""
        connection = self.connection
        if (
            connection is None
            or self._backlog.waits
            or connection.in_transaction
            or (run is not None and run.id is None)
            or self._unreported
        ):
            return self._catch_up(run)
        return True

    def _catch_up(self, run: CurrentRun | None) -> bool:
        """Write the waiting rows and the run's own row; False where some are still waiting."""
        if not self._is_connected():
            return False
        roll_back(self._opened)  # an interrupt may have left a transaction open
        try:
            self._take_in_waiting()
            if run is not None and run.id is None and not self._backlog.waits:
                self._enter_run(run)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.save()
            self._put_off(error)
            return False
        if self._unreported and not self._backlog.waits:
            self._report_dropped()
        return not self._backlog.waits

    def _take_in_waiting(self) -> None:
        until_s, run = time.monotonic() + _PATIENCE.catch_up_s, self.run
        while self._backlog.waits and (entries := self._backlog.next_entries()):
            taken = ingest(self._opened, self._ids.session_id, entries)
            self._backlog.forget(taken.number)
            self.rows_written += sum(entry.kind != "run" for entry in taken.written)
            run.rows += sum(e.kind == "state" and e.run == run.uuid for e in taken.written)
            for why in taken.unfit:
                self._drop(1, why)
            if time.monotonic() > until_s:
                break

    def _enter_run(self, run: CurrentRun) -> None:
        """Write the run's row, or continue the existing one."""
        values = bind(None, self._ids.session_id, self.describe_run(run))
        entered = self._execute(STATEMENTS["run"], values)
        statement = "SELECT id FROM run WHERE uuid = ?"
        ((run_id,),) = self._opened.execute(statement, (run.uuid,)).fetchall()
        if not entered and run is self.run:
            self._execute(_GO_ON, (run_id,))
        run.id = run_id

    def _execute(self, statement: str, values: Values) -> int:
        """Run a statement, trying again for a moment while another writer has the lock."""
        connection = self._opened
        try:
            return connection.execute(statement, values).rowcount
        except sqlite3.OperationalError as error:
            if not is_busy(error):
                raise
        return _patiently(lambda: connection.execute(statement, values).rowcount)

    def _transact(self, act: Callable[[], object]) -> None:
        _patiently(lambda: in_transaction(self._opened, act))

    # -- rows that wait or are dropped ---------------------------------------------------------

    def _put(self, row: Row) -> None:
        """Let a row wait in memory, without the connection lock."""
        self._backlog.put(row)
        if self.off is not None:  # the bridge was closed meanwhile, and no other call checks it
            self._backlog.drop_rows_in_memory(self.off)

    def _keep(self, row: Row) -> None:
        if self.off is not None:
            self._drop(1, self.off)
        else:
            self._backlog.keep(row)

    def _drop(self, rows: int, why: str) -> None:
        """Count rows as dropped, and warn; raises in strict mode."""
        mine = get_ident()
        self._dropped[mine] = self._dropped.get(mine, 0) + rows
        self._unreported = True
        self._why_dropped = why
        self.errors.warn(f"dropped: {why}", f"rows are being dropped: {why}")

    def _report_dropped(self) -> None:
        """Record an event that reports the unreported drops."""
        self._unreported = False
        rows = self.rows_dropped - self._reported_dropped
        self._reported_dropped += rows
        now, data = self._clock.newest_s(self.run), {"row_count": rows, "why": self._why_dropped}
        values = (now, time.time(), "dropped", None, json.dumps(data))
        self._write("event", self.run, values)

    def _waiting_file(self) -> WaitingFile | None:
        """Return the file for waiting rows; None for a database in memory, which ends with us."""
        if not isinstance(self.database, Path):
            return None
        return WaitingFile(waiting_path(self.database, self.uuid), self._describe_session)

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

    # -- the connection ------------------------------------------------------------------------

    @property
    def _opened(self) -> sqlite3.Connection:
        """The connection, for a caller that knows that it is open."""
        assert self.connection is not None
        return self.connection

    @property
    def _ids(self) -> Registration:
        assert self.registration is not None
        return self.registration

    def _is_connected(self) -> bool:
        """Return whether a write may be tried; try to open a closed database once a second."""
        if self.off is not None or time.monotonic() < self._retry_at_s:
            return False
        return self.connection is not None or self._open(patient=False)

    def _open(self, *, patient: bool) -> bool:
        """Open (or create) the database and enter a session; False, with a warning, on failure."""
        if self.off is not None:
            return False
        try:
            self._connect(patient=patient)
        except _FOR_GOOD as error:
            self._give_up(str(error))
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.why = why = text_of(error)
            self._retry_at_s = time.monotonic() + _PATIENCE.retry_s
            if is_damage(error):
                return self._replace_damaged(why)
            if not is_busy(error):
                self.errors.warn(f"open {type(error).__name__}", f"not recording yet: {why}")
        return self.connection is not None

    def _connect(self, *, patient: bool) -> None:
        """Open the database, and enter or continue the session; `patient`: wait for locks.

        Raises:
            DatabaseError, sqlite3.Error, OSError: It cannot be used, at least now.
        """
        connection = connect(self.database, "loop", create=True, patient=patient)
        try:
            if schema_version(connection) == 0:
                create_schema(connection)
            require_current(connection)
            if patient and isinstance(self.database, Path):  # in the loop it takes too long
                adopt(connection, self.database)
            session = (self._identity, self.uuid, self._actions_text())
            registration = register(connection, *session)
            never_wait(connection)
        except BaseException:
            connection.close()
            raise
        self.connection, self.registration = connection, registration
        self._files = identify_files(self.database)
        if (mode := journal_mode(connection)) not in ("wal", "memory"):
            self.errors.warn(
                "journal",
                f"{self.database} is on a drive where SQLite cannot share memory (journal mode "
                f"{mode}: a network drive, or across Windows and WSL): rows will wait while others "
                "read; use a local data folder",
            )

    def _disconnect(self) -> None:
        """Close the connection; the session's row stays as it is."""
        if self.registration is not None:
            deregister(self.registration.session_id)
        connection, self.connection, self.registration = self.connection, None, None
        if connection is not None:
            connection.close()

    def _describe_session(self) -> dict[str, Any]:
        """Return the values of robot and session, for a database without this session."""
        name = self.registration.robot_name if self.registration else self._identity.robot_name
        return {
            "robot": describe_robot(self._identity, name),
            "session": describe_session(self._identity, self.uuid, self._actions_text()),
        }

    def _actions_text(self) -> str:
        return json.dumps(self.actions, ensure_ascii=False)

    # -- after a failure -----------------------------------------------------------------------

    def _put_off(self, error: Exception) -> None:
        """Decide how to continue after a failed write: at once, in a second, or in a new file."""
        self._backlog.why = text = text_of(error)
        if is_busy(error):
            return  # another writer has the lock for the moment: the next call tries again
        self._retry_at_s = time.monotonic() + _PATIENCE.retry_s
        if is_damage(error):
            self._replace_files(text)
        elif (
            isinstance(error, SessionGoneError) or "no such table" in text or "FOREIGN KEY" in text
        ):
            self._start_over(f"the database lost this session ({text})")
        else:
            self.errors.warn(text, f"not recorded yet, trying again each second: {text}")

    def _check_files(self) -> None:
        """Start over if the database was deleted: its open file would still accept rows."""
        if self.connection is None:
            return
        if self._files != identify_files(self.database):
            self._start_over("the database file or its write-ahead log was deleted or replaced")
        else:
            self._confirmed = self.rows_written

    def _replace_damaged(self, why: str) -> bool:
        """Move a damaged database aside if it has our name or the header of a database.

        SQLite's error text shows whether it has that header. Reading the file ourselves is not
        safe: closing it would drop the locks of this process on it, which a maintainer's or another
        bridge's connection may need (SQLite, How To Corrupt, 2.2).
        """
        database = self.database
        if not isinstance(database, Path) or (
            database.name != DATABASE_NAME and "not a database" in why
        ):
            self._give_up(f"{why}; choose another file")
            return False
        self._replace_files(why)
        return self._retry_at_s == 0 and self._open(patient=False)

    def _replace_files(self, why: str) -> None:
        """Rename a damaged database with its log and index, and begin a new one."""
        database = self.database
        assert isinstance(database, Path)
        self._disconnect()
        stamp = time.strftime("%Y%m%d-%H%M%S")
        try:
            for suffix in ("", "-wal", "-shm"):
                damaged = database.with_name(database.name + suffix)
                if damaged.exists():
                    damaged.rename(f"{database}.damaged-{stamp}{suffix}")
        except OSError as error:
            why = f"{database} is damaged and cannot be renamed: {error}; move it away by hand"
            self.errors.warn("damaged", why)
            return
        self._start_over(f"{database} was damaged ({why}) and moved aside")

    def _start_over(self, why: str) -> None:
        """Continue in a new database, which does not have this session yet."""
        self._disconnect()
        self._retry_at_s = 0.0
        run, before = self.run, self.run.uuid
        run.begin_anew()
        self._backlog.rename_run(before, run.uuid)
        moment = (self._clock.newest_s(run), time.time())
        self._backlog.keep(Row("event", run, (*moment, "storage", None, json.dumps({"why": why}))))
        entries = [each for make in self.new_database_entries for each in make()]
        for kind, of_run, values in entries:
            self._backlog.keep(Row(kind, run if of_run else None, values))
        lost, self.rows_written = self.rows_written - self._confirmed, self._confirmed
        if lost:
            self._drop(lost, why)
        self.errors.warn("storage", f"{why}; recording continues in a new database")

    def _give_up(self, why: str) -> None:
        self.off = f"not recording into {self.database}: {why}"
        self.errors.warn("off", self.off)
        self._backlog.drop_rows_in_memory(self.off)


def _patiently(act: Callable[[], Result]) -> Result:
    """Call `act`, and again for a millisecond while another writer has the lock."""
    until_s = time.monotonic() + _PATIENCE.writer_s
    while True:
        try:
            return act()
        except sqlite3.OperationalError as error:
            if not is_busy(error) or time.monotonic() >= until_s:
                raise
        time.sleep(_BETWEEN_TRIES_S)


# -- the connection lock -----------------------------------------------------------------------

this_call: Final = sys._getframe  # pyright: ignore[reportPrivateUsage]


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
        """Try to take the lock; return whether `call` has it now, and has to call `release`.

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
                time.sleep(_BETWEEN_TRIES_S)
            held = self._held.setdefault(_HOLDER, mine)
        return True


def _is_under_way(call: FrameType) -> bool:
    """Return whether a call is still executing: then Python refuses to clear its frame."""
    try:
        call.clear()
    except RuntimeError:
        return True
    return False
