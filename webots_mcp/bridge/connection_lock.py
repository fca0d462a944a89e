"""The lock on a recorder's connection: one call at a time, whatever interrupts it."""

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
    """A lock that belongs to a call, and ends with it however it ends.

    A KeyboardInterrupt comes between any two instructions, so also between a lock's `acquire()`
    and the `try` that would release it. Here taking and naming the holder is one instruction, and
    a holder whose call is over holds nothing any more: its thread takes the lock over.
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
        """Another call may have it."""
        self._held.pop(_HOLDER, None)

    def _acquire_later(
        self, held: tuple[int, FrameType], mine: tuple[int, FrameType], until_s: float
    ) -> bool:
        while held is not mine:
            if held[0] == mine[0]:
                if _is_under_way(held[1]):
                    return False  # this call was made from within that one: a signal's handler
                self._held.pop(_HOLDER)
            elif time.monotonic() >= until_s:
                return False
            else:
                time.sleep(BETWEEN_TRIES_S)
            held = self._held.setdefault(_HOLDER, mine)
        return True


def _is_under_way(call: FrameType) -> bool:
    """Python refuses to clear the frame of a call that is still executing."""
    try:
        call.clear()
    except RuntimeError:
        return True
    return False
