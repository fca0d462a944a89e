"""Define the functions and operators of conditions, and what those about the past remember."""

from __future__ import annotations

import ast
import math
import operator
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, Final, Generic

from webots_mcp.errors import ConditionFailedError
from webots_mcp.signals.conditions.signal_values import (
    Answer,
    State,
)
from webots_mcp.signals.naming import (
    Value,
)

SAME_TIME_S: Final = 1e-6  # a clock that adds up steps is off by less
PLACES_KEPT: Final = 200  # of one displacement


COMPARISONS: Final[dict[type[ast.cmpop], tuple[str, Callable[[Any, Any], bool]]]] = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}
ARITHMETIC: Final[dict[type[ast.operator], Callable[[Any, Any], Any]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: lambda a, b: a / b,
}
OF_NUMBERS: Final[dict[str, Callable[..., Any]]] = {"abs": abs, "min": min, "max": max}
GIVING_FLAGS: Final = ("changed", "missing")
FUNCTIONS: Final = (*OF_NUMBERS, *GIVING_FLAGS, "rate", "displacement", "signal")


class Memory(ABC, Generic[Answer]):
    """Something that is asked of every state, and what follows from the answers.

    Attributes:
        result: As of the state that was taken in last.
        error: Why that state could not be asked; None where it could.
    """

    def __init__(self, ask: Callable[[State], Answer]) -> None:
        self._ask = ask
        self.error: ConditionFailedError | None = None
        self.result: Any = None
        self.forget()

    @abstractmethod
    def forget(self) -> None:
        """A new run has begun."""

    @abstractmethod
    def _take_in(self, answer: Answer, sim_time_s: float) -> None:
        """Keep what follows from an answer."""

    def update(self, state: State, sim_time_s: float) -> None:
        """Take in a state; why it could not be asked is raised where the result is used."""
        self.error = None
        try:
            answer = self._ask(state)
        except ConditionFailedError as error:
            self.error = error
        else:
            self._take_in(answer, sim_time_s)


class Changed(Memory[Value]):
    """Whether a value is another than the last one that was there."""

    def forget(self) -> None:
        """What comes first is no change."""
        self._last: Value = None
        self.result = False

    def _take_in(self, answer: Value, sim_time_s: float) -> None:
        """A missing value is not a change, and neither is the return of the value before."""
        self.result = answer is not None and self._last is not None and answer != self._last
        if answer is not None:
            self._last = answer


class Rate(Memory["int | float | None"]):
    """How fast a value changes, per second, from one state that has it to the next."""

    def forget(self) -> None:
        """There is a rate from the second value on."""
        self._last: tuple[float, float] | None = None
        self.result = None

    def _take_in(self, answer: int | float | None, sim_time_s: float) -> None:
        """While time stands still the rate stays as it is."""
        if answer is None:
            self.result = None
        elif self._last is None:
            self._last = (sim_time_s, answer)
        elif (passed_s := sim_time_s - self._last[0]) > SAME_TIME_S:
            rate = (answer - self._last[1]) / passed_s
            self.result = rate if -math.inf < rate < math.inf else None
            self._last = (sim_time_s, answer)


class Displacement(Memory["tuple[float, float] | None"]):
    """Metres between where the robot is and where it was N seconds ago."""

    def __init__(
        self, place: Callable[[State], tuple[float, float] | None], seconds: float
    ) -> None:
        self._seconds = seconds
        self._apart_s = seconds / PLACES_KEPT
        super().__init__(place)

    def forget(self) -> None:
        """There is a displacement once the run has lasted for that time."""
        self._places: deque[tuple[float, float, float]] = deque()
        self.result = None

    def _take_in(self, answer: tuple[float, float] | None, sim_time_s: float) -> None:
        """Keeps 200 places at most; the one it compares with is older by half a percent at most."""
        self.result = None
        if answer is None:
            return
        places = self._places
        if not places or sim_time_s - places[-1][0] >= self._apart_s:
            places.append((sim_time_s, *answer))
            then_s = sim_time_s - self._seconds + SAME_TIME_S
            while len(places) > 1 and places[1][0] <= then_s:
                places.popleft()
        was_s, was_x, was_y = places[0]
        older_s = sim_time_s - was_s - self._seconds
        if -SAME_TIME_S <= older_s <= self._seconds + SAME_TIME_S:
            self.result = math.hypot(answer[0] - was_x, answer[1] - was_y)


class Lasting(Memory[bool]):
    """Whether a condition held in every state for at least N seconds."""

    def __init__(self, condition: Callable[[State], bool], seconds: float) -> None:
        self._seconds = seconds
        super().__init__(condition)

    def forget(self) -> None:
        """It holds since no time at all."""
        self._since_s: float | None = None
        self.result = False

    def _take_in(self, answer: bool, sim_time_s: float) -> None:
        """Between two states in both of which it holds it counts as unbroken."""
        if not answer:
            self._since_s = None
            self.result = False
            return
        if self._since_s is None:
            self._since_s = sim_time_s
        self.result = sim_time_s - self._since_s >= self._seconds - SAME_TIME_S
