"""The heartbeat of a controller's loop, by which other processes judge whether it is alive."""

from __future__ import annotations

import time

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.contract import HEARTBEAT_INTERVAL_S
from webots_mcp.liveness import LoopStatus
from webots_mcp.pauses import PAUSED


class Heartbeat:
    """Written twice a second, and at once where a command pauses the loop or lets it run.

    Attributes:
        loop: How a command controls the loop now: `PAUSED`, `STEPPING`, or None.
    """

    def __init__(self, recorder: Recorder, clock: Clock) -> None:
        self._recorder = recorder
        self._clock = clock
        self._next_s = 0.0
        self._last_poll_s: float | None = None
        self._mode_before: str | None = None
        self.loop: str | None = None

    @property
    def polled(self) -> bool:
        """Whether the loop ever asked for commands."""
        return self._last_poll_s is not None

    def poll(self) -> None:
        """The loop asked for commands; beat if that is due."""
        self._last_poll_s = time.monotonic()
        self.beat_if_due()

    def beat_if_due(self) -> None:
        """Beat if the last heartbeat is old enough."""
        if time.monotonic() >= self._next_s:
            self.beat()

    def beat(self) -> None:
        """Write a heartbeat now: the loop is alive, and when it last saw time advance."""
        self._next_s = time.monotonic() + HEARTBEAT_INTERVAL_S
        polled_s, moved_s = _wall_time_s(self._last_poll_s), _wall_time_s(self._clock.moved_s)
        pause = (self.loop, self._mode_before)
        self._recorder.beat(LoopStatus(self._clock.sim_time_s, polled_s, moved_s, *pause))

    def change_loop(self, loop: str | None, mode_before: str | None = None) -> None:
        """Write the new status at once: a reader of the command's answer must not see the old one.

        Args:
            loop: The new value of `loop`.
            mode_before: The simulation mode to return to, where it is paused.
        """
        self.loop, self._mode_before = loop, mode_before
        if loop != PAUSED:
            self._clock.start_moving()
        self.beat()


def _wall_time_s(monotonic_s: float | None) -> float | None:
    """The wall time of a moment of the monotonic clock, as the wall clock is set now."""
    return None if monotonic_s is None else time.time() - (time.monotonic() - monotonic_s)
