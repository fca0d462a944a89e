"""What the session says of time, as of the instant at which a command is answered."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.bridge.conftest import Recording, eager
from webots_mcp import MCPBridge


def test_a_handler_that_steps_by_itself_shows_its_robot_as_moving(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None]
) -> None:
    drive(3)
    seen: list[float] = []

    def go(_: dict[str, object]) -> None:
        for _number in range(3):
            bridge.robot.step(16)
        bridge._session.heartbeat._next_s = 0.0  # pyright: ignore[reportPrivateUsage]
        bridge.robot.step(16)
        seen.extend(recording.rows("SELECT sim_time_s FROM session"))

    bridge.register_command("go", go)
    recording.send("go")
    eager(bridge)
    assert seen == [pytest.approx(bridge.robot.getTime())]
