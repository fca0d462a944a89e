"""The schema of a recording: creating it, its version, and whether a file is safe to use.

`store/models.py` and the views in `migrations` define the schema; `schema.sql` is generated from
them (a test compares the two), so that a controller can make a database in milliseconds and without
importing anything but the standard library.

A file of foreign origin may hold anything: a view under the name of a table of ours, or a trigger
on one, would run its author's SQL in every process that opens the file, and a recursion in it need
never end. So what has a name of ours must be what we ship under it, and nothing that runs may hang
on it. Further objects that a person has added are left alone.
"""

from __future__ import annotations

import re
import sqlite3
import time
from functools import cache
from pathlib import Path
from typing import Final

from webots_mcp.contract import (
    APPLICATION_ID,
    PREVIOUS_SCHEMA_VERSION,
    SCHEMA_VERSION,
    new_uuid,
)
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import (
    ForeignDatabaseError,
    SchemaTooNewError,
    SchemaTooOldError,
)

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
            connection.execute(
                "INSERT INTO recording (uuid, created_wall_time_s) VALUES (?, ?)",
                (new_uuid(), time.time()),
            )


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
    # for AUTOINCREMENT, and by ANALYZE
    if re.match(_OF_SQLITE, name.lower()) and not sql.startswith("CREATE TABLE sqlite_"):
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
