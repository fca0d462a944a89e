"""Opening the database: its PRAGMAs, its files, its schema and transactions, for both sides.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import re
import sqlite3
import time
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

from webots_mcp.contract import (
    APPLICATION_ID,
    PREVIOUS_SCHEMA_VERSION,
    SCHEMA_VERSION,
    new_uuid,
)
from webots_mcp.database.files import PRIVATE_FILE, make_folder
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.errors import (
    DatabaseError,
    ForeignDatabaseError,
    ForkedProcessError,
    NoDatabaseError,
    SchemaTooNewError,
    SchemaTooOldError,
)

# Transactions on a database that control loops write to as well, and what SQLite's errors mean.


Result = TypeVar("Result")

_UNINTERRUPTED_MS: Final = 100
LONGEST_WRITE_S: Final = 0.001  # of maintenance: a robot that wants to write waits this long
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
SCHEMA_FILE: Final = Path(__file__).with_name("schema.sql")
# Patterns are texts, which `re` compiles when they are needed: most are for foreign objects only.
_MADE: Final = r'(?i)CREATE (?:UNIQUE )?(?:TABLE|VIEW|INDEX|TRIGGER) "?(\w+)'
_TOKENS: Final = (
    r"(?s)('(?:[^']|'')*'|\"[^\"]*\"|`[^`]*`|\[[^\]]*\]|\w+|/\*.*?\*/|--[^\n]*|[^\s\w])"
)
_OF_COLUMNS: Final = (
    r'(?i)CREATE (UNIQUE )?INDEX "?\w+"? ON "?\w+"? ?\("?\w+"?( (ASC|DESC))?'
    r'(, ?"?\w+"?( (ASC|DESC))?)*\)'
)
_INDEX: Final = r"CREATE (UNIQUE )?INDEX"
# Names of SQLite's own functions: a table or view of such a name would be read in their place.
_OF_SQLITE: Final = r"pragma_|json_(each|tree)$|sqlite_"
_OF_SQLITE_MADE: Final = "CREATE TABLE sqlite_"  # for AUTOINCREMENT, and by ANALYZE
_NEW_RECORDING: Final = "INSERT INTO recording (uuid, created_wall_time_s) VALUES (?, ?)"
OLDEST_SQLITE: Final = (3, 38, 0)  # RETURNING, ->>, shared databases in memory
OPENING_TIMEOUT_MS: Final = 5000
LONGEST_READ_S: Final = 60.0  # of a statement of a reader
_STEPS_PER_CHECK: Final = 1_000_000  # of SQLite's virtual machine: some 20 ms
CHECKPOINT_TIMEOUT_MS: Final = 100  # longer, and a checkpoint makes writers wait for its readers
_MOST_DESCRIPTORS: Final = 1024
# Why: a control loop never waits for a lock; an automatic checkpoint would be its slowest step,
# so only the maintainer checkpoints; NORMAL costs the last commits at a power cut, never the file.
_PRAGMAS: Final[dict[Role, tuple[str, ...]]] = {
    "loop": ("synchronous=NORMAL", "wal_autocheckpoint=0", "foreign_keys=ON"),
    "writer": ("synchronous=NORMAL", "wal_autocheckpoint=0", "foreign_keys=ON"),
    "reader": ("query_only=ON",),
}


def never_wait(connection: sqlite3.Connection) -> None:
    """Make a lock that another connection holds an error at once from now on, not a wait."""
    connection.execute("PRAGMA busy_timeout=0")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Generator[None]:
    """Open a transaction that takes the write lock first: all writes in it are stored, or none.

    Args:
        connection: A connection in autocommit mode and in no transaction, as `connect` opens it.

    Raises:
        sqlite3.Error: If a write fails, or the lock cannot be acquired (`is_busy`); in that case
            nothing inside has run.
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
    """Try once to take the write lock.

    Args:
        connection: A connection that is in no transaction.
        last: Raise if the lock is held by another connection.

    Returns:
        Whether the lock was acquired.
    """
    try:
        connection.execute("BEGIN IMMEDIATE")
    except sqlite3.OperationalError as error:
        if last or not is_busy(error):
            raise
        return False
    return True


def in_transaction(connection: sqlite3.Connection, act: Callable[[], Result]) -> Result:
    """Call `act` in a transaction that no KeyboardInterrupt can leave open.

    A `with` statement cannot promise that: an interrupt may come right after BEGIN, before its
    block has begun, or right before COMMIT, after its block has ended.
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
    """End the transaction, if one is still open: on a full disk SQLite has ended it already."""
    if connection.in_transaction:
        connection.execute("ROLLBACK")


class AtomicStatements:
    """Statements that SQLite runs as one short transaction in one call.

    Maintenance holds the write lock for a millisecond at most while control loops run. In a process
    with several threads a `transaction` cannot promise that: between two of its statements another
    thread may run for 5 ms and more, while every robot waits for the lock. The statements in the
    body of a trigger run without Python in between.

    The rows to write are prepared in temporary tables, which lock out no other process.

    Args:
        name: The name of the trigger's view; no table may have it.
        parameters: Names of the values of a call, which the statements use as `NEW.name`.
        statements: The statements. As in any trigger, tables have no schema name, and a DELETE or
            UPDATE has no LIMIT.
        unless: A condition in SQL; if it holds, the prepared rows are out of date, and nothing is
            done.
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
        """Run all statements, or none of them.

        Args:
            connection: A connection in autocommit mode, with the temporary tables.
            values: One value for each parameter.

        Returns:
            False if the condition `unless` held, and nothing was done.

        Raises:
            sqlite3.Error: If a statement fails, or the write lock cannot be acquired (`is_busy`).
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
    """Return whether another connection held the lock at that instant, so that a retry helps.

    `sqlite3` raises more than its own errors: for a damaged file it may quote bytes in a message
    that are not UTF-8. So code that writes catches any Exception, and checks its meaning here.
    """
    return isinstance(error, sqlite3.OperationalError) and "locked" in str(error)


def is_about_a_value(error: Exception) -> bool:
    """Return whether a single value cannot be read, while the file itself is intact."""
    if isinstance(error, UnicodeDecodeError):  # else it is SQLite's own message that is no text
        return not any(words in text_of(error) for words in _DAMAGE)
    return isinstance(error, sqlite3.Error) and any(s in str(error) for s in _ABOUT_A_VALUE)


def is_damage(error: Exception) -> bool:
    """Return whether SQLite says that the file itself is broken, or never was a database."""
    if not isinstance(error, FAILURES) or is_about_a_value(error):
        return False
    return any(words in text_of(error) for words in _DAMAGE)


def text_of(error: Exception) -> str:
    """Return the message of an error, even if SQLite's own message is not valid text."""
    if isinstance(error, UnicodeDecodeError):
        return error.object.decode("utf-8", "replace")
    # Python 3.10 leaves such a message out; of this class itself, it was about the file.
    return str(error) or (_SAYS_NOTHING if type(error) is sqlite3.DatabaseError else "")


def is_unwritable(error: Exception) -> bool:
    """Return whether the file, or the folder that it needs for its log, cannot be written."""
    return isinstance(error, sqlite3.OperationalError) and any(
        text in str(error) for text in _UNWRITABLE
    )


# Whether a database is ours, whole and of our version, and making an empty one ready.
#
# The schema is defined by `store/models.py` and the views in `migrations`; `schema.sql` is
# generated from them (a test compares the two), so that a controller can make a database in
# milliseconds and without importing anything but the standard library.
#
# A file of foreign origin may hold anything: a view under the name of a table of ours, or a
# trigger on one, would run its author's SQL in every process that opens the file, and a recursion
# in it need never end. So what has a name of ours must be what we ship under it, and nothing that
# runs may hang on it. Further objects that a person has added are left alone.


def schema_version(connection: sqlite3.Connection) -> int:
    """Return the schema version of a database of ours; 0 for an empty file.

    Raises:
        ForeignDatabaseError: If the file holds tables of another application.
        sqlite3.DatabaseError: If the file is not a database, or is damaged.
    """
    # In this order: another starter may be making the tables now, in one transaction. By PRAGMAs:
    # in the place of SQLite's own `pragma_user_version` a view of that name would be read.
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    (application_id,) = connection.execute("PRAGMA application_id").fetchone()
    _, _, file = connection.execute("PRAGMA database_list").fetchone()
    if application_id == APPLICATION_ID:
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        if version < 0 or (version == 0 and tables):
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


def require_current(connection: sqlite3.Connection) -> None:
    """Raise unless the database has exactly the schema of this version.

    Raises:
        SchemaTooNewError: If a newer version of webots-mcp made the database.
        SchemaTooOldError: If an older version made it.
        ForeignDatabaseError: If another application made it.
    """
    version = schema_version(connection)
    if version > SCHEMA_VERSION:
        raise SchemaTooNewError(
            f"the database has schema {version}, this webots-mcp knows {SCHEMA_VERSION}: "
            "upgrade it with 'pip install --upgrade', from where it was installed"
        )
    if version < SCHEMA_VERSION:
        fix = "read it with the webots-mcp that made it"
        if version == PREVIOUS_SCHEMA_VERSION:
            fix = "bring its runs over with 'webots-mcp import FILE'"
        raise SchemaTooOldError(
            f"{_file(connection, 'main')} has schema {version}, of an older webots-mcp, and this "
            f"one knows {SCHEMA_VERSION}: move it aside, so that a new one is begun, and {fix}"
        )


def create_schema(connection: sqlite3.Connection) -> None:
    """Create the tables in an empty database, and its UUID, the only row of `recording`.

    Several processes may call this at the same time: one transaction, which takes the write lock
    first, checks that the database is still empty.
    """
    with transaction(connection):
        if schema_version(connection) == 0:
            for statement in shipped_statements():
                connection.execute(statement)
            connection.execute(_NEW_RECORDING, (new_uuid(), time.time()))


@cache
def shipped_statements() -> tuple[str, ...]:
    """Return the statements of `schema.sql`."""
    return statements_of(SCHEMA_FILE)


def statements_of(file: Path) -> tuple[str, ...]:
    """Return the statements of a file; each ends with a semicolon at the end of a line."""
    return tuple(each for each in file.read_text("utf-8").split(";\n") if each.strip())


def shipped_objects() -> dict[str, str]:
    """Return the statements that create what each recording has, by name."""
    return _objects_of(shipped_statements())


@cache
def _objects_of(statements: tuple[str, ...]) -> dict[str, str]:
    """Return the statements that create tables, views, indexes and triggers, by name."""
    made = ((re.match(_MADE, each), each.rstrip()) for each in statements)
    return {match[1].lower(): each for match, each in made if match}


def require_shipped(
    connection: sqlite3.Connection,
    *,
    schema: str = "main",
    statements: tuple[str, ...] | None = None,
) -> None:
    """Refuse a database whose objects differ from those that we ship, or run code on our tables.

    A missing table or view is refused too; a missing index is not.

    Args:
        connection: A connection on which only PRAGMAs have run so far.
        schema: The name under which the database is attached.
        statements: The statements that created the tables; None for those of this version.

    Raises:
        ForeignDatabaseError: If an object differs; the text names it and says what to do.
    """
    shipped = _objects_of(statements or shipped_statements())
    texts = set(shipped.values())
    statement = (
        "SELECT type, CAST(name AS TEXT), CAST(tbl_name AS TEXT), CAST(sql AS TEXT) "
        "FROM {}.sqlite_master WHERE sql IS NOT NULL"
    )
    found = connection.execute(statement.format(schema)).fetchall()
    names = {name.lower() for _, name, _, _ in found}
    for name, sql in shipped.items():
        if name not in names and not re.match(_INDEX, sql):  # without one, all is slower, and true
            raise ForeignDatabaseError(
                f"{_file(connection, schema)} has no {name!r}, which webots-mcp makes in each "
                "recording: use a copy from before it was removed"
            )
    others = [row for row in found if row[3].rstrip() not in texts]
    if not others:  # as a rule
        return
    referring = {name.lower() for kind, name, _, sql in others if kind == "table" and _refers(sql)}
    for kind, name, table, sql in others:
        if (why := _why_refused(kind, name, table, sql, shipped, referring)) is not None:
            raise ForeignDatabaseError(
                f"the {kind} {name[:60]!r} in {_file(connection, schema)} {why}, and webots-mcp "
                "did not create it, so nothing of the file is used: if it is your own, remove it "
                f"(sqlite3 FILE 'DROP {kind.upper()} ...'), else do not trust the file"
            )


def _file(connection: sqlite3.Connection, schema: str) -> str:
    files = connection.execute("PRAGMA database_list").fetchall()
    return next((path for _, each, path in files if each == schema and path), "the database")


def _why_refused(
    kind: str, name: str, table: str, sql: str, shipped: dict[str, str], referring: set[str]
) -> str | None:
    """Return why an object is refused; None if it is harmless, or ours in another spelling."""
    if (ours := shipped.get(name.lower())) is not None:
        return (
            None
            if _spelled(sql) == _spelled(ours)
            else "differs from the object of that name in recordings"
        )
    if re.match(_OF_SQLITE, name.lower()) and not sql.startswith(_OF_SQLITE_MADE):
        return "has a name of SQLite's own"
    if kind == "trigger" and (table.lower() in shipped or table.lower() in referring):
        return f"runs when {table[:60]!r} is written to"
    if kind == "index" and table.lower() in shipped and not re.fullmatch(_OF_COLUMNS, sql.strip()):
        return f"computes when {table[:60]!r} is written to"
    return None


def _refers(sql: str) -> bool:
    """Return whether a table may have foreign keys: deleting a row of ours may delete its rows."""
    return "references" in sql.lower()


def _spelled(sql: str) -> list[str]:
    """Split a statement into words, since SQLite may store other spaces and comments."""
    return [
        each if each.startswith("'") else each.strip('"').lower()
        for each in re.findall(_TOKENS, sql)
        if not each.startswith(("/*", "--"))
    ]


Role = Literal["loop", "writer", "reader"]


# SQLite remembers in the process' own memory which files it has open and locked. A fork copies that
# memory, but not the locks: a connection that the child opens to the same file believes to hold
# locks that it does not have, and destroys the database under its parent.
# Device and inode of each such file; None if this process was forked and has not listed them yet.
_inherited: set[tuple[int, int]] | None = set()


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
    connection.set_progress_handler(is_late, _STEPS_PER_CHECK)


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
    for descriptor in range(_MOST_DESCRIPTORS):
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
