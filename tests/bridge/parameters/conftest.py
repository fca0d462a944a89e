"""How parameters are set from outside, and what is recorded of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.bridge.conftest import Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor

VALUES = (
    "SELECT run_id, name, value, is_default, set_by, command_id FROM parameter_value ORDER BY id"
)


@pytest.fixture
def lenient(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> Iterator[MCPBridge]:
    """A bridge as in a user's controller: what goes wrong is warned of."""
    monkeypatch.delenv("WEBOTS_MCP_STRICT", raising=False)
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        yield bridge


def ask(recording: Recording, bridge: MCPBridge, **params: Any) -> tuple[str, Any, str | None]:
    """Send `set_parameters`, let the bridge serve it, and return its fate."""
    sent = recording.send("set_parameters", **params)
    eager(bridge)
    return recording.fate(sent)
