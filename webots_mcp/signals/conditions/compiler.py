"""A condition: its tree as one function, and whether it holds as one state follows another.

Each node that is allowed has one place here, no other has any. The function is written from the
checked tree; no text that a person gave is evaluated as Python.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias, cast

from webots_mcp.errors import ConditionFailedError
from webots_mcp.signals.conditions.function_writer import FunctionWriter
from webots_mcp.signals.conditions.functions import (
    ARITHMETIC,
    COMPARISONS,
    FUNCTIONS,
    GIVING_FLAGS,
    OF_NUMBERS,
    SAME_TIME_S,
    Changed,
    Displacement,
    Lasting,
    Memory,
    Rate,
)
from webots_mcp.signals.conditions.signal_values import Plain, PositionReader, Read, State, reader
from webots_mcp.signals.conditions.syntax import (
    FLAGS,
    Nodes,
    Scanned,
    function_of,
    is_signal,
    parse,
    scan,
)
from webots_mcp.signals.naming import NO_POSITION, Value, find_position, flatten, nearest_first

POSITION: Final = "the position"  # what a displacement reads, whatever its signals are called

Number: TypeAlias = "int | float"

_SIGNS: Final[dict[type[ast.operator], str]] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
}
_ALWAYS_OR_NEVER: Final = "it would always be true or always be false"
_NO_COMPARISON: Final = (ast.LShift, ast.RShift, ast.BitAnd, ast.BitOr, ast.BitXor)
_COMPARE: Final = (
    "compare with < <= > >= == or !=; instead of `in` write mode == 'a' or mode == 'b'"
)


@dataclass(frozen=True)
class CompilerLimits:
    """Limits of conditions.

    Attributes:
        offered: Similar names that an error offers.
        duration_s: Maximum of a duration.
        times_as_old: Age of the position that a displacement takes, as a factor.
    """

    offered: int = 3
    duration_s: float = 3600.0
    times_as_old: float = 2.0


_LIMITS: Final = CompilerLimits()


def _as_it_is(value: Any) -> Any:
    return value


@dataclass(frozen=True)
class Condition:
    """A condition of the language in 'webots-mcp help conditions'.

    Attributes:
        text: Without the spaces around it.
        signals: The names of those that it reads, in order, without the position's.
        asks_position: Whether it asks where the robot is.
        remembers_s: How far back in time what it says of a state may reach.
        scanned: Its text as it was parsed.
        tree: All nodes of it are of the language.
    """

    text: str
    signals: tuple[str, ...]
    asks_position: bool
    remembers_s: float
    scanned: Scanned = field(repr=False, compare=False)
    tree: ast.expr = field(repr=False, compare=False)

    def evaluator(self, plain: Plain = _as_it_is) -> Evaluator:
        """Something that follows one robot from state to state.

        Args:
            plain: The counterpart that a row holds, in JSON's terms, of a value that is not plain
                JSON; recorded rows hold no others.
        """
        return Evaluator(Compiler(self.scanned, self.tree, plain), plain)

    def describe_unknown(self, known: Collection[str]) -> list[str]:
        """Return a sentence for each of its signals, and the position, not among the known ones."""
        unknown = [name for name in self.signals if name not in known]
        return [
            *(f"No signal {name!r} is published. {self._instead(name, known)}" for name in unknown),
            *self.describe_lost(known),
        ]

    def _instead(self, name: str, known: Collection[str]) -> str:
        quoted = self.quoted_text(name)
        return f"{quoted}. {_nearest(name, known)}" if quoted else _nearest(name, known)

    def quoted_text(self, name: str) -> str:
        """Return how to compare with a text, if a name may be meant as one; else nothing."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Compare) and isinstance(node.ops[0], (ast.Eq, ast.NotEq)):
                sign, sides = COMPARISONS[type(node.ops[0])][0], [node.left, *node.comparators]
                words = [side.id if isinstance(side, ast.Name) else "" for side in sides]
                if name in words and len(sides) == 2 and is_signal(sides[1 - words.index(name)]):
                    other = ast.unparse(sides[1 - words.index(name)])
                    return f"To compare with a text, quote it: {other} {sign} {name!r}"
        return ""

    def describe_lost(self, known: Collection[str]) -> list[str]:
        """That it asks where the robot is, and none of the known names is a place."""
        lost = self.asks_position and find_position(known) is None
        return [f"displacement has no value: {NO_POSITION}"] * lost


class Evaluator:
    """Whether a condition holds, with each state that follows.

    Attributes:
        sim_time_s: Of the state that was taken in last; None at the begin of a run.
        reaches: As of `Violated`.
    """

    reaches: Final = False

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

    def missing_names(self, state: State) -> set[str]:
        """Return what the condition reads and a state has no value of: signals, and `POSITION`."""
        state = self._as_dict(state)
        lacking = {name for name, read in self._readers.items() if read(state) is None}
        if self._position is not None and self._position.read(state) is None:
            lacking.add(POSITION)
        return lacking

    def names_in(self, state: State) -> list[str]:
        """Return the names of all values of a state, null or not."""
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
    read = (tuple(compiled.readers), asks_position, compiled.remembers_s)
    return Condition(scanned.original, *read, scanned, tree)


def _nearest(name: str, known: Collection[str]) -> str:
    if not known:
        return "Nothing is published yet"
    near = ", ".join(nearest_first(name, known)[: _LIMITS.offered])
    return f"The nearest of {len(known)} signals: {near}"


class Compiler(Nodes):
    """Makes a function of the nodes of one condition, or of one number within a score.

    Attributes:
        readers: What reads each signal that is named, by its name.
        columns: Where each of them is named first, counted from 0.
        memories: What has to take in every state, in this order.
        position: Where displacements are read from; None if there are none.
        remembers_s: How far back in time it may reach.
        root: Whether the condition holds; or the number.
    """

    def __init__(
        self, scanned: Scanned, tree: ast.expr, plain: Plain, *, number: bool = False
    ) -> None:
        super().__init__(scanned)
        self._plain = plain
        self.readers: dict[str, Read] = {}
        self.columns: dict[str, int] = {}
        self.memories: list[Memory[Any]] = []
        self.position: PositionReader | None = None
        self.remembers_s = 0.0
        self._code = FunctionWriter()
        self._constants = {"True", "False"}
        self._require_shallow(tree)
        write = self._number if number else self._condition
        self.root: Callable[[State], Any] = self._code.function(lambda: write(tree))
        for place in self._durations:
            self._refuse_at(
                place,
                "`for` follows a condition; put both in parentheses, as in (x < 1 for "
                "0.5) and y > 2",
            )
        if not self.readers and self.position is None:
            same = "it would be the same in every state"
            self._refuse(tree, f"no signal is named: {same if number else _ALWAYS_OR_NEVER}")

    # -- conditions ----------------------------------------------------------------------------
    # Each method writes the lines that evaluate a node, and returns the expression for its result.

    def _condition(self, node: ast.expr) -> str:
        if isinstance(node, ast.BoolOp):
            return self._combination(node)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return f"(not {self._condition(node.operand)})"
        if isinstance(node, ast.Compare):
            return self._comparison(node)
        if isinstance(node, ast.Tuple):
            return self._lasting(node)
        if function_of(node) in GIVING_FLAGS:
            return self._flag_of(cast("ast.Call", node))
        if is_signal(node):
            return self._flag(node)
        if isinstance(node, ast.Call) and function_of(node) not in FUNCTIONS:
            self._refuse(node, self._unknown_function(node))
        if isinstance(node, ast.BinOp) and type(node.op) in _NO_COMPARISON:
            self._refuse_at(self._operator_column(node), _COMPARE)
        self._refuse(node, "this is a value; a condition compares it, as in x < 1")

    def _combination(self, node: ast.BoolOp) -> str:
        """`and` and `or`: what follows is evaluated only where it decides."""
        code = self._code
        holds = code.assign(self._condition(node.values[0]))
        undecided = holds if isinstance(node.op, ast.And) else f"not {holds}"
        for value in node.values[1:]:
            with code.block(f"if {undecided}:"):
                code.line(f"{holds} = {self._condition(value)}")
        return holds

    def _comparison(self, node: ast.Compare) -> str:
        """`0 < x < 1`: each value is read once, and none after the first that does not fit."""
        code, sides = self._code, [node.left, *node.comparators]
        for op in node.ops:
            if type(op) not in COMPARISONS:
                self._refuse(node, _COMPARE)
        left, right = self._value(sides[0]), self._value(sides[1])
        holds = code.assign("False")
        self._compare(holds, left, node.ops[0], right, sides[0])
        for op, before, side in zip(node.ops[1:], sides[1:], sides[2:], strict=False):
            with code.block(f"if {holds}:"):
                left, right = right, self._value(side)
                code.line(f"{holds} = False")
                self._compare(holds, left, op, right, before)
        return holds

    def _compare(
        self, holds: str, left: str, op: ast.cmpop, right: str, left_node: ast.expr
    ) -> None:
        (sign, _), column = COMPARISONS[type(op)], self._column(left_node)

        def fail(a: Value, b: Value) -> ConditionFailedError:
            return self._failure(
                column,
                f"cannot compare {_shown(a)} with {_shown(b)} by {sign}; "
                "compare texts with == or != and a text in quotes, numbers with numbers",
            )

        code = self._code
        with code.block(f"if {self._are_there(left, right)}:"):
            with code.block("try:"):
                code.line(f"{holds} = {left} {sign} {right}")
            with code.block("except TypeError:"):
                code.line(f"raise {code.refer_to(fail)}({left}, {right}) from None")

    def _lasting(self, node: ast.Tuple) -> str:
        """Return a pair whose comma is a `for`; no other comma stands outside a call."""
        places = self._durations_between(node)
        if not places:
            self._refuse(
                node, "commas are possible only within a function; join conditions with and"
            )
        if len(node.elts) != 2:
            self._refuse_at(places[-1], "`for` takes one number of seconds, as in x < 1 for 0.5")
        self._durations.difference_update(places)
        condition, seconds = node.elts
        holds = self._code.function(lambda: self._condition(condition))
        return self._keep(Lasting(holds, self._seconds(seconds, "for")))

    def _flag_of(self, node: ast.Call) -> str:
        value = self._only(node)
        if function_of(node) == "missing":
            return f"({self._value(value)} is None)"
        return self._keep(Changed(self._code.function(lambda: self._value(value))))

    def _flag(self, node: ast.expr) -> str:
        """Return a signal by itself: a flag that is true, or a number other than 0."""
        value = self._text_refused(node, "{} is not a condition; compare it, as in mode == 'turn'")
        return f"({value} is not None and {value} != 0)"

    def _text_refused(self, node: ast.expr, why: str) -> str:
        """Read a signal; its error where it is a text."""
        code, value, column = self._code, self._signal(node), self._column(node)

        def fail(text: Value) -> ConditionFailedError:
            return self._failure(column, why.format(_shown(text)))

        with code.block(f"if {value}.__class__ is {code.refer_to(str)}:"):
            code.line(f"raise {code.refer_to(fail)}({value})")
        return value

    # -- values --------------------------------------------------------------------------------

    def _value(self, node: ast.expr) -> str:
        """Return a number, a flag, a text or None."""
        if isinstance(node, ast.Name) and node.id in FLAGS:
            return str(FLAGS[node.id])
        if isinstance(node, ast.Constant):
            return self._constant_name(node)
        return self._signal(node) if is_signal(node) else self._number(node)

    def _number(self, node: ast.expr) -> str:
        if isinstance(node, ast.Constant):
            value = self._constant(node)
            if isinstance(value, (str, bool)):
                self._refuse(node, "a number is needed here")
            return self._constant_name(node)
        if is_signal(node):
            return self._text_refused(node, "{} is not a number; name a signal of numbers")
        if isinstance(node, ast.BinOp):
            return self._arithmetic(node)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
            number = self._number(node.operand)
            if isinstance(node.op, ast.UAdd):
                return number
            return self._code.assign(f"-{number} if {self._are_there(number)} else None")
        if isinstance(node, ast.Call):
            return self._call(node)
        self._refuse(node, "a number, a text or a signal is needed here")

    def _arithmetic(self, node: ast.BinOp) -> str:
        if type(node.op) not in ARITHMETIC:
            self._refuse_at(
                self._operator_column(node), "only + - * / are possible; for a square write x * x"
            )
        code, sign = self._code, _SIGNS[type(node.op)]
        left, right = self._number(node.left), self._number(node.right)
        result = code.assign("None")
        with code.block(f"if {self._are_there(left, right)}:"):
            with code.block("try:"):
                code.line(f"{result} = {left} {sign} {right}")
            with code.block(f"except {code.refer_to((ZeroDivisionError, OverflowError))}:"):
                code.line("pass")
            with code.block("else:"):
                infinity = code.refer_to(math.inf)
                with code.block(f"if not -{infinity} < {result} < {infinity}:"):
                    code.line(f"{result} = None")
        return result

    def _call(self, node: ast.Call) -> str:
        name = function_of(node)
        if name in GIVING_FLAGS:
            self._refuse(node, f"{name}(...) is a condition, not a number")
        if name == "rate":
            value = self._only(node)
            return self._keep(Rate(self._code.function(lambda: self._number(value))))
        if name == "displacement":
            return self._displacement(self._only(node))
        if name in OF_NUMBERS:
            return self._of_numbers(node, name)
        self._refuse(node, self._unknown_function(node))

    def _displacement(self, node: ast.expr) -> str:
        if self.position is None:
            self.position = PositionReader(self._plain)
        seconds = self._seconds(node, "displacement")
        return self._keep(Displacement(self.position.read, seconds))

    def _of_numbers(self, node: ast.Call, name: str) -> str:
        self._require_plain_call(node)
        if (len(node.args) == 1) != (name == "abs") or not node.args:
            count = "one value" if name == "abs" else "two or more values"
            hint = "" if name == "abs" else f"; of a long array there is ranges.{name}"
            self._refuse(node, f"{name} takes {count}{hint}")
        numbers = [self._number(each) for each in node.args]
        function = self._code.refer_to(OF_NUMBERS[name])
        applied = f"{function}({', '.join(numbers)})"
        return self._code.assign(f"{applied} if {self._are_there(*numbers)} else None")

    def _keep(self, memory: Memory[Any]) -> str:
        """Add it after those that it is made of: they are up to date when it is its turn."""
        self.memories.append(memory)
        code = self._code
        name = code.refer_to(memory)
        with code.block(f"if {name}.error is not None:"):
            code.line(f"raise {name}.error")
        return code.assign(f"{name}.result")

    # -- signals and constants -----------------------------------------------------------------

    def _signal(self, node: ast.expr) -> str:
        name = self._signal_name(node)
        if name not in self.readers:
            self.readers[name] = reader(name, self._plain)
            self.columns[name] = self._column(node)
        code = self._code
        return code.assign(f"{code.refer_to(self.readers[name])}(state)")

    def _constant_name(self, node: ast.Constant) -> str:
        name = self._code.refer_to(self._constant(node))
        self._constants.add(name)
        return name

    def _are_there(self, *values: str) -> str:
        """Write a test whether all values are there; constants always are."""
        tests = [f"{each} is not None" for each in values if each not in self._constants]
        return " and ".join(tests) or "True"

    def _seconds(self, node: ast.expr, of: str) -> float:
        value = node.value if isinstance(node, ast.Constant) else None
        if type(value) not in (int, float):
            self._refuse(node, f"`{of}` takes a plain number of seconds, such as 0.5")
        seconds = cast("int | float", value)
        if not 0 < seconds <= _LIMITS.duration_s:
            self._refuse(node, f"seconds must be above 0 and at most {_LIMITS.duration_s:g}")
        self.remembers_s += _LIMITS.times_as_old * seconds
        return float(seconds)

    def _unknown_function(self, node: ast.Call) -> str:
        name = function_of(node)
        if name is None:
            return "only these functions can be called: " + ", ".join(f"{f}()" for f in FUNCTIONS)
        offer = ", ".join(f"{each}()" for each in nearest_first(name, FUNCTIONS))
        if name in ("mean", "avg", "average", "first", "last"):
            return (
                f"{name}() is possible only in a score; webots_get_trends has the mean, minimum "
                f"and maximum of a signal. Functions of a condition: {offer}"
            )
        return f"unknown function {name}(). Functions: {offer}"


def _shown(value: Value) -> str:
    if isinstance(value, bool):
        return f"the flag {str(value).lower()}"
    return f"the text {value[:50]!r}" if isinstance(value, str) else f"the number {value}"


# -- what shall hold -------------------------------------------------------------------------------
