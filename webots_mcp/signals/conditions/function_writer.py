"""Python functions that are written line by line, for what is evaluated with every state.

Only the compilers of this folder write them, from trees that they have checked. No text of a
condition gets into the source: names, texts and numbers are objects that the source refers to.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any


class FunctionWriter:
    """Writes functions of one argument, `state`, that share the objects which they refer to."""

    def __init__(self) -> None:
        self._objects: dict[str, Any] = {}
        self._lines: list[str] = []
        self._indent = 1

    def refer_to(self, value: object) -> str:
        """Return a name under which the source finds an object."""
        name = f"object_{len(self._objects)}"
        self._objects[name] = value
        return name

    def variable(self) -> str:
        """Return the name of a new variable."""
        return f"v{len(self._lines)}"

    def line(self, text: str) -> None:
        """Write a line of the current function."""
        self._lines.append("    " * self._indent + text)

    def assign(self, expression: str) -> str:
        """Write a line that assigns an expression to a new variable, and return its name."""
        name = self.variable()
        self.line(f"{name} = {expression}")
        return name

    @contextmanager
    def block(self, head: str) -> Generator[None]:
        """Indent what is written inside, below a line that ends with a colon."""
        self.line(head)
        self._indent += 1
        yield
        self._indent -= 1

    def function(self, write: Callable[[], str]) -> Callable[[Any], Any]:
        """Make a function.

        Args:
            write: Writes its lines, and returns the expression for its result.
        """
        outer, self._lines, self._indent = (self._lines, self._indent), [], 1
        self.line(f"return {write()}")
        source = "\n".join(["def evaluate(state):", *self._lines])
        self._lines, self._indent = outer
        exec(compile(source, "<condition>", "exec"), self._objects)
        return self._objects.pop("evaluate")
