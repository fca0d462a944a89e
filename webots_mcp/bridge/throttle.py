"""Decides which calls of `publish` are recorded."""

from __future__ import annotations


class Throttle:
    """Admits one call in `interval`, and each call that is wanted for another reason.

    Attributes:
        interval: One call in this many is recorded.

    Raises:
        ValueError: The interval is less than 1.
    """

    def __init__(self, interval: int) -> None:
        if interval < 1:
            raise ValueError(f"throttle_interval must be 1 or more, got {interval!r}")
        self.interval = interval
        self._wanted = False
        self._calls_before_run = 0
        self.calls = 0
        self.skipped = 0
        self.stale = False  # the newest published state is not the newest recorded one

    def begin_run(self) -> None:
        """Count from here, so that equal runs are recorded at equal times."""
        self._calls_before_run = self.calls

    def begin_after(self, calls: int) -> None:
        """Count as if that many calls had been made, so that a branch is recorded as its origin."""
        self._calls_before_run = self.calls - calls

    @property
    def calls_in_run(self) -> int:
        """The number of calls in this run."""
        return self.calls - self._calls_before_run

    def want(self) -> None:
        """Admit the next call, whatever its number."""
        self._wanted = True

    def admits(self, force: object) -> bool:
        """Count a call; True if it is to be recorded, which any true value of `force` demands."""
        self.calls += 1
        if self.calls_in_run % self.interval and not (force or self._wanted):
            self.skipped += 1
            self.stale = True
            return False
        self._wanted = self.stale = False
        return True
