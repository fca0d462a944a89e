"""WebSocket frames that are too long are shortened while they are read (RFC 6455, section 5.2).

The scene of a large world is one message of hundreds of megabytes, and every client gets those that
another has asked for. Libraries either keep such a frame whole or hang up.
"""

from __future__ import annotations

from typing import Final

MAX_FRAME_BYTES: Final = 4 << 20  # Qt, which Webots is built with, cuts messages into 512 kB

_LENGTH: Final = 0x7F  # of the second byte; 126 and 127 say that the length follows
_LENGTH_BYTES: Final = {126: 2, 127: 8}


class FrameTrimmer:
    """Passes on what a server sends, of each frame at most its first bytes."""

    def __init__(self, limit_bytes: int = MAX_FRAME_BYTES) -> None:
        self.trimmed_bytes = 0
        self._limit = limit_bytes
        self._header = bytearray()
        self._pass = self._drop = 0

    def feed(self, data: bytes) -> bytes:
        """What is left of the next bytes from the server."""
        left, at = bytearray(), 0
        while at < len(data):
            if self._pass:
                part = data[at : at + self._pass]
                left += part
                self._pass -= len(part)
            elif self._drop:
                part = data[at : at + self._drop]
                self._drop -= len(part)
            else:
                part = data[at : at + 1]
                self._header += part
                left += self._begin() if self._is_complete() else b""
            at += len(part)
        return bytes(left)

    def _is_complete(self) -> bool:
        if len(self._header) < 2:
            return False
        return len(self._header) == 2 + _LENGTH_BYTES.get(self._header[1] & _LENGTH, 0)

    def _begin(self) -> bytes:
        """The header of a frame that is no longer than the limit."""
        header, self._header = bytes(self._header), bytearray()
        length = int.from_bytes(header[2:], "big") if len(header) > 2 else header[1] & _LENGTH
        if length <= self._limit:
            self._pass = length
            return header
        self._pass, self._drop = self._limit, length - self._limit
        self.trimmed_bytes += self._drop
        return bytes((header[0], header[1] | _LENGTH)) + self._limit.to_bytes(8, "big")
