"""What a condition keeps of the states before: the last value, a rate, a way, since when it holds.

All of it is brought up to date with every state, whatever `and` and `or` leave unasked.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Final, Generic, Protocol, TypeVar

from webots_mcp.conditions.reading import State
from webots_mcp.errors import ConditionFailedError
from webots_mcp.naming import Value

SAME_TIME_S: Final = 1e-6  # a clock that adds up steps is off by less
_PLACES_KEPT: Final = 200  # of one displacement

Answer = TypeVar("Answer")


class Memory(Protocol):
    """Something that is kept from state to state."""

    def update(self, state: State, sim_time_s: float) -> None:
        """Take in a state."""
        ...

    def forget(self) -> None:
        """A new run has begun."""
        ...


class _Asking(ABC, Generic[Answer]):
    """Asks something of every state and keeps what follows from the answers."""

    def __init__(self, ask: Callable[[State], Answer]) -> None:
        self._ask = ask
        self._error: ConditionFailedError | None = None
        self.forget()

    @abstractmethod
    def forget(self) -> None:
        """A new run has begun."""

    def update(self, state: State, sim_time_s: float) -> None:
        """Take in a state; why it could not be asked is raised when the result is read."""
        self._error = None
        try:
            answer = self._ask(state)
        except ConditionFailedError as error:
            self._error = error
        else:
            self._take_in(answer, sim_time_s)

    @abstractmethod
    def _take_in(self, answer: Answer, sim_time_s: float) -> None:
        """Keep what follows from an answer."""

    def _check(self) -> None:
        if self._error is not None:
            raise self._error


class _Holding(_Asking[Answer]):
    """Whether something holds, as of the state that was taken in last."""

    _holds = False

    def holds(self, state: State) -> bool:
        """It could be asked of that state; else the error says why not."""
        self._check()
        return self._holds


class Changed(_Holding[Value]):
    """Whether a value is another than the last one that was there."""

    def forget(self) -> None:
        """What comes first is no change."""
        self._last: Value = None
        self._holds = False

    def _take_in(self, answer: Value, sim_time_s: float) -> None:
        """A missing value is no change, and neither is its return as it was."""
        self._holds = answer is not None and self._last is not None and answer != self._last
        if answer is not None:
            self._last = answer


class Rate(_Asking[int | float | None]):
    """How fast a value changes, per second, from one state that has it to the next."""

    def forget(self) -> None:
        """There is a rate from the second value on."""
        self._last: tuple[float, float] | None = None
        self._rate: float | None = None

    def _take_in(self, answer: int | float | None, sim_time_s: float) -> None:
        """While time stands still the rate stays as it is."""
        if answer is None:
            self._rate = None
        elif self._last is None:
            self._last = (sim_time_s, answer)
        elif (passed_s := sim_time_s - self._last[0]) > SAME_TIME_S:
            rate = (answer - self._last[1]) / passed_s
            self._rate = rate if -math.inf < rate < math.inf else None
            self._last = (sim_time_s, answer)

    def read(self, state: State) -> float | None:
        """As of the state that was taken in last."""
        self._check()
        return self._rate


class Displacement:
    """Metres between where the robot is and where it was so many seconds ago."""

    def __init__(
        self, place: Callable[[State], tuple[float, float] | None], seconds: float
    ) -> None:
        self._place = place
        self._seconds = seconds
        self._apart_s = seconds / _PLACES_KEPT
        self.forget()

    def forget(self) -> None:
        """There is a displacement once the run has lasted for that time."""
        self._places: deque[tuple[float, float, float]] = deque()
        self._here: tuple[float, float] | None = None
        self._sim_time_s = 0.0

    def update(self, state: State, sim_time_s: float) -> None:
        """Keeps 200 places at most; the one it compares with is older by half a percent at most."""
        self._sim_time_s = sim_time_s
        self._here = place = self._place(state)
        if place is None:
            return
        places = self._places
        if not places or sim_time_s - places[-1][0] >= self._apart_s:
            places.append((sim_time_s, *place))
            then_s = sim_time_s - self._seconds + SAME_TIME_S
            while len(places) > 1 and places[1][0] <= then_s:
                places.popleft()

    def read(self, state: State) -> float | None:
        """As of the state that was taken in last."""
        if self._here is None:
            return None
        was_s, was_x, was_y = self._places[0]
        age_s = self._sim_time_s - was_s
        if not -SAME_TIME_S <= age_s - self._seconds <= self._seconds + SAME_TIME_S:
            return None
        return math.hypot(self._here[0] - was_x, self._here[1] - was_y)


class Lasting(_Holding[bool]):
    """Whether a condition held in every state of at least so many seconds."""

    def __init__(self, condition: Callable[[State], bool], seconds: float) -> None:
        super().__init__(condition)
        self._seconds = seconds

    def forget(self) -> None:
        """It holds since no time at all."""
        self._since_s: float | None = None
        self._holds = False

    def _take_in(self, answer: bool, sim_time_s: float) -> None:
        """Between two states in both of which it holds it counts as unbroken."""
        if not answer:
            self._since_s = None
            self._holds = False
            return
        if self._since_s is None:
            self._since_s = sim_time_s
        self._holds = sim_time_s - self._since_s >= self._seconds - SAME_TIME_S
