"""The keyboard: no keys are pressed in the stand-in."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from .arguments import integer
from .console import say
from .lacking import lacks


@lacks("get_key")
class Keyboard:
    """A keyboard without a person: no key is ever pressed."""

    END, HOME, LEFT, UP, RIGHT, DOWN = range(312, 318)
    PAGEUP, PAGEDOWN = range(366, 368)
    NUMPAD_HOME, NUMPAD_LEFT, NUMPAD_UP, NUMPAD_RIGHT, NUMPAD_DOWN = range(375, 380)
    NUMPAD_END = 382
    KEY, SHIFT, CONTROL, ALT = 0xFFFF, 1 << 16, 1 << 17, 1 << 18

    def __init__(self, sampling_period: int | None = None) -> None:
        self._period_ms = 0
        self.enable(sampling_period or 0)

    def enable(self, p: int) -> None:
        """Look at the keyboard every so many milliseconds; 0 disables."""
        self._period_ms = integer(p)

    def disable(self) -> None:
        """Look at the keyboard no longer."""
        self.enable(0)

    def getSamplingPeriod(self) -> int:
        """The sampling period in milliseconds, 0 if disabled."""
        return self._period_ms

    @property
    def sampling_period(self) -> int:
        """The sampling period in milliseconds, 0 if disabled."""
        return self.getSamplingPeriod()

    @sampling_period.setter
    def sampling_period(self, p: int | None) -> None:
        self.enable(p or 0)

    def getKey(self) -> int:
        """-1: no key is pressed."""
        if not self._period_ms:
            say(
                "Error: wb_keyboard_get_key() called for a disabled device! "
                "Please use: wb_keyboard_enable()."
            )
        return -1

    def getKeyCode(self) -> int:
        """-1: no key is pressed."""
        return self.getKey()
