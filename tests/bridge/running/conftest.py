"""The user's loop, in each of the orders that controllers have."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor

STEP_S = STEP_MS / 1000


@pytest.fixture
def sparse(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> Iterator[MCPBridge]:
    """A bridge that records one call in seven."""
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    with MCPBridge(robot, throttle_interval=7, database=database) as bridge:
        yield bridge


class Rounds:
    """The user's loop, in one of the orders that controllers have; `n` counts its rounds.

    Where the simulation is paused, the loop would wait for ever: see `let_go_when_paused`.
    """

    def __init__(
        self, robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, order: str
    ) -> None:
        self.robot, self.bridge, self.recording = robot, bridge, recording
        self.order, self.n = order, 0

    def state(self) -> dict[str, Any]:
        return {"n": self.n, "time": self.robot.getTime(), "even": self.n % 2 == 0}

    def drive(self, rounds: int, publish_each: int = 1) -> None:
        for _ in range(rounds):
            if self.robot.step(STEP_MS) == -1:
                return
            self.n += 1
            publish = self.n % publish_each == 0
            if self.order == "published first" and publish:
                self.bridge.publish(self.state())
            eager(self.bridge)
            if self.order == "asked first" and publish:
                self.bridge.publish(self.state())


ORDERS = ("published first", "asked first")


@pytest.fixture(params=ORDERS)
def rounds(
    request: pytest.FixtureRequest,
    robot: InProcessSupervisor,
    sparse: MCPBridge,
    recording: Recording,
) -> Rounds:
    return Rounds(robot, sparse, recording, request.param)


def let_go_when_paused(rounds: Rounds, by: str = "resume") -> list[float]:
    """The times at which the simulation is paused; what lets it go is sent at that moment."""
    times: list[float] = []
    robot = rounds.robot
    set_mode = robot.simulationSetMode

    def noticed(mode: int) -> None:
        set_mode(mode)
        if mode == robot.SIMULATION_MODE_PAUSE:
            times.append(robot.getTime())
            rounds.recording.send(by)

    vars(robot)["simulationSetMode"] = noticed
    return times
