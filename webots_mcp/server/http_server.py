"""The MCP server over streamable HTTP, for many clients at once.

The SDK has the transport. `http_access` stands before it and decides which requests reach it;
`http_limits` ends sessions and requests that would take its place for ever.
"""

from __future__ import annotations

import logging
import socket
import ssl
from collections.abc import Callable
from contextlib import closing
from typing import TYPE_CHECKING, Final

import uvicorn
from mcp.server import streamable_http
from starlette.requests import ClientDisconnect

from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.server.access_token import access_token
from webots_mcp.server.endpoint import Endpoint, transport_security
from webots_mcp.server.http_access import gate
from webots_mcp.server.http_limits import MOST_SESSIONS, PromptProtocol, SessionLimit

if TYPE_CHECKING:
    from mcp.server import MCPServer
    from starlette.types import ASGIApp

PATH: Final = "/mcp"


def serve_http(server: MCPServer, place: Endpoint, ready: Callable[[str], object]) -> None:
    """Serve until a signal; `ready` is called with the address as soon as clients may ask.

    Raises:
        InvalidInputError: The place cannot be listened at, or the files of TLS are not valid.
        CommandRefusedError: There is no valid token.
    """
    access_token()
    logging.getLogger(streamable_http.__name__).addFilter(_is_news)
    with closing(_listening(place)) as listener:
        config = uvicorn.Config(
            guarded_app(server, place),
            http=PromptProtocol,
            log_config=None,
            log_level="warning",
            access_log=False,
            ws="none",
            lifespan="on",
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=1,  # for answers under way when the server ends
            ssl_certfile=place.certificate,
            ssl_keyfile=place.key,
        )
        try:
            config.load()
        except (OSError, ssl.SSLError) as error:
            raise InvalidInputError(f"--tls-cert and --tls-key cannot be used: {error}") from error
        host = f"[{place.host}]" if ":" in place.host else place.host
        ready(f"{place.scheme}://{host}:{listener.getsockname()[1]}{PATH}")
        running = uvicorn.Server(config)
        running.run([listener])
    if not running.started:
        raise CommandRefusedError("the server did not start; what it wrote above says why")


def _is_news(record: logging.LogRecord) -> bool:
    """Return whether a line of the SDK is worth a line on stderr: a client that left is not."""
    return not (record.exc_info and isinstance(record.exc_info[1], ClientDisconnect))


def guarded_app(server: MCPServer, place: Endpoint, most_sessions: int = MOST_SESSIONS) -> ASGIApp:
    """Return the server as an application that checks host, origin and token."""
    app = server.streamable_http_app(
        transport_security=transport_security(place),
        session_idle_timeout=86_400.0,  # people come back to a conversation after hours
        max_sessions=most_sessions,
    )
    return gate(SessionLimit(app, most_sessions), place)


def _listening(place: Endpoint) -> socket.socket:
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    try:
        return socket.create_server((place.host, place.port), family=family)
    except OSError as error:
        raise InvalidInputError(
            f"port {place.port} of {place.host} cannot be listened on: {error}; choose another, or "
            "0 for any that is free"
        ) from error
