"""What a stretch of recorded rows shows: movement, changes, the numbers that changed most."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from webots_mcp.server.shortening import round_number
from webots_mcp.store.history.leaves import Value, flatten, parse
from webots_mcp.store.states import State

# Names under which robots publish where they are, the most telling first.
_PLACES: Final = ("pose", "position", "pos", "translation", "location", "xy", "xyz", "gps", "")
_AXES: Final = (("x", "y"), ("0", "1"), ("x_m", "y_m"))
_STEADY_RANGE: Final = 1e-9


class Change(NamedTuple):
    """A text or a flag that became another."""

    sim_time_s: float
    name: str
    before: Value
    after: Value


@dataclass
class Number:
    """A numeric signal over the window."""

    first: float
    last: float
    min: float
    max: float
    missing: int = 0

    def add(self, value: float) -> None:
        """Take in the next value."""
        self.last = value
        self.min = min(self.min, value)
        self.max = max(self.max, value)

    @property
    def relative_range(self) -> float:
        """Range over largest magnitude: 0 is steady, 2 is from -a to a. Free of scale and unit."""
        if self.max - self.min < _STEADY_RANGE:
            return 0.0
        return (self.max - self.min) / max(abs(self.min), abs(self.max))


@dataclass
class Watched:
    """What was seen in the rows of one or more runs."""

    numbers: dict[str, Number] = field(default_factory=dict[str, Number])
    changes: list[Change] = field(default_factory=list[Change])
    distance: float = 0.0
    place: tuple[str, str] | None = None
    path: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    _texts: dict[str, Value] = field(default_factory=dict[str, Value])

    def read(self, states: Iterable[State]) -> None:
        """Take in the rows of one run, in order."""
        self._texts.clear()
        here: tuple[float, float] | None = None
        for state in states:
            leaves = flatten(parse(state.data))
            for name, value in leaves.items():
                self._add(state.sim_time_s, name, value)
            before, here = here, self._position(leaves) or here
            if before and here:
                self.distance += math.dist(before, here)
            if here:
                self.path.append(here)

    def movement(self) -> dict[str, Any] | None:
        """Distance along the path and displacement, in the unit of the published position."""
        if self.place is None or len(self.path) < 2:
            return None
        start, end = self.path[0], self.path[-1]
        return {
            "position": list(self.place),
            "from": [round_number(value) for value in start],
            "to": [round_number(value) for value in end],
            "distance": round_number(self.distance),
            "displacement": round_number(math.dist(start, end)),
        }

    def changed_most(self) -> list[tuple[str, Number]]:
        """The numeric signals that changed, in the order of their relative range."""
        changed = [item for item in self.numbers.items() if item[1].relative_range > 0]
        return sorted(changed, key=lambda item: -item[1].relative_range)

    def _add(self, sim_time_s: float, name: str, value: Value) -> None:
        if isinstance(value, (bool, str)):
            before = self._texts.get(name, value)
            self._texts[name] = value
            if before != value:
                self.changes.append(Change(sim_time_s, name, before, value))
        elif value is None:
            if name in self.numbers:
                self.numbers[name].missing += 1
        elif name in self.numbers:
            self.numbers[name].add(float(value))
        else:
            number = float(value)
            self.numbers[name] = Number(number, number, number, number)

    def _position(self, leaves: dict[str, Value]) -> tuple[float, float] | None:
        self.place = self.place or find_place(leaves)
        if self.place is None:
            return None
        x, y = (leaves.get(name) for name in self.place)
        return (x, y) if isinstance(x, (int, float)) and isinstance(y, (int, float)) else None


def find_place(leaves: dict[str, Value]) -> tuple[str, str] | None:
    """The names of the two signals that say where the robot is on the ground."""
    for place in _PLACES:
        for x, y in _AXES if place else _AXES[:1]:
            for name in leaves:
                parent, _, last = name.rpartition(".")
                sibling = f"{parent}.{y}" if parent else y
                if last == x and parent.rpartition(".")[2] == place and sibling in leaves:
                    return name, sibling
    return None


def evenly(ids: list[int], most: int) -> list[int]:
    """At most that many of them, evenly spread, always with the first and the last."""
    if len(ids) <= most:
        return ids
    step = (len(ids) - 1) / (most - 1)
    return [ids[round(number * step)] for number in range(most)]
