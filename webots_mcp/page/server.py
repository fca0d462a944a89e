"""The server of the page: on loopback only, for requests that mean it."""

from __future__ import annotations

import logging
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
from tornado.ioloop import IOLoop
from tornado.routing import AnyMatches, HostMatches, Rule, RuleRouter
from tornado.web import Application as WebApplication
from tornado.web import RequestHandler

from webots_mcp.errors import InvalidInputError
from webots_mcp.page.tab import open_tab
from webots_mcp.store.recording import Recording

HOST: Final = "127.0.0.1"
_NAMES: Final = (HOST, "localhost")
_HOSTS: Final = r"^(127\.0\.0\.1|localhost)$"
_REFUSED: Final = (
    "This page is shown to requests for 127.0.0.1 and localhost only: another name may be one that "
    "a web site has pointed here.\n"
)


class _Refusal(RequestHandler):
    """What a request for another host is answered with."""

    def prepare(self) -> None:
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        answer: Any = self
        answer.finish(_REFUSED)


@dataclass(frozen=True)
class PageServer:
    """A server that listens; `run` serves until it is interrupted."""

    server: BaseServer
    port: int

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.port}/"

    def run(self, ready: Callable[[str], object]) -> None:
        """Serve, and tell `ready` the address as soon as a browser may ask."""
        self.server.start()
        loop: Any = self.server.io_loop
        loop.add_callback(ready, self.url)
        try:
            loop.start()
        finally:
            self.server.stop(wait=False)


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
    application = Application(FunctionHandler(partial(open_tab, recording, read_only)))
    port = int(listening.getsockname()[1])
    origins = [f"{name}:{port}" for name in _NAMES]
    pages = BokehTornado({"/": application}, extra_websocket_origins=origins)
    refusals = WebApplication([(r".*", _Refusal)])
    http = HTTPServer(RuleRouter([Rule(HostMatches(_HOSTS), pages), Rule(AnyMatches(), refusals)]))
    http.add_sockets([listening])
    return PageServer(BaseServer(IOLoop.current(), pages, http), port)


def _listening(port: int) -> socket.socket:
    made = socket.create_server((HOST, port), backlog=128)
    made.setblocking(False)
    return made
