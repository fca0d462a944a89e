"""Telling the controller's code of each reload and reset, once."""

from __future__ import annotations

from collections.abc import Callable

from webots_mcp.bridge.commands import ClaimedCommand

Callback = Callable[[], object]


class Reloads:
    """What `on_reload` registered, and what `detect_reload` has not answered yet.

    Args:
        failed: Told of a callback that raised; the next one still runs.

    Attributes:
        requested_by: The command that asked Webots for a reload, while it has not come yet.
    """

    def __init__(self, failed: Callable[[str, Exception], None]) -> None:
        self._failed = failed
        self._callbacks: list[Callback] = []
        self.requested_by: ClaimedCommand | None = None
        self._undetected = False
        self._unfired = False

    def add(self, callback: Callback) -> None:
        """Call it with each reload from now on, and with one that nobody was called for yet."""
        self._callbacks.append(callback)

    def happened(self) -> None:
        """The world was reloaded or reset."""
        self._undetected = self._unfired = True

    def detect(self) -> bool:
        """Whether it happened since the last call."""
        detected, self._undetected = self._undetected, False
        return detected

    def fire(self) -> None:
        """Run the callbacks if it happened and they have not run since."""
        if self._unfired and self._callbacks:
            self._unfired = False
            self.call_back()

    def call_back(self) -> list[Exception | None]:
        """Run all callbacks; for each what it raised, or None."""
        return [self._outcome(callback) for callback in tuple(self._callbacks)]

    def _outcome(self, callback: Callback) -> Exception | None:
        try:
            callback()
        except Exception as error:  # noqa: BLE001  (the next one still has to run)
            self._failed("on_reload callback", error)
            return error
        return None
