"""Opening the database and writing to it: PRAGMAs, transactions and errors, for both sides.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

from webots_mcp.contract import (
    APPLICATION_ID,
    PRIVATE_FILE,
    SCHEMA_VERSION,
    Database,
    MemoryDatabase,
    make_folder,
)
from webots_mcp.errors import (
    DatabaseError,
    ForeignDatabaseError,
    ForkedProcessError,
    NoDatabaseError,
)
from webots_mcp.forked import is_inherited
from webots_mcp.origin import require_shipped

Role = Literal["loop", "writer", "reader"]
Result = TypeVar("Result")

OLDEST_SQLITE: Final = (3, 38, 0)  # RETURNING, ->>, shared databases in memory
OPENING_TIMEOUT_MS: Final = 5000
_UNINTERRUPTED_MS: Final = 100
LONGEST_READ_S: Final = 60.0  # of a statement of a reader
_STEPS_PER_LOOK: Final = 1_000_000  # of SQLite's virtual machine: some 20 ms
LONGEST_WRITE_S: Final = 0.001  # of maintenance: a robot that wants to write waits so long
CHECKPOINT_TIMEOUT_MS: Final = 100  # longer, and a checkpoint makes writers wait for its readers
_UNWRITABLE: Final = ("readonly database", "unable to open database file")
_CALLED_OFF: Final = "called off"
_DAMAGE: Final = ("malformed", "not a database", "unsupported file format")
_SAYS_NOTHING: Final = "malformed database, which SQLite names in bytes that are not text"
_ABOUT_A_VALUE: Final = (
    "malformed JSON", "JSON cannot hold", "JSON path", "to UTF-8 column", "integer overflow",
    "user-defined function",
)  # fmt: skip

# All that a statement may raise because of the database.
FAILURES: Final = (sqlite3.Error, sqlite3.Warning, UnicodeDecodeError, SystemError)

# Why: a control loop never waits for a lock; an automatic checkpoint would be its slowest step,
# so only the maintainer checkpoints; NORMAL costs the last commits at a power cut, never the file.
_PRAGMAS: Final[dict[Role, tuple[str, ...]]] = {
    "loop": ("synchronous=NORMAL", "wal_autocheckpoint=0", "foreign_keys=ON"),
    "writer": ("synchronous=NORMAL", "wal_autocheckpoint=0", "foreign_keys=ON"),
    "reader": ("query_only=ON",),
}


class ReadingConnection(sqlite3.Connection):
    """Each statement is interrupted after a minute: what others wrote may take for ever to read."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._until_s = [0.0]  # apart from the connection, which the handler must not keep alive
        keep_deadline(self)

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        """As of any connection, with a deadline of its own."""
        self._until_s[0] = time.monotonic() + LONGEST_READ_S
        return super().execute(*statement)

    def is_late(self) -> Callable[[], bool]:
        """Tells whether the statement that was begun last has had its time."""
        until_s = self._until_s
        return lambda: time.monotonic() > until_s[0]


def keep_deadline(connection: sqlite3.Connection) -> None:
    """Give a connection back the deadline of its own, if it has one, after another's."""
    is_late = connection.is_late() if isinstance(connection, ReadingConnection) else None
    connection.set_progress_handler(is_late, _STEPS_PER_LOOK)


class FrozenConnection(ReadingConnection):
    """To a file in a place that cannot be written, read as it lies on the disk.

    Reading a database in WAL mode needs two files beside it. Where they cannot be made and are
    not there, nothing but the file itself counts, and SQLite reads it as one that never changes.
    """


def connect(
    database: Database, role: Role, *, create: bool = False, patient: bool = True
) -> sqlite3.Connection:
    """Open the database in autocommit mode: transactions begin only where the code says so.

    For a "reader" a file that cannot be written is opened as well, see `FrozenConnection`.

    Args:
        database: A file or a database in memory.
        role: "loop" for a controller, "writer" for the server, "reader" cannot write.
        create: Make the file (empty, in WAL mode) and its folder where they are missing.
        patient: Wait up to 5 s for locks, here and later; a control loop does not.

    Raises:
        NoDatabaseError: The file is missing and `create` is false.
        DatabaseError: The folder cannot be made, the file cannot be opened, its log cannot be
            read where nothing can be written, or SQLite is too old.
        ForeignDatabaseError: The file belongs to another application, or holds under our names,
            or on our tables, what we did not make.
        ForkedProcessError: The process that this one was forked from has the file open.
        sqlite3.Error: The file is no database, or is locked for longer than 5 s.
    """
    _require_usable(database)
    address = database.uri if isinstance(database, MemoryDatabase) else _file_uri(database, create)
    timeout_s = OPENING_TIMEOUT_MS / 1000 if patient else 0
    try:
        kind = ReadingConnection if role == "reader" else sqlite3.Connection
        connection = _open(address, timeout_s, kind)
    except sqlite3.OperationalError as error:
        raise DatabaseError(f"{database} cannot be opened: {error}; check the folder") from error
    try:
        if create:
            schema_version(connection)  # first: another application's file stays as it is
            _make_wal(connection)
        _prepare(connection, role)
    except Exception as error:
        connection.close()
        if role == "reader" and isinstance(database, Path) and is_unwritable(error):
            return _open_frozen(database)
        raise
    return connection


def _prepare(connection: sqlite3.Connection, role: Role) -> None:
    """Set what the role needs, and look whether all is ours; another version's is only migrated."""
    for pragma in _PRAGMAS[role]:
        connection.execute(f"PRAGMA {pragma}")
    if _can_distrust():
        connection.execute("PRAGMA trusted_schema=OFF")
    if schema_version(connection) == SCHEMA_VERSION:
        require_shipped(connection)


@cache
def _can_distrust() -> bool:
    """Whether views may be kept from functions with side effects, and ours work nevertheless.

    SQLite 3.40 counts those of JSON, which our views call, among them.
    """
    with closing(sqlite3.connect(":memory:")) as probe:
        probe.execute("PRAGMA trusted_schema=OFF")
        probe.execute("CREATE VIEW ours AS SELECT json_valid('1')")
        try:
            probe.execute("SELECT * FROM ours")
        except sqlite3.OperationalError:
            return False
    return True


def _require_usable(database: Database) -> None:
    if sqlite3.sqlite_version_info < OLDEST_SQLITE:
        raise DatabaseError(
            f"SQLite {sqlite3.sqlite_version} of this Python is too old, 3.38 is needed: "
            "use a Python that was built with a newer one"
        )
    if isinstance(database, Path) and is_inherited(database):
        raise ForkedProcessError(
            f"{database} is open in the process that this one was forked from, and would be "
            "destroyed if both wrote to it: start this one anew instead, as subprocess does, or "
            'multiprocessing after set_start_method("spawn")'
        )


def _open(address: str, timeout_s: float, kind: type[sqlite3.Connection]) -> sqlite3.Connection:
    return sqlite3.connect(
        address,
        uri=True,
        timeout=timeout_s,
        isolation_level=None,
        check_same_thread=False,
        factory=kind,
    )


def _open_frozen(file: Path) -> sqlite3.Connection:
    """Never beside a log: it may hold the newest rows, or somebody may be writing it."""
    log = file.with_name(f"{file.name}-wal")
    if log.exists():
        raise DatabaseError(
            f"{file} lies where nothing can be written, and rows that are still in {log.name} can "
            "only be read where SQLite can make a file beside it: copy both to a folder of your "
            "own and give --database that copy"
        )
    connection = _open(f"{file.absolute().as_uri()}?mode=ro&immutable=1", 0, FrozenConnection)
    try:
        _prepare(connection, "reader")
    except BaseException:
        connection.close()
        raise
    return connection


def never_wait(connection: sqlite3.Connection) -> None:
    """From now on a lock that is held by another is an error at once, not a wait."""
    connection.execute("PRAGMA busy_timeout=0")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Generator[None]:
    """All that is written inside is stored, or nothing; the write lock is taken before the first.

    Args:
        connection: In autocommit mode and in no transaction, as `connect` gives it.

    Raises:
        sqlite3.Error: Also where the lock is not to be had (`is_busy`); then nothing ran inside.
    """
    try:
        _begin(connection)
        yield
        connection.execute("COMMIT")
    except BaseException:
        roll_back(connection)
        raise


def _begin(connection: sqlite3.Connection) -> None:
    """Take the write lock, waiting for it in pieces: SQLite's own wait cannot be interrupted."""
    (patience_ms,) = connection.execute("PRAGMA busy_timeout").fetchone()
    if patience_ms <= _UNINTERRUPTED_MS:
        connection.execute("BEGIN IMMEDIATE")
        return
    until_s = time.monotonic() + patience_ms / 1000
    connection.execute(f"PRAGMA busy_timeout={_UNINTERRUPTED_MS}")
    try:
        while not _begun(connection, last=time.monotonic() > until_s):
            pass
    finally:
        connection.execute(f"PRAGMA busy_timeout={patience_ms}")


def _begun(connection: sqlite3.Connection, *, last: bool) -> bool:
    """Whether the write lock is had; the last attempt raises where it is not."""
    try:
        connection.execute("BEGIN IMMEDIATE")
    except sqlite3.OperationalError as error:
        if last or not is_busy(error):
            raise
        return False
    return True


def together(connection: sqlite3.Connection, act: Callable[[], Result]) -> Result:
    """As `transaction`, also where a KeyboardInterrupt comes between any two lines.

    A `with` statement has a moment after BEGIN and one before COMMIT that are outside of it.
    """
    try:
        connection.execute("BEGIN IMMEDIATE")
        result = act()
        connection.execute("COMMIT")
    except BaseException:
        roll_back(connection)
        raise
    return result


def roll_back(connection: sqlite3.Connection) -> None:
    """End the transaction, if one is open: a full disk ends it by itself."""
    if connection.in_transaction:
        connection.execute("ROLLBACK")


class ShortWrites:
    """Work in transactions that hold the write lock for about a millisecond, commit included.

    What an item costs differs a hundredfold from one recording to another, so it is measured: a
    transaction ends when the next item and the commit of all of them would go beyond the time.

    Attributes:
        held_s: How long the last transaction held the lock.
        longest_held_s: How long the longest one did.
    """

    def __init__(self, connection: sqlite3.Connection, limit_s: float = LONGEST_WRITE_S) -> None:
        self._connection = connection
        self._limit_s = limit_s
        self._commit_s = 0.0  # of an item, about
        self.held_s = 0.0
        self.longest_held_s = 0.0

    def write(self, items: Iterable[Result], store: Callable[[Result], object]) -> int:
        """Store the first items in one transaction; returns how many: one at least, if any.

        Raises:
            sqlite3.Error: Also where the lock is not to be had (`is_busy`); nothing was stored.
        """
        stored, started_s, working_s = 0, 0.0, 0.0
        with transaction(self._connection):
            started_s = time.perf_counter()
            for item in items:
                store(item)
                stored += 1
                working_s = time.perf_counter() - started_s
                if (stored + 1) * (working_s / stored + self._commit_s) > self._limit_s:
                    break
        self._measure(time.perf_counter() - started_s, working_s, stored)
        return stored

    def _measure(self, held_s: float, working_s: float, stored: int) -> None:
        self.held_s = held_s
        self.longest_held_s = max(self.longest_held_s, held_s)
        if stored:
            self._commit_s = (self._commit_s + (held_s - working_s) / stored) / 2


class Step:
    """Statements that SQLite runs as one: one short transaction in one call.

    Work that goes on beside control loops holds the write lock for a millisecond at most. In a
    process with several threads a `transaction` cannot promise that: between any two of its
    statements another thread may run for 5 ms and more, while every robot waits for the lock.
    Statements in the body of a trigger run without Python in between.

    What a step writes is prepared before it, in temporary tables, which lock nobody out.

    Args:
        name: Of the step, unlike that of any table.
        parameters: Names of the values that it is run with: `NEW.name` in the statements.
        statements: Tables without the name of a database, no LIMIT on a DELETE or an UPDATE (so
            SQLite wants it in triggers).
        unless: A condition in SQL under which nothing is done: what was prepared is out of date.
    """

    def __init__(
        self, name: str, parameters: tuple[str, ...], *statements: str, unless: str = "0"
    ) -> None:
        call_off = f"SELECT RAISE(ABORT, '{_CALLED_OFF}') WHERE {unless}"
        body = "".join(f"{statement}; " for statement in (call_off, *statements))
        nulls, marks = (", ".join([one] * len(parameters)) for one in ("NULL", "?"))
        self._prepare = (
            f"CREATE TEMP VIEW IF NOT EXISTS {name} ({', '.join(parameters)}) AS SELECT {nulls}",
            f"CREATE TEMP TRIGGER IF NOT EXISTS do_{name} INSTEAD OF INSERT ON {name} "
            f"BEGIN {body}END",
        )
        self._run = f"INSERT INTO {name} VALUES ({marks})"

    def run(self, connection: sqlite3.Connection, *values: object) -> bool:
        """Do all of it and return True, or nothing.

        Args:
            connection: In autocommit mode; it has the temporary tables that the statements name.
            values: One for each parameter.

        Raises:
            sqlite3.Error: Also where the write lock is not to be had (`is_busy`).
        """
        for statement in self._prepare:
            connection.execute(statement)
        try:
            connection.execute(self._run, values)
        except sqlite3.IntegrityError as error:
            if str(error) != _CALLED_OFF:
                raise
            return False
        return True


def is_busy(error: Exception) -> bool:
    """Whether another connection held the lock at that instant: trying again helps.

    `sqlite3` raises more than its own errors: a damaged file makes it quote bytes in a message,
    which are no UTF-8. So who writes catches any Exception, and asks here what it means.
    """
    return isinstance(error, sqlite3.OperationalError) and "locked" in str(error)


def is_about_a_value(error: Exception) -> bool:
    """Whether a single value cannot be read, by SQLite or as text; the file is whole."""
    if isinstance(error, UnicodeDecodeError):  # else it is SQLite's own message that is no text
        return not any(words in text_of(error) for words in _DAMAGE)
    return isinstance(error, sqlite3.Error) and any(s in str(error) for s in _ABOUT_A_VALUE)


def is_damage(error: Exception) -> bool:
    """Whether SQLite says that the file itself is broken, or never was a database."""
    if not isinstance(error, FAILURES) or is_about_a_value(error):
        return False
    return any(words in text_of(error) for words in _DAMAGE)


def text_of(error: Exception) -> str:
    """What went wrong, also where SQLite's own message is no text."""
    if isinstance(error, UnicodeDecodeError):
        return error.object.decode("utf-8", "replace")
    # Python 3.10 leaves such a message out; of this class itself, it was about the file.
    return str(error) or (_SAYS_NOTHING if type(error) is sqlite3.DatabaseError else "")


def is_unwritable(error: Exception) -> bool:
    """Whether the file, or the folder that it needs for its log, cannot be written."""
    return isinstance(error, sqlite3.OperationalError) and any(
        text in str(error) for text in _UNWRITABLE
    )


def identify_files(database: Database) -> tuple[int, ...]:
    """Which files a database consists of at this moment.

    A connection to files that were deleted or replaced still works, on what nobody else sees.
    """
    if isinstance(database, MemoryDatabase):
        return ()
    return (*_identify(f"{database}"), *_identify(f"{database}-wal"))


def _identify(file: str) -> tuple[int, int]:
    try:
        status = os.stat(file)  # noqa: PTH116  (at each heartbeat: no Path objects)
    except OSError:
        return (0, 0)
    return status.st_dev, status.st_ino


def _file_uri(file: Database, create: bool) -> str:
    assert not isinstance(file, MemoryDatabase)
    if create:
        _make(file)
    elif not is_there(file):
        raise NoDatabaseError(f"no database at {file}: {_why_none_is_in(file.parent)}")
    return f"{file.absolute().as_uri()}?mode={'rwc' if create else 'rw'}"


def _why_none_is_in(folder: Path) -> str:
    if folder.is_dir():
        return "no controller with an MCPBridge has recorded there yet"
    return f"{folder} is not a folder" if folder.exists() else f"there is no folder {folder}"


def _make(file: Path) -> None:
    """An empty file that is its owner's alone, as SQLite then makes the log beside it."""
    try:
        make_folder(file.parent)
    except OSError as error:
        raise DatabaseError(f"the folder {file.parent} cannot be made: {error}") from error
    try:
        # Never one that is there: closing it would drop the locks of this process on it.
        os.close(os.open(file, os.O_CREAT | os.O_EXCL | os.O_RDWR, PRIVATE_FILE))
    except FileExistsError:
        return
    except OSError as error:
        raise DatabaseError(f"{file} cannot be opened for writing: {error}") from error


def is_there(file: Path) -> bool:
    """Whether the file exists.

    Raises:
        DatabaseError: Its folder cannot be looked into.
    """
    try:
        return file.exists()
    except OSError as error:
        raise DatabaseError(f"{file} cannot be looked at: {error}") from error


def schema_version(connection: sqlite3.Connection) -> int:
    """The schema version of a database of ours; 0 for an empty file.

    Raises:
        ForeignDatabaseError: The file holds tables of another application.
        sqlite3.DatabaseError: The file is no database, or is damaged.
    """
    # In this order: another starter may be making the tables now, in one transaction. By PRAGMAs:
    # in the place of SQLite's own `pragma_user_version` a view of that name would be read.
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    (application_id,) = connection.execute("PRAGMA application_id").fetchone()
    _, _, file = connection.execute("PRAGMA database_list").fetchone()
    if application_id == APPLICATION_ID:
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        if version < 0 or (version == 0 and tables):  # migrating would run what is there unseen
            raise ForeignDatabaseError(
                f"{file or 'the database'} has tables of schema {version}, which no version of "
                "webots-mcp makes; choose another file"
            )
        return version
    if tables:
        raise ForeignDatabaseError(
            f"the SQLite database {file} belongs to another application (application_id "
            f"{application_id}, expected {APPLICATION_ID}); choose another file"
        )
    return 0


def _make_wal(connection: sqlite3.Connection) -> None:
    """Set what can only be set while the file is empty; harmless on one that is not.

    Asking first matters: setting the mode needs a lock even where it changes nothing.
    """
    if journal_mode(connection) in ("wal", "memory"):
        return
    connection.execute("PRAGMA auto_vacuum=INCREMENTAL")
    connection.execute("PRAGMA journal_mode=WAL").fetchall()


def journal_mode(connection: sqlite3.Connection) -> str:
    """The journal mode in force; anything but "wal" on a file means: no shared memory there.

    Network file systems and the border between Windows and WSL cannot share memory, and without
    it readers and writers block each other.
    """
    return str(connection.execute("PRAGMA journal_mode").fetchone()[0])
