"""What such a folder holds; whatever cannot be read is refused with its file and line."""

from __future__ import annotations

import json
import math
import os
import re
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import CAMERA_FOLDER, SCREENSHOT_FOLDER
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.images import opened

Clock = tuple[int, int, int]  # hour, minute, second

STATUS: Final = "status.json"
LOG: Final = "logs/controller.log"
COMMANDS: Final = "commands.json"
MAX_JSON_BYTES: Final = 16_000_000
MAX_LINE_BYTES: Final = 1_000_000
MAX_DEPTH: Final = 100
_SHOWN: Final = 100  # characters of a value that is wrong
_STAMP: Final = re.compile(r"\[(\d\d):(\d\d):(\d\d)\] ?(.*)", re.DOTALL)


class FoundState(NamedTuple):
    """The newest state; `data` and `replaced` are JSON text as the database holds them."""

    wall_time_s: float
    data: str
    replaced: str | None


class FoundCommand(NamedTuple):
    """A command that no controller had taken; `params` is JSON text."""

    wall_time_s: float
    action: str
    params: str


class FoundLine(NamedTuple):
    """A log line, which may be several lines of text."""

    wall_time_s: float
    message: str


class FoundPicture(NamedTuple):
    """A complete PNG file; `kind` is camera or screenshot."""

    wall_time_s: float
    kind: str
    file: Path
    width: int
    height: int
    size_bytes: int


@dataclass(frozen=True)
class FoundLog:
    """A log file, found to be readable; its lines are read anew each time.

    Attributes:
        first_day: Of the first line; the clock goes back once for each midnight after it.
    """

    file: Path
    first_day: date
    lines: int
    first_wall_time_s: float
    last_wall_time_s: float

    def read(self) -> Iterator[FoundLine]:
        """Its lines, with their dates."""
        day, before = self.first_day, (0, 0, 0)
        for clock, message in _log_entries(self.file):
            day += timedelta(days=clock < before)
            before = clock
            yield FoundLine(_at(day, clock), message)


@dataclass(frozen=True)
class Found:
    """Everything that a folder holds."""

    state: FoundState | None
    log: FoundLog | None
    commands: tuple[FoundCommand, ...]
    pictures: tuple[FoundPicture, ...]

    def wall_times_s(self) -> Iterator[float]:
        """The earliest and the latest of each kind, among others."""
        if self.log:
            yield from (self.log.first_wall_time_s, self.log.last_wall_time_s)
        for found in (self.state, *self.commands, *self.pictures):
            if found:
                yield found.wall_time_s


def read_folder(folder: Path) -> Found:
    """Read a folder; every file in it is looked through.

    Raises:
        InvalidInputError: It is not there or holds nothing to import, or a file is not as it
            should be.
    """
    if not os.path.lexists(folder):
        raise InvalidInputError(f"{folder} cannot be imported: there is no such file or folder")
    try:
        state = _read_state(folder / STATUS)
        found = Found(
            state,
            _read_log(folder / LOG, state.wall_time_s if state else None),
            tuple(_read_commands(folder / COMMANDS)),
            tuple(_read_pictures(folder)),
        )
    except OSError as error:
        raise InvalidInputError(f"{error.filename or folder} cannot be read: {error}") from error
    if not any((found.state, found.log, found.commands, found.pictures)):
        raise InvalidInputError(
            f"{folder} holds nothing to import: no {STATUS}, no {LOG}, no pictures in "
            f"{CAMERA_FOLDER}/ or {SCREENSHOT_FOLDER}/, no command in {COMMANDS}"
        )
    return found


def is_there(file: Path) -> bool:
    """Whether there is such a file.

    Raises:
        InvalidInputError: It is a pipe, a device or a folder, which may never end.
    """
    try:
        mode = file.stat().st_mode
    except FileNotFoundError:
        return False
    if not stat.S_ISREG(mode):
        raise InvalidInputError(f"{file} is not a regular file: move it away and import the rest")
    return True


def _read_state(file: Path) -> FoundState | None:
    if not is_there(file):
        return None
    state = _read_json(file)
    if not isinstance(state, dict):
        raise InvalidInputError(f"{file}: a state is an object, this is a {type(state).__name__}")
    replaced: dict[str, str] = {}
    clean = _clean(cast("dict[str, Any]", state), (), replaced, file)
    wall_time_s = _moment(clean.get("timestamp"), file)
    return FoundState(wall_time_s, _encode(clean), _encode(replaced) if replaced else None)


def _read_commands(file: Path) -> Iterator[FoundCommand]:
    if not is_there(file):
        return
    content = _read_json(file)
    for command in cast("list[Any]", content if isinstance(content, list) else [content]):
        if not isinstance(command, dict) or "action" not in command:
            shown = repr(cast("object", command))[:_SHOWN]
            raise InvalidInputError(f"{file}: a command is an object with an action: {shown}")
        params: dict[str, Any] = _clean(command, (), {}, file)
        action, moment = str(params.pop("action")), params.pop("timestamp", None)
        if action != "none":  # what a bridge leaves where it took a command
            yield FoundCommand(_moment(moment, file), action, _encode(params))


def _read_json(file: Path) -> Any:
    if (size := file.stat().st_size) > MAX_JSON_BYTES:
        raise InvalidInputError(f"{file} has {size:,} bytes, {MAX_JSON_BYTES:,} is the limit")
    text = file.read_bytes()
    if not text.strip():
        raise InvalidInputError(
            f"{file} is empty: its controller ended while writing it; delete the file and "
            "import the rest"
        )
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InvalidInputError(f"{file}, {where}: not valid JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:  # no UTF-8, a number of 5,000 digits
        raise InvalidInputError(f"{file}: not valid JSON: {error}") from error


def _clean(value: Any, path: tuple[str, ...], replaced: dict[str, str], file: Path) -> Any:
    """A copy without what JSON cannot hold; `replaced` names where it stood, as in a bridge."""
    if len(path) > MAX_DEPTH:
        raise InvalidInputError(
            f"{file} is nested over {MAX_DEPTH} levels, at {path[0]!r:.{_SHOWN}}"
        )
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value).items()
        return {
            _text(key, (*path, key), replaced): _clean(item, (*path, key), replaced, file)
            for key, item in items
        }
    if isinstance(value, list):
        array = cast("list[Any]", value)
        return [_clean(item, (*path, str(i)), replaced, file) for i, item in enumerate(array)]
    if isinstance(value, str):
        return _text(value, path, replaced)
    if isinstance(value, (int, float)) and (why := _no_number(value)):
        replaced[".".join(path)] = why
        return None
    return value


def _text(text: str, path: tuple[str, ...], replaced: dict[str, str]) -> str:
    """Text that UTF-8 can hold."""
    if is_text(text):
        return text
    replaced[_readable(".".join(path))] = "surrogate"
    return _readable(text)


def _no_number(value: float) -> str | None:
    """Why a number is none that a float can hold."""
    try:
        return None if math.isfinite(value) else str(value)
    except OverflowError:
        return "int"


def is_text(text: str) -> bool:
    """Whether UTF-8 can hold it, and with it the database: no lone half of a pair is in it."""
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _readable(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


def _encode(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def _moment(stamp: object, file: Path) -> float:
    """Unix time of an ISO 8601 text (without an offset: of this machine) or a number.

    Where there is none, the file's own time.
    """
    if stamp is None:
        return file.stat().st_mtime
    try:
        if isinstance(stamp, (int, float)):
            return datetime.fromtimestamp(stamp).timestamp()
        return datetime.fromisoformat(str(stamp).replace("Z", "+00:00")).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        shown = repr(stamp)[:_SHOWN]
        raise InvalidInputError(f"{file}: timestamp {shown} is not an ISO 8601 time") from error


def _read_log(file: Path, newest_s: float | None) -> FoundLog | None:
    """Look through a log whose last line is about as old as the newest state, or as the file."""
    if not is_there(file):
        return None
    lines, midnights, last, first = 0, 0, (0, 0, 0), (0, 0, 0)
    for clock, _ in _log_entries(file):
        midnights += bool(lines) and clock < last
        first = first if lines else clock
        last = clock
        lines += 1
    if not lines:
        return None
    try:
        last_day = _day_of(last, file.stat().st_mtime if newest_s is None else newest_s)
        first_day = last_day - timedelta(days=midnights)
        return FoundLog(file, first_day, lines, _at(first_day, first), _at(last_day, last))
    except (OverflowError, ValueError) as error:
        raise InvalidInputError(
            f"{file}: its clock goes back {midnights:,} times, to before all calendars: {error}"
        ) from error


def _day_of(clock: Clock, near_s: float) -> date:
    """The day on which the clock showed that time nearest to `near_s`."""
    day = datetime.fromtimestamp(near_s).date()
    days = [day + timedelta(days=offset) for offset in (0, -1, 1)]
    return min(days, key=lambda day: abs(_at(day, clock) - near_s))


def _at(day: date, clock: Clock) -> float:
    return datetime(day.year, day.month, day.day, *clock).timestamp()


def _log_entries(file: Path) -> Iterator[tuple[Clock, str]]:
    """Clock time and message of each; lines without a time go on with the one before."""
    clock, message = None, list[str]()
    with file.open("rb") as log:
        for number, line in enumerate(iter(lambda: log.readline(MAX_LINE_BYTES), b""), 1):
            if len(line) == MAX_LINE_BYTES:
                raise InvalidInputError(f"{file}, line {number}: it has over {len(line):,} bytes")
            text = _decode(line)
            stamp = _STAMP.fullmatch(text)
            if stamp is None and clock is None:
                if not text.strip():
                    continue
                raise InvalidInputError(
                    f"{file}, line {number}: expected '[HH:MM:SS] message', found {text[:60]!r}"
                )
            if stamp is None:
                message.append(text)
                continue
            if clock is not None:
                yield clock, "\n".join(message)
            clock, message = _clock(stamp, file, number), [stamp[4]]
    if clock is not None:
        yield clock, "\n".join(message)


def _clock(stamp: re.Match[str], file: Path, number: int) -> Clock:
    hour, minute, second = int(stamp[1]), int(stamp[2]), int(stamp[3])
    if hour > 23 or minute > 59 or second > 59:
        raise InvalidInputError(f"{file}, line {number}: {stamp[0][:10]} is not a time of day")
    return hour, minute, second


def _decode(line: bytes) -> str:
    """UTF-8; a log that was written on Windows may be in its code page."""
    bare = line.rstrip(b"\r\n")
    try:
        text = bare.decode()
    except UnicodeDecodeError:
        text = bare.decode("cp1252", "replace")
    return text.replace("\0", "\\0")


def _read_pictures(folder: Path) -> Iterator[FoundPicture]:
    for kind, subfolder in (("camera", CAMERA_FOLDER), ("screenshot", SCREENSHOT_FOLDER)):
        yield from _pictures_in(kind, sorted((folder / subfolder).glob("*.png")))


def _pictures_in(kind: str, files: Iterable[Path]) -> Iterator[FoundPicture]:
    for file in files:
        if not is_text(file.name):
            raise InvalidInputError(f"the name of {str(file)!r} is not valid text: rename the file")
        is_there(file)
        status = file.stat()
        yield FoundPicture(status.st_mtime, kind, file, *_picture_size(file), status.st_size)


def _picture_size(file: Path) -> tuple[int, int]:
    """Width and height in pixels of a PNG whose every part is whole."""
    try:
        with opened(file, ("PNG",)) as picture:
            picture.verify()
            return picture.size
    except InvalidInputError as error:
        raise InvalidInputError(f"{error}: delete it and import the rest") from error
