"""The loop of an observer goes round in a pause, and learns whether the time is told to it."""

from __future__ import annotations

from typing import Any

import pytest

from tests.simulator.observer.conftest import STEP_MS
from webots_mcp.simulator import observer
from webots_mcp.simulator.observer import StepPace


class Simulator:
    """Webots as one non-synchronous Supervisor feels it; a second of wall time passes a round."""

    SIMULATION_MODE_PAUSE, SIMULATION_MODE_REAL_TIME, SIMULATION_MODE_FAST = 0, 1, 2

    def __init__(self, *, tells_time: bool, synchronous: bool = False) -> None:
        self.tells_time, self.synchronous = tells_time, synchronous
        self.mode = self.SIMULATION_MODE_REAL_TIME
        self.time_s = self.told_s = 0.0
        self.asked: list[int] = []

    def getTime(self) -> float:
        return self.told_s

    def simulationGetMode(self) -> int:
        return self.mode

    def step(self, duration_ms: int) -> int:
        self.asked.append(duration_ms)
        if self.mode != self.SIMULATION_MODE_PAUSE:
            self.time_s += max(duration_ms / 1000, 0.5)
        elif duration_ms:
            raise AssertionError("a step in a pause does not return")
        if duration_ms or self.tells_time:
            self.told_s = self.time_s
        return 0


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]

    class Time:
        @staticmethod
        def monotonic() -> float:
            return now[0]

        @staticmethod
        def sleep(_: float) -> None:
            now[0] += 0.5

    monkeypatch.setattr(observer, "time", Time)


def rounds(simulator: Any, count: int = 10, *, moves: bool = True) -> list[int]:
    waits = simulator.synchronous
    looping = StepPace(simulator, STEP_MS, world_waits=waits, moves=lambda: moves)
    for _ in range(count):
        assert looping.go_on()
    return simulator.asked


def test_where_the_time_is_told_it_never_asks_for_a_step() -> None:
    assert set(rounds(Simulator(tells_time=True))) == {0}


def test_where_the_time_is_not_told_it_steps_after_a_trial() -> None:
    asked = rounds(Simulator(tells_time=False))
    assert asked[0] == 0
    assert asked[-5:] == [STEP_MS] * 5


def test_a_world_in_which_nothing_moves_is_no_trial_since_a_hanging_loop_may_hold_it() -> None:
    assert set(rounds(Simulator(tells_time=False), 50, moves=False)) == {0}


def test_a_pause_from_the_start_is_no_trial() -> None:
    simulator = Simulator(tells_time=False)
    simulator.mode = Simulator.SIMULATION_MODE_PAUSE
    assert set(rounds(simulator, 50)) == {0}


def test_a_synchronous_observer_only_steps_for_without_steps_the_world_would_stand() -> None:
    assert set(rounds(Simulator(tells_time=True, synchronous=True))) == {STEP_MS}


def test_in_fast_mode_its_rows_lie_close_in_simulation_time() -> None:
    simulator = Simulator(tells_time=True)
    simulator.mode = Simulator.SIMULATION_MODE_FAST
    assert set(rounds(simulator)) == {STEP_MS}
