"""Frames made of plain states and arrays, as recorded."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from webots_mcp.analysis.arrays import Array
from webots_mcp.signals.naming import Value, flatten
from webots_mcp.store.chunks import StateColumns
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.reading.frame_source import FrameSource

_EMPTY = sqlite3.connect(":memory:", check_same_thread=False)  # nothing is read from it


def frame_of(times: Sequence[float] | Array, columns: Mapping[str, Sequence[Any] | Array]) -> Frame:
    """Of each signal one value for each row, None or NaN where it has none."""
    listed = [float(each) for each in times]
    values = {
        name: [None if value != value else value for value in np.asarray(column, object).tolist()]
        for name, column in columns.items()
    }
    rows = StateColumns([*range(1, len(listed) + 1)], listed, listed, [""] * len(listed), values)
    source = FrameSource(_EMPTY, 0, np.zeros((0, 5)), rows, {})
    return Frame(source, 0, len(listed))


def frame_of_states(rows: Sequence[tuple[float, dict[str, Any]]]) -> Frame:
    """NaN and the infinities are null."""
    flat = [flatten(state) for _, state in rows]
    names = dict.fromkeys(name for state in flat for name in state)
    columns = {name: [_recorded(state.get(name)) for state in flat] for name in names}
    return frame_of([time_s for time_s, _ in rows], columns)


def _recorded(value: Value) -> Value:
    return None if isinstance(value, float) and not math.isfinite(value) else value
