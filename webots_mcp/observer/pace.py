"""How the observer's loop goes round without holding up the world, and goes on in a pause.

`step(n)` of a paused simulation does not return, so that whoever waits in it cannot resume. A robot
without synchronization need not wait: it asks `step(0)`, which is answered at once, again and
again. That Webots tells the time in these answers is tried, not assumed; where it does not, and in
fast mode, where a moment would be long in simulation time, the loop makes steps like any other.
"""

from __future__ import annotations

import time
from typing import Any, Final

from webots_mcp.errors import InvalidInputError

PERIOD_MS: Final = 100  # of simulation time between two rows, unless another is asked for
LONGEST_PERIOD_MS: Final = 60_000

_ROUND_S: Final = 0.01  # of wall time
_TRIAL_S: Final = 1.0  # of wall time in which time ought to have moved


def checked_period(period_ms: int) -> int:
    """A period that can be kept to.

    Raises:
        InvalidInputError: It cannot.
    """
    if not 1 <= period_ms <= LONGEST_PERIOD_MS:
        raise InvalidInputError(f"the period is from 1 to {LONGEST_PERIOD_MS} ms, not {period_ms}")
    return period_ms


class Pace:
    """Makes the rounds of a loop.

    Args:
        robot: The observer's own Supervisor.
        period_ms: The step that it makes where it makes one.
    """

    def __init__(self, robot: Any, period_ms: int) -> None:
        self._robot = robot
        self._period_ms = period_ms
        self._may_pump = not robot.getSynchronization()
        self._tells_time: bool | None = None
        self._time_s = float(robot.getTime())
        self._stood_since_s = time.monotonic()

    def go_on(self) -> bool:
        """One round; False where Webots wants the controller to end."""
        if not self._may_pump or self._tells_time is False or self._is_fast():
            return self._robot.step(self._period_ms) != -1
        if self._tells_time is None and self._has_stood():
            return self._try_step()
        answer = self._robot.step(0)
        self._note()
        time.sleep(_ROUND_S)
        return answer != -1

    def _is_fast(self) -> bool:
        return self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_FAST

    def _note(self) -> None:
        now_s = float(self._robot.getTime())
        if now_s != self._time_s:
            self._time_s, self._tells_time = now_s, True

    def _has_stood(self) -> bool:
        if self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_PAUSE:
            self._stood_since_s = time.monotonic()
        return time.monotonic() - self._stood_since_s > _TRIAL_S

    def _try_step(self) -> bool:
        """Where more time passed than a step takes, it went on unseen."""
        before_s, self._stood_since_s = self._time_s, time.monotonic()
        answer = self._robot.step(self._period_ms)
        self._time_s = float(self._robot.getTime())
        if self._time_s - before_s > 2 * self._period_ms / 1000:
            self._tells_time = False
        return answer != -1
