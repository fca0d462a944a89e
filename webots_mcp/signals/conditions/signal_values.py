"""The signal values that a condition reads from a robot's states, and those that it remembers.

A signal's value equals what `flatten` gives for the recorded row. A condition has two microseconds,
which is too short to flatten a whole state. The values of earlier states (the last value, a rate,
positions, since when something holds) are updated with every state, even if `and` or `or` skips
the comparison that uses them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, TypeAlias, TypeVar

from webots_mcp.signals.conditions.function_writer import FunctionWriter
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
_INFINITY: Final = math.inf
_NUMERIC: Final = frozenset("-0123456789")
_CONSTANT_KEYS: Final[dict[str, object]] = {"null": None, "true": True, "false": False}

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ReadLimits:
    """How much of a state a condition reads.

    Attributes:
        text_characters: Length up to which a text is compared; a row may hold less of a longer one.
        array_items: Length up to which an array is read; a row may hold nothing of a longer one.
        names: Names of a state that are remembered.
        searches_apart: Searches from which all names of a state are collected at once.
        number_characters: Length of a number in a key.
    """

    text_characters: int = 10_000
    array_items: int = 4000
    names: int = 2000
    searches_apart: int = 16
    number_characters: int = 30


_LIMITS: Final = ReadLimits()


def reader(name: str, plain: Plain) -> Read:
    """Return a function that reads a signal from a state, and returns None if it has no value.

    NaN and the infinities count as missing: a row holds null in their place.

    Args:
        name: The name of the signal, with dots.
        plain: Returns the plain JSON value that a row holds in place of any other object.
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
                unclear = _may_hold_otherwise(container, others)
                return _flattened(container, name, plain) if unclear else None
            for other in others:
                if other in container:
                    return _flattened(container, name, plain)
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

    def read_other(container: State) -> Value:
        """Read from a long array, a value without parts, or an object that is not plain JSON."""
        kind = container.__class__
        if kind is list or kind is tuple:
            return _reduced(container, name, plain) if name in REDUCTIONS else None
        if kind in _LEAVES:
            return None
        container = plain(container)
        return read(container) if container.__class__ in (dict, list) else None

    return read


def _may_hold_otherwise(container: dict[Any, Any], others: tuple[object, ...]) -> bool:
    """Return whether a key with a dot, or one that is not a string, may give a value its name."""
    try:
        "".join(container)
    except TypeError:
        return True
    for other in others:  # noqa: SIM110  (twice as fast as any())
        if other in container:
            return True
    return False


def _flattened(container: dict[Any, Any], name: str, plain: Plain) -> Value:
    """Read a signal from the flattened container: slow, and right for every kind of key."""
    return _leaf(flatten(plain(container)).get(name), plain)


def _other_keys(name: str) -> tuple[object, ...]:
    """Return the other keys that give a value this name: "a.b", or the number 1 for "1"."""
    parts = name.split(".")
    texts = [".".join(parts[:count]) for count in range(1, len(parts) + 1)]
    return (*texts[1:], *(key for text in texts for key in _keys_written(text)))


def _keys_written(text: str) -> Iterable[object]:
    """Yield the keys that are not strings and that JSON writes as this text."""
    if text in _CONSTANT_KEYS:
        yield _CONSTANT_KEYS[text]
    if text[:1] in _NUMERIC and len(text) < _LIMITS.number_characters:
        with suppress(ValueError):
            yield float(text)  # equals an integer key too


def _leaf(value: Any, plain: Plain) -> Value:
    """Return a value as a row holds it."""
    kind = value.__class__
    if kind is float:
        return value if -_INFINITY < value < _INFINITY else None
    if kind is bool or value is None:
        return value
    if kind is int:
        return value if -(2**63) <= value < 2**63 else _nearest_float(value)
    if kind is str and value.isascii() and len(value) <= _LIMITS.text_characters:
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
    """Return one reduction of a long array; an array of ordinary numbers takes a fast path."""
    if len(array) <= _LIMITS.array_items and _is_usual(array):
        return _REDUCE[reduction](array)
    as_in_row = plain(array)
    if as_in_row.__class__ is not list:
        return None
    usable = [_leaf(item, plain) for item in as_in_row]
    return reduce_array(usable)[REDUCTIONS.index(reduction)]


def _is_usual(array: list[Any] | tuple[Any, ...]) -> bool:
    """Return whether an array holds only numbers that a row stores unchanged."""
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
        if self._looks % _LIMITS.searches_apart != 1 or (
            self.names and self._keys.issuperset(state)
        ):
            return
        if len(self._numeric) >= _LIMITS.names or len(self._keys) >= _LIMITS.names:
            return
        self._keys.update(state)
        values = flatten(self._plain(state))
        self._numeric.update(name for name, value in values.items() if _may_be_number(value))
        if (names := find_position(self._numeric)) != self.names and names is not None:
            self.names, self._metres = names, metres_in(names[0])
            self._x, self._y = (reader(name, self._plain) for name in names)


def _may_be_number(value: Value) -> bool:
    return value.__class__ is not str and value.__class__ is not bool
