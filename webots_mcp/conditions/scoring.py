"""A score of a finished run: `max(pose.x) - 2 * count(stuck)`; see docs/trials.md.

What the values of a whole run come to (mean(x), max(x), time(condition)) follows state by state.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, Protocol, TypeAlias

from webots_mcp.conditions.compiler import ARITHMETIC, OF_NUMBERS, Compiler, Number
from webots_mcp.conditions.signal_values import State
from webots_mcp.conditions.syntax import Nodes, Scanned, function_of, is_signal, parse, scan
from webots_mcp.errors import ConditionFailedError, UnknownSignalError
from webots_mcp.naming import nearest_first

REDUCTIONS: Final[dict[str, Callable[[Sequence[Number]], Number]]] = {
    "min": min,
    "max": max,
    "first": lambda numbers: numbers[0],
    "last": lambda numbers: numbers[-1],
}
_DURATION: Final = "duration"
FUNCTIONS: Final = (*REDUCTIONS, "mean", "abs", "time", "count")
_MOST_OFFERED: Final = 3
_MISPLACED_FOR: Final = "`for` belongs to a condition, as in time(x < 1 for 2)"


class Facts(NamedTuple):
    """Facts about a run in addition to its states.

    Attributes:
        duration_s: Simulated seconds.
        counts: Of each kind of event that the score counts, how many there are; a text says why
            that is not known.
    """

    duration_s: float
    counts: Mapping[str, int | str]


class Scored(NamedTuple):
    """A score's value; or None, and why there is none."""

    value: float | None
    why: str | None = None


Term: TypeAlias = Callable[[Facts], Number]


class _NoValueError(Exception):
    """A part of the score has no value; the text says which and why."""


@dataclass(frozen=True)
class Score:
    """An expression over a run.

    Attributes:
        text: Without the spaces around it.
        signals: The columns of those that it reads, by their names, counted from 0.
        kinds: The columns of the kinds of events that it counts, by their names.
    """

    text: str
    signals: dict[str, int]
    kinds: dict[str, int]
    _scanned: Scanned = field(repr=False, compare=False)
    _tree: ast.expr = field(repr=False, compare=False)

    def of(self, states: Iterable[tuple[float, State]], facts: Facts) -> Scored:
        """The score of a run.

        Args:
            states: Each with its simulation time, in order.
            facts: What else is known of the run.
        """
        compiled = _Compiler(self._scanned, self._tree)
        try:
            for sim_time_s, state in states:
                for aggregate in compiled.aggregates:
                    aggregate.update(state, sim_time_s)
            value = float(compiled.root(facts))
        except (_NoValueError, ConditionFailedError) as error:
            return Scored(None, str(error))
        except (ZeroDivisionError, OverflowError) as error:
            return Scored(None, f"score {self.text!r}: {error}")
        return Scored(value) if math.isfinite(value) else Scored(None, "it is too large")

    def require_known(self, signals: Collection[str]) -> None:
        """See that each signal that it reads is one that the robot has published.

        Raises:
            UnknownSignalError: One is not; the text names the place and what is near.
        """
        for name, column in self.signals.items():
            if name not in signals:
                offer = ", ".join(nearest_first(name, signals)[:_MOST_OFFERED]) or "nothing yet"
                place = self._scanned.place(column)
                raise UnknownSignalError(
                    f"{place}: no signal {name!r} is recorded; there is {offer}"
                )

    def place(self, column: int) -> str:
        """The score and a place in it, for messages."""
        return self._scanned.place(column)


def parse_score(text: str) -> Score:
    """Read a score.

    Raises:
        InvalidConditionError: It is not of the language; the text names the column and what would
            be possible there.
    """
    scanned = scan(text, "score")
    tree = parse(scanned)
    compiled = _Compiler(scanned, tree)
    return Score(scanned.original, compiled.signals, compiled.kinds, scanned, tree)


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


class _Compiler(Nodes):
    """Makes a closure of the nodes of a score; what is inside an aggregate is a number of states.

    Attributes:
        aggregates: Each has to take in every state.
    """

    def __init__(self, scanned: Scanned, tree: ast.expr) -> None:
        super().__init__(scanned)
        self.aggregates: list[Aggregate] = []
        self.signals: dict[str, int] = {}
        self.kinds: dict[str, int] = {}
        self._require_shallow(tree)
        self.root = self._term(tree)
        for place in self._durations:
            self._refuse_at(place, _MISPLACED_FOR)

    def _term(self, node: ast.expr) -> Term:
        if isinstance(node, ast.Constant):
            value = self._constant(node)
            if isinstance(value, str):
                self._refuse(node, "a number is needed here")
            return lambda facts: value
        if isinstance(node, ast.Name) and node.id == _DURATION:
            return lambda facts: facts.duration_s
        if is_signal(node):
            several = "a signal has a value in each state: write mean(...), max(...), last(...)"
            self._refuse(node, several)
        if isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
            return self._arithmetic(node)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            term, sign = self._term(node.operand), -1 if isinstance(node.op, ast.USub) else 1
            return lambda facts: sign * term(facts)
        if isinstance(node, ast.Call):
            return self._call(node)
        if self._durations and isinstance(node, ast.Tuple):
            self._refuse_at(min(self._durations), _MISPLACED_FOR)
        self._refuse(node, "a score is a number: there are + - * /, " + ", ".join(FUNCTIONS))

    def _arithmetic(self, node: ast.BinOp) -> Term:
        left, right, apply = (
            self._term(node.left),
            self._term(node.right),
            ARITHMETIC[type(node.op)],
        )
        return lambda facts: apply(left(facts), right(facts))

    def _call(self, node: ast.Call) -> Term:
        self._require_plain_call(node)
        name = function_of(node)
        if name == "count":
            return self._count(node)
        if name == "time":
            return self._aggregate(node, TimeHeld(self._part(self._condition_in(node))))
        if name == "mean":
            return self._aggregate(node, Mean(self._part(self._only(node), number=True)))
        if name in REDUCTIONS and (len(node.args) == 1 or name not in OF_NUMBERS):
            return self._aggregate(
                node, Reduced(self._part(self._only(node), number=True), REDUCTIONS[name])
            )
        if name in OF_NUMBERS:
            return self._of_numbers(node, name)
        self._refuse(node, self._unknown(name))

    def _of_numbers(self, node: ast.Call, name: str) -> Term:
        terms = [self._term(each) for each in ([self._only(node)] if name == "abs" else node.args)]
        if not terms:
            self._refuse(node, f"{name} takes one value or more")
        return lambda facts: OF_NUMBERS[name](*(term(facts) for term in terms))

    def _count(self, node: ast.Call) -> Term:
        kind = self._only(node)
        if isinstance(kind, ast.Name):
            name = kind.id
        elif isinstance(kind, ast.Constant) and isinstance(kind.value, str):
            name = kind.value
        else:
            self._refuse(kind, "count takes a kind of event, as in count(stuck)")
        self.kinds.setdefault(name, self._column(kind))

        def count(facts: Facts) -> Number:
            found = facts.counts[name]
            if isinstance(found, str):
                raise _NoValueError(f"count({name}) is not known: {found}")
            return found

        return count

    def _aggregate(self, node: ast.Call, aggregate: Aggregate) -> Term:
        self.aggregates.append(aggregate)
        start, end = self._column(node), self._end_column(node)
        columns = self._scanned.columns
        text = self._scanned.original[columns[start] : columns[end]]

        def value(facts: Facts) -> Number:
            found = aggregate.value()
            if found is None:
                raise _NoValueError(f"{text} has no value: no recorded state of the run has one")
            return found

        return value

    def _part(self, node: ast.expr, *, number: bool = False) -> Compiler:
        """What is asked of each state."""
        start, end = self._column(node), self._end_column(node)
        inside = frozenset(place for place in self._durations if start <= place < end)
        self._durations -= inside
        compiled = Compiler(
            replace(self._scanned, durations=inside), node, lambda value: value, number=number
        )
        for name, column in compiled.columns.items():
            self.signals.setdefault(name, column)
        return compiled

    def _condition_in(self, node: ast.Call) -> ast.expr:
        """The condition in `time(...)`: `c for 2` has become two arguments."""
        if len(node.args) != 2:
            return self._only(node)
        pair = ast.Tuple(elts=node.args, ctx=ast.Load())
        first, last = node.args
        pair.lineno, pair.col_offset = first.lineno, first.col_offset
        pair.end_lineno, pair.end_col_offset = last.end_lineno, last.end_col_offset
        return pair

    def _unknown(self, name: str | None) -> str:
        if name is None:
            return "only functions can be called: " + ", ".join(FUNCTIONS)
        offer = ", ".join(f"{each}()" for each in nearest_first(name, FUNCTIONS))
        return f"there is no {name}() of a run; there are {offer}"
