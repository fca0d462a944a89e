"""Bridges that record one call in ten, and what their recordings kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import strategies as st

from tests.bridge.conftest import Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor

State = dict[str, Any]
Make = Callable[..., MCPBridge]
STRETCHES = "SELECT run_id, start_sim_time_s, end_sim_time_s, reason FROM kept_stretch ORDER BY id"


@pytest.fixture
def make(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Make]:
    """Bridges that record one call in ten; strict, so that a test sees what went wrong."""
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    made: list[MCPBridge] = []

    def new(of: Any = robot, **options: Any) -> MCPBridge:
        bridge = MCPBridge(of, **dict[str, Any](throttle_interval=10, database=database) | options)
        made.append(bridge)
        return bridge

    yield new
    for bridge in made:
        bridge.close()


@pytest.fixture
def bridge(make: Make) -> MCPBridge:
    return make()


def kept_numbers(recording: Recording) -> list[list[int]]:
    """The `n` of all that each kept stretch has, in order of time."""
    sql = (
        "SELECT json_extract(data, '$.n') FROM all_state "
        "WHERE run_id = ? AND sim_time_s BETWEEN ? AND ? ORDER BY sim_time_s"
    )
    return [recording.rows(sql, *where) for *where, _ in recording.rows(STRETCHES)]


rows = st.lists(
    st.tuples(
        st.floats(0.001, 3.0),
        st.one_of(
            st.text(max_size=40),
            st.binary(max_size=40),
            st.integers(0, 6000).map("x".__mul__),
            st.just("\U0001f916" * 900),
        ),
    ),
    max_size=60,
)
