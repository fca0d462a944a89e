"""Statistics of a bridge: what it recorded, and the time that this took in the control loop."""

from __future__ import annotations

from typing import NamedTuple


class BridgeStats(NamedTuple):
    """What a bridge recorded so far, and what it could not record.

    Attributes:
        rows_written: Rows that the database has taken.
        rows_waiting: Rows that it could not take yet: in the file next to it, else in memory.
        rows_dropped: Rows that will never be in it.
        publish_calls: Calls of `publish` and `auto_publish` in the session.
        publish_throttled: Calls that the throttle did not record.
        values_replaced: Values that JSON cannot hold; `replaced` of their row names them.
        publish_mean_us: The mean duration of a recorded call, in microseconds.
        publish_max_us: The longest duration of a recorded call, in microseconds.
        ring_interval: One call of `auto_publish` in this many is held in the ring buffer.
        frames_missed: Camera frames that could not be taken or written.
        failures: Calls of the bridge's methods that failed.
        last_error: The newest error, with its reason; None if there was none.
    """

    rows_written: int
    rows_waiting: int
    rows_dropped: int
    publish_calls: int
    publish_throttled: int
    values_replaced: int
    publish_mean_us: float
    publish_max_us: float
    ring_interval: int
    frames_missed: int
    failures: int
    last_error: str | None


class PublishCost:
    """How long the recorded calls of `publish` took."""

    def __init__(self) -> None:
        self._calls = 0
        self._total_s = 0.0
        self._max_s = 0.0

    def add(self, duration_s: float) -> None:
        """Count one call."""
        self._calls += 1
        self._total_s += duration_s
        if duration_s > self._max_s:
            self._max_s = duration_s

    @property
    def mean_us(self) -> float:
        """The mean so far; 0 before the first."""
        return 1e6 * self._total_s / max(1, self._calls)

    @property
    def max_us(self) -> float:
        """The longest so far."""
        return 1e6 * self._max_s
