"""A WebSocket server that behaves as Webots' own does, as far as its sources tell.

It obeys orders only with `--stream`, keeps the console until somebody asks for it, and can be made
silent, slow, or rude.
"""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from types import TracebackType
from typing import Any, Final, Literal

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

Manner = Literal["well", "busy", "cut off", "in other words"]

_PART_BYTES: Final = 512 << 10
_MODES: Final = {"pause": "pause", "real-time": "real-time", "fast": "fast", "step": "pause"}


def _in_parts(text: str) -> Iterator[str]:
    """As Qt, which Webots is built with, cuts messages."""
    for begin in range(0, len(text), _PART_BYTES):
        yield text[begin : begin + _PART_BYTES]


class WebotsServer:
    """Listens on a port of this machine in a thread of its own.

    Args:
        streams: Whether it was started with `--stream`.
        manner: `busy`: its main thread reads nothing; `cut off`: it hangs up in mid-frame;
            `in other words`: it obeys and says something that no release is known to say.
        on_order: Called with each word that it obeys.
        announce_bytes: So long a message about the scene comes before each answer.
    """

    def __init__(
        self,
        *,
        streams: bool,
        manner: Manner = "well",
        on_order: Callable[[str], None] = lambda word: None,
        announce_bytes: int = 0,
        port: int = 0,
    ) -> None:
        self.heard: list[str] = []
        self.mode = "pause"
        self._streams, self._manner = streams, manner
        self.on_order, self._announce_bytes = on_order, announce_bytes
        self._console: list[str] = []
        self._listeners: list[ServerConnection] = []
        self._lock = threading.Lock()
        self._free = threading.Event()  # of a busy main thread
        free = self._free

        class Busy(ServerConnection):
            """Shakes hands, and then sends nothing, no pong either."""

            is_busy = False

            def handshake(self, *arguments: Any, **options: Any) -> None:
                super().handshake(*arguments, **options)
                self.is_busy = True

            def send_data(self) -> None:
                if not self.is_busy or free.is_set():
                    super().send_data()

        self._server: Server = serve(
            self._serve, "127.0.0.1", port, max_size=None, compression=None, ping_interval=None,
            create_connection=Busy if manner == "busy" else ServerConnection,
        )  # fmt: skip
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def __enter__(self) -> WebotsServer:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._free.set()
        self._server.shutdown()
        self._thread.join()

    def log(self, stream: str, text: str) -> None:
        """A line of the console: kept until somebody listens, then gone."""
        with self._lock:
            self._console.append(f"{stream}:{text}")
            self._tell_console()

    @property
    def is_listened_to(self) -> bool:
        """Whether a line of the console would reach somebody, who may have just hung up."""
        return bool(self._listeners)

    def send_raw(self, data: bytes) -> None:
        """Send bytes to all who listen to the console, whatever they mean."""
        for listener in self._listeners:
            listener.socket.sendall(data)

    def hang_up(self) -> None:
        """End all connections without a word."""
        with self._lock:
            gone, self._listeners = self._listeners, []
        for listener in gone:
            with suppress(OSError):
                listener.socket.shutdown(socket.SHUT_RDWR)

    def _tell_console(self) -> None:
        if not (self._listeners and self._console):
            return
        text, self._console = "\n".join(self._console), []
        for listener in self._listeners:
            with suppress(ConnectionClosed):
                listener.send(text)

    def _serve(self, client: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            for message in client:
                self._answer(client, str(message))
        with self._lock, suppress(ValueError):
            self._listeners.remove(client)

    def _answer(self, client: ServerConnection, text: str) -> None:
        self.heard.append(text)
        if text.startswith("robot:"):
            self._window(client, text.removeprefix("robot:"))
        elif self._streams:
            if self._announce_bytes:
                client.send(_in_parts("model:" + "x" * self._announce_bytes))
            if self._manner == "cut off":
                client.socket.sendall(b"\x81\x7e\x10\x00paused by")  # of 4,096 bytes
                client.socket.close()
                return
            self._obey(client, text)

    def _window(self, client: ServerConnection, text: str) -> None:
        if json.loads(text)["message"] == "init robot window":
            with self._lock:
                self._listeners.append(client)
                self._tell_console()

    def _obey(self, client: ServerConnection, text: str) -> None:
        word = text.partition(":")[0]
        if word not in (*_MODES, "reset", "reload", "load"):
            return self.log("stderr", f"ERROR: Streaming server: Unsupported message: {text}")
        self.on_order(text)
        self.mode = _MODES.get(word, self.mode)
        if self._manner == "in other words":
            return client.send("state: changed")
        if word in ("pause", "step"):
            client.send("paused by client")
        elif word in _MODES:
            client.send(word)
        elif word == "reset":
            self.log("stdout", "reset finished")  # queued with the console
        else:
            client.send("delete world")
            client.send("loading:Opening:100")
        return None
