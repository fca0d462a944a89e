"""Reading the devices for `auto_publish`, and limiting how often it is done for the ring buffer."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from typing import Final

from webots_mcp.bridge.devices import read_devices
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.webots_api import Simulation

MOST_READING_US: Final = 100.0  # per call, on average, for rows that go to the ring buffer only
_READINGS: Final = 9  # their median counts, so that a single interrupted reading does not


class DeviceReader:
    """Reads a robot's devices, and measures how long that takes.

    Attributes:
        ring_interval: One call of `auto_publish` in this many reads the devices for the ring
            buffer alone, which limits the mean time of all calls to 100 us.
        why: The reason for an interval above 1; empty while the interval is 1.
    """

    def __init__(self, simulation: Simulation, journal: Journal, errors: ErrorReport) -> None:
        self._simulation = simulation
        self._journal = journal
        self._errors = errors
        self._durations_us: deque[float] = deque(maxlen=_READINGS)
        self._reported_interval = 1
        self.ring_interval = 1
        self.why = ""

    def read(self) -> dict[str, object]:
        """The devices' values, without those that cannot be read; these are counted as failures."""
        if self._simulation.over:
            return {}
        started_s = time.perf_counter()
        try:
            return read_devices(self._simulation.robot, self._failed)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("auto_publish", error)
            return {}
        finally:
            self._count(1e6 * (time.perf_counter() - started_s))

    def _failed(self, name: str, error: Exception) -> None:
        self._errors.failed(f"auto_publish of the device {name!r}", error)

    def _count(self, duration_us: float) -> None:
        """Set the interval by the median of the last durations; log it when it has doubled."""
        self._durations_us.append(duration_us)
        usual_us = statistics.median(self._durations_us)
        interval = max(1, math.ceil(usual_us / MOST_READING_US))
        if interval != self.ring_interval:
            self.ring_interval = interval
            self.why = _why(interval, usual_us) if interval > 1 else ""
        if self.ring_interval > self._reported_interval and len(self._durations_us) == _READINGS:
            self._reported_interval = 2 * self.ring_interval
            self._journal.log("info", "bridge", f"ring buffer: {self.why}")


def _why(interval: int, usual_us: float) -> str:
    share = f"one call of auto_publish() in {interval}"
    return f"{share}, because reading the devices takes {usual_us:.0f} us"
