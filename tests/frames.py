"""Frames made of plain states, in small chunks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from webots_mcp.naming import Value, flatten
from webots_mcp.store.analysis.arrays import Array, Indexes

CHUNK_ROWS = 4


@dataclass
class ListedZones:
    first_row: Indexes
    value_count: Indexes
    min: Array
    max: Array


@dataclass
class ListedCodes:
    codes: Indexes
    labels: Sequence[Value]


class ListedFrame:
    """Rows that are held as lists of plain values."""

    def __init__(self, times: Sequence[float], columns: dict[str, list[Value]]) -> None:
        self.times = np.array(times, np.float64)
        self._columns = columns

    def __len__(self) -> int:
        return len(self.times)

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def numbers(self, name: str) -> Array:
        held = self._columns[name]
        return np.array([_number(each) for each in held], np.float64)

    def coded(self, name: str) -> ListedCodes:
        held = self._columns[name]
        labels = list(dict.fromkeys(held))
        return ListedCodes(np.array([labels.index(each) for each in held], np.intp), labels)

    def zones(self, name: str) -> ListedZones:
        numbers = self.numbers(name)
        firsts = np.arange(0, len(self), CHUNK_ROWS)
        parts = [numbers[at : at + CHUNK_ROWS] for at in firsts]
        there = [part[~np.isnan(part)] for part in parts]
        return ListedZones(
            firsts,
            np.array([len(part) for part in there], np.intp),
            np.array([part.min() if len(part) else math.nan for part in there]),
            np.array([part.max() if len(part) else math.nan for part in there]),
        )

    def rows(self, start: int, stop: int) -> ListedFrame:
        columns = {name: held[start:stop] for name, held in self._columns.items()}
        return ListedFrame(self.times[start:stop].tolist(), columns)


def frame_of_states(rows: Sequence[tuple[float, dict[str, Any]]]) -> ListedFrame:
    """As recorded: NaN and the infinities are null."""
    flat = [flatten(state) for _, state in rows]
    names = dict.fromkeys(name for state in flat for name in state)
    columns = {name: [_recorded(state.get(name)) for state in flat] for name in names}
    return ListedFrame([time_s for time_s, _ in rows], columns)


def _recorded(value: Value) -> Value:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Value) -> float:
    return math.nan if value is None or isinstance(value, str) else value
