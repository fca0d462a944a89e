"""A bridge whose database is a file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.database.waiting_file import adopt
from webots_mcp.standin import InProcessSupervisor


@pytest.fixture
def bridge(robot: InProcessSupervisor, file: Path) -> Iterator[MCPBridge]:
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        yield bridge


POSIX = pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")


def adopt_into(file: Path) -> int:
    with closing(connect(file, "writer")) as connection:
        return adopt(connection, file)
