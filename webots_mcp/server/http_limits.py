"""Limits of the server over HTTP: how many sessions are open, and how long headers may take.

The SDK refuses new sessions at its limit, and uvicorn waits for ever for the rest of a request.
Both would let abandoned clients, or those that send half a request, lock out all others.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import h11
from mcp_types.version import HANDSHAKE_PROTOCOL_VERSIONS
from starlette.datastructures import Headers
from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_SESSIONS: Final = 1_000  # of clients before 2026-07-28
HEADERS_S: Final = 10.0  # from the connection, or from the answer before
BODY_S: Final = 60.0  # from the headers; a body has at most 4 MiB
_SESSION: Final = "mcp-session-id"


@dataclass
class _Session:
    under_way: int = 0
    idle_since_s: float = field(default_factory=time.monotonic)


class SessionLimit:
    """An application whose sessions are limited: at the limit the one idle for longest ends.

    A session with a request under way, or with an open stream, is never ended.
    """

    def __init__(self, app: ASGIApp, most: int) -> None:
        self._app, self._most = app, most
        self._sessions: dict[str, _Session] = {}
        self._opening = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        headers = Headers(scope=scope)
        if (name := headers.get(_SESSION)) is not None:
            return await self._go_on(name, scope, receive, send)
        version = headers.get("mcp-protocol-version")
        if version is not None and version not in HANDSHAKE_PROTOCOL_VERSIONS:
            return await self._app(scope, receive, send)  # a protocol without sessions
        self._opening += 1
        try:
            await self._open(scope, receive, send)
        finally:
            self._opening -= 1

    async def _open(self, scope: Scope, receive: Receive, send: Send) -> None:
        while len(self._sessions) + self._opening > self._most:
            if (name := self._idle_longest()) is None:
                break  # the SDK says that there are too many
            await self._end(name, scope)

        async def noted(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] < 400:
                name = Headers(raw=message["headers"]).get(_SESSION)
                if name is not None:
                    self._sessions[name] = _Session()
            await send(message)

        await self._app(scope, receive, noted)

    async def _go_on(self, name: str, scope: Scope, receive: Receive, send: Send) -> None:
        session = self._sessions.get(name) or _Session()

        async def noted(message: Message) -> None:
            if message["type"] == "http.response.start":
                status, is_end = message["status"], scope["method"] == "DELETE"
                if status == 404 or (is_end and status < 400):
                    self._sessions.pop(name, None)
            await send(message)

        session.under_way += 1
        try:
            await self._app(scope, receive, noted)
        finally:
            session.under_way -= 1
            session.idle_since_s = time.monotonic()

    def _idle_longest(self) -> str | None:
        idle = {name: each for name, each in self._sessions.items() if not each.under_way}
        return min(idle, key=lambda name: idle[name].idle_since_s, default=None)

    async def _end(self, name: str, scope: Scope) -> None:
        """End a session as its client would, by a request of its own."""
        del self._sessions[name]
        left_out = (*(b"content-length", b"content-type", b"transfer-encoding"), _SESSION.encode())
        headers = [each for each in scope["headers"] if each[0] not in left_out]
        headers.append((_SESSION.encode(), name.encode("latin-1")))

        async def receive() -> Message:
            return {"type": "http.request", "body": b""}

        async def send(_: Message) -> None:
            """Nobody is there to read that it has ended, or had ended before."""

        await self._app({**scope, "method": "DELETE", "headers": headers}, receive, send)


class PromptProtocol(H11Protocol):
    """A connection that ends where a request does not come in time.

    Its headers have `HEADERS_S`, its body has `BODY_S` more.
    """

    _clock: asyncio.TimerHandle | None = None
    _awaited: type[h11.IDLE] | type[h11.SEND_BODY] | None = None

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._mind_the_time()

    def handle_events(self) -> None:
        """Act on what has come."""
        super().handle_events()
        self._mind_the_time()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._mind_the_time()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        super().connection_lost(exc)
        self._stop_the_clock()

    def _mind_the_time(self) -> None:
        """Run the clock while something is awaited: what comes meanwhile does not set it back."""
        awaited = self.conn.their_state
        if awaited not in (h11.IDLE, h11.SEND_BODY) or self.transport.is_closing():
            self._stop_the_clock()
        elif self._clock is None or self._awaited is not awaited:
            self._stop_the_clock()
            self._awaited = awaited
            seconds = HEADERS_S if awaited is h11.IDLE else BODY_S
            self._clock = self.loop.call_later(seconds, self._give_up)

    def _stop_the_clock(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            self._clock = self._awaited = None

    def _give_up(self) -> None:
        is_body, self._clock, self._awaited = self._awaited is h11.SEND_BODY, None, None
        is_answered = self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE)
        if (is_body or self.conn.trailing_data[0]) and not is_answered:
            self.transport.write(
                b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
            )
        self.transport.close()
