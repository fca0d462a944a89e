"""Noticing that the write-ahead log was cut short under an open connection.

SQLite keeps in shared memory how far the log goes, and reads and writes on beyond its end: what
was cut off reads as zeros, and what is written afterwards is lost with the next opening. The log's
format: sqlite.org/fileformat2.html, section 4.
"""

from __future__ import annotations

from typing import Final, NamedTuple

_HEADER_BYTES: Final = 32
_FRAME_HEADER_BYTES: Final = 24
_MAGIC: Final = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")


class _Log(NamedTuple):
    """What was seen of a log: the salts of its generation, and its last frame."""

    salts: bytes
    size: int
    frame: int
    frame_salts: bytes


class LogWatch:
    """Compares a log with what it was at the last look; a checkpoint that empties it is fine.

    Args:
        log: The file.
    """

    def __init__(self, log: str) -> None:
        self._log = log
        self._seen: _Log | None = None

    def is_whole(self) -> bool:
        """Whether nothing was cut off since the last look, as far as can be known.

        One that is empty now tells nothing: the next look does, after something was written.
        """
        before, self._seen = self._seen, None
        try:
            with open(self._log, "rb", buffering=0) as file:  # noqa: PTH123  (at each heartbeat)
                header = file.read(_HEADER_BYTES)
                if len(header) < _HEADER_BYTES:
                    return True
                if header[:4] not in _MAGIC:
                    return False
                salts, page_bytes = header[16:24], int.from_bytes(header[8:12], "big")
                size = file.seek(0, 2)
                if before is not None and before.salts == salts:
                    file.seek(before.frame + 8)
                    if size < before.size or file.read(8) != before.frame_salts:
                        return False
                frame_bytes = _FRAME_HEADER_BYTES + page_bytes
                frames = max(1, (size - _HEADER_BYTES) // frame_bytes)
                frame = _HEADER_BYTES + (frames - 1) * frame_bytes
                file.seek(frame + 8)
                frame_salts = file.read(8)
        except OSError:
            return True
        if frame_salts == salts:  # else it is left over from the generation before
            self._seen = _Log(salts, size, frame, frame_salts)
        return True
