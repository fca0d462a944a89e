"""The MCP clients that are connected to a server, and how a message reaches them unasked.

A client of protocols before 2026-07-28 has a connection that stays; a later one has it over stdio
only, since over HTTP each of its requests stands alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import anyio
from mcp.server.connection import Connection
from mcp.server.context import CallNext, HandlerResult, ServerRequestContext
from mcp.server.mcpserver import Context
from mcp_types.version import MODERN_PROTOCOL_VERSIONS

from webots_mcp.store.requests import Requester


@dataclass(frozen=True)
class ClientLimits:
    """Limits of connected clients.

    Attributes:
        send_timeout_s: Wall time for a client that does not read.
        clients: Maximum number; more than the sessions that are served over HTTP.
    """

    send_timeout_s: float = 5.0
    clients: int = 256


_LIMITS: Final = ClientLimits()


class ConnectedClients:
    """A middleware that notes connections as their first messages come, until they close."""

    def __init__(self) -> None:
        self._staying: dict[int, Connection] = {}
        self._pipe: Connection | None = None  # of requests that share one pipe: the newest

    async def __call__(
        self, ctx: ServerRequestContext[Any, Any], call_next: CallNext
    ) -> HandlerResult:
        """Note whose message it is, and go on."""
        self._note(connection_of(ctx))
        return await call_next(ctx)

    async def notify(
        self, method: str, params: Mapping[str, Any], only: Mapping[int, Connection] | None = None
    ) -> None:
        """Send a notification to all clients, or only to some; never raises, never waits long.

        Args:
            method: Of the notification.
            params: Its parameters.
            only: The connections that get it; all if None.
        """
        chosen = only if only is not None else self._all()
        async with anyio.create_task_group() as sending:
            for connection in list(chosen.values()):
                if connection.initialized.is_set():
                    sending.start_soon(_send, connection, method, params)

    def _all(self) -> dict[int, Connection]:
        pipe = {} if self._pipe is None else {id(self._pipe): self._pipe}
        return self._staying | pipe

    def _note(self, connection: Connection) -> None:
        if id(connection) in self._staying or not connection.has_standalone_channel:
            return
        if connection.protocol_version in MODERN_PROTOCOL_VERSIONS:
            self._pipe = connection
            return
        if len(self._staying) < _LIMITS.clients:
            self._staying[id(connection)] = connection
            connection.exit_stack.callback(self._staying.pop, id(connection), None)


def connection_of(ctx: ServerRequestContext[Any, Any]) -> Connection:
    """Return the connection that a message came by, which the SDK names only in private."""
    return ctx.session._connection  # pyright: ignore[reportPrivateUsage]


async def _send(connection: Connection, method: str, params: Mapping[str, Any]) -> None:
    with anyio.move_on_after(_LIMITS.send_timeout_s):
        await connection.notify(method, dict(params))


def requester_of(ctx: Context[Any]) -> Requester:
    """Return the client, as it has named itself, and the transport that its call came by."""
    asked = ctx.request_context
    client = asked.session.client_params
    name, version = (client.client_info.name, client.client_info.version) if client else ("", "")
    return Requester(name, version, "stdio" if asked.request is None else "http")
