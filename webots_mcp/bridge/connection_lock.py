"""The lock on a recorder's connection: one call at a time, released even if interrupted."""

from __future__ import annotations

import sys
import time
from threading import get_ident
from types import FrameType
from typing import Final

this_call: Final = sys._getframe  # pyright: ignore[reportPrivateUsage]
_HOLDER: Final = "holder"
# Windows may sleep for 15 ms where less was asked for.
BETWEEN_TRIES_S: Final = 0.0 if sys.platform == "win32" else 0.0001


class ConnectionLock:
    """A lock that belongs to a function call, and is free again when that call has ended.

    A KeyboardInterrupt may come between any two instructions, so also between a lock's `acquire()`
    and the `try` that would release it: a `threading.Lock` would then stay locked for ever. Here
    taking the lock and naming its holder is one instruction (`dict.setdefault`), and the lock of a
    call that has ended is taken over by the next call of the same thread.
    """

    def __init__(self) -> None:
        self._held: dict[str, tuple[int, FrameType]] = {}

    def acquire(self, call: FrameType, patience_s: float = 0.0) -> bool:
        """Whether `call` has the lock now; then `release` follows.

        Args:
            call: The frame that calls `release`.
            patience_s: How long to wait for another thread.
        """
        mine = (get_ident(), call)
        held = self._held.setdefault(_HOLDER, mine)
        return held is mine or self._acquire_later(held, mine, time.monotonic() + patience_s)

    def release(self) -> None:
        """Free the lock for another call."""
        self._held.pop(_HOLDER, None)

    def _acquire_later(
        self, held: tuple[int, FrameType], mine: tuple[int, FrameType], until_s: float
    ) -> bool:
        while held is not mine:
            if held[0] == mine[0]:
                if _is_under_way(held[1]):
                    return False  # made from within the holder, by a signal handler: never wait
                self._held.pop(_HOLDER)
            elif time.monotonic() >= until_s:
                return False
            else:
                time.sleep(BETWEEN_TRIES_S)
            held = self._held.setdefault(_HOLDER, mine)
        return True


def _is_under_way(call: FrameType) -> bool:
    """Whether a call is still executing: Python refuses to clear the frame of one that is."""
    try:
        call.clear()
    except RuntimeError:
        return True
    return False
