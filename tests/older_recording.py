"""A recording of another schema than this one."""

from contextlib import closing
from pathlib import Path

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.database.connection import connect, create_schema

OLDER_SCHEMA = SCHEMA_VERSION - 1


def make_older(file: Path) -> None:
    """Make a recording that says of itself that it is one of the schema before."""
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute(f"PRAGMA user_version = {OLDER_SCHEMA}")
