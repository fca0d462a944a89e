"""How a controller and the stand-in simulator talk: one message is a length and a marshalled value.

`marshal` rather than JSON because pictures are bytes and ranges are hundreds of floats; version 2
because every Python 3 reads it. It is read only from a peer that has shown the simulation's token.
"""

from __future__ import annotations

import marshal
import socket
import struct
from typing import Any, Final, TypeAlias

Message: TypeAlias = tuple[Any, ...]

ADDRESS_FILE: Final = "address"
"""File in the instance folder: the port on this machine, a space, the token."""

_LENGTH: Final = struct.Struct("!I")


def pack(message: Message) -> bytes:
    """A message as it goes over the wire."""
    body = marshal.dumps(message, 2)
    return _LENGTH.pack(len(body)) + body


class Inbox:
    """Puts messages together from what arrives."""

    def __init__(self) -> None:
        self._arrived = bytearray()

    def feed(self, data: bytes) -> None:
        """Take what the socket gave."""
        self._arrived += data

    def take(self) -> Message | None:
        """The next whole message; None if it has not arrived yet."""
        if len(self._arrived) < _LENGTH.size:
            return None
        end = _LENGTH.size + _LENGTH.unpack_from(self._arrived)[0]
        if len(self._arrived) < end:
            return None
        message = marshal.loads(self._arrived[_LENGTH.size : end])
        del self._arrived[:end]
        return message


def connect(port: int) -> socket.socket:
    """A connection to the simulator on this machine."""
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection
