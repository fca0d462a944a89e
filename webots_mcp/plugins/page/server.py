"""The server of the page: on loopback only, for who was told its address.

Everything lies below a token that is drawn anew at each start and is part of the address: other
programs of this computer, and web sites that a browser here shows, do not know it.
"""

from __future__ import annotations

import logging
import re
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.routing import AnyMatches, HostMatches, Matcher, PathMatches, Rule, RuleRouter
from tornado.web import Application as WebApplication
from tornado.web import OutputTransform, RequestHandler

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.page.chunk_maker import ChunkMaker
from webots_mcp.plugins.page.tab import open_tab
from webots_mcp.store.recording import Recording

HOST: Final = "127.0.0.1"
_NAMES: Final = (HOST, "localhost")
_HOSTS: Final = r"^(127\.0\.0\.1|localhost)$"
MOST_TABS: Final = 20  # each reads the recording ten times a second
_FOREIGN: Final = (
    "This page is shown to requests for 127.0.0.1 and localhost only: another name may be one that "
    "a web site has pointed here.\n"
)
_UNTOLD: Final = (
    "The address of this page has a token, without which nothing is shown: open the address that "
    "'webots-mcp view' printed when it started.\n"
)
_FULL: Final = (
    f"{MOST_TABS} tabs of this page are open: close one, wait a quarter of a minute, and open this "
    "one again.\n"
)


class _Refusal(RequestHandler):
    """What a request is answered with that the page is not for."""

    def initialize(self, status: int, why: str) -> None:
        self._refused = status, why

    def prepare(self) -> None:
        status, why = self._refused
        self.set_status(status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        answer: Any = self
        answer.finish(why)


class _Guarded(OutputTransform):
    """What each answer tells the browser: no other page may show it, or be told its address."""

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        headers["Content-Security-Policy"] = "frame-ancestors 'none'"
        headers["X-Frame-Options"] = "DENY"
        headers["Referrer-Policy"] = "no-referrer"
        return status_code, headers, chunk


class _OneTooMany(Matcher):
    """Matches what would open a further tab while no more may be open."""

    def __init__(self, path: str, pages: BokehTornado) -> None:
        self._path, self._pages = path, pages

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        opens = request.path.rstrip("/") == self._path
        return {} if opens and len(self._pages.get_sessions("/")) >= MOST_TABS else None


@dataclass(frozen=True)
class PageServer:
    """A server that listens; `run` serves until it is interrupted."""

    server: BaseServer
    port: int
    token: str
    chunk_maker: ChunkMaker

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    def run(self, ready: Callable[[str], object]) -> None:
        """Serve, and tell `ready` the address as soon as a browser may ask."""
        self.server.start()
        self.chunk_maker.start()
        loop: Any = self.server.io_loop
        loop.add_callback(ready, self.url)
        try:
            loop.start()
        finally:
            self.server.stop(wait=False)
            self.chunk_maker.stop()


def create_page_server(recording: Recording, port: int, *, read_only: bool = False) -> PageServer:
    """A server of the page of a recording, which need not be there yet.

    Args:
        recording: What is shown; commands go through it unless `read_only`.
        port: 0 for any that is free.
        read_only: Without buttons and inputs.

    Raises:
        InvalidInputError: The port is taken.
    """
    logging.getLogger("bokeh").setLevel(logging.ERROR)  # a tab that was closed is no news
    logging.getLogger("tornado.access").setLevel(logging.ERROR)
    try:
        listening = _listening(port)
    except (OSError, OverflowError) as error:
        raise InvalidInputError(
            f"port {port} of {HOST} cannot be listened on: {error}; choose another by --port, or 0 "
            "for any that is free"
        ) from error
    chunk_maker = ChunkMaker(recording)
    application = Application(FunctionHandler(partial(open_tab, recording, read_only, chunk_maker)))
    port = int(listening.getsockname()[1])
    origins = [f"{name}:{port}" for name in _NAMES]
    token = secrets.token_urlsafe(18)
    pages = BokehTornado(
        {"/": application},
        prefix=token,
        extra_websocket_origins=origins,
        secret_key=secrets.token_bytes(32),
        sign_sessions=True,  # a session is begun by loading the page, and by nothing else
        transforms=[_Guarded],
    )
    http = HTTPServer(_router(token, pages))
    http.add_sockets([listening])
    return PageServer(BaseServer(IOLoop.current(), pages, http), port, token, chunk_maker)


def _router(token: str, pages: BokehTornado) -> RuleRouter:
    """The page alone below its token, without what would put it into a page of others."""
    of_page = RuleRouter([
        Rule(PathMatches(f"/{re.escape(token)}/autoload.js"), _refusing(403, _UNTOLD)),
        Rule(_OneTooMany(f"/{token}", pages), _refusing(503, _FULL)),
        Rule(PathMatches(f"/{re.escape(token)}(/.*)?"), pages),
        Rule(AnyMatches(), _refusing(403, _UNTOLD)),
    ])  # fmt: skip
    return RuleRouter([
        Rule(HostMatches(_HOSTS), of_page), Rule(AnyMatches(), _refusing(403, _FOREIGN)),
    ])  # fmt: skip


def _refusing(status: int, why: str) -> WebApplication:
    return WebApplication(
        [(r".*", _Refusal, {"status": status, "why": why})], transforms=[_Guarded]
    )


def _listening(port: int) -> socket.socket:
    made = socket.create_server((HOST, port), backlog=128)
    made.setblocking(False)
    return made
