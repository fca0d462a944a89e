"""Whether a database is ours, whole and of our version, and making an empty one ready.

The schema is defined by `store/models.py` and the views in `migrations`; `schema.sql` is generated
from them (a test compares the two), so that a controller can make a database in milliseconds and
without importing anything but the standard library.

A file of foreign origin may hold anything: a view under the name of a table of ours, or a trigger
on one, would run its author's SQL in every process that opens the file, and a recursion in it need
never end. So what has a name of ours must be what we ship under it, and nothing that runs may hang
on it. Further objects that a person has added are left alone.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import re
import sqlite3
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Final

from webots_mcp.contract import APPLICATION_ID, SCHEMA_VERSION, new_uuid
from webots_mcp.errors import ForeignDatabaseError, SchemaTooNewError, SchemaTooOldError
from webots_mcp.transactions import transaction

SCHEMA_FILE: Final = Path(__file__).with_name("schema.sql")

OLDER_SCHEMA: Final = 9  # of the recordings before the values lay in chunks
_FROM_OLDER: Final = (
    "{file} has schema {version}, of an older webots-mcp, and this one knows {known}: move it "
    "aside, so that a new one is begun, and {then}"
)
_THEN: Final = "take it in with 'webots-mcp import FILE'"
_IF_OLDEST: Final = "read it with the webots-mcp that made it"
_MADE: Final = re.compile(r'CREATE (?:UNIQUE )?(?:TABLE|VIEW|INDEX|TRIGGER) "?(\w+)', re.IGNORECASE)
_TOKENS: Final = re.compile(
    r"('(?:[^']|'')*'|\"[^\"]*\"|`[^`]*`|\[[^\]]*\]|\w+|/\*.*?\*/|--[^\n]*|[^\s\w])", re.DOTALL
)
_OF_COLUMNS: Final = re.compile(
    r'CREATE (UNIQUE )?INDEX "?\w+"? ON "?\w+"? ?\("?\w+"?( (ASC|DESC))?'
    r'(, ?"?\w+"?( (ASC|DESC))?)*\)',
    re.IGNORECASE,
)
_INDEX: Final = re.compile(r"CREATE (UNIQUE )?INDEX")
_OBJECTS: Final = (
    "SELECT type, CAST(name AS TEXT), CAST(tbl_name AS TEXT), CAST(sql AS TEXT) "
    "FROM {}.sqlite_master WHERE sql IS NOT NULL"
)
# SQLite's own, which our questions use: a table or view of that name would be read in their place.
_OF_SQLITE: Final = re.compile(r"pragma_|json_(each|tree)$|sqlite_")
_OF_SQLITE_MADE: Final = "CREATE TABLE sqlite_"  # for AUTOINCREMENT, and by ANALYZE
_NEW_RECORDING: Final = "INSERT INTO recording (uuid, created_wall_time_s) VALUES (?, ?)"


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
        SchemaTooNewError, SchemaTooOldError, ForeignDatabaseError: As they say.
    """
    version = schema_version(connection)
    if version > SCHEMA_VERSION:
        raise SchemaTooNewError(
            f"the database has schema {version}, this webots-mcp knows {SCHEMA_VERSION}: "
            "upgrade it with 'pip install --upgrade', from where it was installed"
        )
    if version < SCHEMA_VERSION:
        raise SchemaTooOldError(
            _FROM_OLDER.format(
                file=_file(connection, "main"),
                version=version,
                known=SCHEMA_VERSION,
                then=_THEN if version == OLDER_SCHEMA else _IF_OLDEST,
            )
        )


def create_schema(connection: sqlite3.Connection) -> None:
    """Make the tables in an empty database; of several starters at once, one does it.

    The database gets its UUID, the one row of `recording`. The check, the tables and that row
    stand in one transaction that takes the write lock first.
    """
    with transaction(connection):
        if schema_version(connection) == 0:
            for statement in shipped_statements():
                connection.execute(statement)
            connection.execute(_NEW_RECORDING, (new_uuid(), time.time()))


@cache
def shipped_statements() -> tuple[str, ...]:
    """The statements of `schema.sql`; each ends with a semicolon at the end of a line."""
    return tuple(each for each in SCHEMA_FILE.read_text("utf-8").split(";\n") if each.strip())


@cache
def shipped_objects() -> dict[str, str]:
    """By their names, the statements that make tables, views and indexes."""
    return _by_name(shipped_statements())


def _by_name(statements: Iterable[str]) -> dict[str, str]:
    made = ((_MADE.match(each), each.rstrip()) for each in statements)
    return {match[1].lower(): each for match, each in made if match}


def require_shipped(
    connection: sqlite3.Connection,
    statements: Iterable[str] | None = None,
    *,
    schema: str = "main",
) -> None:
    """Raise where a table, view or index of ours is not what we ship, or something runs on one.

    A table or view that is missing is as wrong; an index is not.

    Args:
        connection: Nothing but PRAGMAs was asked of that database yet.
        statements: Those that make what we ship, in another version; None for this one.
        schema: The name that the database was attached under.

    Raises:
        ForeignDatabaseError: The text names what it is, and what to do.
    """
    shipped = shipped_objects() if statements is None else _by_name(statements)
    texts = set(shipped.values())
    found = connection.execute(_OBJECTS.format(schema)).fetchall()
    names = {name.lower() for _, name, _, _ in found}
    for name, sql in shipped.items():
        if name not in names and not _INDEX.match(sql):  # without one, all is slower, and true
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
                "has not made it, so nothing of the file is used: if it is your own, remove it "
                f"(sqlite3 FILE 'DROP {kind.upper()} ...'), else do not trust the file"
            )


def _file(connection: sqlite3.Connection, schema: str) -> str:
    files = connection.execute("PRAGMA database_list").fetchall()
    return next((path for _, each, path in files if each == schema and path), "the database")


def _why_refused(
    kind: str, name: str, table: str, sql: str, shipped: dict[str, str], referring: set[str]
) -> str | None:
    """Why an object is refused; None where it is harmless, or ours in another spelling."""
    if (ours := shipped.get(name.lower())) is not None:
        return None if _spelled(sql) == _spelled(ours) else "stands where another is in recordings"
    if _OF_SQLITE.match(name.lower()) and not sql.startswith(_OF_SQLITE_MADE):
        return "has a name of SQLite's own"
    if kind == "trigger" and (table.lower() in shipped or table.lower() in referring):
        return f"runs when {table[:60]!r} is written to"
    if kind == "index" and table.lower() in shipped and not _OF_COLUMNS.fullmatch(sql.strip()):
        return f"computes when {table[:60]!r} is written to"
    return None


def _refers(sql: str) -> bool:
    """Whether a table may have foreign keys, by which a deleted row of ours deletes rows there."""
    return "references" in sql.lower()


def _spelled(sql: str) -> list[str]:
    """The words of a statement: versions of SQLite and ours differ in spaces and comments."""
    return [
        each if each.startswith("'") else each.strip('"').lower()
        for each in _TOKENS.findall(sql)
        if not each.startswith(("/*", "--"))
    ]
