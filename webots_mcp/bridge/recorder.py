"""The write path: when `record` returns, the row is in the database, or kept and counted.

One recorded row is one short transaction into the write-ahead log: a controller that is killed
the next instant loses nothing. The control loop never waits: where another writer holds the lock
at that moment, the row is kept and written, in order, with the next call. So is a row that meets
a full disk, a read-only or a vanished file; those are tried again once a second. Beyond
`MAX_WAITING_ROWS` or `MAX_WAITING_BYTES` the oldest are dropped, counted, and told as an event as
soon as one can be written.
"""

from __future__ import annotations

import json
import os
import sqlite3
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.opening import is_damage, is_ours, open_session
from webots_mcp.bridge.registration import Registration, deregister
from webots_mcp.bridge.run import Run
from webots_mcp.connection import journal_mode
from webots_mcp.contract import Database, MemoryDatabase
from webots_mcp.errors import (
    DatabaseError,
    ForeignDatabaseError,
    SchemaTooNewError,
    SchemaTooOldError,
)

MAX_WAITING_ROWS: Final = 10_000
MAX_WAITING_BYTES: Final = 16_000_000
_ROWS_PER_FLUSH: Final = 500  # about 5 ms: a loop that catches up must not stall over it
_RETRY_INTERVAL_S: Final = 1.0

INSERT_STATE: Final = (
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data, odd) VALUES (?, ?, ?, ?, ?)"
)
INSERT_EVENT: Final = (
    "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name, data) "
    "VALUES (?, ?, ?, ?, ?, ?)"
)
_INSERT_RUN: Final = (
    "INSERT INTO run (session_id, robot_id, world, basic_time_step_ms, start_reason, "
    "started_wall_time_s, started_sim_time_s, last_wall_time_s, last_sim_time_s) "
    "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
)
_END_RUN: Final = (
    "UPDATE run SET end_reason = :reason, ended_wall_time_s = :now, last_wall_time_s = :now, "
    "last_sim_time_s = :sim_time, rows = :rows WHERE id = :run"
)
_BEAT_SESSION: Final = (
    "UPDATE session SET last_seen_wall_time_s = ?, last_poll_wall_time_s = ?, "
    "moved_wall_time_s = ?, sim_time_s = ?, hold = ?, rows_waiting = ?, rows_dropped = ?, "
    "last_error = ? WHERE id = ?"
)
_BEAT_RUN: Final = "UPDATE run SET last_wall_time_s = ?, last_sim_time_s = ?, rows = ? WHERE id = ?"
_END_SESSION: Final = (
    "UPDATE session SET ended_wall_time_s = ?, last_seen_wall_time_s = ?, end_reason = ?, "
    "hold = NULL, rows_waiting = 0, rows_dropped = ?, last_error = ? WHERE id = ?"
)


Values = tuple[Any, ...] | dict[str, Any]


class Pulse(NamedTuple):
    """What a heartbeat says of the loop."""

    sim_time_s: float
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    hold: str | None


class _Row(NamedTuple):
    statement: str
    run: Run | None
    values: Values


class Recorder:
    """One connection, one session, and the rows that could not be written yet."""

    def __init__(self, database: Database, identity: Identity, run: Run, *, strict: bool) -> None:
        self._database = database
        self._identity = identity
        self._strict = strict
        self._waiting: deque[_Row] = deque()
        self._waiting_bytes = 0
        self._unreported_drops = 0
        self._lock = threading.Lock()
        self._said: set[str] = set()
        self._file: tuple[int, int] | None = None
        self._retry_at_s = 0.0
        self._off: str | None = None
        self.run = run
        self.connection: sqlite3.Connection | None = None
        self.registration: Registration | None = None
        self.actions: dict[str, str] = {}
        self.rows_written = 0
        self.rows_dropped = 0
        self.last_error: str | None = None
        self.last_use_s = time.monotonic()
        self._open(patient=True)

    # -- writing -------------------------------------------------------------------------------

    def record(self, statement: str, run: Run | None, values: Values) -> int | None:
        """Write a row now, or keep it for the next call.

        Args:
            statement: An INSERT or UPDATE; if `run` is given, the run's id is its first
                parameter, or the one named `run`.
            run: The run that the row belongs to; its id may not be known yet.
            values: The other parameters, in order or by name.

        Returns:
            How many rows the statement changed, or None where it was put off.
        """
        self.last_use_s = time.monotonic()
        if self._off is not None:
            self.rows_dropped += 1
            return None
        connection = self.connection
        if connection is None or self._waiting or (run is not None and run.id is None):
            self._keep(_Row(statement, run, values))
            return 1 if self.flush() else None
        try:
            changed = connection.execute(statement, _bind(run, values)).rowcount
        except sqlite3.Error as error:
            self._keep(_Row(statement, run, values))
            self._put_off(error)
            return None
        self.rows_written += 1
        return changed

    def flush(self) -> bool:
        """Write what is waiting, as much as one call may; True if nothing waits any more."""
        if time.monotonic() < self._retry_at_s or not self._lock.acquire(blocking=False):
            return False
        try:
            if self.connection is not None or self._open(patient=False):
                self._drain()
        except sqlite3.Error as error:
            self._put_off(error)
        finally:
            self._lock.release()
        return not self._waiting

    @property
    def rows_waiting(self) -> int:
        """Rows kept in memory until the database can take them."""
        return len(self._waiting)

    def _keep(self, row: _Row) -> None:
        self._waiting.append(row)
        self._waiting_bytes += _weight(row)
        while len(self._waiting) > MAX_WAITING_ROWS or self._waiting_bytes > MAX_WAITING_BYTES:
            self._drop(self._waiting.popleft())

    def _drop(self, row: _Row) -> None:
        self._waiting_bytes -= _weight(row)
        self.rows_dropped += 1
        self._unreported_drops += 1
        self.complain("dropped", f"rows are being dropped: {self.last_error or 'buffer full'}")

    def _drain(self) -> None:
        """Write the oldest rows in one transaction, in order; they are forgotten after it."""
        assert self.connection is not None
        batch = [self._waiting[i] for i in range(min(len(self._waiting), _ROWS_PER_FLUSH))]
        fresh = [row.run for row in batch if row.run is not None and row.run.id is None]
        self.connection.execute("BEGIN IMMEDIATE")
        try:
            for row in batch:
                self._write(self.connection, row)
            self._tell_drops(self.connection)
            self.connection.execute("COMMIT")
        except BaseException:
            for run in fresh:
                run.id = None
            _roll_back(self.connection)
            raise
        self._unreported_drops = 0
        self.rows_written += len(batch)
        for row in batch:
            self._waiting.popleft()
            self._waiting_bytes -= _weight(row)

    def _write(self, connection: sqlite3.Connection, row: _Row) -> None:
        if row.run is not None and row.run.id is None:
            self._insert_run(connection, row.run)
        connection.execute(row.statement, _bind(row.run, row.values))

    def _insert_run(self, connection: sqlite3.Connection, run: Run) -> None:
        assert self.registration is not None
        begun = (run.started_wall_time_s, run.started_sim_time_s)
        where = (self._identity.world, self._identity.basic_time_step_ms, run.start_reason)
        owner = (self.registration.session_id, self.registration.robot_id)
        run.id = connection.execute(_INSERT_RUN, (*owner, *where, *begun, *begun)).lastrowid

    def _tell_drops(self, connection: sqlite3.Connection) -> None:
        if not self._unreported_drops:
            return
        if self.run.id is None:
            self._insert_run(connection, self.run)
        data = json.dumps({"rows": self._unreported_drops, "why": self.last_error})
        now = (self.run.started_sim_time_s, time.time())
        connection.execute(INSERT_EVENT, (self.run.id, *now, "dropped", None, data))

    # -- heartbeat and end ---------------------------------------------------------------------

    def beat(self, pulse: Pulse) -> None:
        """Say that the loop is alive. Skipped while rows wait: a late heartbeat tells nothing."""
        self._look_after_file()
        if self._waiting and not self.flush():
            return
        if self.connection is None or self.registration is None or self.run.id is None:
            return
        now = time.time()
        session = (now, pulse.last_poll_wall_time_s, pulse.moved_wall_time_s, pulse.sim_time_s)
        health = (pulse.hold, self.rows_waiting, self.rows_dropped, self.last_error)
        try:
            self.connection.execute("BEGIN IMMEDIATE")
            self.connection.execute(
                _BEAT_SESSION, (*session, *health, self.registration.session_id)
            )
            beat_run = (now, pulse.sim_time_s, self.run.rows, self.run.id)
            self.connection.execute(_BEAT_RUN, beat_run)
            self.connection.execute("COMMIT")
        except sqlite3.Error as error:
            _roll_back(self.connection)
            self._put_off(error)

    def update_actions(self) -> None:
        """Publish the names and docstrings of the registered custom actions."""
        if self.registration is not None:
            text = json.dumps(self.actions, ensure_ascii=False)
            values = (text, self.registration.session_id)
            self.record("UPDATE session SET actions = ? WHERE id = ?", None, values)

    def end_run(self, reason: str, sim_time_s: float) -> None:
        """The current run is over, as of the simulation time that was seen last."""
        times = {"now": time.time(), "sim_time": sim_time_s}
        self.record(_END_RUN, self.run, {"reason": reason, **times, "rows": self.run.rows})

    def close(self, reason: str, sim_time_s: float) -> None:
        """Write what waits (trying for up to a second), end run and session, close the file."""
        now = time.time()
        self.end_run(reason, sim_time_s)
        if self.registration is not None:
            health = (self.rows_dropped, self.last_error)
            values = (now, now, reason, *health, self.registration.session_id)
            self.record(_END_SESSION, None, values)
        deadline_s = time.monotonic() + 1
        while not self.flush() and self.connection is not None and time.monotonic() < deadline_s:
            time.sleep(0.005)
        self._disconnect()
        self._off = "closed"

    # -- trouble -------------------------------------------------------------------------------

    def complain(self, kind: str, text: str) -> None:
        """Remember what went wrong; say it on stderr once a kind; raise in strict mode."""
        self.last_error = text
        if kind not in self._said:
            self._said.add(kind)
            print(f"webots-mcp: {text}", file=sys.stderr, flush=True)  # noqa: T201
        if self._strict:
            raise DatabaseError(text)

    def _put_off(self, error: sqlite3.Error) -> None:
        """Decide how a failed write goes on: at once, in a second, or with a new file."""
        text = str(error)
        if "locked" in text:
            return  # another writer, this instant: the next call tries again
        self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
        if is_damage(text):
            self._move_aside(text)
        elif "no such table" in text or "FOREIGN KEY" in text:
            self._start_over(f"the database lost this session ({text})")
        else:
            self.complain(text, f"not recorded yet, trying again each second: {text}")

    def _look_after_file(self) -> None:
        """A deleted or replaced file still takes rows, which nobody would ever see."""
        if self.connection is None or self._file is None or self._file == self._identify_file():
            return
        self._start_over("the database file was deleted or replaced")

    def _identify_file(self) -> tuple[int, int] | None:
        if isinstance(self._database, MemoryDatabase):
            return None
        try:
            status = os.stat(self._database)  # noqa: PTH116  (a heartbeat: no Path objects)
        except OSError:
            return (0, 0)
        return status.st_dev, status.st_ino

    def _move_aside(self, why: str) -> None:
        """Keep a damaged file, with its log and index, under another name; begin a new one."""
        assert isinstance(self._database, Path)
        self._disconnect()
        stamp = time.strftime("%Y%m%d-%H%M%S")
        try:
            for suffix in ("", "-wal", "-shm"):
                damaged = self._database.with_name(self._database.name + suffix)
                if damaged.exists():
                    damaged.rename(f"{self._database}.damaged-{stamp}{suffix}")
        except OSError as error:
            self.complain("damaged", f"{self._database} is damaged and cannot be moved: {error}")
            return
        self._start_over(f"{self._database} was damaged ({why}) and moved aside")

    def _start_over(self, why: str) -> None:
        """Record into a database that knows nothing of this session yet."""
        self._disconnect()
        for row in self._waiting:
            if row.run is not None:
                row.run.id = None
        self.run.id = None
        self._retry_at_s = 0.0
        data = json.dumps({"why": why})
        now = (self.run.started_sim_time_s, time.time())
        self._waiting.appendleft(_Row(INSERT_EVENT, self.run, (*now, "storage", None, data)))
        self._waiting_bytes += _weight(self._waiting[0])
        self.complain("storage", f"{why}; recording goes on in a new database")

    def _disconnect(self) -> None:
        if self.registration is not None:
            deregister(self.registration.session_id)
        if self.connection is not None:
            self.connection.close()
        self.connection = None
        self.registration = None

    # -- opening -------------------------------------------------------------------------------

    def _open(self, *, patient: bool) -> bool:
        """Open (or make) the database and enter a session; False, and said, where it fails."""
        if self._off is not None:
            return False
        try:
            self._enter(patient)
        except (ForeignDatabaseError, SchemaTooNewError, SchemaTooOldError) as error:
            self._off = str(error)
            self.complain("off", f"not recording into {self._database}: {error}")
        except (DatabaseError, sqlite3.Error, OSError) as error:
            self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
            if is_damage(str(error)):
                return self._replace_damaged(str(error))
            if "locked" not in str(error):
                self.complain(f"open {type(error).__name__}", f"not recording yet: {error}")
        return self.connection is not None

    def _enter(self, patient: bool) -> None:
        actions = json.dumps(self.actions, ensure_ascii=False)
        opened = open_session(self._database, self._identity, actions, patient=patient)
        self.connection, self.registration = opened
        self._file = self._identify_file()
        mode = journal_mode(self.connection)
        if mode not in ("wal", "memory"):
            self.complain(
                "journal",
                f"{self._database} lies where SQLite cannot share memory (journal mode {mode}: a "
                "network drive, or across Windows and WSL): readers will make rows wait",
            )

    def _replace_damaged(self, why: str) -> bool:
        """A damaged database, or a file of our name, is moved aside; any other file is not ours."""
        if is_ours(self._database):
            self._move_aside(why)
            return self.connection is None and self._retry_at_s == 0 and self._open(patient=False)
        self._off = why
        self.complain("off", f"not recording into {self._database}: {why}; choose another file")
        return False


def _bind(run: Run | None, values: Values) -> Values:
    if run is None:
        return values
    return (run.id, *values) if isinstance(values, tuple) else {"run": run.id, **values}


def _weight(row: _Row) -> int:
    """About the bytes that a waiting row holds: its texts."""
    values = row.values if isinstance(row.values, tuple) else row.values.values()
    return 200 + sum(len(value) for value in values if isinstance(value, str))


def _roll_back(connection: sqlite3.Connection) -> None:
    if connection.in_transaction:
        connection.execute("ROLLBACK")
