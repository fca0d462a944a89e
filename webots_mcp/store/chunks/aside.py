"""Chunks of a recording that is not to be written: in a temporary file of this process, made once.

The file is a recording without states, which are read from the other one; a reader sees its groups,
chunks and signals in the place of those of the recording. It goes when the process ends.
"""

from __future__ import annotations

import atexit
import shutil
import sqlite3
import tempfile
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.schema import create_schema
from webots_mcp.store.chunks.stored import IS_MARK, watermark

_SEEN: Final = ("signal", "row_group", "chunk", "watermark")
_COPIED: Final = ("robot", "session", "run", *_SEEN)
_OTHERS: Final = (
    "SELECT type, name FROM main.sqlite_master WHERE type = 'view' OR type = 'table' AND name "
    f"NOT IN {_COPIED} AND name NOT LIKE 'sqlite_%'"
)
_LAST_IDS: Final = (
    "DELETE FROM main.sqlite_sequence WHERE name = 'state'",
    "INSERT INTO main.sqlite_sequence SELECT * FROM recorded.sqlite_sequence WHERE name = 'state'",
)

_UUID: Final = "SELECT uuid FROM {}.recording"  # a new file may have the number of a deleted one
_MARK: Final = f"SELECT state_id FROM main.watermark WHERE name = 'chunk' AND {IS_MARK}"
_LAST_ID: Final = "SELECT coalesce(max(max_state_id), 0) FROM row_group WHERE is_complete = 1"


class _Made(NamedTuple):
    file: Path
    uuid: str  # of the recording
    last_id: int  # up to which its rows are in chunks


_made: dict[tuple[int, int], _Made] = {}


def is_chunked_aside(connection: sqlite3.Connection, database: Path) -> bool:
    """Whether this process has chunks of its own of a recording, which has not got as far.

    A server that has begun to maintain it meanwhile deletes rows after it put them into chunks.
    """
    made = _made.get(_key(database))
    if made is None or connection.execute(_UUID.format("main")).fetchone() != (made.uuid,):
        return False
    (mark,) = connection.execute(_MARK).fetchone() or (0,)
    return mark < made.last_id


def show_chunks_aside(connection: sqlite3.Connection, database: Path) -> None:
    """Let a reader see the chunks that this process has of its recording, if it has any."""
    if not is_chunked_aside(connection, database):
        return
    file = _made[_key(database)].file
    connection.execute("ATTACH DATABASE ? AS aside", (f"{file.as_uri()}?mode=ro",))
    connection.execute("PRAGMA query_only=OFF")  # for views of this connection alone
    for table in _SEEN:
        connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM aside.{table}")
    connection.execute("PRAGMA query_only=ON")


@contextmanager
def chunks_aside(database: Path, *, frozen: bool) -> Generator[sqlite3.Connection]:
    """A connection on which `make_chunks` writes into the temporary file; readers see it after.

    Args:
        database: The recording.
        frozen: No process writes to it, nor can one.
    """
    key = _key(database)
    file = _made[key].file if key in _made else _new_file()
    with closing(sqlite3.connect(file, isolation_level=None)) as connection:
        immutable = "&immutable=1" if frozen else ""
        address = f"{database.absolute().as_uri()}?mode=ro{immutable}"
        connection.execute("ATTACH DATABASE ? AS recorded", (address,))
        (uuid,) = connection.execute(_UUID.format("recorded")).fetchone()
        if key not in _made or _made[key].uuid != uuid:
            for table in _COPIED:
                connection.execute(f"DELETE FROM main.{table}")
                connection.execute(f"INSERT INTO main.{table} SELECT * FROM recorded.{table}")
        for statement in _LAST_IDS:  # up to which a watermark is believed
            connection.execute(statement)
        try:
            yield connection
        finally:
            (last_id,) = connection.execute(_LAST_ID).fetchone()  # also of work that broke off
            _made[key] = _Made(file, uuid, max(last_id, watermark(connection)))


def _new_file() -> Path:
    """One in which whatever is not copied is missing, so that it is read from the recording."""
    folder = tempfile.mkdtemp(prefix="webots-mcp-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    file = Path(folder) / DATABASE_NAME
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("PRAGMA foreign_keys=OFF")
        connection.execute("PRAGMA journal_mode=DELETE")
        for kind, name in connection.execute(_OTHERS).fetchall():
            connection.execute(f"DROP {kind} {name}")
    return file


def _key(database: Path) -> tuple[int, int]:
    status = database.stat()
    return status.st_dev, status.st_ino
