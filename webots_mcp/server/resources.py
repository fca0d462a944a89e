"""What a client can read beside the tools."""

from __future__ import annotations

from contextlib import closing

from mcp.server import MCPServer
from mcp.server.mcpserver.exceptions import ResourceError

from webots_mcp.connection import connect, create_schema
from webots_mcp.contract import MemoryDatabase
from webots_mcp.errors import NoDatabaseError, WebotsMCPError
from webots_mcp.schema import create_schema
from webots_mcp.store.questions.sql import describe_schema
from webots_mcp.store.recording import Recording

SCHEMA_URI = "webots://schema"


def add_resources(mcp: MCPServer, recording: Recording) -> None:
    """Register the resources of a recording."""

    @mcp.resource(
        SCHEMA_URI, title="Schema of the recording", mime_type="text/plain",
        description="All tables, views and columns with their comments, for webots_query_sql.",
    )  # fmt: skip
    def schema() -> str:
        try:
            with recording.reader() as connection:
                return describe_schema(connection)
        except NoDatabaseError:
            return _schema_to_come()
        except WebotsMCPError as error:  # of any other a client is not told what it says
            raise ResourceError(str(error)) from error


def _schema_to_come() -> str:
    """What the database will have when something is recorded."""
    database = MemoryDatabase()
    with closing(connect(database, "writer")) as connection:
        create_schema(connection)
        text = describe_schema(connection)
    database.close()
    return text
