"""The write path: when `record` returns, the row is in the database, or kept and counted.

One recorded row is one short transaction into the write-ahead log: a controller that is killed
the next instant loses nothing. The control loop never waits: where another writer holds the lock
at that moment, the row is kept and written, in order, with the next call. So is a row that meets
a full disk, a read-only or a vanished file; those are tried again once a second. Beyond the limits
of the backlog the oldest are dropped, and so is a row that the database refuses whatever comes;
dropped rows are counted, and told as an event as soon as one can be written.
"""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from webots_mcp.bridge.backlog import Backlog, Row, Values, bind
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.drops import UNFIT, Drops, is_unfit
from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.opening import is_ours, move_aside, open_session, why_readers_block
from webots_mcp.bridge.pulse import END_RUN, END_SESSION, Health, Pulse, write_pulse
from webots_mcp.bridge.registration import Registration, deregister
from webots_mcp.bridge.run import INSERT_EVENT, INSERT_STATE, Run, insert_run
from webots_mcp.bridge.trouble import Trouble
from webots_mcp.connection import identify_files, is_busy, is_damage, transaction
from webots_mcp.contract import Database
from webots_mcp.errors import (
    DatabaseError,
    ForeignDatabaseError,
    SchemaTooNewError,
    SchemaTooOldError,
)

_ROWS_PER_FLUSH: Final = 500  # about 5 ms: a loop that catches up must not stall over it
_FLUSH_S: Final = 0.005  # beside busy threads each row may cost a turn of theirs
_RETRY_INTERVAL_S: Final = 1.0

_of_parents: list[sqlite3.Connection | None] = []


class Recorder:
    """One connection, one session, and the rows that could not be written yet.

    The loop's thread, the maintainer's and any that logs share the connection: whoever uses it
    holds the lock, and nobody waits for that either.
    """

    def __init__(
        self, database: Database, identity: Identity, clock: Clock, *, strict: bool
    ) -> None:
        self._database = database
        self._identity = identity
        self._clock = clock
        self.trouble = Trouble(strict=strict)
        self.drops = Drops(self.trouble)
        self._backlog = Backlog()
        self._lock = threading.Lock()
        self._obstacle = "too many wait"
        self._seen_whole = 0
        self._files: tuple[int, ...] = ()
        self._retry_at_s = 0.0
        self._off: str | None = None
        self.run = clock.run
        self.connection: sqlite3.Connection | None = None
        self.registration: Registration | None = None
        self.actions: dict[str, str] = {}
        self.rows_written = 0
        self.last_use_s = time.monotonic()
        self._open(patient=True)

    @property
    def rows_waiting(self) -> int:
        """Rows kept in memory until the database can take them."""
        return len(self._backlog.rows)

    def complain(self, kind: str, text: str) -> None:
        """Remember what went wrong; say it on stderr once a kind; raise in strict mode."""
        self.trouble.complain(kind, text)

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
        connection = self.connection
        if (
            connection is None
            or self._backlog.rows
            or (run is not None and run.id is None)
            or not self._lock.acquire(False)  # by name would take twice the time
        ):
            return self._keep(Row(statement, run, values))
        try:
            changed = connection.execute(statement, bind(run, values)).rowcount
            self.rows_written += 1
        except (sqlite3.Error, *UNFIT) as error:
            self._write_failed(Row(statement, run, values), error)
            return None
        finally:
            self._lock.release()
        return changed

    def fetch(self, statement: str, values: Values) -> Sequence[Any]:
        """The rows that a statement reads or changes; none while another thread writes.

        Raises:
            sqlite3.Error: It cannot be run, at least now.
        """
        if self.connection is None or not self._lock.acquire(blocking=False):
            return ()
        try:  # to the end: a RETURNING that is not read so far keeps the write lock
            return self.connection.execute(statement, values).fetchall()
        finally:
            self._lock.release()

    def flush(self) -> bool:
        """Write what is waiting, as much as one call may; True if nothing waits any more."""
        return self._exclusively(self._write_waiting) and not self._backlog.rows

    def _exclusively(self, act: Callable[[], None]) -> bool:
        """False, and nothing done, while another thread writes."""
        if not self._lock.acquire(blocking=False):
            return False
        try:
            act()
        except sqlite3.Error as error:
            self._put_off(error)
        finally:
            self._lock.release()
        return True

    def _keep(self, row: Row) -> int | None:
        if self._off is not None:
            self._drop(row, self._off)
            return None
        self._backlog.add(row)
        return 1 if self.flush() else None

    def _write_failed(self, row: Row, error: Exception) -> None:
        if is_unfit(error):
            self._drop(row, str(error))
        elif isinstance(error, sqlite3.Error):
            self._backlog.add(row)
            self._put_off(error)

    def _write_waiting(self) -> None:
        while self._backlog.is_over_limit():
            self._drop(self._backlog.remove_oldest(), self._obstacle)
        nothing = not self._backlog.rows and not self.drops.untold
        if nothing or time.monotonic() < self._retry_at_s:
            return
        if self.connection is not None or self._open(patient=False):
            self._drain()

    def _drain(self) -> None:
        """Write the oldest rows in one transaction, in order; they are forgotten after it."""
        assert self.connection is not None
        batch = self._backlog.oldest(_ROWS_PER_FLUSH)
        fresh = {row.run for row in batch if row.run is not None and row.run.id is None}
        try:
            with transaction(self.connection):
                unfit = self._write_batch(self.connection, batch)
                self._tell_drops(self.connection)
        except BaseException:
            for run in fresh:
                run.id = None
            raise
        self.drops.untold = 0
        self.rows_written += unfit.count(None)
        for why in unfit:
            row = self._backlog.remove_oldest()
            if why is not None:
                self._drop(row, why)

    def _write_batch(self, connection: sqlite3.Connection, batch: list[Row]) -> list[str | None]:
        """Of each row that there was time for, why it is never taken; None where it was."""
        until_s = time.monotonic() + _FLUSH_S
        unfit: list[str | None] = []
        for row in batch:
            unfit.append(self._write(connection, row))
            if time.monotonic() > until_s:
                break
        return unfit

    def _write(self, connection: sqlite3.Connection, row: Row) -> str | None:
        """Write the row; or why the database will never take it, which stops no other row."""
        try:
            if row.run is not None and row.run.id is None:
                self._insert_run(connection, row.run)
            connection.execute(row.statement, bind(row.run, row.values))
        except UNFIT as error:
            if not is_unfit(error):
                raise
            return str(error)
        return None

    def _insert_run(self, connection: sqlite3.Connection, run: Run) -> None:
        assert self.registration is not None
        insert_run(connection, run, self.registration, self._identity)

    # -- dropping ------------------------------------------------------------------------------

    def _drop(self, row: Row, why: str) -> None:
        if row.statement == INSERT_STATE and row.run is not None:
            row.run.rows -= 1
        self.drops.count(1, why)

    def _drop_waiting(self, why: str) -> None:
        while self._backlog.rows:
            self._drop(self._backlog.remove_oldest(), why)

    def _tell_drops(self, connection: sqlite3.Connection) -> None:
        if not self.drops.untold:
            return
        if self.run.id is None:
            self._insert_run(connection, self.run)
        now = (self._clock.newest_s(self.run), time.time())
        event = (self.run.id, *now, "dropped", None, self.drops.describe())
        connection.execute(INSERT_EVENT, event)

    # -- heartbeat and end ---------------------------------------------------------------------

    def beat(self, pulse: Pulse) -> None:
        """Say that the loop is alive. Skipped while rows wait: a late heartbeat tells nothing."""
        self._exclusively(self._look_after_files)
        if self._backlog.rows and not self.flush():
            return
        self._exclusively(lambda: self._beat(pulse))

    def _beat(self, pulse: Pulse) -> None:
        if self.connection is None or self.registration is None or self.run.id is None:
            return
        if self.drops.untold:
            self._drain()
        health = Health(self.rows_waiting, self.drops.rows, self.trouble.last_error)
        with transaction(self.connection):
            write_pulse(self.connection, pulse, health, self.registration.session_id, self.run)

    def update_actions(self) -> None:
        """Publish the names and docstrings of the registered custom actions."""
        if self.registration is not None:
            text = json.dumps(self.actions, ensure_ascii=False)
            values = (text, self.registration.session_id)
            self.record("UPDATE session SET actions = ? WHERE id = ?", None, values)

    def end_run(self, reason: str, sim_time_s: float) -> None:
        """The current run is over, as of the simulation time that was seen last."""
        times = {"now": time.time(), "sim_time": sim_time_s}
        self.record(END_RUN, self.run, {"reason": reason, **times})

    def end(self, reason: str, sim_time_s: float) -> None:
        """Run and session are over; what is recorded until `close` still belongs to them."""
        self.end_run(reason, sim_time_s)
        if self.registration is not None:
            now, health = time.time(), (self.drops.rows, self.trouble.last_error)
            times = (now, now, time.monotonic())
            values = (*times, reason, *health, self.registration.session_id)
            self.record(END_SESSION, None, values)

    def close(self, reason: str, sim_time_s: float) -> None:
        """Write what waits (trying for up to a second), end run and session, close the file."""
        self.end(reason, sim_time_s)
        deadline_s = time.monotonic() + 1
        while not self.flush() and self.connection is not None and time.monotonic() < deadline_s:
            time.sleep(0.005)
        with self._lock:
            self._disconnect()
            self._off = self._off or "the bridge is closed"
            self._drop_waiting(self._obstacle)

    def abandon(self) -> None:
        """In a forked child: connection and session belong to the parent, which goes on."""
        _of_parents.append(self.connection)  # not even closed: SQLite forbids any use
        self.connection = self.registration = None
        self._lock = threading.Lock()  # the thread that may have held it was not forked
        self._backlog = Backlog()
        self._off = "a forked process does not record for its parent"

    # -- trouble -------------------------------------------------------------------------------

    def _put_off(self, error: sqlite3.Error) -> None:
        """Decide how a failed write goes on: at once, in a second, or with a new file."""
        self._obstacle = text = str(error)
        if is_busy(error):
            return  # another writer, this instant: the next call tries again
        self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
        if is_damage(error):
            self._replace_files(text)
        elif "no such table" in text or "FOREIGN KEY" in text:
            self._start_over(f"the database lost this session ({text})")
        else:
            self.complain(text, f"not recorded yet, trying again each second: {text}")

    def _look_after_files(self) -> None:
        """A deleted or replaced file still takes rows, which nobody would ever see."""
        if self.connection is None:
            return
        if self._files == identify_files(self._database):
            self._seen_whole = self.rows_written
        else:
            self._start_over("the database file or its write-ahead log was deleted or replaced")

    def _replace_files(self, why: str) -> None:
        """Keep a damaged database under another name; begin a new one."""
        assert isinstance(self._database, Path)
        self._disconnect()
        try:
            move_aside(self._database)
        except OSError as error:
            self.complain("damaged", f"{self._database} is damaged and cannot be moved: {error}")
            return
        self._start_over(f"{self._database} was damaged ({why}) and moved aside")

    def _start_over(self, why: str) -> None:
        """Record into a database that knows nothing of this session yet."""
        self._disconnect()
        self._retry_at_s = 0.0
        waiting = tuple(self._backlog.rows)
        states = Counter(row.run for row in waiting if row.statement == INSERT_STATE)
        for run in {self.run, *(row.run for row in waiting if row.run is not None)}:
            run.begin_anew(states[run])
        data = json.dumps({"why": why})
        event = (self._clock.newest_s(self.run), time.time(), "storage", None, data)
        self._backlog.add_first(Row(INSERT_EVENT, self.run, event))
        self._lose_what_was_not_seen(why)
        self.complain("storage", f"{why}; recording goes on in a new database")

    def _lose_what_was_not_seen(self, why: str) -> None:
        """Rows that were written since the files were last seen in their place."""
        lost = self.rows_written - self._seen_whole
        self.rows_written = self._seen_whole
        if lost:
            self.drops.count(lost, why)

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
            self._give_up(str(error))
        except (DatabaseError, sqlite3.Error, OSError) as error:
            self._obstacle = str(error)
            self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
            if is_damage(error):
                return self._replace_damaged(str(error))
            if not is_busy(error):
                self.complain(f"open {type(error).__name__}", f"not recording yet: {error}")
        return self.connection is not None

    def _enter(self, patient: bool) -> None:
        actions = json.dumps(self.actions, ensure_ascii=False)
        opened = open_session(self._database, self._identity, actions, patient=patient)
        self.connection, self.registration = opened
        self._files = identify_files(self._database)
        if (why := why_readers_block(self.connection)) is not None:
            self.complain("journal", f"{self._database} {why}")

    def _replace_damaged(self, why: str) -> bool:
        """A damaged database, or a file of our name, is moved aside; any other file is not ours."""
        if is_ours(self._database):
            self._replace_files(why)
            return self.connection is None and self._retry_at_s == 0 and self._open(patient=False)
        self._give_up(f"{why}; choose another file")
        return False

    def _give_up(self, why: str) -> None:
        self._off = f"not recording into {self._database}: {why}"
        self.complain("off", self._off)
        self._drop_waiting(self._off)
