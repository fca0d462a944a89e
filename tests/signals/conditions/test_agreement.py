"""A breakpoint is hit where the same condition is found in the rows, and nowhere else."""

from __future__ import annotations

import json
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.signals.conditions.writing import Node, Rows, conditions, rows, written
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.database.connection import connect
from webots_mcp.judging.detection.condition import values_at, where_held
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline

pytestmark = pytest.mark.slow

Held = list[tuple[float, dict[str, Any]]]

STEP_MS = 16  # stands for the tenth of a second that the rows are apart
SHORT = {1.0: 0.16, 0.5: 0.08, 0.3: 0.048, 0.2: 0.032, 0.1: 0.016}


@settings(deadline=None, max_examples=60)
@given(st.lists(conditions, min_size=1, max_size=5), rows(), rows())
def test_hits_and_stretches_begin_at_the_same_steps(
    asked: list[Node], first: Rows, second: Rows
) -> None:
    texts = list(dict.fromkeys(written(_shortened(node)) for node in asked))
    database = MemoryDatabase()
    try:
        robot = InProcessSupervisor("rover")
        with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
            for text in texts:
                bridge.breakpoint(text, "log")
            for history in (first, second):
                _drive(robot, bridge, history)
                robot.simulationReset()
        connection = connect(database, "reader")
        for (run_id,) in connection.execute("SELECT DISTINCT run_id FROM state").fetchall():
            for text in texts:
                assert _told(_found(connection, run_id, text), text) == _told(
                    _hit(connection, run_id, text), text
                )
        connection.close()
    finally:
        database.close()


def _shortened(node: Node) -> Node:
    kind, *parts = node
    if kind == "displacement":
        return (kind, SHORT[parts[0]])
    if kind == "for":
        return (kind, _shortened(parts[0]), SHORT[parts[1]])
    inner: list[Any] = [
        _shortened(cast("Node", part)) if isinstance(part, tuple) else part for part in parts
    ]
    return (kind, *inner)


def _drive(robot: InProcessSupervisor, bridge: MCPBridge, history: Rows) -> None:
    at_s = -0.1
    for time_s, state in history:
        robot.step(STEP_MS * round((time_s - at_s) / 0.1))
        bridge.publish(state)
        at_s = time_s


def _found(connection: Any, run_id: int, text: str) -> Held:
    segment = whole_run(connection, run_id)
    assert segment is not None
    condition, frame = parse_condition(text), read_frame(connection, segment, Deadline())
    runs = where_held(condition, frame, ("x", "y"))
    values = values_at(condition, frame, None, runs)
    return [(run.start_s, held) for run, held in zip(runs.spans(), values, strict=True)]


def _hit(connection: Any, run_id: int, text: str) -> Held:
    sql = (
        "SELECT sim_time_s, json_extract(data, '$.values') FROM event "
        "WHERE run_id = ? AND kind = 'breakpoint' AND name = ? ORDER BY id"
    )
    found = connection.execute(sql, (run_id, text)).fetchall()
    return [(time_s, json.loads(values)) for time_s, values in found]


def _told(held: Held, text: str) -> Held:
    """Without a place, which has no y either where it has no x."""
    places = ("x", "y") if "displacement" in text else ()
    return [
        (time_s, {name: value for name, value in values.items() if name not in places})
        for time_s, values in held
    ]
