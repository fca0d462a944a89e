"""The HTTP server of the live page, which listens on loopback only.

All paths begin with a key that is made from the user's access token. Other users of this computer,
and web sites in a browser on it, do not know the key.
"""

from __future__ import annotations

import io
import json
import logging
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final, cast
from urllib.parse import parse_qsl

from webots_mcp.errors import InvalidInputError, WebotsMCPError
from webots_mcp.plotting.interactive_svg import figure_part
from webots_mcp.plugins.page.page_data import (
    all_runs,
    controller_variables,
    describe_signals,
    draw,
    film,
    page_request,
    picture,
    problem,
    robot_status,
)
from webots_mcp.plugins.page.page_orders import (
    WebotsSearch,
    steer,
    tune,
    why_not_steerable,
)
from webots_mcp.server.access_token import LOOPBACK, named_host, page_key
from webots_mcp.store.chunk_making import make_missing_chunks
from webots_mcp.store.recording import OpenConnections, RecordingAccess

HOST: Final = LOOPBACK[0]
ORDERS: Final = ("pause", "resume", "step", "reset")
_PARTS: Final = Path(__file__).parent / "parts"
_TYPES: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
# No other page may embed the page or learn its address. It loads only its own files.
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; "
    "style-src 'self' 'unsafe-inline'; img-src data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_PERIOD_S: Final = 1.0


@dataclass(frozen=True)
class PageLimits:
    """Limits of the server of the page."""

    tabs: int = 20
    """Open tabs; each reads the recording five times a second."""
    tab_s: float = 15.0
    """How long a tab counts as open after its last request."""
    connections: int = 160
    """Connections; browsers make at most 6 for each tab."""
    idle_s: float = 60.0
    """Waiting time for the next request of a connection, and for writing an answer."""
    request_s: float = 10.0
    """Time from the first byte of a request to its last."""
    request_bytes: int = 100_000
    """Bytes of the body of a request."""
    length_digits: int = 9
    """Digits that are read of a Content-Length; a longer number is too large anyway."""


LIMITS: Final = PageLimits()

_log: Final = logging.getLogger(__name__)


class PageServer(ThreadingHTTPServer):
    """A server that listens; `run` serves until it is interrupted.

    Attributes:
        recording: The recording to show.
        steered: The same recording, through which commands are sent.
    """

    daemon_threads = True
    request_queue_size = 128
    """Connections that wait until they are accepted. With the 5 of `socketserver`, some of those
    that a browser opens at once wait for a second or more."""

    def __init__(self, recording: RecordingAccess, port: int, *, read_only: bool) -> None:
        super().__init__((HOST, port), _Request)
        self._connections = OpenConnections()  # A tab asks five times a second.
        self.recording, self.read_only = (
            replace(recording, connections=self._connections),
            read_only,
        )
        self.steered = replace(self.recording, read_only=False)
        self.chunk_maker = ChunkMaker(self.recording)
        self.webots = WebotsSearch(self.recording)
        self._tabs: dict[str, float] = {}  # Monotonic time of the last request of each tab.
        self._logged: set[str] = set()
        self._waiting: dict[socket.socket, float] = {}  # Since when each waits for a request.
        self._open = 0
        self._lock = threading.Lock()

    @property
    def url(self) -> str:
        """Return the address of the page."""
        return f"http://{HOST}:{self.server_port}/{page_key()}/"

    def run(self, ready: Callable[[str], object]) -> None:
        """Serve, and call `ready` with the address as soon as browsers can connect."""
        self.chunk_maker.start()
        ready(self.url)  # A request from now on waits until it is served.
        try:
            self.serve_forever(poll_interval=0.1)
        finally:
            self.chunk_maker.stop()
            self.server_close()
            self._connections.close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in its own thread; above the limit, close the idlest connection."""
        with self._lock:
            self._open += 1
            idlest = min(self._waiting, key=self._waiting.__getitem__, default=None)
            if self._open <= LIMITS.connections or idlest is None:
                idlest = None
            else:
                del self._waiting[idlest]
            is_refused = self._open > LIMITS.connections and idlest is None
            self._waiting[request] = time.monotonic()
        if is_refused:  # All connections are being answered.
            self.shutdown_request(request)
            return
        if idlest is not None:
            with suppress(OSError):  # It was closed meanwhile.
                idlest.shutdown(socket.SHUT_RDWR)  # This ends its thread.
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open -= 1
            self._waiting.pop(request, None)
        super().shutdown_request(request)

    def set_idle(self, connection: socket.socket, *, is_idle: bool) -> None:
        """Mark a connection as waiting for a request, or as being answered."""
        with self._lock:
            if is_idle:  # A new connection has waited since it was accepted.
                self._waiting.setdefault(connection, time.monotonic())
            else:
                self._waiting.pop(connection, None)

    def admit_tab(self, tab: str) -> bool:
        """Return whether a tab is open or can be opened, and count it as open."""
        now_s = time.monotonic()
        with self._lock:
            self._tabs = {each: at for each, at in self._tabs.items() if now_s - at < LIMITS.tab_s}
            if tab not in self._tabs and len(self._tabs) >= LIMITS.tabs:
                return False
            self._tabs[tab] = now_s
            return True

    def handle_error(self, request: object, client_address: object) -> None:
        """Log unexpected errors; a tab that was closed is none."""
        error = sys.exc_info()[1]
        if isinstance(error, Exception) and not isinstance(error, OSError):
            self.log_once(error)

    def log_once(self, error: Exception) -> None:
        """Log the traceback of an unexpected error once, not with each request."""
        with self._lock:
            is_new = repr(error) not in self._logged
            self._logged.add(repr(error))
        if is_new:
            _log.error("the page cannot show all", exc_info=error)


def create_page_server(
    recording: RecordingAccess, port: int, *, read_only: bool = False
) -> PageServer:
    """Make a server of the page of a recording, which need not exist yet.

    Args:
        recording: The recording to show. Commands are sent through it unless `read_only`.
        port: Port on loopback; 0 for any free port.
        read_only: Whether the page has no buttons and inputs.

    Raises:
        InvalidInputError: The port is taken.
    """
    try:
        return PageServer(recording, port, read_only=read_only)
    except (OSError, OverflowError) as error:
        raise InvalidInputError(
            f"port {port} of {HOST} cannot be listened on: {error}; choose another by --port, or 0 "
            "for any that is free"
        ) from error


class _TimedReader(io.RawIOBase):
    """The bytes that a browser sends, with a time limit for each whole request.

    The timeout of a socket begins anew with each byte, so it cannot limit a request.
    """

    def __init__(self, connection: socket.socket, idle_s: float) -> None:
        super().__init__()
        self._connection, self._idle_s = connection, idle_s
        self._until_s: float | None = None

    def begin(self) -> None:
        """Wait for the next request."""
        self._until_s = None

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read the bytes that have arrived.

        Raises:
            TimeoutError: The time limit is over.
        """
        left_s = self._idle_s if self._until_s is None else self._until_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the rest of the request did not come in time")
        self._connection.settimeout(left_s)
        count = self._connection.recv_into(buffer)
        if self._until_s is None:
            self._until_s = time.monotonic() + LIMITS.request_s
        return count


class _Request(BaseHTTPRequestHandler):
    """One connection of a browser."""

    protocol_version = "HTTP/1.1"
    server_version = "webots-mcp"
    timeout = LIMITS.idle_s

    def setup(self) -> None:
        """Read with time limits."""
        super().setup()
        self._reading = _TimedReader(self.connection, LIMITS.idle_s)
        self.rfile.close()
        self.rfile = io.BufferedReader(self._reading)

    def handle_one_request(self) -> None:
        """Wait for a request. Once it has begun, it has to arrive within the time limit."""
        self._page.set_idle(self.connection, is_idle=True)
        self._reading.begin()
        super().handle_one_request()

    def parse_request(self) -> bool:
        """Read the headers; refuse a body without a definite length."""
        if not super().parse_request():
            return False
        self._page.set_idle(self.connection, is_idle=False)
        self.connection.settimeout(self.timeout)  # For writing the answer.
        lengths = self.headers.get_all("Content-Length") or ["0"]
        is_sure = len(lengths) == 1 and lengths[0].isascii() and lengths[0].isdecimal()
        if not is_sure or "Transfer-Encoding" in self.headers:
            self._refuse(400, "A request needs one Content-Length, in digits.\n")
            return False
        self._length = int(lengths[0][: LIMITS.length_digits])
        if self._length > (LIMITS.request_bytes if self.command == "POST" else 0):
            self._refuse(
                413, f"A request has at most {LIMITS.request_bytes:,} bytes, as an order only.\n"
            )
            return False
        return True

    def do_GET(self) -> None:
        if (path := self._path()) is None:
            return
        if path == "":
            self._answer(200, (_PARTS / "page.html").read_bytes(), "text/html")
        elif path in ("figure.js", "figure.css"):
            self._answer(200, figure_part(path).encode(), _TYPES[Path(path).suffix])
        elif path in ("page.js", "page.css"):
            self._answer(200, (_PARTS / path).read_bytes(), _TYPES[Path(path).suffix])
        elif path in _QUESTIONS:
            self._ask(_QUESTIONS[path])
        else:
            self._refuse(404, "There is no such page.\n")

    def do_POST(self) -> None:
        """Steer the robot. Only the page itself can send this, no form of another page."""
        if (path := self._path()) is None:
            return
        if path != "steer" or self._page.read_only:
            return self._refuse(403, "This page only shows.\n")
        own = {f"http://{name}:{self._page.server_port}" for name in LOOPBACK}
        is_json = self.headers.get("Content-Type") == "application/json"
        if not is_json or self.headers.get("Origin") not in own:
            return self._refuse(403, "Orders are taken from the page itself only.\n")
        try:
            body = json.loads(self.rfile.read(self._length))
        except (ValueError, RecursionError):
            body = None
        if not isinstance(body, dict):
            return self._refuse(400, "An order is a JSON object.\n")
        order = cast("dict[str, Any]", body)
        self._ask(lambda server, asked: _steer(server, asked, order))

    @property
    def _page(self) -> PageServer:
        assert isinstance(self.server, PageServer)
        return self.server

    def _path(self) -> str | None:
        """Return the path after the key; None if the request was refused."""
        hosts = self.headers.get_all("Host") or [""]
        if len(hosts) != 1 or named_host(hosts[0]) not in LOOPBACK:
            return self._refuse(
                403,
                "This page is shown to requests for 127.0.0.1 and localhost only: another name "
                "may be one that a web site has pointed here.\n",
            )
        key, slash, rest = self.path.partition("?")[0].removeprefix("/").partition("/")
        try:
            own = page_key()
        except (WebotsMCPError, OSError):
            return self._refuse(
                503, "There is no valid token: 'webots-mcp token' says what is wrong.\n"
            )
        if not slash or not secrets.compare_digest(key.encode(), own.encode()):
            return self._refuse(
                403,
                "The address of this page has a key, without which nothing is shown: open the "
                "address that 'webots-mcp view' prints.\n",
            )
        return rest

    def _ask(self, question: Callable[[PageServer, dict[str, str]], dict[str, Any]]) -> None:
        asked = dict(parse_qsl(self.path.partition("?")[2]))
        if not self._page.admit_tab(asked.get("tab", "")):
            return self._refuse(
                503,
                f"{LIMITS.tabs} tabs of this page are open: close one, wait a quarter of a "
                "minute, and open this one again.\n",
            )
        try:
            answer = question(self._page, asked)
        except WebotsMCPError as error:
            answer = problem(error, self._page.recording)
        except Exception as error:  # noqa: BLE001 - Otherwise the page would silently stop.
            self._page.log_once(error)
            answer = problem(error, self._page.recording)
        self._answer(200, json.dumps(answer).encode(), "application/json")

    def _refuse(self, status: int, why: str) -> None:
        self.close_connection = True
        self._answer(status, why.encode(), "text/plain")

    def _answer(self, status: int, body: bytes, media_type: str) -> None:
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", f"{media_type}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        try:
            self.wfile.write(body)
        except OSError:  # The tab was closed.
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Log nothing: the terminal is for messages that a person needs."""


def _answer_status(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    found = robot_status(server.recording, page_request(asked), steers=not server.read_only)
    answer = found | {"orders": (), "why_off": "", "rounds": server.chunk_maker.rounds}
    if not server.read_only:
        answer["orders"] = ORDERS
        answer["why_off"] = why_not_steerable(found["robot"], server.webots, is_live=found["live"])
    return answer


def _answer_figures(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    drawn = draw(server.recording, page_request(asked))
    if drawn.get("is_cut") and server.chunk_maker.says:
        drawn["notes"].insert(0, server.chunk_maker.says)
    return drawn


def _answer_signals(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    return {"signals": describe_signals(server.recording, page_request(asked))}


def _answer_picture(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    return picture(server.recording, page_request(asked))


def _answer_film(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    return film(server.recording, page_request(asked))


def _answer_variables(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    return controller_variables(server.recording, page_request(asked))


def _answer_runs(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    return all_runs(server.recording, page_request(asked))


def _steer(server: PageServer, asked: dict[str, str], body: dict[str, Any]) -> dict[str, Any]:
    robot = asked.get("robot", "")
    if body.get("order") in ORDERS:
        return steer(server.steered, robot, body["order"])
    name = body.get("name")
    if "order" in body or not isinstance(name, str) or "value" not in body:
        raise InvalidInputError(
            f"this is no order of the page: give order, one of {', '.join(ORDERS)}, or name and "
            "value of a parameter"
        )
    return tune(server.steered, robot, name, body["value"])


_QUESTIONS: Final = {
    "look": _answer_status,
    "draw": _answer_figures,
    "picture": _answer_picture,
    "film": _answer_film,
    "signals": _answer_signals,
    "variables": _answer_variables,
    "runs": _answer_runs,
}


class ChunkMaker(threading.Thread):
    """Checks once a second whether rows can be put into chunks.

    Attributes:
        says: Its progress, or why it stopped; "" if nothing is left.
        rounds: How often it has put all rows into chunks.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        super().__init__(name="webots-mcp page", daemon=True)
        self._recording = recording
        self._ending = threading.Event()
        self.says = ""
        self.rounds = 0

    def run(self) -> None:
        """Make chunks until stopped."""
        while not self._ending.is_set():
            self.make_chunks()
            self._ending.wait(_PERIOD_S)

    def make_chunks(self) -> None:
        """Put the rows that are there into chunks."""
        worked = False

        def note(done: int, of: int) -> None:
            nonlocal worked
            worked = True
            self.says = f"making chunks of what was recorded: {100 * done // max(of, 1)} %"

        try:
            self.says = make_missing_chunks(self._recording, note, called_off=self._ending.is_set)
        except WebotsMCPError:  # The tabs report it.
            self.says = ""
        self.rounds += worked

    def stop(self) -> None:
        """Stop the thread, and wait for it for at most 2 s."""
        self._ending.set()
        self.join(timeout=2)
