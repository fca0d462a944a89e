"""An expectation: a condition with a name that shall hold, always or while another one does."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Final

from webots_mcp.errors import InvalidConditionError
from webots_mcp.signals.conditions.compiler import Condition, Evaluator, parse_condition
from webots_mcp.signals.conditions.functions import (
    SAME_TIME_S,
)
from webots_mcp.signals.conditions.signal_values import Plain, State
from webots_mcp.signals.naming import Value

MOST_CHARACTERS: Final = 100  # of a name
_DURING: Final = re.compile(r"""(?:[^'"]|'[^']*'|"[^"]*")*?(?<=[\s)])(during)(?=[\s(])""")
_WITHIN: Final = re.compile(r"(.*[^\s])\s+within\s+(\d+\.?\d*|\.\d+)\s*", re.DOTALL)


@dataclass(frozen=True)
class Expectation:
    """What is expected of a robot.

    Attributes:
        name: As it is reported.
        expected: What shall hold.
        during: Only while this holds; None: always.
        within_s: It must hold once, at most N seconds after the run began; None: in
            each state.
    """

    name: str
    expected: Condition
    during: Condition | None = None
    within_s: float | None = None

    @property
    def text(self) -> str:
        """What is expected, as it was given."""
        within = "" if self.within_s is None else f" within {self.within_s:g}"
        return self.expected.text + within

    @property
    def asks(self) -> tuple[str, str, str | None]:
        """Name and texts: two with the same are one."""
        return self.name, self.text, self.during and self.during.text

    @property
    def violation(self) -> Condition:
        """That it does not hold: its text and signals, for people; it is not asked itself."""
        text, signals = f"not ({self.text})", self.expected.signals
        if self.during is not None:
            text = f"({self.during.text}) and {text}"
            signals = tuple(dict.fromkeys([*self.during.signals, *signals]))
        return replace(self.expected, text=text, signals=signals)

    @property
    def asks_position(self) -> bool:
        """Whether one of its conditions asks where the robot is."""
        return self.expected.asks_position or bool(self.during and self.during.asks_position)

    @property
    def takes_s(self) -> float:
        """How long a run takes until it can be asked: what it remembers has to be there."""
        return self.expected.remembers_s / 2  # a displacement takes places of twice the age

    @property
    def asks_missing(self) -> bool:
        """Whether it is about missing values; else states without its values are not judged."""
        return "missing(" in self.expected.text

    @property
    def needs_two(self) -> bool:
        """Whether the first state alone shows nothing of it."""
        return "rate(" in self.expected.text

    def evaluator(self, plain: Plain) -> Violated:
        """Something that follows one robot from state to state."""
        return Violated(self, plain)


class Violated:
    """Whether an expectation is violated, with each state that follows; as an `Evaluator`.

    Attributes:
        reaches: The newest state is the first that meets what shall be reached in time.
    """

    def __init__(self, expectation: Expectation, plain: Plain) -> None:
        self._expectation = expectation
        self._within_s = expectation.within_s
        self._expected: Evaluator = expectation.expected.evaluator(plain)
        self._during = expectation.during and expectation.during.evaluator(plain)
        self._since_s: float | None = None
        self._reached = self.reaches = False

    def holds(self, state: State, sim_time_s: float) -> bool:
        """Take in the next state; True where what is expected does not hold.

        Raises:
            ConditionFailedError: See `Evaluator.holds`.
        """
        is_meant = self._during is None or self._during.holds(state, sim_time_s)
        is_met, since_s = self._expected.holds(state, sim_time_s), self._since_s
        is_first = since_s is None or sim_time_s < since_s - SAME_TIME_S
        if is_first or since_s is None:
            self._since_s = since_s = sim_time_s
            self._reached = False
        if is_met and self._within_s is None:  # as a rule
            return False
        asked, elapsed_s = self._expectation, sim_time_s - since_s
        decides = (
            is_met is (asked.within_s is not None)
            and is_meant
            and not (is_first and asked.needs_two)
            and elapsed_s >= asked.takes_s - SAME_TIME_S
            and (asked.asks_missing or not self._expected.missing_names(state))
        )
        if asked.within_s is None:
            return decides
        late = elapsed_s > asked.within_s + SAME_TIME_S and not self._reached
        self.reaches = decides and not self._reached
        self._reached |= decides
        return late

    def forget(self) -> None:
        """A new run begins."""
        self._since_s = None
        for each in filter(None, (self._expected, self._during)):
            each.forget()

    def values(self, state: State) -> dict[str, Value]:
        """Return the signals of both conditions as they are in a state."""
        during = {} if self._during is None else self._during.values(state)
        return during | self._expected.values(state)

    def names_in(self, state: Any) -> list[str]:
        """Return the names of all values of a state."""
        return self._expected.names_in(state)


def parse_expectation(
    condition: str, during: str | None = None, name: str | None = None
) -> Expectation:
    """Read an expectation; without a name it is called as its condition.

    Args:
        condition: A condition, or one with how soon it shall hold: `x > 2 within 20`.
        during: Another one.
        name: As it is reported.

    Raises:
        InvalidConditionError: A condition is not of the language, or the name is no short text.
    """
    within = _WITHIN.fullmatch(condition) if isinstance(condition, str) else None  # pyright: ignore[reportUnnecessaryIsInstance]
    if within and during is not None:
        raise InvalidConditionError("'within' counts from the begin of the run: leave out 'during'")
    expected = parse_condition(within[1] if within else condition)
    meant = None if during is None else parse_condition(during)
    found = Expectation("", expected, meant, float(within[2]) if within else None)
    if name is None:
        return replace(found, name=found.text[:MOST_CHARACTERS].strip())
    is_text = isinstance(name, str) and name.strip().isprintable()  # pyright: ignore[reportUnnecessaryIsInstance]
    if not is_text or not 0 < len(name.strip()) <= MOST_CHARACTERS:
        raise InvalidConditionError(
            f"the name of an expectation is a text of 1 to {MOST_CHARACTERS} printable characters, "
            f"not {name!r:.150}"
        )
    return replace(found, name=name.strip())


def read_expectation(text: str) -> Expectation:
    """Read `front_m > 0.1 during mode == 'drive'`, or a condition alone.

    Raises:
        InvalidConditionError: See `parse_expectation`.
    """
    if (found := _DURING.match(text)) is None:
        return parse_expectation(text)
    expected, during = text[: found.start(1)], text[found.end(1) :]
    return parse_expectation(expected, during, text.strip()[:MOST_CHARACTERS])
