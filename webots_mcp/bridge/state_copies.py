"""Copies of published states, made in a few microseconds while their keys and types stay the same.

Most controllers publish the same keys with each call. From one state a function is compiled that
reads the values of the next ones in a single expression, and refuses a state of another shape.
"""

from __future__ import annotations

import marshal
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

_MOST_VALUES: Final = 1000  # of a state that is copied so; compiling takes longer for each
_MOST_DEPTH: Final = 20
_MOST_BYTES: Final = 100_000  # of a copy; the values of a larger state are cut when it is encoded
_PLAIN_FORMAT: Final = 2  # of marshal; later ones look up equal objects, which takes longer
_CALLS_BETWEEN_SHAPES: Final = 256  # a state whose keys change all the time is not compiled again
_FIRST_SHAPES: Final = 8  # that are compiled at once

_LEAVES: Final = frozenset((float, int, str, bool, type(None)))


class StateCopy:
    """A copied state: its values, and the shape into which they belong.

    Attributes:
        values: The values, packed by `marshal`.
    """

    __slots__ = ("_shape", "values")

    def __init__(self, shape: _Shape, values: bytes) -> None:
        self._shape = shape
        self.values = values

    def state(self) -> dict[str, Any]:
        """Return a state that equals the copied one, in all types."""
        return self._shape.restore(iter(marshal.loads(self.values)))


class StateCopier:
    """Copies states of the shape that it saw last. Any thread may use it."""

    def __init__(self) -> None:
        self._shape: _Shape | None = None
        self._shapes = 0
        self._refused = 0

    def copy(self, state: object) -> StateCopy | None:
        """Return a copy; None where the state is large, or has another shape than the last one."""
        shape = self._shape
        if shape is not None:
            try:
                values = marshal.dumps(shape.read(state), _PLAIN_FORMAT)
            except Exception:  # noqa: BLE001  (another shape, or an object of the user's raises)
                self._shape = None
            else:
                if len(values) <= _MOST_BYTES:
                    return StateCopy(shape, values)
                self._shape, self._shapes = None, _FIRST_SHAPES
        self._refused += 1
        if self._shapes < _FIRST_SHAPES or self._refused % _CALLS_BETWEEN_SHAPES == 0:
            self._shapes += 1
            self._shape = shape_of(state)
        return None


class _UnlikeError(Exception):
    """A state has another shape."""


class _Shape(NamedTuple):
    """Reads the values of states with certain keys, and makes such a state of them.

    Attributes:
        read: Returns the values in the order of the keys; raises where the state has another shape.
        restore: The opposite.
    """

    read: Callable[[Any], tuple[Any, ...]]
    restore: Callable[[Iterator[Any]], dict[str, Any]]


def shape_of(state: object) -> _Shape | None:
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
    return _Shape(names["read"], restore)


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
