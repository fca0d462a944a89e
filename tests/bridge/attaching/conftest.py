"""A robot whose steps publish and serve commands, and what was recorded of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import control
from webots_mcp.standin import InProcessSupervisor


@pytest.fixture
def look_in_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step looks into the queue, not only one in 5 ms."""
    monkeypatch.setattr(control, "POLL_INTERVAL_S", 0.0)
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")


@pytest.fixture
def attached(robot: InProcessSupervisor, database: MemoryDatabase) -> Iterator[MCPBridge]:
    enable(robot)
    with MCPBridge.attach(robot, database=database, throttle_interval=1) as bridge:
        yield bridge


def enable(robot: Any) -> None:
    for name in ("gps", "imu", "front"):
        if device := robot.devices.get(name):
            device.enable(STEP_MS)


def times(recording: Recording) -> list[float]:
    return [round(t, 3) for t in recording.rows("SELECT sim_time_s FROM state ORDER BY id")]
