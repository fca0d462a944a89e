"""Simulation time as the controller sees it: when it moves, and when it goes back."""

from __future__ import annotations

import time
from typing import Final

from webots_mcp.bridge.run import Run
from webots_mcp.bridge.simulation import Simulation

_EPSILON_S: Final = 1e-9


class Clock:
    """The newest simulation time, and the run that it belongs to.

    Time going backwards is all the notice that a controller gets of a reset.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.sim_time_s = simulation.time_s
        self.moved_s: float | None = None  # by the monotonic clock
        self.stepped_s = self.sim_time_s  # at the end of the newest step that was gone along with
        self.steps_seen = 0  # looks at which time had gone forward, or the steps between them
        self.step_s: float | None = None  # of a loop that does not make the steps itself
        self.run = Run("start", self.sim_time_s)
        self.ended_sim_time_s = self.sim_time_s  # of the run before this one
        self._reset_from_s: float | None = None

    def look(self, *, after_step: bool = False) -> bool:
        """Read the time; True if it went back since the last look: a new run has begun.

        Args:
            after_step: A step has just ended, which is the only proof that one was made where the
                time is the same again.
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
        """From this moment on time moves; it counts as standing only after a while without."""
        self.moved_s = time.monotonic()

    def newest_s(self, run: Run) -> float:
        """The newest simulation time of the current run, or of the one before it."""
        return self.sim_time_s if run is self.run else self.ended_sim_time_s

    def await_reset(self) -> None:
        """A reset was asked for. It comes with the end of the next physics step.

        Close to the start the first time after it is not below the last one before it: from 0
        any time that follows, and else the same time again after a step, is that of the new run.
        """
        self._reset_from_s = self.sim_time_s

    def forget_reset(self) -> None:
        """The reset did not come."""
        self._reset_from_s = None

    def _is_awaited_reset(self, now_s: float, after_step: bool) -> bool:
        if self._reset_from_s is None:
            return False
        if self._reset_from_s < self._simulation.basic_time_step_s - _EPSILON_S:
            return now_s > self._reset_from_s + _EPSILON_S
        return after_step and now_s <= self._reset_from_s + _EPSILON_S
