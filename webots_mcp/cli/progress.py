"""How far long work has come: shown on a terminal, silent in a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final

_INTERVAL_S: Final = 0.1


@contextmanager
def shown_progress(doing: str) -> Generator[Callable[[int, int], None]]:
    """A function to call with how much is done and how much there is; the line vanishes at the end.

    It is written to stderr, because stdout may be the data.
    """
    next_s = 0.0

    def show(done: int, of: int) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + _INTERVAL_S
            print(f"\r{doing}: {100 * done // max(of, 1)} %", end="\x1b[K", file=sys.stderr)

    if not sys.stderr.isatty():
        yield lambda done, of: None
        return
    try:
        yield show
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
