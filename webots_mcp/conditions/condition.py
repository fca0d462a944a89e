"""A condition, and whether it holds as one state follows another."""

from __future__ import annotations

import ast
import keyword
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, Final

from webots_mcp.conditions.compiling import Compiler
from webots_mcp.conditions.memory import SAME_TIME_S
from webots_mcp.conditions.reading import Plain, State
from webots_mcp.conditions.scanning import Scanned, refusal, scan
from webots_mcp.naming import NO_POSITION, Value, find_position, flatten, nearest_first

POSITION: Final = "the position"  # what a displacement reads, whatever its signals are called
_MOST_OFFERED: Final = 3
_NAME: Final = re.compile(r"""'[^']*'|"[^"]*"|(?P<name>[^\W\d]\w*(?:\.\w+|\[\d+\])*)""")
_SIGNS: Final = ("and", "or", "not", "in", "is", "for", "if", "else", "True", "False", "None")


def _as_it_is(value: Any) -> Any:
    return value


@dataclass(frozen=True)
class Condition:
    """A condition of the language in docs/conditions.md.

    Attributes:
        text: Without the spaces around it.
        signals: The names of those that it reads, in order, without the position's.
        asks_position: Whether it asks where the robot is.
        remembers_s: How far back in time what it says of a state may reach.
    """

    text: str
    signals: tuple[str, ...]
    asks_position: bool
    remembers_s: float
    _scanned: Scanned = field(repr=False, compare=False)
    _tree: ast.expr = field(repr=False, compare=False)

    def evaluator(self, plain: Plain = _as_it_is) -> Evaluator:
        """Something that follows one robot from state to state.

        Args:
            plain: The counterpart that a row holds, in JSON's terms, of a value that is not plain
                JSON; recorded rows hold no others.
        """
        return Evaluator(Compiler(self._scanned, self._tree, plain), plain)

    def describe_unknown(self, known: Collection[str]) -> list[str]:
        """A sentence for each of its signals, and the position, not among the known ones."""
        return [
            *(
                f"{name} is missing as long as it is not published; there is {near}"
                for name, near in self.nearest_to_unknown(known)
            ),
            *self.describe_lost(known),
        ]

    def describe_lost(self, known: Collection[str]) -> list[str]:
        """That it asks where the robot is, and none of the known names is a place."""
        lost = self.asks_position and find_position(known) is None
        return [f"displacement has no value: {NO_POSITION}"] * lost

    def nearest_to_unknown(self, known: Collection[str]) -> list[tuple[str, str]]:
        """Each of its signals that is not among the known ones, and the names that are near."""
        unknown = [name for name in self.signals if name not in known]
        return [(name, _nearest(name, known)) for name in unknown]


class Evaluator:
    """Whether a condition holds, with each state that follows.

    Attributes:
        sim_time_s: Of the state that was taken in last; None at the begin of a run.
    """

    def __init__(self, compiled: Compiler, plain: Plain) -> None:
        self._root = compiled.root
        self._memories = tuple(compiled.memories)
        self._readers = compiled.readers
        self._position = compiled.position
        self._plain = plain
        self.sim_time_s: float | None = None

    def holds(self, state: State, sim_time_s: float) -> bool:
        """Take in the next state. A time that goes back begins a new run: all before is forgotten.

        Raises:
            ConditionFailedError: The values are not of the kinds that it can be asked of.
        """
        if self.sim_time_s is not None and sim_time_s < self.sim_time_s - SAME_TIME_S:
            self.forget()
        self.sim_time_s = sim_time_s
        if state.__class__ is not dict:
            state = self._as_dict(state)
        for memory in self._memories:
            memory.update(state, sim_time_s)
        return self._root(state)

    def forget(self) -> None:
        """A new run begins."""
        self.sim_time_s = None
        for memory in self._memories:
            memory.forget()

    def values(self, state: State) -> dict[str, Value]:
        """The signals of the condition as they are in a state; None where they are missing."""
        state = self._as_dict(state)
        names = self._position.names if self._position is not None else None
        place = self._position.read(state) if self._position is not None else None
        values = {name: read(state) for name, read in self._readers.items()}
        return values | dict(zip(names, place or (None, None), strict=True)) if names else values

    def lacks(self, state: State) -> set[str]:
        """What the condition reads and a state has no value of: signals, and `POSITION`."""
        state = self._as_dict(state)
        lacking = {name for name, read in self._readers.items() if read(state) is None}
        if self._position is not None and self._position.read(state) is None:
            lacking.add(POSITION)
        return lacking

    def names_in(self, state: State) -> list[str]:
        """The names of all values of a state, null or not."""
        return list(flatten(self._plain(self._as_dict(state))))

    def _as_dict(self, state: State) -> dict[Any, Any]:
        if state.__class__ is dict:
            return state
        plain = self._plain(state)
        return plain if plain.__class__ is dict else {}


def parse_condition(text: str) -> Condition:
    """Read a condition.

    Raises:
        InvalidConditionError: It is not of the language; the text names the column and what would
            be possible there.
    """
    scanned = scan(text)
    tree = parse(scanned)
    compiled = Compiler(scanned, tree, _as_it_is)
    asks_position = compiled.position is not None
    told = (tuple(compiled.readers), asks_position, compiled.remembers_s)
    return Condition(scanned.original, *told, scanned, tree)


def parse(scanned: Scanned) -> ast.expr:
    """Python's tree of a scanned text.

    Raises:
        InvalidConditionError: Its signs make no sense in this order.
    """
    reserved = _reserved_name(scanned.original, dotted=True)
    if reserved is not None:
        raise refusal(scanned, scanned.columns.index(reserved.start()), _instead_of(reserved))
    try:
        return ast.parse(scanned.source, mode="eval").body
    except SyntaxError as error:
        end = len(scanned.source)
        place = min(error.offset - 1, end) if error.offset else end
        raise refusal(scanned, place, _why_unread(scanned, place, error)) from None
    except (RecursionError, MemoryError, ValueError):
        raise refusal(scanned, 0, "it is nested too deep") from None


def _why_unread(scanned: Scanned, place: int, error: SyntaxError) -> str:
    if "never closed" in str(error.msg) or "unmatched" in str(error.msg):
        return str(error.msg)
    if reserved := _reserved_name(scanned.original, dotted=False):
        return _instead_of(reserved)
    rest = scanned.original[scanned.columns[place] :].strip()
    return f"not understood from {rest[:20]!r} on" if rest else "something is missing at the end"


def _reserved_name(text: str, *, dotted: bool) -> re.Match[str] | None:
    """The first name that Python's parser takes for something else: a part of it is reserved.

    One without a dot may be meant as what it is, a sign such as `and`.
    """
    for found in _NAME.finditer(text):
        parts = re.split(r"[.\[]", found["name"] or "")
        reserved = any(keyword.iskeyword(part) for part in parts)
        if reserved and (len(parts) > 1) == dotted and (dotted or parts[0] not in _SIGNS):
            return found
    return None


def _instead_of(reserved: re.Match[str]) -> str:
    name = re.sub(r"\[(\d+)\]", r".\1", reserved.group())
    return f"a part of {name!r} is a reserved word: write signal({name!r})"


def _nearest(name: str, known: Collection[str]) -> str:
    return ", ".join(nearest_first(name, known)[:_MOST_OFFERED]) or "nothing yet"
