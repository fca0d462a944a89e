"""The file of a tape: lines of JSON, compressed in blocks, the newest lines as they are.

A line is in the file when the step that it belongs to has ended. A process that is killed
therefore leaves a tape that can be read up to its last step. The file begins with `MAGIC`; then
come blocks (a mark, length, checksum, zlib), then lines that are in no block yet. When there are
enough of these, a block replaces them.

Each line is a list: its number, its kind, and what the kind says.

    [0, "head", {...}]                          the controller, its robot and Webots' package
    [1, "source", "controllers/rover/rover.py", "..."]
    [2, "call", 7, "device:ds", "DistanceSensor", "getValue", [], "question"]
    [3, "place", 2, "controllers/rover/rover.py", 31]
    [4, "round", 0, 0.032, "step", [32], 0, [7, 0.25, 9, [[5.0], 2]]]
    [5, "end", "finished"]

The events of a round are pairs of a call and its answer, of a command its arguments and its place.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, BinaryIO, Final, NamedTuple, cast

try:
    import orjson
except ImportError:  # where it is not installed, as in Webots' own Python
    orjson = None

from webots_mcp.database.files import PRIVATE_FILE, make_folder
from webots_mcp.errors import InvalidInputError

TAPE_FOLDER: Final = "tapes"  # in the data folder
TAPE_ENDING: Final = ".tape"
IMPORTED: Final = "imported"  # in that folder
MAX_TAPE_BYTES: Final = 256_000_000
NOTES: Final = 0  # the call whose answers are notes of the bridge, not of Webots' package
RUN: Final = "run"  # the note of a run: its identity, and its number in the session
MAGIC: Final = b"webots-mcp tape 1\n"
_MARK: Final = b"\0BLK"
_BLOCK: Final = struct.Struct(">4sII")
_BLOCK_FROM: Final = 48_000  # bytes of lines: about half a millisecond
_LEVEL: Final = 1  # three times as fast as 6, for a tenth more bytes
_MOST_LINE_BYTES: Final = 16_000_000
_MOST_BLOCK_BYTES: Final = 2 * _MOST_LINE_BYTES  # of lines in one block, against files that lie
_HEAD: Final = {  # what a replay reads of it
    "controller": (str, type(None)), "project": str, "arguments": list, "devices": dict,
    "facts": dict, "packages": dict, "began_late": bool,
}  # fmt: skip


def tape_file(data_dir: Path, session_uuid: str, *, imported: bool = False) -> Path:
    """Return the file of a session's tape, next to its database.

    Args:
        data_dir: The folder of the database.
        session_uuid: Of the session.
        imported: Whether it came from elsewhere: its code is not run without being asked for.
    """
    name = "".join(each for each in session_uuid if each.isalnum() or each in "-_")
    folder = data_dir / TAPE_FOLDER
    return (folder / IMPORTED if imported else folder) / f"{name}{TAPE_ENDING}"


def tape_files(data_dir: Path, session_uuid: str) -> tuple[Path, Path]:
    """Return where the tape of a session may be: recorded here, or imported."""
    return (
        tape_file(data_dir, session_uuid),
        tape_file(data_dir, session_uuid, imported=True),
    )


def is_tape(path: PurePath) -> bool:
    """Return whether a path from the data folder is that of a tape."""
    return len(path.parts) == 2 and path.parts[0] == TAPE_FOLDER and path.suffix == TAPE_ENDING


_ENCODER: Final = json.JSONEncoder(separators=(",", ":"), check_circular=False)


def _encoded(line: list[Any]) -> bytes:
    """Return a line as JSON. orjson writes NaN and infinity as null, and refuses some texts."""
    if orjson is not None:
        try:
            text = orjson.dumps(line)
        except (TypeError, ValueError):
            return _ENCODER.encode(line).encode("ascii")
        if b"null" not in text:
            return text
    return _ENCODER.encode(line).encode("ascii")


class TapeWriter:
    """Appends lines to a new tape.

    Args:
        file: It must not exist.
        max_bytes: The size beyond which nothing is written; the tape then ends as `full`.

    Attributes:
        is_open: Whether lines are still written.

    Raises:
        OSError: The file cannot be created.
    """

    def __init__(self, file: Path, max_bytes: int = MAX_TAPE_BYTES) -> None:
        make_folder(file.parent)
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        self._handle = os.open(file, flags, PRIVATE_FILE)
        os.write(self._handle, MAGIC)
        self._block_start = len(MAGIC)
        self._raw: list[bytes] = []
        self._raw_bytes = 0
        self._number = 0
        self._max_bytes = max_bytes
        self.is_open = True

    def write(self, lines: Sequence[Sequence[Any]]) -> None:
        """Append lines, each without its number, in one write.

        Raises:
            OSError: They could not be written.
            TypeError, ValueError: A value is not JSON; nothing is written.
        """
        if not self.is_open:
            return
        texts: list[bytes] = []
        for line in lines:
            text = _encoded([self._number + len(texts), *line])
            if len(text) > _MOST_LINE_BYTES:
                raise ValueError(f"a step has {len(text):,} bytes, more than {_MOST_LINE_BYTES:,}")
            texts.append(text)
        texts.append(b"")
        content = b"\n".join(texts)
        if self._block_start + self._raw_bytes + len(content) > self._max_bytes:
            self.close("full")
            return
        self._number += len(lines)
        self._append(content)

    def _append(self, content: bytes) -> None:
        self._write_all(content)
        self._raw.append(content)
        self._raw_bytes += len(content)
        if self._raw_bytes >= _BLOCK_FROM:
            self._pack()

    def _write_all(self, content: bytes) -> None:
        rest = memoryview(content)
        while rest:  # a disk that is nearly full takes a part
            rest = rest[os.write(self._handle, rest) :]

    def _pack(self) -> None:
        """Replace the lines that are in no block by a block.

        A process that is killed in between leaves the block and the rest of the lines behind it,
        which a reader knows by their numbers.
        """
        packed = zlib.compress(b"".join(self._raw), _LEVEL)
        block = _BLOCK.pack(_MARK, len(packed), zlib.crc32(packed)) + packed
        os.lseek(self._handle, self._block_start, os.SEEK_SET)
        self._write_all(block)
        self._block_start += len(block)
        os.ftruncate(self._handle, self._block_start)
        self._raw, self._raw_bytes = [], 0

    def close(self, reason: str) -> None:
        """Write why the tape ends, and close the file."""
        if not self.is_open:
            return
        self.is_open = False
        try:
            self._append(_encoded([self._number, "end", reason]) + b"\n")
            if self._raw:
                self._pack()
        finally:
            os.close(self._handle)

    def abandon(self) -> None:
        """Close the file without writing, in a forked child."""
        if self.is_open:
            self.is_open = False
            os.close(self._handle)


# -- reading ---------------------------------------------------------------------------------------


class TapedCall(NamedTuple):
    """A call that occurs on a tape: of which object, by which name, with which arguments.

    Attributes:
        path: `robot`, `device:NAME`, or how the object was obtained.
        kind: `question`, `command`, or `seen` of what only the bridge asked.
    """

    path: str
    owner: str
    name: str
    arguments: list[Any]
    kind: str


class TapedPlace(NamedTuple):
    """The line of the user's code that gave a command."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


class TapedRound(NamedTuple):
    """What a controller asked and commanded up to the end of a step.

    Attributes:
        number: From 0.
        end_s: Simulation time after the step.
        step: The name of the step's method, its arguments and its answer.
        events: Pairs of a call's number and its answer.
    """

    number: int
    end_s: float
    step: tuple[str, list[Any], Any]
    events: list[Any]


@dataclass
class Tape:
    """A tape that is read: its head at once, its rounds one by one.

    Attributes:
        file: The file.
        head: The facts of the process, its robot and Webots' package.
        calls: Those that occurred in the rounds read so far, by number.
        places: Likewise.
        end: Why it ends; None where it was not closed, as after a kill.
    """

    file: Path
    head: dict[str, Any]
    calls: dict[int, TapedCall] = field(default_factory=dict[int, TapedCall])
    places: dict[int, TapedPlace] = field(default_factory=dict[int, TapedPlace])
    end: str | None = None

    def rounds(self) -> Iterator[TapedRound]:
        """Yield the rounds in their order."""
        for line in _lines(self.file):
            kind: str = line[1]
            try:
                if kind == "round":
                    number, end_s, name, arguments, answer, events = line[2:8]
                    found = TapedRound(number, end_s, (name, arguments, answer), events)
                    if not isinstance(events, list) or not isinstance(arguments, list):
                        return
                    yield found
                elif kind == "call":
                    self.calls[line[2]] = TapedCall(*line[3:8])
                elif kind == "place":
                    self.places[line[2]] = TapedPlace(line[3], line[4])
                elif kind == "end":
                    self.end = line[2]
            except (TypeError, ValueError, IndexError):  # damaged, or made by hand
                return

    def number_of_run(self, uuid: str) -> int | None:
        """Return the number of a run in its session, from 0; None where the tape does not know."""
        name = f'["{RUN}",["{uuid}",'.encode()
        for text in _texts(self.file):
            _, is_held, rest = text.partition(name)
            number = rest.partition(b"]")[0]
            if is_held and number.isdigit():
                return int(number)
        return None

    def sources(self) -> dict[str, str]:
        """Return the text of each source file by its path, as it was when it was first used."""
        lines = (each for each in _lines(self.file, b'"source"') if len(each) > 3)
        return {each[2]: each[3] for each in lines if isinstance(each[3], str)}


def open_tape(file: Path) -> Tape:
    """Read the head of a tape.

    Raises:
        InvalidInputError: It is missing or is no tape, or its head is damaged.
    """
    try:
        first = next(_lines(file), None)
    except OSError as error:
        raise InvalidInputError(f"The tape {file} cannot be read: {error.strerror}.") from error
    if first is None or first[1] != "head" or not isinstance(first[2], dict):
        raise InvalidInputError(f"The tape {file} is damaged: it has no head.")
    return Tape(file, _checked(file, cast("dict[str, Any]", first[2])))


def _checked(file: Path, head: dict[str, Any]) -> dict[str, Any]:
    for name, kind in _HEAD.items():
        if name in head and not isinstance(head[name], kind):
            raise InvalidInputError(f"The tape {file} is damaged: {name!r} of its head is wrong.")
    return head


def _lines(file: Path, holding: bytes = b"") -> Generator[list[Any]]:
    """Yield the lines of a tape in their order, each once; what is damaged ends it."""
    last = -1
    for text in _texts(file):
        if holding not in text:
            continue
        try:
            line: Any = json.loads(text)
        except (ValueError, RecursionError):  # the rest of lines that became a block
            continue
        if not isinstance(line, list):
            continue
        parts = cast("list[Any]", line)
        if len(parts) < 3 or not isinstance(parts[0], int) or parts[0] <= last:
            continue
        if parts[0] > last + 1 and not holding:  # a line is lost: what follows would be shifted
            return
        last = parts[0]
        if not holding or parts[1] == holding.decode().strip('"'):
            yield parts


def _texts(file: Path) -> Generator[bytes]:
    with file.open("rb") as tape:
        if tape.read(len(MAGIC)) != MAGIC:
            raise InvalidInputError(f"{file} is not a tape of webots-mcp.")
        while True:
            start = tape.read(_BLOCK.size)
            if start[:4] != _MARK:
                break
            mark_and_sizes = _BLOCK.unpack(start) if len(start) == _BLOCK.size else (b"", 0, 0)
            packed = tape.read(mark_and_sizes[1])
            if zlib.crc32(packed) != mark_and_sizes[2]:
                return
            unpacking = zlib.decompressobj()
            try:
                lines = unpacking.decompress(packed, _MOST_BLOCK_BYTES)
                if not unpacking.eof:
                    return
            except zlib.error:
                return
            yield from lines.splitlines()
        yield from _plain_lines(tape, start)


def _plain_lines(tape: BinaryIO, start: bytes) -> Generator[bytes]:
    """Yield the lines that are in no block, of which the first bytes were read already."""
    *whole, rest = start.split(b"\n")
    yield from whole
    while text := tape.readline(_MOST_LINE_BYTES + 1):
        if len(rest) + len(text) > _MOST_LINE_BYTES:
            return
        yield rest + text
        rest = b""
    yield rest
