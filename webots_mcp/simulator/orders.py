"""Give orders to a running Webots over its WebSocket.

Every Webots listens at the port of `--port`. It obeys orders only if it was started with
`--stream`, but sends its console to every client. This module never sends the bare words `w3d` and
`x3d`, which pause the simulation at its next step.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from webots_mcp.contract import host_name
from webots_mcp.errors import CommandRefusedError

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

Order = Literal["pause", "resume", "fast", "step", "reset", "reload"]
MAX_MESSAGE_BYTES: Final = 4 << 20
ANSWER_S: Final = 1.0  # Webots answers at once or does not obey
_CLOSING_S: Final = 0.2
# What is sent, and how the reply begins. The number is a time limit in ms; -1 means no limit.
_ORDERS: Final[dict[Order, tuple[str, tuple[str, ...]]]] = {
    "pause": ("pause", ("pause",)),  # "paused by client", and "pause: <ms>" for the others
    "resume": ("real-time:-1", ("real-time",)),
    "fast": ("fast:-1", ("fast",)),
    "step": ("step", ("pause", "step")),
    "reset": ("reset", ("reset finished",)),
    "reload": ("reload", ("delete world", "loading:", "world:", "scene load completed")),
}
RESTARTING: Final = ("reset", "reload")  # these may be answered to other clients, or much later


class WebotsAddress(NamedTuple):
    """The address at which a Webots listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class Message(NamedTuple):
    """A message of Webots.

    Attributes:
        text: The text, up to 4 MB.
        dropped_bytes: How many bytes at its end were dropped.
    """

    text: str
    dropped_bytes: int = 0


class WebotsLine(NamedTuple):
    """A line of Webots' console, of `stdout` or `stderr`."""

    stream: str
    text: str


class OrderReply(NamedTuple):
    """Webots' reply to an order.

    Attributes:
        text: Webots' own words; None without a reply.
        is_alive: Whether its main thread answered at all, so that it is not busy.
        other: Another message of Webots, which only a Webots that accepts orders sends.
    """

    text: str | None
    is_alive: bool
    other: str | None = None


def address_of(instance: str) -> WebotsAddress | None:
    """Return where the Webots of a session listens, by its `instance`; None if unknown."""
    host, _, port = instance.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and 0 < int(port) < 1 << 16):
        return None
    return WebotsAddress("127.0.0.1" if host == host_name() else host, int(port))


class Stream:
    """A connection to Webots."""

    def __init__(self, connection: ClientConnection, address: WebotsAddress) -> None:
        self._connection = connection
        self._address = address

    def send(self, text: str) -> None:
        """Send a text.

        Raises:
            CommandRefusedError: Webots closed the connection.
        """
        with self._open():
            self._connection.send(text)

    def ping(self) -> threading.Event:
        """Ask Webots' main thread for a sign of life, which comes after what was sent before.

        Raises:
            CommandRefusedError: Webots closed the connection.
        """
        with self._open():
            return self._connection.ping()

    def receive(self, until_s: float) -> Message | None:
        """Return the next message; None if none came by a time of `time.monotonic`.

        Raises:
            CommandRefusedError: Webots closed the connection.
        """
        with self._open():
            try:
                data = self._connection.recv(_left_s(until_s), decode=False)
            except TimeoutError:
                return None
        # The scene of a large world is a message of hundreds of megabytes, and every client gets
        # those that another has asked for.
        kept = data[:MAX_MESSAGE_BYTES]
        return Message(kept.decode("utf-8", "replace"), len(data) - len(kept))

    @contextmanager
    def _open(self) -> Generator[None]:
        from websockets.exceptions import ConnectionClosed

        try:
            yield
        except ConnectionClosed as error:
            why = f"Webots at {self._address} closed the connection"
            raise CommandRefusedError(why) from error


@contextmanager
def connected(address: WebotsAddress, timeout_s: float) -> Generator[Stream]:
    """Open a connection to Webots.

    Raises:
        CommandRefusedError: If nothing listens there, it is not Webots, it does not answer, or it
            closed the connection.
    """
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    try:
        connection = connect(
            f"ws://{address}/",
            open_timeout=timeout_s,
            close_timeout=_CLOSING_S,
            ping_interval=None,
            compression=None,
            max_size=None,
            proxy=None,
        )
    except TimeoutError as error:
        raise CommandRefusedError(
            f"what listens at {address} did not answer within {timeout_s:g} s: Webots' main thread "
            "is busy, or it is not Webots"
        ) from error
    except WebSocketException as error:  # it refuses, or hangs up in the handshake
        raise CommandRefusedError(f"what listens at {address} is not Webots ({error})") from error
    except OSError as error:
        raise CommandRefusedError(f"no Webots listens at {address} ({error})") from error
    with connection:
        yield Stream(connection, address)


def give_order(address: WebotsAddress, order: Order, timeout_s: float = ANSWER_S) -> OrderReply:
    """Send Webots an order, and return its reply.

    Raises:
        CommandRefusedError: If no Webots can be reached.
    """
    words, answers = _ORDERS[order]
    return _give(address, words, answers, timeout_s, late=order in RESTARTING)


def load_world(address: WebotsAddress, file_name: str, timeout_s: float = ANSWER_S) -> OrderReply:
    """Order Webots to open another world in the folder of the current one.

    Raises:
        CommandRefusedError: If no Webots can be reached.
    """
    return _give(address, f"load:{file_name}", _ORDERS["reload"][1], timeout_s, late=True)


def _give(
    address: WebotsAddress, words: str, answers: tuple[str, ...], timeout_s: float, *, late: bool
) -> OrderReply:
    until_s = time.monotonic() + timeout_s
    other = None
    with connected(address, timeout_s) as stream:
        stream.send(words)
        pong = stream.ping()
        is_alive = False
        while (now_s := time.monotonic()) < until_s:
            message = stream.receive(min(until_s, now_s + 0.02))
            line = message.text.partition("\n")[0][:200] if message else ""
            if message and line.startswith(answers):
                return OrderReply(line, is_alive=True)
            # also without --stream
            if message and not line.startswith(("stdout:", "stderr:", "robot")):
                other = other or line[:60]
            if pong.is_set() and not is_alive:
                is_alive = True
                if not late:
                    # Words are answered in their order: what comes now is about something else.
                    until_s = min(until_s, time.monotonic() + _CLOSING_S)
    return OrderReply(None, is_alive, other)


def why_not_obeyed(address: WebotsAddress, reply: OrderReply) -> str:
    """Return why Webots did not answer an order, as far as that is known."""
    if reply.other is not None:
        return (
            f"Webots at {address} answered {reply.other!r}, which does not show whether it obeyed: "
            "check its window, or the recording"
        )
    if reply.is_alive:
        return (
            f"Webots at {address} receives orders but does not obey them: it was started without "
            "--stream; restart it with that option"
        )
    return (
        f"Webots at {address} did not answer within {ANSWER_S:g} s: it was started without "
        "--stream, or its main thread is busy and may still obey later"
    )


def begin_console(stream: Stream) -> None:
    """Request Webots' console, which is then sent to all clients from the first unsent line on."""
    # A robot of this name need not exist: asking for a window begins the logs for this client.
    request = {"name": "webots-mcp", "message": "init robot window"}
    stream.send(f"robot:{json.dumps(request, separators=(',', ':'))}")


def console_lines(text: str) -> Iterator[WebotsLine]:
    """Yield the console lines of a message.

    A line names its stream; lines that continue it do not. Empty lines are omitted: Webots sends
    one after each line of a controller.
    """
    kind = None
    for line in text.split("\n"):
        head, colon, rest = line.partition(":")
        if colon and head in ("stdout", "stderr"):
            kind, line = head, rest
        if kind is None:  # it is about something else
            return
        if line.strip():
            yield WebotsLine(kind, line)


def _left_s(until_s: float) -> float:
    return max(until_s - time.monotonic(), 0.001)
