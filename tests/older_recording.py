"""A recording of the previous schema."""

from contextlib import closing
from pathlib import Path

from webots_mcp.contract import PREVIOUS_SCHEMA_VERSION, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import statements_of
from webots_mcp.database.schema_migration import PREVIOUS_SCHEMA_FILE

OLDER_SCHEMA = PREVIOUS_SCHEMA_VERSION


def make_older(file: Path) -> None:
    """Make an empty recording as the version before made it."""
    with closing(connect(file, "writer", create=True)) as connection:
        for statement in statements_of(PREVIOUS_SCHEMA_FILE):
            connection.execute(statement)
        connection.execute("INSERT INTO recording VALUES (?, 0)", (new_uuid(),))
