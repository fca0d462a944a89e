"""How fast a tab is sent what is new: not faster than its browser shows it."""

from __future__ import annotations

import time
from typing import Any, Final

from bokeh.models import Range1d

_UNHEARD_S: Final = 0.5  # until the browser has answered once, it may not be there yet
_PATIENCE_S: Final = 5.0  # then a missing answer is one that was lost


class Beat:
    """A number that goes to the browser with each change, and comes back when that was taken in.

    Attributes:
        models: To be hung into the document.
    """

    def __init__(self) -> None:
        there: Any = Range1d(start=0.0)
        back: Any = Range1d(start=0.0)
        there.js_link("start", back, "start")
        back.on_change("start", self._heard)
        self._there = there
        self._answered = self._sent_s = 0.0
        self.models = [there, back]

    @property
    def is_due(self) -> bool:
        """Whether the browser has taken in what it was sent last, or will not say so any more."""
        if self._answered == self._there.start:
            return True
        patience_s = _PATIENCE_S if self._answered else _UNHEARD_S
        return time.monotonic() - self._sent_s > patience_s

    def send(self) -> None:
        """To be called with each change, after it."""
        self._sent_s = time.monotonic()
        self._there.start += 1

    def _heard(self, _name: str, _old: object, new: float) -> None:
        self._answered = new
