"""What the session says of time, as of the instant at which a command is answered."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from tests.bridge.conftest import Recording, eager
from webots_mcp import MCPBridge


def age(bridge: MCPBridge) -> None:
    """As if the simulation had stood still for a minute."""
    bridge._session.clock.moved_s = time.monotonic() - 60  # pyright: ignore[reportPrivateUsage]


def standing_for_s(recording: Recording) -> float:
    (moved_s,) = recording.rows("SELECT moved_wall_time_s FROM session")
    return time.time() - moved_s


@pytest.mark.parametrize("action", ["resume", "fast", "step", "reset"])
def test_time_that_is_let_go_after_a_long_pause_counts_as_moving_at_once(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None], action: str
) -> None:
    drive(3)
    bridge.register_command("stand", lambda _: age(bridge))
    for sent in ("pause", "stand", action):
        recording.send(sent)
    eager(bridge)
    assert standing_for_s(recording) < 30


def test_a_run_that_has_just_begun_counts_as_moving_at_once(
    bridge: MCPBridge, recording: Recording, drive: Callable[[int], None]
) -> None:
    drive(3)
    bridge.robot.simulationReset()
    bridge.robot.step(16)
    age(bridge)
    bridge.detect_reload()
    assert recording.rows("SELECT start_reason FROM run ORDER BY id") == ["start", "reset"]
    assert standing_for_s(recording) < 30


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
