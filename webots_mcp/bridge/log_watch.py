"""Detecting that the write-ahead log was truncated under an open connection.

SQLite keeps the length of the log in shared memory, and continues to read and write beyond the end
of a truncated file: the missing part reads as zeros, and what is written afterwards is lost when
the database is opened next. The log's format: sqlite.org/fileformat2.html, section 4.
"""

from __future__ import annotations

from typing import Final, NamedTuple

_HEADER_BYTES: Final = 32
_FRAME_HEADER_BYTES: Final = 24
_MAGIC: Final = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")


class _Log(NamedTuple):
    """A log as it was at one moment: the salts of its generation, and its last frame."""

    salts: bytes
    size: int
    frame: int
    frame_salts: bytes


class LogWatch:
    """Compares a log with its state at the last call; a checkpoint that empties it is no fault.

    Args:
        log: The file.
    """

    def __init__(self, log: str) -> None:
        self._log = log
        self._seen: _Log | None = None

    def is_whole(self) -> bool:
        """Whether the log was not truncated since the last call, as far as can be known.

        An empty log could be either; it is judged at the next call, when it has frames again.
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
        if frame_salts == salts:  # else the frame is left over from the previous generation
            self._seen = _Log(salts, size, frame, frame_salts)
        return True
