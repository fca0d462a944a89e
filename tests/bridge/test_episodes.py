"""The reward of a run is summed up over each published state, and recorded at its end."""

from __future__ import annotations

import json
from collections import OrderedDict
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor


def episodes(recording: Recording) -> list[tuple[int, dict[str, Any]]]:
    rows = recording.rows("SELECT run_id, data FROM event WHERE kind = 'episode' ORDER BY id")
    return [(run_id, json.loads(data)) for run_id, data in rows]


@pytest.fixture
def sparse(robot: InProcessSupervisor, recording: Recording) -> MCPBridge:
    """A bridge that records one call in five."""
    database: MemoryDatabase = recording.database  # type: ignore[assignment]
    return MCPBridge(robot, database=database, throttle_interval=5)


def test_rewards_of_throttled_states_count(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording
) -> None:
    for _ in range(2):
        for number in range(12):
            robot.step(STEP_MS)
            sparse.publish({"reward": 0.25, "terminated": number == 11, "truncated": False})
        robot.simulationReset()
        robot.step(STEP_MS)
    sparse.close()
    assert recording.rows("SELECT count(*) FROM state WHERE run_id = 1") == [2]
    assert episodes(recording) == [
        (run_id, {"reward": 3.0, "count": 12, "terminated": True, "truncated": False})
        for run_id in (1, 2)
    ]


def test_values_of_extra_count_once_in_each_call(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording
) -> None:
    for _ in range(7):
        robot.step(STEP_MS)
        sparse.auto_publish({"reward": 1, "is_success": True})
    sparse.close()
    assert episodes(recording) == [(1, {"reward": 7.0, "count": 7, "success": True})]


@pytest.mark.parametrize(
    "reward",
    [np.float32(0.5), np.int64(2), np.array(1.0), Fraction(1, 2), Decimal("1.5"), True],
)
def test_every_kind_of_real_number_is_a_reward(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording, reward: Any
) -> None:
    robot.step(STEP_MS)
    sparse.publish({"reward": reward})
    sparse.close()
    assert episodes(recording) == [(1, {"reward": float(reward), "count": 1})]


@pytest.mark.parametrize(
    "reward", [None, "3", [1.0], np.ones(1), float("nan"), float("inf"), 10**400, {"sum": 2}]
)
def test_what_is_no_finite_number_leaves_the_state_as_it_is(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording, reward: Any
) -> None:
    robot.step(STEP_MS)
    sparse.publish({"reward": reward, "x": 1.5}, force=True)
    sparse.close()
    assert recording.rows("SELECT json_extract(data, '$.x') FROM state") == [1.5]
    assert episodes(recording) == []


def test_a_controller_without_rewards_has_no_episodes(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording
) -> None:
    robot.step(STEP_MS)
    sparse.publish({"x": 1.0})
    sparse.close()
    assert episodes(recording) == []


def test_the_last_step_of_a_run_may_lack_its_reward_and_tell_how_it_ended(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording
) -> None:
    for reward in (1.0, float("nan"), 2.0, None):
        robot.step(STEP_MS)
        sparse.publish(OrderedDict(reward=reward, success=np.bool_(reward is None)))
    robot.step(STEP_MS)
    sparse.publish({"truncated": 1.0})
    sparse.close()
    told = {"reward": 3.0, "count": 2, "missing": 3, "success": True, "truncated": True}
    assert episodes(recording) == [(1, told)]


def test_a_hostile_number_costs_nothing_but_its_reward(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording
) -> None:
    class Hostile(float):
        def __float__(self) -> float:
            raise RuntimeError

        def __sub__(self, other: object) -> float:
            raise RuntimeError

    robot.step(STEP_MS)
    sparse.publish({"reward": Hostile(2.0), "x": 1.5}, force=True)
    sparse.close()
    assert recording.rows("SELECT json_extract(data, '$.x') FROM state") == [1.5]
