"""Devices that are slow to read are read less often for the ring, which says so."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording
from tests.bridge.keeping.conftest import STRETCHES, Make, kept_numbers
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor


class SlowDevices:
    """The clock by which reading is measured goes on by so much with each reading of the GPS."""

    def __init__(self, robot: Any, patch: pytest.MonkeyPatch) -> None:
        self.cost_us, self.readings, now_s = 0.0, 0, time.perf_counter()
        gps = robot.getDevice("gps")
        gps.enable(STEP_MS)
        values = gps.getValues

        def read() -> Any:
            nonlocal now_s
            now_s += self.cost_us / 1e6
            self.readings += 1
            return values()

        patch.setattr(gps, "getValues", read)
        patch.setattr(time, "perf_counter", lambda: now_s)

    def drive(self, robot: Any, bridge: MCPBridge, numbers: range) -> int:
        """How often the devices were read."""
        before = self.readings
        for number in numbers:
            robot.step(STEP_MS)
            bridge.auto_publish({"n": number})
        return self.readings - before


def test_slow_devices_are_read_for_the_ring_no_more_than_100_us_per_call(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow, bridge = SlowDevices(robot, monkeypatch), make(throttle_interval=1000)
    slow.cost_us = 390
    assert slow.drive(robot, bridge, range(200)) == 51  # the first, and one in four
    assert bridge.stats().ring_interval == 4
    bridge.keep("a look")
    assert slow.drive(robot, bridge, range(200, 260)) == 15
    ((*_, reason),) = recording.rows(STRETCHES)
    why = "one call of auto_publish() in 4, because reading the devices takes 390 us"
    assert reason == f"a look; {why}"
    assert recording.rows("SELECT level, message FROM log") == [("info", f"ring buffer: {why}")]
    (kept,) = kept_numbers(recording)
    assert kept == [0, *range(3, 260, 4)]

    slow.cost_us = 40
    slow.drive(robot, bridge, range(260, 300))
    assert slow.drive(robot, bridge, range(300, 700)) == 400
    bridge.keep("another look")
    slow.drive(robot, bridge, range(700, 701))
    assert recording.rows(STRETCHES)[-1][3] == "another look"


def test_one_slow_reading_among_fast_ones_slows_nothing(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow, bridge = SlowDevices(robot, monkeypatch), make()
    slow.cost_us = 40
    slow.drive(robot, bridge, range(20))
    slow.cost_us = 20_000
    slow.drive(robot, bridge, range(20, 21))
    slow.cost_us = 40
    assert slow.drive(robot, bridge, range(21, 60)) == 39
    assert recording.rows("SELECT message FROM log") == []


def test_slow_devices_are_read_in_every_call_where_a_breakpoint_is_armed(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow, bridge = SlowDevices(robot, monkeypatch), make()
    slow.cost_us = 5000
    bridge.breakpoint("n == 50", "keep")
    assert slow.drive(robot, bridge, range(60)) == 60
    ((*_, reason),) = recording.rows(STRETCHES)
    assert "one call in" not in reason
    assert kept_numbers(recording) == [list(range(60))]
