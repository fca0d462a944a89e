"""The task that reads what is new in a recording and has it sent to the clients.

It runs next to the answers: it reads in a thread of its own, so that no tool waits for it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Final

import anyio
from anyio import CapacityLimiter, to_thread

from webots_mcp.errors import WebotsMCPError, warn
from webots_mcp.server.notable_events import News, OccurrenceReader

READ_EVERY_S: Final = 0.5
Receiver = Callable[[News], Awaitable[None]]


class UpdateWatch:
    """Reads what is new, once somebody wants to know it.

    Args:
        reader: Reads the recording.

    Attributes:
        receivers: Are called with what is new.
    """

    def __init__(self, reader: OccurrenceReader) -> None:
        self.receivers: list[Receiver] = []
        self._reader = reader
        self._threads: CapacityLimiter | None = None
        self._beginning: anyio.Lock | None = None
        self._wanted: anyio.Event | None = None
        self._warned: str | None = None

    async def begin(self) -> None:
        """Read from now on: what is in the recording by now is not new."""
        if self._beginning is None:
            self._beginning = anyio.Lock()
        async with self._beginning:
            if self._wanted is None:
                self._wanted = anyio.Event()
            if not self._wanted.is_set():
                await self._read()
                self._wanted.set()

    async def run(self) -> None:
        """Read and send until it is cancelled."""
        if self._wanted is None:
            self._wanted = anyio.Event()
        await self._wanted.wait()
        while True:
            await anyio.sleep(READ_EVERY_S)
            news = await self._read()
            if news is None:
                continue
            for receive in self.receivers:
                await receive(news)

    async def _read(self) -> News | None:
        """Return what is new; None, with a warning once, where it cannot be read."""
        if self._threads is None:
            self._threads = CapacityLimiter(1)
        try:
            news = await to_thread.run_sync(
                self._reader.read, abandon_on_cancel=True, limiter=self._threads
            )
        except WebotsMCPError as error:
            if str(error) != self._warned:
                self._warned = str(error)
                warn(f"no updates are sent: {error}")
            return None
        self._warned = None
        return news
