"""Where the values of a frame come from: the chunks of some groups, and rows that are in none."""

from __future__ import annotations

import sqlite3
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, Indexes, np
from webots_mcp.store.chunks.codec import DamagedChunkError, Decoded, decoded_of
from webots_mcp.store.chunks.columns import STATE_COLUMNS, StateColumns
from webots_mcp.store.chunks.statistics import Statistics, statistics_of
from webots_mcp.store.chunks.stored import (
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    Group,
    statistics_in,
    values_in,
)

MOST_KEPT_BYTES: Final = 64_000_000  # of values that a frame keeps for who asks again

_ROWS_OF: Final = (
    f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND sim_time_s >= ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s, id"
)


class Unread(NamedTuple):
    """A part of what was asked for that is not in a frame: [start_s, end_s], and why."""

    start_s: float
    end_s: float
    why: str

    def __str__(self) -> str:
        return f"not read from {self.start_s:.3f} to {self.end_s:.3f} s: {self.why}"


class Part(NamedTuple):
    """Rows of a frame that are decoded together: a group, or rows that are in none."""

    start: int  # place of the first row
    rows: int
    group: Group | None
    columns: StateColumns | None

    @property
    def bounds_s(self) -> tuple[float, float]:
        """Simulation time of its first and last row."""
        if self.group is not None:
            return self.group.start_s, self.group.end_s
        assert self.columns is not None
        return self.columns.times[0], self.columns.times[-1]


class FrameSource:
    """Where the values come from, before a range and an order are laid over them."""

    def __init__(
        self,
        connection: sqlite3.Connection | None,
        run_id: int,
        parts: Sequence[Part],
        ids: Mapping[str, int],
    ) -> None:
        self.connection = connection
        self.run_id = run_id
        self.parts = parts
        self.ids = ids
        self.rows = parts[-1].start + parts[-1].rows if parts else 0
        self.unread: dict[Unread, None] = {}
        self.order: Indexes | None = None
        self._groups = [part.group for part in parts if part.group is not None]
        self._of_group = {part.group.id: part for part in parts if part.group is not None}
        self._kept: OrderedDict[object, Any] = OrderedDict()
        self._kept_bytes = 0

    @cached_property
    def bounds_s(self) -> tuple[Array, Array]:
        """Simulation times of the first rows of all parts, and of the last ones."""
        bounds = [part.bounds_s for part in self.parts]
        return np.array([each[0] for each in bounds]), np.array([each[1] for each in bounds])

    @cached_property
    def is_in_order(self) -> bool:
        """Whether simulation time never falls from row to row."""
        starts_s, ends_s = self.bounds_s
        columns = [part.columns.times for part in self.parts if part.columns is not None]
        return bool((starts_s[1:] >= ends_s[:-1]).all()) and all(
            (np.diff(times) >= 0).all() for times in columns
        )

    def decoded(self, name: str, start: int, stop: int) -> list[tuple[Part, Decoded | None]]:
        """The values of a signal in the parts that touch rows [start, stop); None: it has none."""
        wanted = [p for p in self.parts if p.start < stop and p.start + p.rows > start]
        stored = self._stored(self.ids.get(name), name, wanted)
        found: list[tuple[Part, Decoded | None]] = []
        for part in wanted:
            if part.group is not None:
                found.append((part, stored.get(part.group.id)))
            else:
                assert part.columns is not None
                values = part.columns.values.get(name)
                found.append((part, None if values is None else decoded_of(values)))
        return found

    def of_rows(self, signal_id: int, attribute: str, start: int, stop: int) -> Array:
        """Times or ids of rows [start, stop)."""
        wanted = [p for p in self.parts if p.start < stop and p.start + p.rows > start]
        first = wanted[0].start if wanted else start
        stored = self._stored(signal_id, attribute, wanted)
        whole = np.full(max(stop, start) - first, np.nan)
        for part in wanted:
            inside = slice(part.start - first, part.start - first + part.rows)
            if part.columns is not None:
                values: Any = getattr(part.columns, attribute)
            elif part.group is not None and part.group.id in stored:
                values = stored[part.group.id].numbers
            else:
                continue
            whole[inside] = values[: len(whole) - inside.start]
        return whole[start - first :]

    def _stored(
        self, signal_id: int | None, name: str, parts: Sequence[Part]
    ) -> dict[int, Decoded]:
        groups = [part.group for part in parts if part.group is not None]
        if signal_id is None or self.connection is None or not groups:
            return {}
        found: dict[int, Decoded] = {}
        for group_id, values in values_in(self.connection, self.run_id, signal_id, groups):
            if isinstance(values, DamagedChunkError):
                again = self._from_rows(self._of_group[group_id], name, signal_id, values)
                if again is None:
                    continue
                values = again
            found[group_id] = values
        return found

    def _from_rows(
        self, part: Part, name: str, signal_id: int, error: DamagedChunkError
    ) -> Decoded | None:
        """What the rows of a damaged chunk say, where they are all there; else it is not read."""
        assert self.connection is not None and part.group is not None
        group = part.group
        columns = StateColumns()
        asked = (self.run_id, group.start_s, group.end_s)
        columns.add(self.connection.execute(_ROWS_OF, asked).fetchall())
        if len(columns) == group.row_count:
            values: Sequence[Any] | None = {
                SIM_TIMES: columns.times, WALL_TIMES: columns.wall_times, STATE_IDS: columns.ids
            }.get(signal_id, columns.values.get(name))  # fmt: skip
            if values is not None:
                return decoded_of(values)
        self.unread[Unread(group.start_s, group.end_s, f"the chunk of {name} is {error}")] = None
        return None

    def zones(
        self, signal_id: int | None, values_of: Callable[[StateColumns], Sequence[Any] | None]
    ) -> list[tuple[Part, Statistics | None]]:
        """What a signal comes to in each part."""
        stored: dict[int, Statistics] = {}
        if signal_id is not None and self.connection is not None and self._groups:
            stored = statistics_in(self.connection, self.run_id, signal_id, self._groups)
        found: list[tuple[Part, Statistics | None]] = []
        for part in self.parts:
            if part.group is not None:
                found.append((part, stored.get(part.group.id)))
            else:
                assert part.columns is not None
                values = values_of(part.columns)
                found.append((part, statistics_of(decoded_of(values)) if values else None))
        return found

    def forget(self) -> None:
        """Forget what was made."""
        self._kept.clear()
        self._kept_bytes = 0

    def kept(self, key: object, make: Any, size: int) -> Any:
        """What was made before, or is made now; the oldest makes room for it."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        made = make()
        self._kept[key] = (made, size)
        self._kept_bytes += size
        while self._kept_bytes > MOST_KEPT_BYTES and len(self._kept) > 1:
            _, (_, freed) = self._kept.popitem(last=False)
            self._kept_bytes -= freed
        return made
