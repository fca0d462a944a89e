"""Whether a database is ours and of our version, and making an empty one ready.

The schema is defined by `store/models.py` and the migrations; `schema.sql` is generated from them
(a test compares the two), so that a controller can make a database in milliseconds and without
importing anything but the standard library.
"""

from __future__ import annotations

import sqlite3
import time
from typing import Final

from webots_mcp.connection import schema_version, transaction
from webots_mcp.contract import SCHEMA_VERSION, new_uuid
from webots_mcp.errors import SchemaTooNewError, SchemaTooOldError
from webots_mcp.origin import shipped_statements

_NEW_RECORDING: Final = "INSERT INTO recording (uuid, created_wall_time_s) VALUES (?, ?)"


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
            f"the database has schema {version}, this webots-mcp needs {SCHEMA_VERSION}: "
            "run 'webots-mcp migrate'"
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
