"""Records the rows of the current run (states, logs, events) and the heartbeat of the session."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final, NamedTuple

from webots_mcp.bridge.encoding import Encoded, encode
from webots_mcp.bridge.error_report import cut, storable
from webots_mcp.bridge.json_cleaning import BYTES_AS_TEXT, TEXT_WITH_SURROGATES, TOO_LARGE
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Clock
from webots_mcp.contract import HEARTBEAT_INTERVAL_S, LOG_CHARACTERS
from webots_mcp.database.heartbeat import LoopStatus
from webots_mcp.database.pause_states import PAUSED

_NOT_LOST: Final = ("nan", "inf", "-inf", BYTES_AS_TEXT, TEXT_WITH_SURROGATES)
_LEVELS: Final = {"stdout": "info", "stderr": "warning"}


class JournalLogLimits(NamedTuple):
    """Lengths of what a bridge without a database logs into its journal.

    Attributes:
        message_characters: Length at which a message is cut.
        logger_characters: Length at which the name of a logger is cut.
        lost_paths: Paths that a line about lost values names.
    """

    message_characters: int = LOG_CHARACTERS
    logger_characters: int = 200
    lost_paths: int = 20


_LOG_LIMITS: Final = JournalLogLimits()


class Journal:
    """Records rows with the run, simulation time and wall time of this moment."""

    def __init__(self, recorder: Recorder, clock: Clock) -> None:
        self._recorder = recorder
        self._clock = clock
        self._lost: set[str] = set()
        self.values_replaced = 0

    def state(self, encoded: Encoded) -> None:
        """Record a published state."""
        clock = self._clock
        row = (clock.sim_time_s, time.time(), encoded.text, encoded.replaced_text)
        self._recorder.record("state", clock.run, row)
        if encoded.replaced:
            self.values_replaced += len(encoded.replaced) - bool(encoded.unnamed) + encoded.unnamed
            self._log_lost(encoded.replaced)

    def log(self, level: str, source: str, message: str, logger: str | None = None) -> None:
        """Record a log line, cut to 10,000 characters."""
        text = storable(cut(message, _LOG_LIMITS.message_characters))
        name = None if logger is None else storable(cut(logger, _LOG_LIMITS.logger_characters))
        row = (self._clock.sim_time_s, time.time(), level, source, text, name)
        self._recorder.record("log", self._clock.run, row)

    def output(self, stream: str, lines: Sequence[str]) -> None:
        """Record what was printed on `stdout` or `stderr`."""
        level, clock, now = _LEVELS[stream], self._clock, time.time()
        texts = [storable(cut(line, _LOG_LIMITS.message_characters)) for line in lines]
        rows = [(clock.sim_time_s, now, level, "controller", text, stream) for text in texts]
        self._recorder.record_together("log", clock.run, rows)

    def event(
        self, kind: str, data: dict[str, object] | None = None, name: str | None = None
    ) -> None:
        """Record an event that happened now."""
        text = encode(data).text if data is not None else None
        row = (self._clock.sim_time_s, time.time(), kind, name, text)
        self._recorder.record("event", self._clock.run, row)

    def _log_lost(self, replaced: dict[str, str]) -> None:
        """Log each path whose value is not in the row, once; the row's column names all of them."""
        for path, kind in replaced.items():
            if kind in _NOT_LOST or path in self._lost or len(self._lost) >= _LOG_LIMITS.lost_paths:
                continue
            self._lost.add(path)
            what = "could not be stored whole" if kind == TOO_LARGE else "could not be stored"
            self.log("warning", "bridge", f"{path or 'state'} {what}: {kind}")


class Heartbeat:
    """The sign of life: written twice a second, and at once when a command changes the loop.

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
        """Note that the loop asked for commands, and beat if that is due."""
        self._last_poll_s = time.monotonic()
        self.beat_if_due()

    def beat_if_due(self) -> None:
        """Beat if the last heartbeat is old enough."""
        if time.monotonic() >= self._next_s:
            self.beat()

    def beat(self) -> None:
        """Write a heartbeat now, with the time at which the loop last saw time advance."""
        self._next_s = time.monotonic() + HEARTBEAT_INTERVAL_S
        meter = self._clock.meter
        meter.leave_bridge()  # a sign of life also from within a long pause
        polled_s, moved_s = _wall_time_s(self._last_poll_s), _wall_time_s(self._clock.moved_s)
        pause = (self.loop, self._mode_before)
        self._recorder.beat(
            LoopStatus(self._clock.sim_time_s, polled_s, moved_s, *pause, meter.times)
        )

    def change_loop(self, loop: str | None, mode_before: str | None = None) -> None:
        """Write how a command controls the loop from now on.

        It is written at once: a reader of the command's answer must not see the old status.

        Args:
            loop: The new value of `loop`.
            mode_before: The simulation mode to return to after a pause.
        """
        self.loop, self._mode_before = loop, mode_before
        if loop != PAUSED:
            self._clock.start_moving()
        self.beat()


def _wall_time_s(monotonic_s: float | None) -> float | None:
    """Return the wall time of a moment of the monotonic clock, as the wall clock is set now."""
    return None if monotonic_s is None else time.time() - (time.monotonic() - monotonic_s)
