"""The MCP server over streamable HTTP, for many clients at once.

The SDK has the transport. What stands before it checks Host and Origin, asks each request for the
token, and lets a client that goes away end what it has asked: a client of protocols before
2026-07-28 cannot come back for the answer, and the SDK would let the call go on.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import socket
import ssl
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import uvicorn
from mcp.server import streamable_http
from mcp.server.transport_security import TransportSecuritySettings
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.responses import PlainTextResponse

from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.server.access_token import LOOPBACK, access_token, is_admitted, named_host
from webots_mcp.server.http_limits import MOST_SESSIONS, PromptProtocol, SessionLimit

if TYPE_CHECKING:
    from mcp.server import MCPServer
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

PATH: Final = "/mcp"


class Endpoint(NamedTuple):
    """Where a server listens.

    Attributes:
        allowed: Names besides those of loopback that a request may be addressed to.
        certificate, key: PEM files for TLS; both or neither.
    """

    host: str
    port: int
    allowed: Sequence[str] = ()
    certificate: Path | None = None
    key: Path | None = None

    @property
    def scheme(self) -> str:
        """Of its address."""
        return "https" if self.certificate else "http"

    def require_safe(self) -> None:
        """Check that nobody on the network can read the token, or what it opens.

        Raises:
            InvalidInputError: It is not so, or a file of TLS is missing.
        """
        if (self.certificate is None) != (self.key is None):
            raise InvalidInputError("--tls-cert and --tls-key belong together: give both")
        if _is_loopback(self.host) or (self.allowed and self.certificate):
            return
        raise InvalidInputError(
            f"{self.host} can be reached from the network: that takes --tls-cert FILE and "
            "--tls-key FILE, and --allow-host NAME for each name that clients use. Without them "
            f"serve on this computer alone (--http {self.port}), and let another computer come "
            f"through a tunnel: ssh -N -L {self.port}:127.0.0.1:{self.port} USER@THIS_COMPUTER"
        )


def endpoint_of(
    text: str, allowed: Sequence[str] = (), certificate: Path | None = None, key: Path | None = None
) -> Endpoint:
    """Return the place that `[HOST:]PORT` names; without a host 127.0.0.1.

    Raises:
        InvalidInputError: It names none, or none that is safe.
    """
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal() and int(port) < 2**16):
        raise InvalidInputError(f"--http {text!r} is not [HOST:]PORT, such as 8000")
    place = Endpoint(host.strip("[]") or LOOPBACK[0], int(port), allowed, certificate, key)
    place.require_safe()
    return place


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
        transport_security=_allowing(place),
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


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _names(place: Endpoint) -> tuple[str, ...]:
    """Return the hosts that requests may be addressed to."""
    own = (place.host,) if _is_loopback(place.host) else ()  # such as 127.0.0.2
    return (*LOOPBACK, *own, *place.allowed)


def _allowing(place: Endpoint) -> TransportSecuritySettings:
    """Requests for these names; pages of the same ones, as far as a browser sends any."""
    names = (*_names(place), *map(str.lower, place.allowed))  # as clients send it
    hosts = [spelled for name in names for spelled in (name, f"{name}:*")]
    origins = [f"{place.scheme}://{host}" for host in hosts]
    return TransportSecuritySettings(allowed_hosts=hosts, allowed_origins=origins)


def gate(app: ASGIApp, place: Endpoint) -> ASGIApp:
    """Return the application, for requests that are addressed to it and have the token.

    The SDK compares the beginning of Host and Origin only, so that both are read here first.
    """
    names = {each.lower() for each in _names(place)}

    async def admit(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            hosts, origins = headers.getlist("host"), headers.getlist("origin")
            if len(hosts) != 1 or named_host(hosts[0]) not in names:
                return await PlainTextResponse(
                    "This server answers requests for the host that it was started for; "
                    "--allow-host NAME adds another.\n",
                    421,
                )(scope, receive, send)
            scheme = f"{place.scheme}://"
            for origin in origins:
                host = named_host(origin.removeprefix(scheme))
                if not origin.startswith(scheme) or host not in names:
                    return await PlainTextResponse(
                        "This server answers pages of its own host only.\n", 403
                    )(scope, receive, send)
            given = headers.getlist("authorization")
            try:
                admitted = len(given) == 1 and is_admitted(given[0])
            except (CommandRefusedError, OSError):
                return await PlainTextResponse(
                    "This server has no valid token: there 'webots-mcp token' says what is "
                    "wrong.\n",
                    503,
                )(scope, receive, send)
            if not admitted:
                refusal = {"WWW-Authenticate": "Bearer", "Connection": "close"}
                return await PlainTextResponse(
                    "This server answers requests with the header 'Authorization: Bearer TOKEN' "
                    "only; 'webots-mcp token' shows the token to the user who started the "
                    "server.\n",
                    401,
                    refusal,
                )(scope, receive, send)
            return await _follow(app, _lowered(scope), receive, send)
        await app(scope, receive, send)

    return admit


def _lowered(scope: Scope) -> Scope:
    """Return the request with its hosts in lower case, as the SDK expects them."""
    headers = [
        (name, value.lower() if name in (b"host", b"origin") else value)
        for name, value in scope["headers"]
    ]
    return {**scope, "headers": headers}


async def _follow(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request; cancel what it has asked of a session if the client leaves before that."""
    body, is_answered, has_left = bytearray(), False, False

    async def watched() -> Message:
        nonlocal has_left
        message = await receive()
        body.extend(message.get("body", b""))  # as far as the SDK reads: 4 MiB
        has_left |= message["type"] == "http.disconnect" and not is_answered
        return message

    async def noted(message: Message) -> None:
        nonlocal is_answered
        await send(message)
        is_answered |= message["type"] == "http.response.body" and not message.get("more_body")

    session = Headers(scope=scope).get("mcp-session-id")
    with suppress(ClientDisconnect):  # within what it had to say
        await app(dict(scope), watched, noted)
    if has_left and session and (asked := _request_in(body)) is not None:
        await _cancel(app, scope, asked)


def _request_in(body: bytearray) -> Any:
    """Return the id of the request that a body holds; None for a notification or a part of one."""
    try:
        message: dict[str, Any] = dict(json.loads(body))
    except (ValueError, TypeError, RecursionError):
        return None
    return message.get("id") if "method" in message else None


async def _cancel(app: ASGIApp, scope: Scope, request_id: Any) -> None:
    """Tell the session what the client would, as a message of the same session."""
    params = {"requestId": request_id, "reason": "the client has gone"}
    message = {"jsonrpc": "2.0", "method": "notifications/cancelled", "params": params}
    said: Message = {"type": "http.request", "body": json.dumps(message).encode()}
    framing = (b"content-length", b"transfer-encoding")
    headers = [each for each in scope["headers"] if each[0] not in framing]

    async def receive() -> Message:
        return said

    async def send(_: Message) -> None:
        """Nobody is there to read that it was accepted."""

    await app({**scope, "headers": headers}, receive, send)
