"""A score of a finished run: `max(pose.x) - 2 * count(stuck)`; see 'webots-mcp help trials'.

It is arithmetic over facts about the run, such as what the values of a signal come to: mean(x),
max(x), time(condition).
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, TypeAlias

from webots_mcp.errors import UnknownSignalError
from webots_mcp.signals.conditions.compiler import Compiler, Number
from webots_mcp.signals.conditions.functions import ARITHMETIC, OF_NUMBERS
from webots_mcp.signals.conditions.syntax import Nodes, Scanned, function_of, is_signal, parse, scan
from webots_mcp.signals.naming import nearest_first

_REDUCTIONS: Final = ("min", "max", "first", "last", "mean")
_FUNCTIONS: Final = (*_REDUCTIONS, "abs", "time", "count")
_MOST_OFFERED: Final = 3
_MISPLACED_FOR: Final = "`for` belongs to a condition, as in time(x < 1 for 2)"


class Aggregate(NamedTuple):
    """What the values of a whole run come to.

    Attributes:
        text: As it is written: `mean(x)`.
        function: `mean`, `min`, `max`, `first` or `last` of a number, or `time` of a condition.
        scanned: What the tree was parsed from.
        tree: Of that number or condition.
    """

    text: str
    function: str
    scanned: Scanned
    tree: ast.expr


class Facts(NamedTuple):
    """Facts about a run.

    Attributes:
        duration_s: Simulated seconds.
        counts: Of each kind of event that the score counts, how many there are; a text says why
            that is not known.
        aggregates: Of each that the score has; None where no row has a value.
    """

    duration_s: float
    counts: Mapping[str, int | str]
    aggregates: Sequence[float | None]


class Scored(NamedTuple):
    """A score's value; or None, and why there is none."""

    value: float | None
    why: str | None = None


_Term: TypeAlias = Callable[[Facts], Number]


class _NoValueError(Exception):
    """A part of the score has no value; the text says which and why."""


@dataclass(frozen=True)
class Score:
    """An expression over a run.

    Attributes:
        text: Without the spaces around it.
        signals: The columns of those that it reads, by their names, counted from 0.
        kinds: The columns of the kinds of events that it counts, by their names.
        aggregates: What it asks of the values of a run.
    """

    text: str
    signals: dict[str, int]
    kinds: dict[str, int]
    aggregates: tuple[Aggregate, ...]
    _scanned: Scanned = field(repr=False, compare=False)
    _root: _Term = field(repr=False, compare=False)

    def of(self, facts: Facts) -> Scored:
        """Return the score of a run."""
        try:
            value = float(self._root(facts))
        except _NoValueError as error:
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
                raise UnknownSignalError(
                    f"{self.place(column)}: no signal {name!r} is recorded. Nearest signals: "
                    f"{offer}"
                )

    def place(self, column: int) -> str:
        """Return the score and a place in it, for messages."""
        return self._scanned.place(column)


def parse_score(text: str) -> Score:
    """Read a score.

    Raises:
        InvalidConditionError: It is not of the language; the text names the column and what would
            be possible there.
    """
    scanned = scan(text, "score")
    read = _Compiler(scanned, parse(scanned))
    aggregates = tuple(read.aggregates)
    return Score(scanned.original, read.signals, read.kinds, aggregates, scanned, read.root)


class _Compiler(Nodes):
    """Makes a closure of the nodes of a score; what is inside an aggregate is left as it is."""

    def __init__(self, scanned: Scanned, tree: ast.expr) -> None:
        super().__init__(scanned)
        self.aggregates: list[Aggregate] = []
        self.signals: dict[str, int] = {}
        self.kinds: dict[str, int] = {}
        self._require_shallow(tree)
        self.root = self._term(tree)
        for place in self._durations:
            self._refuse_at(place, _MISPLACED_FOR)

    def _term(self, node: ast.expr) -> _Term:
        if isinstance(node, ast.Constant):
            value = self._constant(node)
            if isinstance(value, str):
                self._refuse(node, "a number is needed here")
            return lambda facts: value
        if isinstance(node, ast.Name) and node.id == "duration":
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
        self._refuse(node, "a score is a number: there are + - * /, " + ", ".join(_FUNCTIONS))

    def _arithmetic(self, node: ast.BinOp) -> _Term:
        left, right, apply = (
            self._term(node.left),
            self._term(node.right),
            ARITHMETIC[type(node.op)],
        )
        return lambda facts: apply(left(facts), right(facts))

    def _call(self, node: ast.Call) -> _Term:
        self._require_plain_call(node)
        name = function_of(node)
        if name == "count":
            return self._count(node)
        if name == "time":
            return self._aggregate(node, name, self._condition_in(node))
        if name in _REDUCTIONS and (len(node.args) == 1 or name not in OF_NUMBERS):
            return self._aggregate(node, name, self._only(node))
        if name in OF_NUMBERS:
            return self._of_numbers(node, name)
        self._refuse(node, self._unknown(name))

    def _of_numbers(self, node: ast.Call, name: str) -> _Term:
        terms = [self._term(each) for each in ([self._only(node)] if name == "abs" else node.args)]
        if not terms:
            self._refuse(node, f"{name} takes one value or more")
        return lambda facts: OF_NUMBERS[name](*(term(facts) for term in terms))

    def _count(self, node: ast.Call) -> _Term:
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

    def _aggregate(self, node: ast.Call, function: str, inside: ast.expr) -> _Term:
        start, end = self._column(inside), self._end_column(inside)
        durations = frozenset(place for place in self._durations if start <= place < end)
        self._durations -= durations
        scanned = replace(self._scanned, durations=durations)
        is_number = function != "time"
        compiled = Compiler(scanned, inside, lambda value: value, number=is_number)
        for name, column in compiled.columns.items():
            self.signals.setdefault(name, column)
        columns = self._scanned.columns
        text = self._scanned.original[columns[self._column(node)] : columns[self._end_column(node)]]
        place = len(self.aggregates)
        self.aggregates.append(Aggregate(text, function, scanned, inside))

        def value(facts: Facts) -> Number:
            found = facts.aggregates[place]
            if found is None:
                raise _NoValueError(f"{text} has no value: no recorded state of the run has one")
            return found

        return value

    def _condition_in(self, node: ast.Call) -> ast.expr:
        """Return the condition in `time(...)`: `c for 2` has become two arguments."""
        if len(node.args) != 2:
            return self._only(node)
        pair = ast.Tuple(elts=node.args, ctx=ast.Load())
        first, last = node.args
        pair.lineno, pair.col_offset = first.lineno, first.col_offset
        pair.end_lineno, pair.end_col_offset = last.end_lineno, last.end_col_offset
        return pair

    def _unknown(self, name: str | None) -> str:
        if name is None:
            return "only these functions can be called: " + ", ".join(_FUNCTIONS)
        offer = ", ".join(f"{each}()" for each in nearest_first(name, _FUNCTIONS))
        return f"there is no {name}() of a run; there are {offer}"
