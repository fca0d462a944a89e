"""State rows turned into columns: the values of each signal, one for each row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from webots_mcp.naming import Value, flatten
from webots_mcp.store.chunks.codec import ABSENT, Recorded, Replaced
from webots_mcp.store.signals import is_replaced, parse, replaced_names

_NUMBERS: Final = frozenset({int, float})
STATE_COLUMNS: Final = "id, sim_time_s, wall_time_s, data, replaced"


@dataclass
class StateColumns:
    """Rows of one run in order.

    Attributes:
        values: Of each signal its value in each row: `ABSENT` where the state lacks it, `Replaced`
            where it held what JSON cannot hold.
        texts: The states as they were recorded, JSON.
    """

    ids: list[int] = field(default_factory=list[int])
    times: list[float] = field(default_factory=list[float])
    wall_times: list[float] = field(default_factory=list[float])
    texts: list[str] = field(default_factory=list[str])
    values: dict[str, list[Recorded]] = field(default_factory=dict[str, "list[Recorded]"])

    def __len__(self) -> int:
        return len(self.ids)

    def add(self, rows: Sequence[tuple[Any, ...]]) -> None:
        """Add rows of `STATE_COLUMNS`; one whose data is no JSON object has no signals.

        Raises:
            TypeError: Another program wrote what no bridge writes.
        """
        if not rows:
            return
        before = len(self.ids)
        ids, times, walls, texts, replaced = zip(*rows, strict=True)
        if not _NUMBERS.issuperset(map(type, times + walls)) or {*map(type, texts)} != {str}:
            raise TypeError("a state row has a time that is no number, or data that is no text")
        self.ids += ids
        self.times += times
        self.wall_times += walls
        self.texts += texts
        columns = _transposed([flatten(parse(text)) for text in texts])
        for name in [name for name in columns if name not in self.values]:
            self.values[name] = [ABSENT] * before
        for name, values in self.values.items():
            values += columns.get(name) or [ABSENT] * len(rows)
        for row, why in enumerate(replaced, before):
            if why is not None:
                self._note_replaced(row, why)

    def _note_replaced(self, row: int, text: str) -> None:
        reasons = replaced_names(text)
        for name in reasons.keys() & self.values.keys():
            values = self.values[name]
            value: Any = values[row]
            if value is not ABSENT and is_replaced(reasons, name, value) and value is None:
                values[row] = Replaced(reasons[name])

    def part(self, start: int, rows: int) -> StateColumns:
        """Some of the rows."""
        inside = slice(start, start + rows)
        values = {name: values[inside] for name, values in self.values.items()}
        places = (self.ids[inside], self.times[inside], self.wall_times[inside])
        return StateColumns(*places, self.texts[inside], values)


def _transposed(states: Sequence[dict[str, Value]]) -> dict[str, list[Recorded]]:
    """Of each name its value in each state; states mostly have the same names in the same order."""
    names = list(states[0])
    if names and all(list(state) == names for state in states):
        columns = zip(*(state.values() for state in states), strict=True)
        return {name: list(values) for name, values in zip(names, columns, strict=True)}
    every = dict.fromkeys(name for state in states for name in state)
    return {name: [state.get(name, ABSENT) for state in states] for name in every}
