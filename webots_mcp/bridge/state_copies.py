"""Copies of published states, made in a few microseconds while their keys stay the same."""

from __future__ import annotations

import marshal
from typing import Any, Final

from webots_mcp.bridge.state_shapes import ShapeOfLast, StateShape

_MOST_BYTES: Final = 100_000  # of a copy; the values of a larger state are cut when it is encoded
_PLAIN_FORMAT: Final = 2  # of marshal; later ones look up equal objects, which takes longer


class StateCopy:
    """A copied state: its values, and the shape into which they belong.

    Attributes:
        values: The values, packed by `marshal`.
    """

    __slots__ = ("_shape", "values")

    def __init__(self, shape: StateShape, values: bytes) -> None:
        self._shape = shape
        self.values = values

    def state(self) -> dict[str, Any]:
        """Return a state that equals the copied one, in all types."""
        return self._shape.restore(iter(marshal.loads(self.values)))


class StateCopier:
    """Copies states of the shape that it saw last. Any thread may use it."""

    def __init__(self) -> None:
        self._last = ShapeOfLast()

    def copy(self, state: object) -> StateCopy | None:
        """Return a copy; None where the state is large, or has another shape than the last one."""
        shape = self._last.shape
        if shape is not None and (values := _packed(shape, state)) is not None:
            if len(values) <= _MOST_BYTES:
                return StateCopy(shape, values)
            self._last.learn_seldom()
        self._last.learn(state)
        return None


def _packed(shape: StateShape, state: object) -> bytes | None:
    """Return the values of a state as bytes; None where it has another shape."""
    try:
        return marshal.dumps(shape.read(state), _PLAIN_FORMAT)
    except Exception:  # noqa: BLE001  (another shape, or an object of the user's raises)
        return None
