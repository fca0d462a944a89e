"""The simulator's end of a controller's socket."""

from __future__ import annotations

import socket
from contextlib import suppress

from controller.wire import Inbox, Message, pack


class Connection:
    """The socket of one controller."""

    def __init__(self, stream: socket.socket) -> None:
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.stream = stream
        self.inbox = Inbox()

    def send(self, message: Message) -> None:
        """Send an answer; a controller that is gone is noticed when its socket is read."""
        with suppress(OSError):
            self.stream.sendall(pack(message))

    def receive(self) -> list[Message] | None:
        """The messages that have arrived; None if the controller is gone."""
        try:
            data = self.stream.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            return None
        self.inbox.feed(data)
        return [*iter(self.inbox.take, None)]
