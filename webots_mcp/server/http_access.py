"""Which requests over HTTP are admitted, and the status codes of those that are refused.

Host and Origin are checked first, then the token. A client that goes away ends what it has asked:
one of protocols before 2026-07-28 cannot come back for the answer, and the SDK would let the call
go on.
"""

from __future__ import annotations

import json
from collections.abc import Container
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.responses import PlainTextResponse, Response

from webots_mcp.errors import CommandRefusedError
from webots_mcp.server.access_token import is_admitted, named_host
from webots_mcp.server.endpoint import Endpoint, allowed_hosts

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send


def gate(app: ASGIApp, place: Endpoint) -> ASGIApp:
    """Return the application, for requests that are addressed to it and have the token.

    The SDK compares the beginning of Host and Origin only, so that both are read here first.
    """
    names = {each.lower() for each in allowed_hosts(place)}

    async def admit(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return await app(scope, receive, send)
        headers = Headers(scope=scope)
        refusal = _refused_address(headers, names, f"{place.scheme}://") or _refused_token(headers)
        if refusal is not None:
            return await refusal(scope, receive, send)
        return await _follow(app, _lowered(scope), receive, send)

    return admit


def _refused_address(
    headers: Headers, names: Container[str | None], scheme: str
) -> Response | None:
    """Return the refusal of a request for another host, or from a page of one; else None."""
    hosts = headers.getlist("host")
    if len(hosts) != 1 or named_host(hosts[0]) not in names:
        return PlainTextResponse(
            "This server answers requests for the host that it was started for; "
            "--allow-host NAME adds another.\n",
            421,
        )
    for origin in headers.getlist("origin"):
        if not origin.startswith(scheme) or named_host(origin.removeprefix(scheme)) not in names:
            return PlainTextResponse("This server answers pages of its own host only.\n", 403)
    return None


def _refused_token(headers: Headers) -> Response | None:
    """Return the refusal of a request without the token; else None."""
    given = headers.getlist("authorization")
    try:
        if len(given) == 1 and is_admitted(given[0]):
            return None
    except (CommandRefusedError, OSError):
        return PlainTextResponse(
            "This server has no valid token: there 'webots-mcp token' says what is wrong.\n", 503
        )
    return PlainTextResponse(
        "This server answers requests with the header 'Authorization: Bearer TOKEN' only; "
        "'webots-mcp token' shows the token to the user who started the server.\n",
        401,
        {"WWW-Authenticate": "Bearer", "Connection": "close"},
    )


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
