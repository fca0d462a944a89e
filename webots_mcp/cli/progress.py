"""How far long work has come: shown on a terminal, silent in a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final

from webots_mcp.cli.terminal import rewrite

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
            rewrite(sys.stderr, f"{doing}: {100 * done // max(of, 1)} %")

    if not sys.stderr.isatty():
        yield lambda done, of: None
        return
    try:
        yield show
    finally:
        rewrite(sys.stderr)


@contextmanager
def line_of_progress() -> Generator[None]:
    """Inside, `show_progress` has a line, which vanishes at the end."""
    try:
        yield
    finally:
        rewrite(sys.stderr)


async def show_progress(progress: float, total: float | None, text: str) -> None:
    """On a terminal one line that changes; in a pipe nothing, as for all commands."""
    rewrite(sys.stderr, text)
