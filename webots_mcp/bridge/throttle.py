"""Which calls of `publish` are recorded."""

from __future__ import annotations


class Throttle:
    """One call in so many is recorded, and whenever somebody waits for the newest state.

    Attributes:
        interval: One call in this many.

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
        self.stale = False  # what was published last is not what was recorded last

    def begin_run(self) -> None:
        """Count from here: like runs are recorded at like times."""
        self._calls_before_run = self.calls

    def want(self) -> None:
        """Let the next call pass, whatever its number."""
        self._wanted = True

    def admits(self, force: object) -> bool:
        """Count a call; True if it is to be recorded, as whatever is true for `force` demands."""
        self.calls += 1
        if (self.calls - self._calls_before_run) % self.interval and not (force or self._wanted):
            self.skipped += 1
            self.stale = True
            return False
        self._wanted = self.stale = False
        return True
