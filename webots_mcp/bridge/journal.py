"""The rows of the current run: states, logs, events."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.encoding import Encoded, encode
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.text import cut, storable

MOST_LOG_CHARACTERS: Final = 10_000
_MOST_LOGGER_CHARACTERS: Final = 200
_NOT_LOST: Final = ("nan", "inf", "-inf", "bytes", "surrogate")
_CUT: Final = ("text[", "key[", "dict cut")
_MOST_LOST_PATHS: Final = 20
_LEVELS: Final = {"stdout": "info", "stderr": "warning"}


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
        text = storable(cut(message, MOST_LOG_CHARACTERS))
        name = None if logger is None else storable(cut(logger, _MOST_LOGGER_CHARACTERS))
        row = (self._clock.sim_time_s, time.time(), level, source, text, name)
        self._recorder.record("log", self._clock.run, row)

    def output(self, stream: str, lines: Sequence[str]) -> None:
        """Record what was printed on `stdout` or `stderr`."""
        level, clock, now = _LEVELS[stream], self._clock, time.time()
        texts = [storable(cut(line, MOST_LOG_CHARACTERS)) for line in lines]
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
            if kind in _NOT_LOST or path in self._lost or len(self._lost) >= _MOST_LOST_PATHS:
                continue
            self._lost.add(path)
            what = "was cut" if kind.startswith(_CUT) else "could not be stored"
            self.log("warning", "bridge", f"{path or 'state'} {what}: {kind}")
