"""Simulation time as the controller sees it: when it advances, and when it goes back."""

from __future__ import annotations

import time
from typing import Final

from webots_mcp.bridge.run import Run
from webots_mcp.bridge.webots_api import Simulation

_EPSILON_S: Final = 1e-9


class Clock:
    """The newest simulation time, and the run that it belongs to.

    A controller is not notified of a reset: it only sees that time has gone back.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.sim_time_s = simulation.time_s
        self.moved_s: float | None = None  # by the monotonic clock
        self.stepped_s = self.sim_time_s  # at the end of the newest step that the bridge saw
        self.steps_seen = 0  # calls of `look` at which time had advanced, or the steps between them
        self.step_s: float | None = None  # of a loop that only watches the steps of others
        self.run = Run("start", self.sim_time_s)
        self.ended_sim_time_s = self.sim_time_s  # of the run before this one
        self._reset_from_s: float | None = None

    def look(self, *, after_step: bool = False) -> bool:
        """Read the time; True if it went back since the last look: a new run has begun.

        Args:
            after_step: A step has just ended. Where the time is the same as before, only this
                proves that a step was made, and so that the awaited reset has happened.
        """
        before, now = self.sim_time_s, self._simulation.time_s
        self.sim_time_s = now
        if after_step:
            self.stepped_s = now
        if now > before + _EPSILON_S:
            self.moved_s = time.monotonic()
            self.steps_seen += max(round((now - before) / self.step_s), 1) if self.step_s else 1
        if now >= before - _EPSILON_S and not self._is_awaited_reset(now, after_step):
            return False
        self._reset_from_s = None
        self.ended_sim_time_s = before
        self.run = Run("reset", now)
        self.start_moving()
        return True

    def start_moving(self) -> None:
        """Count time as moving from now on; it counts as standing still only after a while."""
        self.moved_s = time.monotonic()

    def newest_s(self, run: Run) -> float:
        """The newest simulation time of the current run, or of the one before it."""
        return self.sim_time_s if run is self.run else self.ended_sim_time_s

    def await_reset(self) -> None:
        """A reset was asked for. It happens at the end of the next physics step.

        Close to the start of a run, the first time after the reset is not below the last one before
        it. So where the last time was 0, any later time is taken for the new run's; else the same
        time again after a step is.
        """
        self._reset_from_s = self.sim_time_s

    def forget_reset(self) -> None:
        """No reset happened in time: do not wait for it any more."""
        self._reset_from_s = None

    def _is_awaited_reset(self, now_s: float, after_step: bool) -> bool:
        if self._reset_from_s is None:
            return False
        if self._reset_from_s < self._simulation.basic_time_step_s - _EPSILON_S:
            return now_s > self._reset_from_s + _EPSILON_S
        return after_step and now_s <= self._reset_from_s + _EPSILON_S
