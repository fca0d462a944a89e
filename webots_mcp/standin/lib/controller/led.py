"""Lamps."""

from __future__ import annotations

from .arguments import integer
from .device import Device


class LED(Device):
    """A lamp; it is not rendered, but it stores its value."""

    _c_name = "led"

    def __init__(self, name: int | str) -> None:
        super().__init__(name)
        self._value = 0

    def set(self, v: int) -> None:
        """Switch on, with 1 or the number or RGB value of a color, or off with 0."""
        self._value = integer(v, position=2)

    def get(self) -> int:
        """The value that was set last."""
        return self._value

    @property
    def value(self) -> int:
        """The value that was set last."""
        return self.get()

    @value.setter
    def value(self, v: int) -> None:
        self.set(v)
