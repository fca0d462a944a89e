"""The nodes of a parsed text: where each stands, and the refusal of those that are not allowed."""

from __future__ import annotations

import ast
from typing import Final, NoReturn, cast

from webots_mcp.conditions.scanning import Scanned, refusal
from webots_mcp.errors import ConditionFailedError

MAX_DEPTH: Final = 50
MAX_NUMBER: Final = 1e300
FLAGS: Final = {"true": True, "false": False, "True": True, "False": False}


class Nodes:
    """What every compiler of the language asks of the nodes that it meets."""

    def __init__(self, scanned: Scanned) -> None:
        self._scanned = scanned
        self._durations: set[int] = set(scanned.durations)
        self._encoded = scanned.source.encode()

    def _constant(self, node: ast.Constant) -> int | float | str:
        value = node.value
        if type(value) is str or type(value) is bool:
            return value
        if type(value) not in (int, float):
            self._refuse(node, "it has no meaning here; for no value, write missing(x)")
        number = cast("int | float", value)
        if abs(number) > MAX_NUMBER:
            self._refuse(node, f"numbers are up to {MAX_NUMBER:g}")
        return number

    def _durations_between(self, node: ast.Tuple) -> list[int]:
        start, end = self._column(node), self._end_column(node)
        inner = [(self._column(part), self._end_column(part)) for part in node.elts]
        return sorted(
            place
            for place in self._durations
            if start <= place < end and not any(a <= place < b for a, b in inner)
        )

    def _only(self, node: ast.Call) -> ast.expr:
        self._require_plain_call(node)
        if len(node.args) != 1:
            self._refuse(node, f"{function_of(node)} takes one value, not {len(node.args)}")
        return node.args[0]

    def _require_plain_call(self, node: ast.Call) -> None:
        if node.keywords or any(isinstance(each, ast.Starred) for each in node.args):
            self._refuse(node, "a function takes values only, as in max(a, b)")

    def _require_shallow(self, tree: ast.expr) -> None:
        level: list[ast.AST] = [tree]
        for _ in range(MAX_DEPTH):
            level = [child for node in level for child in ast.iter_child_nodes(node)]
        if level:
            self._refuse_at(0, f"it is nested over {MAX_DEPTH} levels: make it simpler")

    def _column(self, node: ast.expr) -> int:
        return len(self._encoded[: node.col_offset].decode())

    def _end_column(self, node: ast.expr) -> int:
        return len(self._encoded[: node.end_col_offset].decode())

    def _operator_column(self, node: ast.BinOp) -> int:
        """Behind the left operand, and the parentheses and spaces after it."""
        start = self._end_column(node.left)
        after = self._scanned.source[start:]
        return start + len(after) - len(after.lstrip(" )"))

    def _refuse(self, node: ast.expr, why: str) -> NoReturn:
        self._refuse_at(self._column(node), why)

    def _refuse_at(self, column: int, why: str) -> NoReturn:
        raise refusal(self._scanned, column, why)

    def _failure(self, column: int, why: str) -> ConditionFailedError:
        return ConditionFailedError(f"{self._scanned.place(column)}: {why}")


def is_signal(node: ast.expr) -> bool:
    """Whether it names a signal."""
    if isinstance(node, ast.Name):
        return node.id not in FLAGS
    return isinstance(node, (ast.Attribute, ast.Subscript)) or function_of(node) == "signal"


def function_of(node: ast.expr) -> str | None:
    """The name of the function that is called; None where none is."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return node.func.id
    return None
