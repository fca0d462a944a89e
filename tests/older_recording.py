"""A recording of the schema before this one."""

from contextlib import closing
from pathlib import Path

from webots_mcp.connection import connect
from webots_mcp.schema import OLDER_SCHEMA, create_schema


def make_older(file: Path) -> None:
    """Make a recording that says of itself that it is one."""
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute(f"PRAGMA user_version = {OLDER_SCHEMA}")
