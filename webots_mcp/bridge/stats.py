"""What a bridge recorded, and what that cost the control loop."""

from __future__ import annotations

from typing import NamedTuple


class BridgeStats(NamedTuple):
    """What a bridge recorded so far, and what it could not."""

    rows_written: int
    rows_waiting: int
    rows_dropped: int
    publish_calls: int
    publish_throttled: int
    values_replaced: int
    publish_mean_us: float
    publish_max_us: float
    failures: int
    last_error: str | None
