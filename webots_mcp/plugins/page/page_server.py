"""The server of the page: on loopback only, for who was told its address.

Everything lies below a key that is made from the user's access token and is part of the address:
other users of this computer, and web sites that a browser here shows, do not know it.
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
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final, cast
from urllib.parse import parse_qsl

import anyio

from webots_mcp.answers.models import CommandAnswer
from webots_mcp.contract import VERSION
from webots_mcp.errors import InvalidInputError, WebotsMCPError
from webots_mcp.plotting.on_a_page import figure_part
from webots_mcp.plugins.page.page_data import choice_of, draw, look, picture, problem
from webots_mcp.questions.parameters import set_parameters
from webots_mcp.server.access_token import LOOPBACK, named_host, page_key
from webots_mcp.signals.parameter import Value
from webots_mcp.simulator.orders import Order
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import Attempt
from webots_mcp.store.chunk_making import make_missing_chunks
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import OpenRequest, Requester

HOST: Final = LOOPBACK[0]
MOST_TABS: Final = 20  # each reads the recording five times a second
ORDERS: Final = ("pause", "resume", "step", "reset")
_TAB_S: Final = 15.0  # for so long a tab counts as open after it asked
MOST_CONNECTIONS: Final = 160  # a browser has at most 6 for each of the tabs
_IDLE_S: Final = 60.0  # for the next request of a connection, and to write an answer
_REQUEST_S: Final = 10.0  # from the first byte of a request to its last
_MOST_BYTES: Final = 100_000  # of a request
_MOST_DIGITS: Final = 9  # that are read of a length, which is too large with so many
_log: Final = logging.getLogger(__name__)
_PARTS: Final = Path(__file__).parent / "parts"
_TYPES: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_FOREIGN: Final = (
    "This page is shown to requests for 127.0.0.1 and localhost only: another name may be one that "
    "a web site has pointed here.\n"
)
_UNTOLD: Final = (
    "The address of this page has a key, without which nothing is shown: open the address that "
    "'webots-mcp view' prints.\n"
)
_CLOSED: Final = "There is no valid token: 'webots-mcp token' says what is wrong.\n"
_FULL: Final = (
    f"{MOST_TABS} tabs of this page are open: close one, wait a quarter of a minute, and open this "
    "one again.\n"
)
_HEADERS: Final = {  # no other page may show it, or be told its address; it loads its own parts
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; "
    "style-src 'self' 'unsafe-inline'; img-src data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_PERIOD_S: Final = 1.0
_WAIT_S: Final = 10.0
_BY_PAGE: Final = Requester("webots-mcp view", VERSION, "page")


class PageServer(ThreadingHTTPServer):
    """A server that listens; `run` serves until it is interrupted.

    Attributes:
        recording: What is shown; commands go through it unless `read_only`.
    """

    daemon_threads = True

    def __init__(self, recording: RecordingAccess, port: int, *, read_only: bool) -> None:
        super().__init__((HOST, port), _Request)
        self.recording, self.read_only = recording, read_only
        self.steered = replace(recording, read_only=False)
        self.chunk_maker = ChunkMaker(recording)
        self._tabs: dict[str, float] = {}  # when each has asked last, on the monotonic clock
        self._said: set[str] = set()
        self._waiting: dict[socket.socket, float] = {}  # since when each has asked for nothing
        self._open = 0
        self._lock = threading.Lock()

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/{page_key()}/"

    def run(self, ready: Callable[[str], object]) -> None:
        """Serve, and tell `ready` the address as soon as a browser may ask."""
        self.chunk_maker.start()
        ready(self.url)  # what asks now waits until it is served
        try:
            self.serve_forever(poll_interval=0.1)
        finally:
            self.chunk_maker.stop()
            self.server_close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own; above the limit, the idlest one is closed."""
        with self._lock:
            self._open += 1
            idlest = min(self._waiting, key=self._waiting.__getitem__, default=None)
            if self._open <= MOST_CONNECTIONS or idlest is None:
                idlest = None
            else:
                del self._waiting[idlest]
            is_refused = self._open > MOST_CONNECTIONS and idlest is None
            self._waiting[request] = time.monotonic()
        if is_refused:  # all are being answered
            self.shutdown_request(request)
            return
        if idlest is not None:
            with suppress(OSError):  # it was closed meanwhile
                idlest.shutdown(socket.SHUT_RDWR)  # its thread ends
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open -= 1
            self._waiting.pop(request, None)
        super().shutdown_request(request)

    def waits(self, connection: socket.socket, *, is_idle: bool) -> None:
        """A connection waits for a request from now on, or is being answered."""
        with self._lock:
            if is_idle:
                self._waiting[connection] = time.monotonic()
            else:
                self._waiting.pop(connection, None)

    def has_room_for(self, tab: str) -> bool:
        """Whether a tab is one of those that are open, or may be opened."""
        now_s = time.monotonic()
        with self._lock:
            self._tabs = {each: at for each, at in self._tabs.items() if now_s - at < _TAB_S}
            if tab not in self._tabs and len(self._tabs) >= MOST_TABS:
                return False
            self._tabs[tab] = now_s
            return True

    def handle_error(self, request: object, client_address: object) -> None:
        """A tab that was closed is no news."""
        error = sys.exc_info()[1]
        if isinstance(error, Exception) and not isinstance(error, OSError):
            self.log_once(error)

    def log_once(self, error: Exception) -> None:
        """Write more about an error that nobody foresaw: once, not at each look."""
        with self._lock:
            is_new = repr(error) not in self._said
            self._said.add(repr(error))
        if is_new:
            _log.error("the page cannot show all", exc_info=error)


def create_page_server(
    recording: RecordingAccess, port: int, *, read_only: bool = False
) -> PageServer:
    """A server of the page of a recording, which need not be there yet.

    Args:
        recording: What is shown; commands go through it unless `read_only`.
        port: 0 for any that is free.
        read_only: Without buttons and inputs.

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
    """What a browser sends: a request that has begun comes within `_REQUEST_S`, or not at all.

    A timeout of the socket alone begins anew with each byte.
    """

    def __init__(self, connection: socket.socket, idle_s: float) -> None:
        super().__init__()
        self._connection, self._idle_s = connection, idle_s
        self._until_s: float | None = None

    def begin(self) -> None:
        """Wait for the next request."""
        self._until_s = None

    def readable(self) -> bool:
        """It is."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read what has come.

        Raises:
            TimeoutError: The time is over.
        """
        left_s = self._idle_s if self._until_s is None else self._until_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the rest of the request did not come in time")
        self._connection.settimeout(left_s)
        count = self._connection.recv_into(buffer)
        if self._until_s is None:
            self._until_s = time.monotonic() + _REQUEST_S
        return count


class _Request(BaseHTTPRequestHandler):
    """One connection of a browser."""

    protocol_version = "HTTP/1.1"
    server_version = "webots-mcp"
    timeout = _IDLE_S

    def setup(self) -> None:
        """Read within bounds of time."""
        super().setup()
        self._reading = _TimedReader(self.connection, _IDLE_S)
        self.rfile.close()
        self.rfile = io.BufferedReader(self._reading)

    def handle_one_request(self) -> None:
        """Wait for a request; once it has begun, all of it has to come soon."""
        self._page.waits(self.connection, is_idle=True)
        self._reading.begin()
        super().handle_one_request()

    def parse_request(self) -> bool:
        """Read the headers; what has a body of no certain length is refused."""
        if not super().parse_request():
            return False
        self._page.waits(self.connection, is_idle=False)
        self.connection.settimeout(self.timeout)  # again, to write the answer
        lengths = self.headers.get_all("Content-Length") or ["0"]
        is_sure = len(lengths) == 1 and lengths[0].isascii() and lengths[0].isdecimal()
        if not is_sure or "Transfer-Encoding" in self.headers:
            self._refuse(400, "A request needs one Content-Length, in digits.\n")
            return False
        self._length = int(lengths[0][:_MOST_DIGITS])
        if self._length > (_MOST_BYTES if self.command == "POST" else 0):
            self._refuse(413, f"A request has at most {_MOST_BYTES:,} bytes, as an order only.\n")
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
        """Steer: what the page itself sends, which no form of another page can."""
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
        """The path below the key; None where the request was refused."""
        hosts = self.headers.get_all("Host") or [""]
        if len(hosts) != 1 or named_host(hosts[0]) not in LOOPBACK:
            return self._refuse(403, _FOREIGN)
        key, slash, rest = self.path.partition("?")[0].removeprefix("/").partition("/")
        try:
            own = page_key()
        except (WebotsMCPError, OSError):
            return self._refuse(503, _CLOSED)
        if not slash or not secrets.compare_digest(key.encode(), own.encode()):
            return self._refuse(403, _UNTOLD)
        return rest

    def _ask(self, question: Callable[[PageServer, dict[str, str]], dict[str, Any]]) -> None:
        asked = dict(parse_qsl(self.path.partition("?")[2]))
        if not self._page.has_room_for(asked.get("tab", "")):
            return self._refuse(503, _FULL)
        try:
            answer = question(self._page, asked)
        except WebotsMCPError as error:
            answer = problem(error)
        except Exception as error:  # noqa: BLE001  (the page would stand still without a word)
            self._page.log_once(error)
            answer = problem(error)
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
        except OSError:  # a tab that was closed is no news
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Say nothing: the terminal is for what a person must know."""


def _look(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    found = look(server.recording, choice_of(asked), steers=not server.read_only)
    orders = () if server.read_only else ORDERS
    return found | {"orders": orders, "rounds": server.chunk_maker.rounds}


def _draw(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    drawn = draw(server.recording, choice_of(asked))
    if drawn.get("is_cut") and server.chunk_maker.says:
        drawn["notes"].insert(0, server.chunk_maker.says)
    return drawn


def _picture(server: PageServer, asked: dict[str, str]) -> dict[str, Any]:
    return picture(server.recording, choice_of(asked))


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


_QUESTIONS: Final = {"look": _look, "draw": _draw, "picture": _picture}


# Making chunks while the page is served, where no server does: what is long is drawn whole.


class ChunkMaker(threading.Thread):
    """Looks once a second whether there is something to put into chunks.

    Attributes:
        says: How far it has come, or why it does not go on; "" where nothing is left.
        rounds: How often it put all that there was into chunks.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        super().__init__(name="webots-mcp page", daemon=True)
        self._recording = recording
        self._ending = threading.Event()
        self.says = ""
        self.rounds = 0

    def run(self) -> None:
        """Look until stopped."""
        while not self._ending.is_set():
            self.look()
            self._ending.wait(_PERIOD_S)

    def look(self) -> None:
        """Put what there is into chunks."""
        worked = False

        def note(done: int, of: int) -> None:
            nonlocal worked
            worked = True
            self.says = f"making chunks of what was recorded: {100 * done // max(of, 1)} %"

        try:
            self.says = make_missing_chunks(self._recording, note, called_off=self._ending.is_set)
        except WebotsMCPError:  # the tabs say what it is
            self.says = ""
        self.rounds += worked

    def stop(self) -> None:
        """End it within an instant."""
        self._ending.set()
        self.join(timeout=2)


# What the buttons and inputs of the page do: the way that the tools' own commands go.


def steer(recording: RecordingAccess, robot: str, order: Order) -> dict[str, Any]:
    """Give an order to the simulation of a robot; answers in words what came of it."""
    params = {"steps": 1} if order == "step" else {}
    dispatcher = Dispatcher(recording, _silent)
    attempt = Attempt(recording, dispatcher, robot, _WAIT_S, order, params)
    asked = {"command": order, "robot": robot}
    request = OpenRequest(recording, _BY_PAGE, ["webots_simulation_control"], asked)
    return _told(order, attempt.steer, request)


def tune(recording: RecordingAccess, robot: str, name: str, value: Value) -> dict[str, Any]:
    """Set one parameter of a robot's controller, and say what came of it."""
    setting = partial(
        set_parameters, recording, _silent, {name: value}, robot=robot, timeout_s=_WAIT_S
    )
    asked = {"values": {name: value}, "robot": robot}
    request = OpenRequest(recording, _BY_PAGE, ["webots_set_parameters"], asked)
    return _told(f"{name} = {value!r}", setting, request)


def _told(what: str, ask: Any, request: OpenRequest) -> dict[str, Any]:
    try:
        with request:
            answer: CommandAnswer = anyio.run(ask)
            request.outcome = answer.outcome or ""
    except WebotsMCPError as error:
        return {"text": f"{what}: {error}", "is_done": False}
    if answer.outcome == "done":
        return {"text": f"{what}: done", "is_done": True}
    why = answer.error or answer.hint or "no answer in time"
    return {"text": f"{what}: not done ({answer.outcome}): {why}", "is_done": False}


async def _silent(waited_s: float, of_s: float | None, text: str) -> None:
    """The page says that it waits by the button itself."""
