"""The action `run` with real processes: fast mode stops at the very step, kills are survived."""

from __future__ import annotations

import math

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import Start, has_states
from tests.bridge.processes.test_control import wait
from webots_mcp.database.connection import connect
from webots_mcp.database.session_cleanup import reap
from webots_mcp.standin import Mode, Simulation

# `front_m` falls and rises with time in the same way in each run, whatever the physics do.
DRIVE = """
import math

if {interval} != 1:
    bridge.close()
    bridge = MCPBridge(robot, throttle_interval={interval})

def state():
    time = robot.getTime()
    return {{"time": time, "front_m": round(abs(math.sin(1.3 * time)), 6)}}

while robot.step(16) != -1:
    {loop}
"""
PUBLISHED_FIRST = "bridge.publish(state()); bridge.get_command()"
ASKED_FIRST = "bridge.get_command(); bridge.publish(state())"


def drive(
    start: Start, interval: int, loop: str = PUBLISHED_FIRST, mode: str = "fast"
) -> Simulation:
    return start(DRIVE.format(interval=interval, loop=loop), mode)


@pytest.mark.parametrize("loop", [PUBLISHED_FIRST, ASKED_FIRST])
def test_fast_mode_stops_at_the_very_step(start: Start, filed: Recording, loop: str) -> None:
    simulation = drive(start, 50, loop)
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    for _ in range(3):
        command = filed.send("run", until="front_m < 0.02", for_s=60, reset=True, pace="fast")
        result = wait(simulation, filed, command)
        assert result["ended"] == "condition held"
        assert simulation.mode is Mode.PAUSE
        assert simulation.time_s == pytest.approx(result["sim_time_s"])
        newest = "SELECT data FROM state ORDER BY id DESC LIMIT 1"
        assert f'"front_m":{result["values"]["front_m"]}' in filed.rows(newest)[0]
        # The first step of all at which it holds, as all steps recorded would show it.
        assert result["sim_time_s"] == pytest.approx(first_step_below_0_02())


def first_step_below_0_02() -> float:
    steps = (0.016 * n for n in range(1, 10_000))
    return next(time for time in steps if round(abs(math.sin(1.3 * time)), 6) < 0.02)


def test_a_killed_controller_leaves_no_run_behind(start: Start, filed: Recording) -> None:
    simulation = drive(start, 5)
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    command = filed.send("run", until="front_m > 2", reset=True)
    simulation.wait_for(lambda: filed.fate(command)[0] == "claimed", timeout_s=30)
    begun_by_reset = "SELECT count(*) FROM run WHERE start_reason = 'reset'"
    simulation.wait_for(lambda: filed.rows(begun_by_reset) == [1], timeout_s=30)
    simulation.controller("rover").kill()
    simulation.wait_for(lambda: not simulation.controller("rover").is_running, timeout_s=30)
    connection = connect(filed.database, "writer")
    reap(connection, 1e10)
    connection.close()
    status, _, error = filed.fate(command)
    assert (status, error) == (
        "lost",
        "its controller ended before it finished; it may have run in part",
    )
