"""How a client starts the servers that are compared."""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import anyio
from mcp import Client, StdioServerParameters

from tests.benchmarks.processes import environment

_LOOK_INTERVAL_S: Final = 1.0
_LOOK: Final = {"robot": "rover 0", "lookback_wall_s": 60}


def our_server(database: Path) -> StdioServerParameters:
    """`webots-mcp serve`."""
    return _module("webots_mcp", "serve", "--database", str(database))


def one_tool_server() -> StdioServerParameters:
    """The smallest server of the same library."""
    return _module("tests.benchmarks.programs.one_tool_server")


def _module(*arguments: str) -> StdioServerParameters:
    line = ["-m", *arguments]
    return StdioServerParameters(command=sys.executable, args=line, env=environment())


@dataclass
class RunningServer:
    """`webots-mcp serve` with a client, as long as its `with` block lasts.

    Args:
        database: Of the robots, of which one is `rover 0`.
        looking: Whether the client asks once a second what happened in the last minute.
    """

    database: Path
    looking: bool
    _over: threading.Event = field(default_factory=threading.Event)
    _ready: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> None:
        self._over.clear()
        self._ready.clear()
        self._thread = threading.Thread(target=lambda: anyio.run(self._be_client))
        self._thread.start()
        self._ready.wait()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    async def _be_client(self) -> None:
        try:
            async with Client(our_server(self.database)) as client:
                await client.list_tools()
                self._ready.set()
                while not await anyio.to_thread.run_sync(self._over.wait, _LOOK_INTERVAL_S):
                    if self.looking:
                        await client.call_tool("webots_monitor", _LOOK)
        finally:
            self._ready.set()
