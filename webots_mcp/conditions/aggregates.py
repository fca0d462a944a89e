"""What the values of a whole run come to: mean(x), max(x), time(condition), as states follow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol, TypeAlias

from webots_mcp.conditions.compiling import Compiler
from webots_mcp.conditions.reading import State

Number: TypeAlias = "int | float"

REDUCTIONS: Final[dict[str, Callable[[Sequence[Number]], Number]]] = {
    "min": min,
    "max": max,
    "first": lambda numbers: numbers[0],
    "last": lambda numbers: numbers[-1],
}


class Aggregate(Protocol):
    """One of them, in one run."""

    def update(self, state: State, sim_time_s: float) -> None:
        """Take in the next state."""
        ...

    def value(self) -> Number | None:
        """What it has come to; None where nothing had a value."""
        ...


class Reduced:
    """An extreme, or the first or last of a number's values."""

    def __init__(self, compiled: Compiler, reduce: Callable[[Sequence[Number]], Number]) -> None:
        self._compiled = compiled
        self._reduce = reduce
        self._numbers: list[Number] = []

    def update(self, state: State, sim_time_s: float) -> None:
        """States in which the number has no value do not count."""
        number = _root(self._compiled, state, sim_time_s)
        if number is not None:
            self._numbers.append(number)

    def value(self) -> Number | None:
        """Flags count as 1 and 0."""
        return self._reduce(self._numbers) if self._numbers else None


class Mean:
    """The mean over time: each value counts for as long as it holds, up to the next state.

    So a stretch with more states than others does not count more.
    """

    def __init__(self, compiled: Compiler) -> None:
        self._compiled = compiled
        self._newest: tuple[float, Number] | None = None
        self._area = self._time_s = self._sum = 0.0
        self._count = 0

    def update(self, state: State, sim_time_s: float) -> None:
        """While the number has no value, the time does not count."""
        if self._newest is not None:
            since_s, held = self._newest
            self._area += held * (sim_time_s - since_s)
            self._time_s += sim_time_s - since_s
        number = _root(self._compiled, state, sim_time_s)
        self._newest = None if number is None else (sim_time_s, number)
        if number is not None:
            self._sum += number
            self._count += 1

    def value(self) -> float | None:
        """Where no time has passed, the states count alike."""
        if self._time_s > 0:
            return self._area / self._time_s
        return self._sum / self._count if self._count else None


class TimeHeld:
    """For how many seconds a condition held: from each state in which it does up to the next."""

    def __init__(self, compiled: Compiler) -> None:
        self._compiled = compiled
        self._since_s: float | None = None
        self._held_s: float | None = None

    def update(self, state: State, sim_time_s: float) -> None:
        """Take in the next state."""
        if self._since_s is not None:
            self._held_s = (self._held_s or 0.0) + sim_time_s - self._since_s
        holds = _root(self._compiled, state, sim_time_s)
        self._since_s = sim_time_s if holds else None
        self._held_s = self._held_s or 0.0

    def value(self) -> float | None:
        """None without any state."""
        return self._held_s


def _root(compiled: Compiler, state: State, sim_time_s: float) -> Number | None:
    for memory in compiled.memories:
        memory.update(state, sim_time_s)
    return compiled.root(state)
