"""What a condition remembers of a robot's states: the newest values, and earlier ones.

A signal's value is what `flatten` of the recorded row gives under its name. A whole state is not
flattened for that: a condition has two microseconds. What is kept of the states before (the last
value, a rate, places, since when something holds) is brought up to date with every state, whatever
`and` and `or` leave unasked.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, Final, Generic, TypeAlias, TypeVar

from webots_mcp.errors import ConditionFailedError
from webots_mcp.signals.conditions.generated_code import FunctionWriter
from webots_mcp.signals.naming import (
    FARTHEST_M,
    INDEXES,
    LONGEST_SPREAD_ARRAY,
    REDUCTIONS,
    Value,
    find_position,
    flatten,
    mean_of,
    metres_in,
    reduce_array,
)

State: TypeAlias = Any  # what a controller publishes: usually a dict, with anything in it
Read: TypeAlias = Callable[[State], Value]
Plain: TypeAlias = Callable[[Any], Any]

_MISSING: Final = "Ellipsis"  # stands for a key that is not there
_LEAVES: Final = frozenset((float, int, str, bool, type(None)))
_NUMBERS: Final = frozenset((float, int))
_LONGEST_TEXT: Final = 10_000  # characters; a row may hold less of a longer one
_LONGEST_ARRAY: Final = 4000  # items; a row may hold nothing of a longer one
_MOST_NAMES: Final = 2000
_LOOKS_APART: Final = 16
_INFINITY: Final = math.inf
_NUMERIC: Final = frozenset("-0123456789")
_LONGEST_NUMBER: Final = 30  # characters
_CONSTANT_KEYS: Final[dict[str, object]] = {"null": None, "true": True, "false": False}
SAME_TIME_S: Final = 1e-6  # a clock that adds up steps is off by less
PLACES_KEPT: Final = 200  # of one displacement

Answer = TypeVar("Answer")


def reader(name: str, plain: Plain) -> Read:
    """What reads the signal of that name from a state; None where it has no value.

    NaN and the infinities are no values: a row holds null in their place.

    Args:
        name: Dotted.
        plain: The counterpart that a row holds, in JSON's terms, of what is not plain JSON.
    """
    return _shortcut(name, _careful_reader(name, plain))


def _shortcut(name: str, careful: Read) -> Read:
    """Read a signal with the lookups of its name alone; leave whatever is unusual to another."""
    code = FunctionWriter()
    other_way = f"{code.refer_to(careful)}(state)"

    def write() -> str:
        parts, value = name.split("."), "state"
        for place, part in enumerate(parts):
            others = _other_keys(".".join(parts[place:]))
            index = INDEXES.index(part) if part in INDEXES else -1
            if index >= 0:
                usual = f"{index} < len({value}) <= {LONGEST_SPREAD_ARRAY}"
                unusual = [f"{value}.__class__ is not list", f"not {usual}"]
                read = f"{value}[{index}]"
            else:
                unusual = [f"{value}.__class__ is not dict"]
                unusual += [f"{code.refer_to(other)} in {value}" for other in others]
                read = f"{value}.get({code.refer_to(part)}, {_MISSING})"
            with code.block(f"if {' or '.join(unusual)}:"):
                code.line(f"return {other_way}")
            value = code.assign(read)
        infinity = code.refer_to(math.inf)
        with code.block(f"if {value}.__class__ is {code.refer_to(float)}:"):
            code.line(f"return {value} if -{infinity} < {value} < {infinity} else None")
        with code.block(f"if {value} is True or {value} is False or {value} is None:"):
            code.line(f"return {value}")
        return other_way

    return code.function(write)


def _careful_reader(name: str, plain: Plain) -> Read:
    """Read a signal from whatever a state may be made of."""
    part, _, rest = name.partition(".")
    deeper = _careful_reader(rest, plain) if rest else None
    others = _other_keys(name)
    index = INDEXES.index(part) if part in INDEXES else -1

    def read(container: State) -> Value:
        kind = container.__class__
        if kind is dict:
            if part not in container:
                return whole(container) if is_unclear(container) else None
            for other in others:
                if other in container:
                    return whole(container)
            value = container[part]
        elif (kind is list or kind is tuple) and len(container) <= LONGEST_SPREAD_ARRAY:
            if not 0 <= index < len(container):
                return None
            value = container[index]
        else:
            return read_other(container)
        if deeper is not None:
            return deeper(value)
        if value.__class__ is float:
            return value if -_INFINITY < value < _INFINITY else None
        return _leaf(value, plain)

    def is_unclear(container: dict[Any, Any]) -> bool:
        """Whether a key that holds a dot, or is no text, may give a value that name."""
        try:
            "".join(container)
        except TypeError:
            return True
        for other in others:  # noqa: SIM110  (twice as fast as any())
            if other in container:
                return True
        return False

    def whole(container: dict[Any, Any]) -> Value:
        """The slow way that is always right."""
        return _leaf(flatten(plain(container)).get(name), plain)

    def read_other(container: State) -> Value:
        """Of a long array, of nothing that could have parts, or of what is not plain JSON."""
        kind = container.__class__
        if kind is list or kind is tuple:
            return _reduced(container, name, plain) if name in REDUCTIONS else None
        if kind in _LEAVES:
            return None
        container = plain(container)
        return read(container) if container.__class__ in (dict, list) else None

    return read


def _other_keys(name: str) -> tuple[object, ...]:
    """Keys of a dict that give its values the same name: one with a dot in it, or the number 1."""
    parts = name.split(".")
    texts = [".".join(parts[:count]) for count in range(1, len(parts) + 1)]
    return (*texts[1:], *(key for text in texts for key in _keys_written(text)))


def _keys_written(text: str) -> Iterable[object]:
    """The key that is no text and that JSON writes like that."""
    if text in _CONSTANT_KEYS:
        yield _CONSTANT_KEYS[text]
    if text[:1] in _NUMERIC and len(text) < _LONGEST_NUMBER:
        with suppress(ValueError):
            yield float(text)  # equals an integer key too


def _leaf(value: Any, plain: Plain) -> Value:
    """A value as a row holds it."""
    kind = value.__class__
    if kind is float:
        return value if -_INFINITY < value < _INFINITY else None
    if kind is bool or value is None:
        return value
    if kind is int:
        return value if -(2**63) <= value < 2**63 else _nearest_float(value)
    if kind is str and value.isascii() and len(value) <= _LONGEST_TEXT:
        return value
    if kind in (dict, list, tuple):
        return None
    value = plain(value)
    if value.__class__ is float and not math.isfinite(value):
        return None
    return value if value.__class__ in _LEAVES else None


def _nearest_float(number: int) -> float | None:
    try:
        return float(number)
    except OverflowError:
        return None


def _reduced(array: list[Any] | tuple[Any, ...], reduction: str, plain: Plain) -> Value:
    """One reduction of a long array; of nothing but ordinary numbers at the speed of C."""
    if len(array) <= _LONGEST_ARRAY and _is_usual(array):
        return _REDUCE[reduction](array)
    as_in_row = plain(array)
    if as_in_row.__class__ is not list:
        return None
    usable = [_leaf(item, plain) for item in as_in_row]
    return reduce_array(usable)[REDUCTIONS.index(reduction)]


def _is_usual(array: list[Any] | tuple[Any, ...]) -> bool:
    """Whether it holds nothing but numbers that a row holds as they are."""
    kinds = set(map(type, array))
    if not kinds <= _NUMBERS:
        return False
    try:
        finite = math.isfinite(sum(array))
    except OverflowError:
        return False
    return finite and (int not in kinds or -(2.0**63) <= min(array) <= max(array) < 2.0**63)


_REDUCE: Final[dict[str, Callable[[Any], Value]]] = {
    "count": len,
    "min": min,
    "max": max,
    "mean": mean_of,
    "argmin": lambda array: array.index(min(array)),
}


class PositionReader:
    """Reads where a robot is: from the signals that the tools take its position from."""

    def __init__(self, plain: Plain) -> None:
        self._plain = plain
        self._keys: set[object] = set()
        self._numeric: set[str] = set()
        self._looks = 0
        self._x: Read | None = None
        self._y: Read | None = None
        self._metres = 1.0  # in one of their unit
        self.names: tuple[str, str] | None = None

    def read(self, state: State) -> tuple[float, float] | None:
        """X and y in metres; None where the state has no position."""
        self._read(state)
        if self._x is None or self._y is None:
            return None
        x: Any = self._x(state)
        y: Any = self._y(state)
        try:
            near = -FARTHEST_M <= x <= FARTHEST_M and -FARTHEST_M <= y <= FARTHEST_M
        except TypeError:  # a text, or no value
            return None
        return (x * self._metres, y * self._metres) if near else None

    def _read(self, state: State) -> None:
        """Find out the names, at first and when there are keys that were not there before."""
        self._looks += 1
        if self._looks % _LOOKS_APART != 1 or (self.names and self._keys.issuperset(state)):
            return
        if len(self._numeric) >= _MOST_NAMES or len(self._keys) >= _MOST_NAMES:
            return
        self._keys.update(state)
        values = flatten(self._plain(state))
        self._numeric.update(name for name, value in values.items() if _may_be_number(value))
        if (names := find_position(self._numeric)) != self.names and names is not None:
            self.names, self._metres = names, metres_in(names[0])
            self._x, self._y = (reader(name, self._plain) for name in names)


def _may_be_number(value: Value) -> bool:
    return value.__class__ is not str and value.__class__ is not bool


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
    """Metres between where the robot is and where it was so many seconds ago."""

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
    """Whether a condition held in every state of at least so many seconds."""

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
