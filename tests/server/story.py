"""The recording whose story is known, behind a server."""

from __future__ import annotations

import os
import sqlite3
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any, Literal

from mcp import Client, StdioServerParameters

from tests.recordings.rover import record_rover
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.server.mcp_server import create_server

Way = Literal["memory", "memory-legacy", "stdio", "stdio-legacy"]
WAYS: tuple[Way, ...] = ("memory", "memory-legacy", "stdio", "stdio-legacy")


def write_story(file: Path) -> Path:
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        record_rover(connection)
    return file


def copy_of(file: Path, other: Path) -> Path:
    with closing(sqlite3.connect(file)) as source, closing(sqlite3.connect(other)) as target:
        source.backup(target)
        target.execute("PRAGMA journal_mode=WAL").fetchall()
    return other


@asynccontextmanager
async def client_on(
    file: Path, way: Way = "memory", *, read_only: bool = True
) -> AsyncGenerator[Client]:
    mode: Any = "legacy" if way.endswith("legacy") else "auto"
    options = ["--read-only"] if read_only else []
    arguments = ["-m", "webots_mcp", "serve", "--database", str(file), *options]
    child = StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))
    server = create_server(file, file.parent, read_only=read_only)
    async with Client(child if way.startswith("stdio") else server, mode=mode) as client:
        yield client


def rows_of(table: dict[str, Any] | None) -> list[dict[str, Any]]:
    """A table as one dict per row."""
    if table is None:
        return []
    shared = table.get("in_every_row", {})
    return [shared | dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
