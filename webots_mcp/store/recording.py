"""Give questions access to a recording, opened anew for each one, except by a server.

Questions that fail because of a row that no bridge writes are repeated without such rows. Jobs that
only one process at a time may do in a recording hold a lease of it.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database import session_cleanup
from webots_mcp.database.connection import (
    LONGEST_READ_S,
    FrozenConnection,
    Role,
    connect,
    identify_files,
)
from webots_mcp.database.job_leases import JobLease, still_held
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.database.maintenance import FREE_THE_LOG, held_log
from webots_mcp.database.queue import any_unfinished
from webots_mcp.database.schema import create_schema, require_current, schema_version
from webots_mcp.database.transactions import (
    FAILURES,
    is_about_a_value,
    is_busy,
    is_damage,
    is_unwritable,
    text_of,
)
from webots_mcp.database.waiting_file import adopt, count_rows, left_waiting, waiting_paths
from webots_mcp.errors import (
    DatabaseError,
    LeaseLostError,
    MalformedRowError,
    NoDatabaseError,
    NothingRecordedError,
)
from webots_mcp.signals.naming import counted
from webots_mcp.store.chunks import StateColumns, is_chunked_aside, show_chunks_aside
from webots_mcp.store.invalid_rows import is_past_invalid_rows, shadow_if_asked
from webots_mcp.store.journal_intake import (
    BUDGET_S,
    has_news,
    ingest_journals,
    journals_behind,
    kept_journals,
)
from webots_mcp.store.loop_evidence import request_stacks
from webots_mcp.store.reading.observed_pose import find_observed
from webots_mcp.store.reading.segment import Subject, choose, require_run
from webots_mcp.store.relative_times import LONG_AGO_S, utc
from webots_mcp.store.retention_limits import Asked
from webots_mcp.store.robot_status import Status, decide_status, stopped_for
from webots_mcp.store.robots import RobotRecord, console_trouble
from webots_mcp.store.run_rows import RunRecord, StateRecord, current_run, newest_state
from webots_mcp.store.sessions import SessionRecord

GETTING_STARTED: Final = (
    "Add two lines to a controller: 'from webots_mcp import MCPBridge' and, where it has made its "
    "robot, 'bridge = MCPBridge.attach(robot)', which records the devices' values at each step; "
    "then start the simulation. 'webots-mcp demo' shows it without Webots. If controllers record "
    "elsewhere, start the server with --data-dir or --database."
)

_ENDED: Final = {
    "crashed": "its controller crashed or was killed",
    "finished": "its controller finished",
    "superseded": "another bridge took its robot over",
}
_VALUE_ERRORS: Final = (
    TypeError, OverflowError, ValueError, RecursionError, sqlite3.DataError, sqlite3.IntegrityError,
    MalformedRowError,
)  # fmt: skip


@dataclass(frozen=True)
class ConnectionLimits:
    """Connections and leases that a process keeps.

    Attributes:
        idle: Idle connections, each of which may hold 2 MB of pages.
        renew_every_s: Wall time between two renewals of a lease.
    """

    idle: int = 8
    renew_every_s: float = 3.0


_CONNECTIONS: Final = ConnectionLimits()


@dataclass(frozen=True)
class RobotView:
    """One robot, one run, now: the content of an answer's header.

    All of it was read at one moment, however long the answer takes to complete. Otherwise one
    answer could mix old and new data.

    Attributes:
        state: The newest state of the run.
        is_newest: Whether the run is the robot's newest.
    """

    connection: sqlite3.Connection
    robot: RobotRecord
    run: RunRecord | None
    now_s: float
    state: StateRecord | None
    is_newest: bool

    @cached_property
    def status(self) -> Status:
        """Whether simulation time advances. It is decided at first access, so read it early.

        Sending a command to a live robot does not need it: that saves a dozen statements.
        """
        if self.run is None or self.is_newest:
            return decide_status(self.connection, self.session, self.run, self.now_s)
        return _status_of_earlier_run(self.run, self.now_s)

    @property
    def session(self) -> SessionRecord | None:
        """The robot's latest session."""
        return self.robot.session

    def header(self) -> dict[str, Any]:
        """Return the fields that every answer begins with."""
        sim_time_s, wall_time_s = self._newest_times()
        return {
            "robot": self.robot.name,
            "run_id": self.run.id if self.run else None,
            "sim_time_s": None if sim_time_s is None else round(sim_time_s, 4),
            "age_s": None if wall_time_s is None else self.age_s(wall_time_s),
            **self._time_of_day(wall_time_s),
            "status": self.status.text,
            "why": self._why(),
            **storage(self.connection),
        }

    def _time_of_day(self, wall_time_s: float | None) -> dict[str, str]:
        """Return when the newest data were recorded, if that is long ago."""
        if wall_time_s is None or self.now_s - wall_time_s <= LONG_AGO_S:
            return {}
        return {"newest_wall_time": utc(wall_time_s)}

    def _why(self) -> str | None:
        """Return why time stands still; for an ended robot, also what a later console said."""
        trouble = None if self.robot.live else console_trouble(self.connection)
        return "; ".join(filter(None, (self.status.why, trouble))) or None

    def position_by(self) -> dict[str, Any]:
        """Name the observer that recorded the position, if the robot publishes none."""
        if self.run is None or self.state is None:
            return {}
        newest, state = StateColumns(), self.state
        newest.add([(state.id, state.sim_time_s, state.wall_time_s, state.data, state.replaced)])
        found = find_observed(self.connection, self.run.id, newest)
        return (
            {
                "position_by": (
                    f"observer {found.observer!r} saw the position (observer.x_m, ...); the robot "
                    "publishes none"
                )
            }
            if found
            else {}
        )

    def _newest_times(self) -> tuple[float, float] | tuple[None, None]:
        """Return the times of the newest state.

        Before the first one, of the run's last sign of life.
        """
        if self.state is not None:
            return self.state.sim_time_s, self.state.wall_time_s
        if self.run is not None:
            return self.run.last_sim_time_s, self.run.last_wall_time_s
        return None, None

    def age_s(self, wall_time_s: float) -> float:
        """Age of the newest data, to 10 ms; to the second if over an hour."""
        age_s = max(self.now_s - wall_time_s, 0.0)
        return round(age_s, 2) if age_s <= LONG_AGO_S else round(age_s)

    def require_run(self) -> RunRecord:
        """Return the run; see `segment.require_run`."""
        return require_run(self.robot, self.run)

    @property
    def subject(self) -> Subject:
        """The subject of a question about this robot and this run."""
        return Subject(self.robot.id, self.robot.name, self.require_run().id)


_Kind = Literal["reader", "reader past invalid rows", "writer"]


class OpenConnections:
    """Connections that a server keeps open between its questions, each with its cache.

    A connection is used again if its file is still the one that it was opened for, and its schema
    has not changed.
    """

    def __init__(self) -> None:
        self._idle: dict[_Kind, list[tuple[object, sqlite3.Connection]]] = {
            "reader": [], "reader past invalid rows": [], "writer": [],
        }  # fmt: skip
        self._is_closed = False

    @contextmanager
    def reader(
        self, database: Path, open_one: Callable[[], sqlite3.Connection]
    ) -> Generator[sqlite3.Connection]:
        """Lend a connection for one question; it is closed if the question fails.

        Connections that leave out invalid rows are kept apart: making their views takes longer than
        a question.
        """
        kind: _Kind = "reader past invalid rows" if is_past_invalid_rows() else "reader"
        with self._taken(kind, database, open_one) as connection:
            shadow_if_asked(connection)
            yield connection

    @contextmanager
    def writer(
        self, database: Path, open_one: Callable[[], sqlite3.Connection]
    ) -> Generator[sqlite3.Connection]:
        """Lend a connection to write with; it is closed if that fails, or leaves a transaction."""
        with self._taken("writer", database, open_one) as connection:
            yield connection

    @contextmanager
    def _taken(
        self, kind: _Kind, database: Path, open_one: Callable[[], sqlite3.Connection]
    ) -> Generator[sqlite3.Connection]:
        idle = self._idle[kind]
        while True:
            try:
                known, connection = idle.pop()
            except IndexError:
                connection = open_one()
                known = _identity(database, connection)
                break
            if known == _identity(database, connection):
                break
            connection.close()
        try:
            yield connection
        except BaseException:
            connection.close()
            raise
        is_enough = len(idle) >= _CONNECTIONS.idle
        is_unfit = isinstance(connection, FrozenConnection) or connection.in_transaction
        if known is None or is_enough or is_unfit:
            connection.close()
        else:
            idle.append((known, connection))
        if self._is_closed:
            self.close()

    def close(self) -> None:
        """Close all idle connections, and the others when they are returned."""
        self._is_closed = True
        for idle in self._idle.values():
            while idle:
                idle.pop()[1].close()


def _identity(database: Path, connection: sqlite3.Connection) -> object:
    """Return the identity of the files and the schema version of SQLite; None for missing files."""
    try:
        version = connection.execute("PRAGMA schema_version").fetchone()
        return identify_files(database), version, is_chunked_aside(connection, database)
    except (OSError, *FAILURES):
        return None


@dataclass(frozen=True)
class RecordingAccess:
    """A database, the folder of its pictures, and whether the caller may write.

    Only `create` and `ingest` create a database. Without one, questions answer how to get one.

    Attributes:
        limits: Retention limits that the caller requests.
        asker: The source of commands: `mcp` or `cli`.
        connections: Keeps connections open; None opens one for each question.
    """

    database: Database
    data_dir: Path
    read_only: bool = False
    limits: Asked = field(default_factory=dict[str, Any])
    asker: str = "mcp"
    connections: OpenConnections | None = None

    @contextmanager
    def reader(self) -> Generator[sqlite3.Connection]:
        """Lend a read-only connection that no other question uses meanwhile.

        What controllers wrote into journals is ingested first.
        """
        self.ingest()
        if self.connections is None or not isinstance(self.database, Path):
            with self._opened("reader") as connection:
                shadow_if_asked(connection)
                yield connection
            return
        with (
            self._explaining_errors(),
            self.connections.reader(self.database, lambda: self._open("reader")) as connection,
        ):
            yield connection

    @contextmanager
    def writer(self) -> Generator[sqlite3.Connection]:
        """Open a connection that waits up to 5 s for the write lock."""
        with self._opened("writer") as connection:
            yield connection

    @contextmanager
    def brief_writer(self) -> Generator[sqlite3.Connection]:
        """Lend a kept connection to write with, for a statement or a short transaction.

        Its settings must stay as they are. It waits up to 5 s for the write lock.
        """
        if self.connections is None or not isinstance(self.database, Path):
            with self.writer() as connection:
                yield connection
            return
        with (
            self._explaining_errors(),
            self.connections.writer(self.database, lambda: self._open("writer")) as connection,
        ):
            yield connection

    @contextmanager
    def view(self, robot: str | None = None, run_id: int | None = None) -> Generator[RobotView]:
        """Read a robot (the only live one by default) and its current run or the given one.

        Raises:
            NothingRecordedError: The database does not exist or holds no robot.
            InvalidInputError: The robot or run does not exist, or several robots are possible.
        """
        with self.reader() as connection:
            seen = view_robot(connection, robot, run_id)
            is_moving = seen.status.is_moving  # decided here, with all else that the view has
            may_ask = not (is_moving or self.read_only) and run_id is None
            if may_ask and seen.session and request_stacks(connection, seen.session, seen.now_s):
                # Keep the time from before the signal, which may have woken the loop.
                seen = view_of(connection, seen.robot, seen.now_s)
            yield seen

    def settle(self) -> None:
        """Finish the commands that no live process will finish, unless `read_only`."""
        if self.read_only:
            return
        with self.writer() as connection:
            if any_unfinished(connection):
                if isinstance(self.database, Path):
                    adopt(
                        connection, self.database
                    )  # a command's result may wait in a file next to the database
                session_cleanup.reap(connection, time.time())

    def ingest(self) -> None:
        """Ingest what controllers wrote into journals, unless the caller may not write."""
        database = self.database
        if not isinstance(database, Path) or (self.read_only and self.asker == "mcp"):
            return
        # A server's maintainer recovers what bridges left; without a server, the command does.
        left = self.asker == "cli" and waiting_paths(database)
        if left or has_news(database):
            until_s = time.monotonic() + BUDGET_S
            # a locked or unwritable database: `storage` reports what waits
            with suppress(DatabaseError):
                self.create()
                with self.writer() as connection:
                    if left:
                        adopt(connection, database, until_s)
                    ingest_journals(connection, database, until_s - time.monotonic())

    def create(self) -> None:
        """Create the database and its folder, unless they exist.

        Raises:
            DatabaseError: It cannot be created or written, or has another format.
        """
        with (
            self._explaining_errors(),
            closing(connect(self.database, "writer", create=True)) as connection,
        ):
            create_schema(connection)

    @contextmanager
    def _opened(self, role: Role) -> Generator[sqlite3.Connection]:
        with self._explaining_errors(), closing(self._open(role)) as connection:
            yield connection

    @contextmanager
    def _explaining_errors(self) -> Generator[None]:
        try:
            yield
        except FAILURES as error:
            kind = MalformedRowError if is_about_a_value(error) else DatabaseError
            raise kind(_explain(error, self.database)) from error

    def _open(self, role: Role) -> sqlite3.Connection:
        try:
            connection = connect(self.database, role)
        except NoDatabaseError as error:
            raise NoDatabaseError(f"{error}. {GETTING_STARTED}") from error
        try:
            self._require_ours(connection)
            if role == "reader" and isinstance(self.database, Path) and not is_past_invalid_rows():
                show_chunks_aside(connection, self.database)
        except BaseException:
            connection.close()
            raise
        return connection

    def _require_ours(self, connection: sqlite3.Connection) -> None:
        if schema_version(connection) == 0:
            raise NoDatabaseError(
                f"the database at {name_of(self.database)} is empty: no controller has recorded "
                f"there yet. {GETTING_STARTED}"
            )
        require_current(connection)


def view_robot(
    connection: sqlite3.Connection, robot: str | None, run_id: int | None = None
) -> RobotView:
    """Return a view over an open connection; see `RecordingAccess.view`."""
    now_s = time.time()
    try:
        chosen, run = choose(connection, robot, run_id, now_s)
    except NothingRecordedError as error:
        left = "".join(f". {said}" for said in storage(connection).values())
        raise NothingRecordedError(f"{error}{left}. {GETTING_STARTED}") from error
    return view_of(connection, chosen, now_s, run)


def view_of(
    connection: sqlite3.Connection, robot: RobotRecord, now_s: float, run: RunRecord | None = None
) -> RobotView:
    """Return a view of a robot that is already known, and of that run or its newest one."""
    current = current_run(connection, robot.id)
    run = run or current
    state = newest_state(connection, run.id) if run else None
    return RobotView(connection, robot, run, now_s, state, is_newest=run == current)


def _status_of_earlier_run(run: RunRecord, now_s: float) -> Status:
    ended_s = run.ended_wall_time_s or run.last_wall_time_s
    how = _ENDED.get(f"{run.end_reason}", f"it ended by {run.end_reason or 'an unknown cause'}")
    return Status(stopped_for(now_s - ended_s), f"this is an earlier run; {how}")


def storage(connection: sqlite3.Connection) -> dict[str, Any]:
    """Return what an answer reports about its file, and about rows that are not in it."""
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    if not file:
        return {}
    behind, kept = journals_behind(connection, Path(file)), kept_journals(Path(file))
    said = [
        (
            f"{name} could not be read and was left as it is: {why}. Correct the program that "
            "writes it, then move or delete the file"
        )
        for name, why in kept.items()
    ]
    if held := held_log(Path(file)):
        said.append(f"{held}: {FREE_THE_LOG}")
    if isinstance(connection, FrozenConnection):
        waiting = [*(path.name for path in waiting_paths(Path(file))), *behind]
        frozen_text = "the file cannot be written from here: read as it is on the disk"
        not_in = (
            "; without the rows in {} waiting files next to it (...-waiting-...): copy all of "
            "them to a writable folder and open the copy with webots-mcp serve to include them"
        )
        said.insert(0, f"{frozen_text}{not_in.format(len(waiting)) if waiting else ''}")
    elif beside := waiting_rows_note(connection):
        said.insert(0, beside)
    return {"storage": "; ".join(said)} if said else {}


def waiting_rows_note(connection: sqlite3.Connection) -> str:
    """Return a note on rows outside the database that should be in it by now; "" if none."""
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    if not file:
        return ""
    said: list[str] = []
    if rows := sum(map(count_rows, left_waiting(Path(file)))):
        left_text = (
            "{} of controllers that have ended wait in files next to the database "
            "(...-waiting-...) and are not in this answer: ask again, or start 'webots-mcp "
            "serve' (not --read-only)"
        )
        said.append(left_text.format(counted(rows, "row")))
    if behind := journals_behind(connection, Path(file)):
        behind_text = (
            "newer rows of {} are not in the database yet: ask again, or start 'webots-mcp "
            "serve' (not --read-only), which takes them in"
        )
        said.append(behind_text.format(", ".join(behind)))
    return "; ".join(said)


def name_of(database: Database) -> str:
    """Return the name of the database for a person."""
    return "(in memory)" if isinstance(database, MemoryDatabase) else str(database)


def _explain(error: Exception, database: Database) -> str:
    """Return what a person can do about an error."""
    text, name = text_of(error), name_of(database)
    if is_busy(error):
        return (
            f"the database at {name} stayed locked by another process: ask again; if it lasts, "
            "look for a program that holds a transaction open (a sqlite3 shell?)"
        )
    if is_about_a_value(error):
        return f"the database at {name} holds a value that cannot be read: {text}"
    if "interrupted" in text:
        return (
            f"reading the database at {name} was stopped: one statement took longer than "
            f"{LONGEST_READ_S:g} s; ask for less, by run and time"
        )
    # This is the message of SQLite.
    if "file is not a database" in text:
        moved = isinstance(database, Path) and database.name == DATABASE_NAME
        aside = "; a bridge that finds it there moves it aside and begins a new one"
        return (
            f"the file {name} is not a database: name the one that a bridge records into"
            + aside * moved
        )
    if is_damage(error):
        return (
            f"the database at {name} is damaged ({text}): the bridge moves such a file aside at "
            "its next start; 'sqlite3 FILE .recover' can save rows from it"
        )
    if is_unwritable(error):
        return (
            f"the database at {name} cannot be written from here ({text}): commands that read it, "
            "and 'webots-mcp serve --read-only', work"
        )
    return f"the database at {name} cannot be used: {text}; check free space and permissions"


# Jobs that one process at a time does in a recording, as long as it holds their lease.


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """What this process does as long as it holds the lease.

    Attributes:
        recording: The recording of the lease.
        lease: The lease of this process.
    """

    recording: RecordingAccess
    lease: JobLease

    @contextmanager
    def writer(self) -> Generator[sqlite3.Connection]:
        """Open a connection in a transaction, for writes that only the holder may do.

        Raises:
            LeaseLostError: Another process has the lease; nothing is written.
        """
        with self.recording.writer() as connection, still_held(connection, self.lease):
            yield connection

    def require_held(self) -> None:
        """Raise an error unless this process still holds the lease.

        Raises:
            LeaseLostError: Another process has the lease.
        """
        with self.writer():
            pass

    @contextmanager
    def renewed(self) -> Generator[None]:
        """Keep the lease from expiring during the block."""
        over = threading.Event()
        thread = threading.Thread(target=self._renew, args=(over,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _renew(self, over: threading.Event) -> None:
        while not over.wait(_CONNECTIONS.renew_every_s):
            with suppress(LeaseLostError):  # the worker notices when it writes
                self._renew_now()

    def _renew_now(self) -> None:
        try:
            self.require_held()
        except DatabaseError as error:  # there is time to try again
            _log.warning("%s is not renewed: %s", self.lease.name, error)


# Values that no bridge writes. Other programs may write to a recording, and SQLite accepts any
# value in any column. A question that meets one is repeated without it (`invalid_rows`).


def is_invalid_value(error: Exception) -> bool:
    """Return whether work on rows failed because of an invalid value, not because of the file."""
    if is_damage(error):
        return False
    return isinstance(error, _VALUE_ERRORS) or is_about_a_value(error)
