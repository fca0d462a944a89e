"""Waiting for what comes about, however busy the machine is."""

from __future__ import annotations

import inspect
import time
from collections.abc import Awaitable, Callable
from typing import Any, NoReturn, TypeVar

import anyio

T = TypeVar("T")
_PATIENCE_S = 90.0  # on a slow machine who waits for a lease looks seldom


def wait_for(
    look: Callable[[], T | None],
    reached: Callable[[T], object] = bool,
    *,
    patience_s: float = _PATIENCE_S,
    pause_s: float = 0.02,
) -> T:
    """What is seen, once it is what is waited for: true, if nothing else is said."""
    until_s = time.monotonic() + patience_s
    while (seen := look()) is None or not reached(seen):
        if time.monotonic() > until_s:
            _fail(look, reached, seen=seen)
        time.sleep(pause_s)
    return seen


async def until(
    look: Callable[[], Awaitable[T | None] | T | None], reached: Callable[[T], object] = bool
) -> T:
    """The same where a server runs in this event loop, also for what is asked of it."""
    seen: T | None = None
    with anyio.move_on_after(_PATIENCE_S):
        while True:
            looked: Any = look()
            seen = await looked if inspect.isawaitable(looked) else looked
            if seen is not None and reached(seen):
                return seen
            await anyio.sleep(0.02)
    _fail(look, reached, seen=seen)


def _fail(*functions: Callable[..., object], seen: object) -> NoReturn:
    """Name what was waited for by its source, which is in one place if both are lambdas."""
    told = dict.fromkeys(
        inspect.getsource(each).strip() if inspect.isfunction(each) else repr(each)
        for each in functions
        if each is not bool
    )
    raise AssertionError("\n".join(("it did not come about:", *told, f"last seen: {seen!r}")))
