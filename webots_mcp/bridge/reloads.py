"""Notifying the controller's code of each reload and reset, once."""

from __future__ import annotations

from collections.abc import Callable

from webots_mcp.bridge.command_queue import ClaimedCommand

Callback = Callable[[], object]


class Reloads:
    """The callbacks of `on_reload`, and the reload that `detect_reload` has not returned yet.

    Args:
        failed: Receives the error of a callback that raised; the next one still runs.

    Attributes:
        requested_by: The command that asked Webots for a reload, until it happens.
    """

    def __init__(self, failed: Callable[[str, Exception], None]) -> None:
        self._failed = failed
        self._callbacks: list[Callback] = []
        self.requested_by: ClaimedCommand | None = None
        self._undetected = False
        self._unfired = False

    def add(self, callback: Callback) -> None:
        """Add a callback; one for a reload that happened before the first callback is still due."""
        self._callbacks.append(callback)

    def happened(self) -> None:
        """The world was reloaded or reset."""
        self._undetected = self._unfired = True

    def detect(self) -> bool:
        """Whether a reload or reset happened since the last call."""
        detected, self._undetected = self._undetected, False
        return detected

    def fire(self) -> None:
        """Run the callbacks if a reload or reset happened and they have not run since."""
        if self._unfired and self._callbacks:
            self._unfired = False
            self.call_back()

    def call_back(self) -> list[Exception | None]:
        """Run all callbacks; returns the exception of each, or None."""
        return [self._outcome(callback) for callback in tuple(self._callbacks)]

    def _outcome(self, callback: Callback) -> Exception | None:
        try:
            callback()
        except Exception as error:  # noqa: BLE001  (the next one still has to run)
            self._failed("on_reload callback", error)
            return error
        return None
