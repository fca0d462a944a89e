"""Frames made of plain states, as recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from webots_mcp.naming import Value, flatten
from webots_mcp.store.reading.frame import Frame


def frame_of_states(rows: Sequence[tuple[float, dict[str, Any]]]) -> Frame:
    """NaN and the infinities are null."""
    flat = [flatten(state) for _, state in rows]
    names = dict.fromkeys(name for state in flat for name in state)
    columns = {name: [_recorded(state.get(name)) for state in flat] for name in names}
    return Frame.of([time_s for time_s, _ in rows], columns)


def _recorded(value: Value) -> Value:
    return None if isinstance(value, float) and not math.isfinite(value) else value
