"""Opening the database, for both sides: its PRAGMAs, its files, and forked processes.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from webots_mcp.contract import (
    SCHEMA_VERSION,
)
from webots_mcp.database.files import PRIVATE_FILE, make_folder
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.database.schema import require_shipped, schema_version
from webots_mcp.database.transactions import is_unwritable
from webots_mcp.errors import (
    DatabaseError,
    ForkedProcessError,
    NoDatabaseError,
)

OLDEST_SQLITE: Final = (3, 38, 0)  # RETURNING, ->>, shared databases in memory
OPENING_TIMEOUT_MS: Final = 5000
LONGEST_READ_S: Final = 60.0  # of a statement of a reader
CHECKPOINT_TIMEOUT_MS: Final = 100  # longer, and a checkpoint makes writers wait for its readers
# Why: a control loop never waits for a lock; an automatic checkpoint would be its slowest step,
# so only the maintainer checkpoints; NORMAL costs the last commits at a power cut, never the file.
_PRAGMAS: Final[dict[Role, tuple[str, ...]]] = {
    "loop": ("synchronous=NORMAL", "wal_autocheckpoint=0", "foreign_keys=ON"),
    "writer": ("synchronous=NORMAL", "wal_autocheckpoint=0", "foreign_keys=ON"),
    "reader": ("query_only=ON",),
}

Role = Literal["loop", "writer", "reader"]


# SQLite remembers in the process' own memory which files it has open and locked. A fork copies that
# memory, but not the locks: a connection that the child opens to the same file believes to hold
# locks that it does not have, and destroys the database under its parent.
# Device and inode of each such file; None if this process was forked and has not listed them yet.
_inherited: set[tuple[int, int]] | None = set()


class ReaderLimits(NamedTuple):
    """Limits of a connection.

    Attributes:
        steps_per_check: Instructions of SQLite's virtual machine between two checks: some 20 ms.
        descriptors: Open files of a process that are checked.
    """

    steps_per_check: int = 1_000_000
    descriptors: int = 1024


_READER: Final = ReaderLimits()


class ReadingConnection(sqlite3.Connection):
    """Interrupts each statement after a minute, since views of others may never end."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._until_s = [0.0]  # apart from the connection, which the handler must not keep alive
        keep_deadline(self)

    def execute(self, *statement: Any) -> sqlite3.Cursor:
        """Execute a statement, with a deadline of its own."""
        self._until_s[0] = time.monotonic() + LONGEST_READ_S
        return super().execute(*statement)

    def is_late(self) -> Callable[[], bool]:
        """Return a function that returns whether the newest statement exceeds its time."""
        until_s = self._until_s
        return lambda: time.monotonic() > until_s[0]


def keep_deadline(connection: sqlite3.Connection) -> None:
    """Restore a connection's own deadline, if it has one, after another one was set."""
    is_late = connection.is_late() if isinstance(connection, ReadingConnection) else None
    connection.set_progress_handler(is_late, _READER.steps_per_check)


class FrozenConnection(ReadingConnection):
    """A connection to a file in a folder that cannot be written.

    Reading a database in WAL mode needs two files next to it. If these do not exist and cannot be
    created, SQLite reads the database file alone, as one that never changes.
    """


def connect(
    database: Database, role: Role, *, create: bool = False, patient: bool = True
) -> sqlite3.Connection:
    """Open the database in autocommit mode: transactions begin only where the code says so.

    A "reader" can also open a file that cannot be written, see `FrozenConnection`.

    Args:
        database: A file or a database in memory.
        role: "loop" for a controller, "writer" for the server, "reader" for read access.
        create: Create the file (empty, in WAL mode) and its folder if they are missing.
        patient: Wait up to 5 s for locks, now and later; a control loop does not.

    Raises:
        NoDatabaseError: If the file is missing and `create` is false.
        DatabaseError: If the folder cannot be created, the file cannot be opened, its log cannot
            be read in a folder without write access, or SQLite is too old.
        ForeignDatabaseError: If the file belongs to another application, or has objects under our
            names, or on our tables, that we did not create.
        ForkedProcessError: If the process from which this one was forked has the file open.
        sqlite3.Error: If the file is not a database, or is locked for longer than 5 s.
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
        # Another application's file stays as it is, and one of another version too.
        if create and schema_version(connection) in (0, SCHEMA_VERSION):
            _make_wal(connection)
        _prepare(connection, role)
    except Exception as error:
        connection.close()
        if role == "reader" and isinstance(database, Path) and is_unwritable(error):
            return _open_frozen(database)
        raise
    return connection


def _prepare(connection: sqlite3.Connection, role: Role) -> None:
    """Set the PRAGMAs of the role, and refuse foreign objects in a database of this version."""
    for pragma in _PRAGMAS[role]:
        connection.execute(f"PRAGMA {pragma}")
    if _can_distrust():
        connection.execute("PRAGMA trusted_schema=OFF")
    if schema_version(connection) == SCHEMA_VERSION:
        require_shipped(connection)


@cache
def _can_distrust() -> bool:
    """Return whether `trusted_schema` can be off without breaking our own views.

    SQLite 3.40 counts the JSON functions, which our views call, among those with side effects.
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


def is_inherited(file: Path) -> bool:
    """Return whether a process that this one was forked from had the file open at that moment."""
    global _inherited
    if _inherited is None:
        _inherited = _open_files()
    if not _inherited:
        return False
    try:
        status = file.stat()
    except OSError:
        return False
    return (status.st_dev, status.st_ino) in _inherited


def _open_files() -> set[tuple[int, int]]:
    files: set[tuple[int, int]] = set()
    for descriptor in range(_READER.descriptors):
        try:
            status = os.fstat(descriptor)
        except OSError:
            continue
        files.add((status.st_dev, status.st_ino))
    return files


def _forget() -> None:
    global _inherited
    _inherited = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


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
    """Open a file that cannot be written, as one that never changes.

    Raises:
        DatabaseError: If it has a write-ahead log, which may have the newest rows.
    """
    log = file.with_name(f"{file.name}-wal")
    if log.exists():
        raise DatabaseError(
            f"{file} is in a folder that cannot be written, and the rows in {log.name} can only be "
            "read where SQLite can create a file next to it: copy both to a folder of your own and "
            "give --database that copy"
        )
    connection = _open(f"{file.absolute().as_uri()}?mode=ro&immutable=1", 0, FrozenConnection)
    try:
        _prepare(connection, "reader")
    except BaseException:
        connection.close()
        raise
    return connection


def identify_files(database: Database) -> tuple[int, ...]:
    """Identify the files of a database, to notice later that they were deleted or replaced.

    A connection to such files still works, on data that no other process sees.
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
    """Create an empty file that only its owner can read: SQLite gives its log the same rights."""
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
    """Return whether the file exists.

    Raises:
        DatabaseError: If its folder cannot be read.
    """
    try:
        return file.exists()
    except OSError as error:
        raise DatabaseError(f"{file} cannot be checked: {error}") from error


def _make_wal(connection: sqlite3.Connection) -> None:
    """Set the journal mode and vacuum mode, which is only possible while the file is empty.

    The mode is read first, since setting it takes a lock even if nothing changes.
    """
    if journal_mode(connection) in ("wal", "memory"):
        return
    connection.execute("PRAGMA auto_vacuum=INCREMENTAL")
    connection.execute("PRAGMA journal_mode=WAL").fetchall()


def journal_mode(connection: sqlite3.Connection) -> str:
    """Return the journal mode; for a file, any mode but "wal" means that memory cannot be shared.

    Network file systems cannot share memory, nor can Windows and WSL with each other. Without
    shared memory, readers and writers block each other.
    """
    return str(connection.execute("PRAGMA journal_mode").fetchone()[0])
