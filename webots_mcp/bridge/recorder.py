"""The write path: when `record` returns, the row survives the process, whatever ends it.

One recorded row is one statement and so one short transaction into the write-ahead log: a
controller that is killed the next instant loses nothing. The control loop hardly waits: a row that
meets another writer's lock for longer than a millisecond, a full disk, a read-only or a vanished
database goes into a file of the session beside it, and into memory only where that fails too.
What waits is written, in order, with the next call, or by whoever opens the database next. Beyond
the limits of the backlog the oldest rows in memory are dropped, and so is a row that the database
refuses whatever comes; dropped rows are counted, and told as an event as soon as one can be
written.

A KeyboardInterrupt may come between any two lines. Nothing here hangs on what would have followed:
a statement is written or not, a transaction is rolled back by the next call, what waits is known
by its number, and a turn ends with its call.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from webots_mcp.adoption import Taken, is_unfit, take_in
from webots_mcp.bridge.backlog import Backlog, Row
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.drops import Drops
from webots_mcp.bridge.heartbeat_rows import LoopStatus, RecordingStatus, write_heartbeat
from webots_mcp.bridge.identity import Identity
from webots_mcp.bridge.log_watch import LogWatch
from webots_mcp.bridge.opening import is_ours, move_aside, open_session, why_readers_block
from webots_mcp.bridge.registration import (
    Registration,
    deregister,
    describe_robot,
    describe_session,
)
from webots_mcp.bridge.run import Run
from webots_mcp.bridge.trouble import Trouble
from webots_mcp.bridge.turn import PAUSE_S, Turn, this_call
from webots_mcp.connection import (
    identify_files,
    is_busy,
    is_damage,
    roll_back,
    text_of,
    together,
)
from webots_mcp.contract import Database, new_uuid
from webots_mcp.entries import STATEMENTS, Kind, Values, WaitingFile, bind, waiting_path
from webots_mcp.errors import (
    ForeignDatabaseError,
    ForkedProcessError,
    SchemaTooNewError,
    SchemaTooOldError,
    SessionGoneError,
)

_CATCH_UP_S: Final = 0.002  # a loop that catches up must not stall over it
_PATIENCE_S: Final = 0.001  # with another writer, whose commit takes 50 us
_TURN_S: Final = 0.02  # with another thread of this process, which catches up at that moment
_RETRY_INTERVAL_S: Final = 1.0

_RUN_ID: Final = "SELECT id FROM run WHERE uuid = ?"
_GO_ON: Final = "UPDATE run SET end_reason = NULL, ended_wall_time_s = NULL WHERE id = ?"

# What no later try will change.
_FOR_GOOD: Final = (
    ForeignDatabaseError, ForkedProcessError, SchemaTooNewError, SchemaTooOldError,
)  # fmt: skip

Result = TypeVar("Result")

_of_parents: list[sqlite3.Connection | None] = []


class Recorder:
    """One connection, one session, and the rows that could not be written yet.

    The loop's thread, the maintainer's and any that logs share the connection, one at a time.
    """

    def __init__(
        self, database: Database, identity: Identity, clock: Clock, *, strict: bool
    ) -> None:
        self._database = database
        self._identity = identity
        self._clock = clock
        self._uuid = new_uuid()
        self.trouble = Trouble(strict=strict)
        self.drops = Drops(self.trouble)
        self._backlog = self._new_backlog()
        self._turn = Turn()
        self._obstacle = "too many wait"
        self._seen_whole = 0
        self._files: tuple[int, ...] = ()
        self._log_watch: LogWatch | None = None
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
        """Rows that the database could not take yet."""
        return self._backlog.rows

    @property
    def rows_in_memory(self) -> int:
        """Of those that wait, the ones that a killed process would lose."""
        return self._backlog.rows_in_memory

    def complain(self, kind: str, text: str) -> None:
        """Remember what went wrong; say it on stderr once a kind; raise in strict mode."""
        self.trouble.complain(kind, text)

    # -- writing -------------------------------------------------------------------------------

    def record(self, kind: Kind, run: Run | None, values: Values) -> int | None:
        """Write a row now, or keep it until it can be written.

        Args:
            kind: What is written.
            run: The run that the row belongs to; its id may not be known yet.
            values: As `entries.STATEMENTS` says.

        Returns:
            How many rows the statement changed, or None where it was put off.
        """
        self.last_use_s = time.monotonic()
        if not self._turn.take(this_call(), _TURN_S):
            self._backlog.put(Row(kind, run, values))
            return None
        try:
            return self._write(kind, run, values)
        except BaseException:
            if run is not None:
                run.counted = False
            raise
        finally:
            self._turn.give_back()

    def fetch(self, statement: str, values: Values) -> Sequence[Any]:
        """The rows that a statement reads or changes; none while that is not possible."""
        if self.connection is None or not self._turn.take(this_call()):
            return ()
        try:
            if self._is_behind(None) and not self._catch_up(None):
                return ()
            # to the end: a RETURNING that is not read so far keeps the write lock
            return self.connection.execute(statement, values).fetchall()
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._put_off(error)
            return ()
        finally:
            self._turn.give_back()

    def flush(self) -> bool:
        """Write what is waiting, as much as one call may; True if nothing waits any more."""
        return self._in_turn(lambda: self._catch_up(None)) is True

    def _in_turn(self, act: Callable[[], Result]) -> Result | None:
        """None, and nothing done, while another thread writes or where it fails."""
        if not self._turn.take(this_call()):
            return None
        try:
            return act()
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._put_off(error)
            return None
        finally:
            self._turn.give_back()

    def _write(self, kind: Kind, run: Run | None, values: Values) -> int | None:
        if self._is_behind(run) and not self._catch_up(run):
            self._keep(Row(kind, run, values))
            return None
        assert self.connection is not None
        assert self.registration is not None
        bound = bind(run.id if run else None, self.registration.session_id, values)
        try:
            changed = self._execute(STATEMENTS[kind], bound)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._write_failed(Row(kind, run, values), error)
            return None
        self.rows_written += 1
        if kind == "state" and run is not None:
            run.rows += 1
        return changed

    def _execute(self, statement: str, values: Values) -> int:
        """Run a statement, trying again for a moment while another writer has the lock."""
        assert self.connection is not None
        connection = self.connection
        try:
            return connection.execute(statement, values).rowcount
        except sqlite3.OperationalError as error:
            if not is_busy(error):
                raise
        return _patiently(lambda: connection.execute(statement, values).rowcount)

    def _write_failed(self, row: Row, error: Exception) -> None:
        if is_unfit(error):
            self.drops.count(1, str(error))
        else:
            self._keep(row)
            self._put_off(error)

    def _keep(self, row: Row) -> None:
        """Put the row where it survives the process; in memory only where that fails."""
        if self._off is not None:
            self.drops.count(1, self._off)
            return
        self._backlog.put(row)
        self._backlog.save()
        while self._backlog.is_over_limit():
            self._backlog.remove_oldest()
            self.drops.count(1, self._obstacle)

    # -- catching up ---------------------------------------------------------------------------

    def _is_behind(self, run: Run | None) -> bool:
        """Whether something else comes before a row of that run."""
        return (
            self.connection is None
            or self._backlog.waits
            or self.connection.in_transaction
            or (run is not None and run.id is None)
            or self.drops.untold > 0
        )

    def _catch_up(self, run: Run | None) -> bool:
        """Write what comes before; False where that is not possible now, or not all of it."""
        if self._off is not None or time.monotonic() < self._retry_at_s:
            return False
        if self.connection is None and not self._open(patient=False):
            return False
        assert self.connection is not None
        roll_back(self.connection)  # what an interrupt left open
        try:
            self._take_in_waiting()
            if run is not None and run.id is None and not self._backlog.waits:
                self._enter_run(run)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.save()
            self._put_off(error)
            return False
        if self._backlog.waits:
            return False
        self._tell_drops()
        return not self._backlog.waits

    def _take_in_waiting(self) -> None:
        assert self.connection is not None
        assert self.registration is not None
        until_s = time.monotonic() + _CATCH_UP_S
        while self._backlog.waits and (entries := self._backlog.next_entries()):
            taken = take_in(self.connection, self.registration.session_id, entries)
            self._backlog.forget(taken.number)
            self._count(taken)
            if time.monotonic() > until_s:
                break

    def _count(self, taken: Taken) -> None:
        self.rows_written += sum(entry.kind != "run" for entry in taken.written)
        states = [entry.run for entry in taken.written if entry.kind == "state"]
        self.run.rows += states.count(self.run.uuid)
        for why in taken.unfit:
            self.drops.count(1, why)

    def _enter_run(self, run: Run) -> None:
        """Write the run's row, or go on with the one that is there."""
        assert self.connection is not None
        assert self.registration is not None
        values = bind(None, self.registration.session_id, run.describe(self._identity))
        entered = self._execute(STATEMENTS["run"], values)
        ((run_id,),) = self.connection.execute(_RUN_ID, (run.uuid,)).fetchall()
        if not entered and run is self.run:
            self._execute(_GO_ON, (run_id,))
        run.id = run_id

    def _tell_drops(self) -> None:
        if not self.drops.untold:
            return
        text, self.drops.untold = self.drops.describe(), 0
        now = (self._clock.newest_s(self.run), time.time())
        self._write("event", self.run, (*now, "dropped", None, text))

    # -- heartbeat and end ---------------------------------------------------------------------

    def beat(self, loop: LoopStatus) -> None:
        """Say that the loop is alive. Skipped while rows wait: a late heartbeat tells nothing."""
        self._in_turn(lambda: self._beat(loop))

    def _beat(self, loop: LoopStatus) -> None:
        self._look_after_files()
        if self._is_behind(self.run) and not self._catch_up(self.run):
            return
        connection, registration = self.connection, self.registration
        assert connection is not None
        assert registration is not None
        recording = RecordingStatus(self.rows_waiting, self.drops.rows, self.trouble.last_error)
        ids = (registration.session_id, self.run)
        _patiently(
            lambda: together(
                connection,
                lambda: write_heartbeat(connection, loop, recording, *ids),
            )
        )

    def update_actions(self) -> None:
        """Publish the names and docstrings of the registered custom actions."""
        if self.registration is not None:
            values = {"actions": json.dumps(self.actions, ensure_ascii=False)}
            self.record("actions", None, values)

    def end_run(self, reason: str, sim_time_s: float) -> None:
        """The current run is over, as of the simulation time that was seen last."""
        run = self.run
        rows = run.rows if run.counted and not self._backlog.waits else None
        values = {"reason": reason, "now": time.time(), "sim_time": sim_time_s, "rows": rows}
        self.record("run end", run, values)

    def end(self, reason: str, sim_time_s: float) -> None:
        """Run and session are over; what is recorded until `close` still belongs to them."""
        self.end_run(reason, sim_time_s)
        times = {"now": time.time(), "monotonic": time.monotonic()}
        health = {"dropped": self.drops.rows, "error": self.trouble.last_error}
        self.record("session end", None, {"reason": reason, **times, **health})

    def close(self, reason: str, sim_time_s: float) -> None:
        """Write what waits (trying for up to a second), end run and session, close the file."""
        if self._off is None:
            self.end(reason, sim_time_s)
        deadline_s = time.monotonic() + 1
        while not self.flush() and self.connection is not None and time.monotonic() < deadline_s:
            time.sleep(0.005)
        self._turn.take(this_call(), 1.0)
        try:
            self._disconnect()
            self._leave_waiting()
            self._off = self._off or "the bridge is closed"
        finally:
            self._turn.give_back()

    def _leave_waiting(self) -> None:
        """What waits in the file stays there; what waits in memory is lost."""
        self._backlog.save()
        self._drop_waiting(self._obstacle)
        rows = self.rows_waiting
        if (path := self._backlog.close()) is not None:
            self.complain(
                "waiting",
                f"{rows} rows wait in {path}, because {self._obstacle}; the next bridge or server "
                "that opens the database takes them in",
            )

    def _drop_waiting(self, why: str) -> None:
        while self._backlog.rows_in_memory:
            self._backlog.remove_oldest()
            self.drops.count(1, why)

    def abandon(self) -> None:
        """In a forked child: connection and session belong to the parent, which goes on."""
        _of_parents.append(self.connection)  # not even closed: SQLite forbids any use
        self.connection = self.registration = None
        self._turn = Turn()  # the thread that may have had it was not forked
        self._backlog.leave_file()
        self._backlog = Backlog(None, self._describe_run)
        self._off = "a forked process does not record for its parent"

    # -- what waits ----------------------------------------------------------------------------

    def _new_backlog(self) -> Backlog:
        """A database in memory ends with its process, and so may what waits for it."""
        if not isinstance(self._database, Path):
            return Backlog(None, self._describe_run)
        path = waiting_path(self._database, self._uuid)
        return Backlog(WaitingFile(path, self._describe_session), self._describe_run)

    def _describe_run(self, run: Run) -> dict[str, Any]:
        return run.describe(self._identity)

    def _describe_session(self) -> dict[str, Any]:
        """Who records, for a database that does not know of this session."""
        name = self.registration.robot_name if self.registration else self._identity.robot_name
        actions = json.dumps(self.actions, ensure_ascii=False)
        return {
            "robot": describe_robot(self._identity, name),
            "session": describe_session(self._identity, self._uuid, actions),
        }

    # -- trouble -------------------------------------------------------------------------------

    def _put_off(self, error: Exception) -> None:
        """Decide how a failed write goes on: at once, in a second, or with a new file."""
        self._obstacle = text = text_of(error)
        if is_busy(error):
            return  # another writer, this instant: the next call tries again
        self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
        if is_damage(error):
            self._replace_files(text)
        elif isinstance(error, SessionGoneError) or _misses_rows(text):
            self._start_over(f"the database lost this session ({text})")
        else:
            self.complain(text, f"not recorded yet, trying again each second: {text}")

    def _look_after_files(self) -> None:
        """A deleted or replaced file still takes rows, which nobody would ever see."""
        if self.connection is None:
            return
        if self._files != identify_files(self._database):
            self._start_over("the database file or its write-ahead log was deleted or replaced")
        elif self._log_watch is not None and not self._log_watch.is_whole():
            self._start_over("the database's write-ahead log was cut short")
        else:
            self._seen_whole = self.rows_written

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
        before = self.run.uuid
        self.run.begin_anew()
        self._backlog.rename_run(before, self.run.uuid)
        data = json.dumps({"why": why})
        event = (self._clock.newest_s(self.run), time.time(), "storage", None, data)
        self._keep(Row("event", self.run, event))
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
        connection, self.connection, self.registration = self.connection, None, None
        if connection is not None:
            connection.close()

    # -- opening -------------------------------------------------------------------------------

    def _open(self, *, patient: bool) -> bool:
        """Open (or make) the database and enter a session; False, and said, where it fails."""
        if self._off is not None:
            return False
        try:
            self._enter(patient)
        except _FOR_GOOD as error:
            self._give_up(str(error))
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._obstacle = text_of(error)
            self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
            if is_damage(error):
                return self._replace_damaged(text_of(error))
            if not is_busy(error):
                self.complain(
                    f"open {type(error).__name__}", f"not recording yet: {self._obstacle}"
                )
        return self.connection is not None

    def _enter(self, patient: bool) -> None:
        actions = json.dumps(self.actions, ensure_ascii=False)
        who = (self._identity, self._uuid, actions)
        opened = open_session(self._database, *who, patient=patient)
        self.connection, self.registration = opened
        self._files = identify_files(self._database)
        if isinstance(self._database, Path):
            self._log_watch = LogWatch(f"{self._database}-wal")
        if (why := why_readers_block(self.connection)) is not None:
            self.complain("journal", f"{self._database} {why}")

    def _replace_damaged(self, why: str) -> bool:
        """A damaged database, or a file of our name, is moved aside; any other file is not ours."""
        if is_ours(self._database, why):
            self._replace_files(why)
            return self.connection is None and self._retry_at_s == 0 and self._open(patient=False)
        self._give_up(f"{why}; choose another file")
        return False

    def _give_up(self, why: str) -> None:
        self._off = f"not recording into {self._database}: {why}"
        self.complain("off", self._off)
        self._drop_waiting(self._off)


def _misses_rows(text: str) -> bool:
    """Whether SQLite says that what a row refers to, or its table, is not there any more."""
    return "no such table" in text or "FOREIGN KEY" in text


def _patiently(act: Callable[[], Result]) -> Result:
    """Do it, trying again for a moment while another writer has the lock."""
    until_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return act()
        except sqlite3.OperationalError as error:
            if not is_busy(error) or time.monotonic() >= until_s:
                raise
        time.sleep(PAUSE_S)
