"""A controller of one line, as a process on the stand-in: nothing in its loop knows the bridge."""

from __future__ import annotations

import pytest

from tests.bridge.conftest import Recording
from tests.processes.conftest import Start, has_states
from tests.processes.test_control import wait
from webots_mcp.standin import Mode

ATTACHED = """
MCPBridge.attach(robot)
while robot.step(16) != -1:
    pass
print("left the loop", flush=True)
"""


def test_it_is_paused_stepped_and_resumed_from_outside(start: Start, filed: Recording) -> None:
    simulation = start(ATTACHED, mode="realtime")
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    wait(simulation, filed, filed.send("pause"))
    from_s = simulation.time_s
    assert simulation.mode is Mode.PAUSE
    assert filed.rows("SELECT max(sim_time_s) FROM state") == [pytest.approx(from_s)]
    wait(simulation, filed, filed.send("step", steps=3))
    assert simulation.time_s == pytest.approx(from_s + 0.048)
    wait(simulation, filed, filed.send("resume"))
    simulation.wait_for(lambda: simulation.time_s > from_s + 0.5)


@pytest.mark.parametrize("action", ["reset", "reload"])
def test_the_world_begins_anew_from_outside(start: Start, filed: Recording, action: str) -> None:
    simulation = start(ATTACHED, mode="realtime")
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    wait(simulation, filed, filed.send(action))
    reasons = "SELECT start_reason FROM run ORDER BY id"
    assert filed.rows(reasons) == ["start", action]
    restarted = [action] if action == "reload" else []
    ended = filed.rows("SELECT end_reason FROM session WHERE ended_wall_time_s NOT NULL")
    assert ended == restarted


def test_a_world_that_a_person_reloads_finds_the_session_ended_and_whole(
    start: Start, filed: Recording
) -> None:
    simulation = start(ATTACHED, mode="fast")
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    simulation.reload()
    simulation.wait_for(lambda: filed.rows("SELECT count(*) FROM run") == [2], timeout_s=30)
    assert sum("left the loop" in line for line in simulation.console) == 1
    ended = "SELECT end_reason, ended_wall_time_s NOT NULL FROM session ORDER BY id LIMIT 1"
    assert filed.rows(ended) in ([("reload", 1)], [("finished", 1)])
