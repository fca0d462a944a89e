"""Shapes of published states: their keys, and which of their values are dicts, lists or tuples.

Most controllers publish the same keys with each call. From one state a function is compiled that
reads the values of the next ones in a single expression, and refuses a state of another shape.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

_MOST_VALUES: Final = 1000  # of a shape, containers included; compiling takes longer for each
_MOST_DEPTH: Final = 20
_CALLS_BETWEEN_SHAPES: Final = 256  # a state whose keys change all the time is not compiled again
_FIRST_SHAPES: Final = 8  # that are compiled at once

_LEAVES: Final = frozenset((float, int, str, bool, type(None)))


class StateShape(NamedTuple):
    """Reads the values of states with certain keys, and makes such a state of them.

    Attributes:
        read: Returns the values in the order of the keys; raises where the state has another shape.
        restore: The opposite.
    """

    read: Callable[[Any], tuple[Any, ...]]
    restore: Callable[[Iterator[Any]], dict[str, Any]]


class ShapeOfLast:
    """The shape of the states that came last.

    Attributes:
        shape: None until it was learned, and where the states have none.
    """

    def __init__(self) -> None:
        self.shape: StateShape | None = None
        self._learned = 0
        self._refused = 0

    def learn(self, state: object, fits: Callable[[object], bool] | None = None) -> None:
        """Learn the shape of a state that has another one; of many such states only of some.

        Args:
            state: The state.
            fits: Whether its shape may be learned; None if any may.
        """
        self.shape = None
        self._refused += 1
        if self._learned < _FIRST_SHAPES or self._refused % _CALLS_BETWEEN_SHAPES == 0:
            self._learned += 1
            self.shape = shape_of(state) if fits is None or fits(state) else None

    def learn_seldom(self) -> None:
        """From now on learn only of some states: knowing the shape did not help."""
        self._learned = _FIRST_SHAPES


def shape_of(state: object) -> StateShape | None:
    """Return the shape of a state; None where its values are not plain, or too many."""
    writer = _ShapeWriter()
    try:
        restore = writer.add(state, "state", 0)
    except _UnlikeError:
        return None
    if type(state) is not dict:
        return None
    source = "\n    ".join(
        [
            "def read(state):",
            *writer.lines,
            f"values = ({''.join(f'{each}, ' for each in writer.values)})",
            "if not leaves.issuperset(map(type, values)):",
            "    raise unlike",
            "return values",
        ]
    )
    names: dict[str, Any] = {"leaves": _LEAVES, "unlike": _UnlikeError}
    exec(compile(source, "<shape of a state>", "exec"), names)  # keys stand in it as literals only
    return StateShape(names["read"], restore)


class _UnlikeError(Exception):
    """A state has another shape."""


class _ShapeWriter:
    """Writes the function that reads the values of a state.

    Attributes:
        lines: Each container is assigned to a name, and its type and length are tested.
        values: One expression for each value, or for all items of an array.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.values: list[str] = []
        self._count = 0

    def add(self, value: object, name: str, depth: int) -> Callable[[Iterator[Any]], Any]:
        """Add a value that stands under a name in the function.

        Returns:
            What takes the value from the values of a state.
        """
        kind = type(value)
        if kind in _LEAVES:
            self._count_values(1)
            self.values.append(name)
            return next
        if depth > _MOST_DEPTH:
            raise _UnlikeError
        if kind is dict:
            return self._add_dict(value, name, depth)  # pyright: ignore[reportArgumentType]
        if kind is list or kind is tuple:
            return self._add_items(value, name, depth)  # pyright: ignore[reportArgumentType]
        raise _UnlikeError

    def _add_dict(
        self, value: dict[Any, Any], name: str, depth: int
    ) -> Callable[[Iterator[Any]], Any]:
        container = self._test(name, "dict", len(value))
        parts: list[tuple[str, Callable[[Iterator[Any]], Any]]] = []
        for key, item in value.items():
            if type(key) is not str:
                raise _UnlikeError
            parts.append((key, self.add(item, f"{container}[{key!r}]", depth + 1)))
        return lambda values: {key: restore(values) for key, restore in parts}

    def _add_items(
        self, value: list[Any] | tuple[Any, ...], name: str, depth: int
    ) -> Callable[[Iterator[Any]], Any]:
        kind, count = type(value), len(value)
        container = self._test(name, kind.__name__, count)
        if _LEAVES.issuperset(map(type, value)):
            self._count_values(count)
            self.values.append(f"*{container}")
            return lambda values: kind(next(values) for _ in range(count))
        parts = [self.add(item, f"{container}[{i}]", depth + 1) for i, item in enumerate(value)]
        return lambda values: kind(restore(values) for restore in parts)

    def _test(self, name: str, kind: str, count: int) -> str:
        """Write lines that assign a container to a name of its own and check type and length."""
        self._count_values(1)
        own_name = f"c{len(self.lines)}"
        self.lines.append(f"{own_name} = {name}")
        self.lines.append(
            f"if type({own_name}) is not {kind} or len({own_name}) != {count}: raise unlike"
        )
        return own_name

    def _count_values(self, count: int) -> None:
        self._count += count
        if self._count > _MOST_VALUES:
            raise _UnlikeError
