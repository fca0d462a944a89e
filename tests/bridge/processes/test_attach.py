"""A controller of one line, as a process on the stand-in: nothing in its loop knows the bridge."""

from __future__ import annotations

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import Start, has_states
from tests.bridge.processes.test_control import wait
from webots_mcp.standin import Mode

pytestmark = pytest.mark.slow

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
