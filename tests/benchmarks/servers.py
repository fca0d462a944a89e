"""Servers that benchmarks ask and compare, as processes of their own."""

from __future__ import annotations

import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import anyio
from mcp import Client, StdioServerParameters

from tests.benchmarks.processes import PROGRAMS, environment

_LOOK_INTERVAL_S: Final = 1.0
_LOOK: Final = {"robot": "rover 0", "lookback_wall_s": 60}


def our_server(database: Path) -> StdioServerParameters:
    """`webots-mcp serve`."""
    return _started_by("-m", "webots_mcp", "serve", "--database", str(database))


def one_tool_server() -> StdioServerParameters:
    """The smallest server of the same library."""
    return _started_by(*PROGRAMS, "one_tool_server")


def _started_by(*arguments: str) -> StdioServerParameters:
    return StdioServerParameters(command=sys.executable, args=[*arguments], env=environment())


@contextmanager
def running_server(database: Path) -> Generator[None]:
    """`webots-mcp serve` with a client that asks each second what `rover 0` did in a minute."""
    over, ready = threading.Event(), threading.Event()

    async def be_client() -> None:
        try:
            async with Client(our_server(database)) as client:
                await client.list_tools()
                ready.set()
                while not await anyio.to_thread.run_sync(over.wait, _LOOK_INTERVAL_S):
                    await client.call_tool("webots_monitor", _LOOK)
        finally:
            ready.set()

    thread = threading.Thread(target=lambda: anyio.run(be_client))
    thread.start()
    ready.wait()
    try:
        yield
    finally:
        over.set()
        thread.join()
