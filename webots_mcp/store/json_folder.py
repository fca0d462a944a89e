"""Importing the data folder of a bridge that writes JSON files, as one finished run.

    status.json            the newest state, one object, with an ISO `timestamp`
    logs/controller.log    lines "[HH:MM:SS] message"
    camera/*.png, screenshots/*.png
    commands.json          the newest command, if it was not taken

Such a folder has no simulation times: they are counted in seconds of wall time from the earliest
thing in it. `reading` checks everything before `import_folder` writes the first row.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import socket
import sqlite3
import stat
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.connection import transaction
from webots_mcp.contract import (
    CAMERA_FOLDER,
    PRIVATE_FILE,
    SCREENSHOT_FOLDER,
    make_folder,
    new_uuid,
)
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.chunks import StateColumns
from webots_mcp.store.run_rows import opened
from webots_mcp.store.signals import enter_signals, seen_in

__all__ = ["Imported", "import_folder", "read_folder"]


# A folder becomes a run of a robot of its own: all of it, or nothing.


Progress = Callable[[int, int], object]

DEFAULT_ROBOT: Final = "imported"
_KNOWN_ROBOT: Final = "SELECT 1 FROM robot WHERE name = ?"
_IMPORTED: Final = (
    "SELECT run.id, robot.name FROM session JOIN run ON run.session_id = session.id "
    "JOIN robot ON robot.id = session.robot_id WHERE session.instance = ?"
)
_INSERT_LINE: Final = (
    "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
    "VALUES (?, ?, ?, 'info', 'controller', ?)"
)
_NOTE: Final = "simulation times are wall time since the first entry: the folder has no others"
_NOT_RUN: Final = "imported: it was waiting when its folder was imported, and will never run"
_PROGRESS_LINES: Final = 1000
_BLOCK_BYTES: Final = 1_000_000


class Imported(NamedTuple):
    """What an import made."""

    robot: str
    run_id: int
    states: int
    lines: int
    commands: int
    pictures: int


def import_folder(
    connection: sqlite3.Connection,
    folder: Path,
    data_dir: Path,
    robot: str = DEFAULT_ROBOT,
    progress: Progress | None = None,
) -> Imported:
    """Import a folder in one transaction; robots that record meanwhile keep their rows until then.

    Args:
        connection: Of the role "writer", in autocommit mode.
        folder: Holds `status.json`, `logs/`, `camera/` and so on.
        data_dir: Where this database's pictures live; those of `folder` are copied to it.
        robot: The name to record under; no robot may have it yet.
        progress: Called now and then with the log lines written so far and in all.

    Raises:
        InvalidInputError: There is nothing to import, a file is damaged (the text names it and
            the line), the name is taken, or the same folder was imported before. Nothing is
            written then.
    """
    try:
        folder, data_dir = folder.resolve(), data_dir.resolve()
    except (OSError, RuntimeError) as error:  # a loop of links
        raise InvalidInputError(f"{folder} cannot be read: {error}") from error
    found = read_folder(folder)
    instance = f"import {_fingerprint(folder, found)}"
    with _taken_back() as made, transaction(connection):
        _require_new(connection, instance, folder, robot)
        paths = [
            _copy(picture, _destination(picture, folder, data_dir, robot), made)
            .relative_to(data_dir)
            .as_posix()
            for picture in found.pictures
        ]
        writer = _Writer(connection, found, robot)
        writer.write(instance, folder, paths, progress)
    lines = found.log.lines if found.log else 0
    states, commands = int(found.state is not None), len(found.commands)
    return Imported(robot, writer.run_id, states, lines, commands, len(found.pictures))


def _fingerprint(folder: Path, found: Found) -> str:
    digest = hashlib.sha256()
    for name in (STATUS, LOG, COMMANDS):
        if is_there(folder / name):
            digest.update(name.encode())
            with (folder / name).open("rb") as file:
                for block in iter(lambda: file.read(_BLOCK_BYTES), b""):
                    digest.update(block)
    for picture in found.pictures:
        digest.update(f"{picture.file.name} {picture.size_bytes}".encode())
    return digest.hexdigest()


def _require_new(connection: sqlite3.Connection, instance: str, folder: Path, robot: str) -> None:
    if before := connection.execute(_IMPORTED, (instance,)).fetchone():
        raise InvalidInputError(
            f"{folder} was imported before, as run {before[0]} of robot {before[1]!r}"
        )
    if not robot.strip() or not is_text(robot):
        raise InvalidInputError(f"the robot needs a name to be recorded under, not {robot!r}")
    if connection.execute(_KNOWN_ROBOT, (robot,)).fetchone():
        raise InvalidInputError(
            f"there is a robot {robot!r} already, whose newest run this would seem to be: choose "
            "another name"
        )


@contextlib.contextmanager
def _taken_back() -> Generator[list[Path]]:
    """The files that are made inside; they go again on an error."""
    made: list[Path] = []
    try:
        yield made
    except BaseException:
        for file in made:
            file.unlink(missing_ok=True)
        raise


def _copy(picture: FoundPicture, file: Path, made: list[Path]) -> Path:
    """The picture where it belongs; a file that was made for it is noted."""
    if file == picture.file:
        return file
    if file.exists():
        raise InvalidInputError(f"{file} already exists: move it away first")
    made.append(file)
    try:
        make_folder(file.parent)
        shutil.copy2(picture.file, file)
        file.chmod(PRIVATE_FILE)
    except OSError as error:
        raise InvalidInputError(f"the pictures cannot be copied: {error}") from error
    return file


def _destination(picture: FoundPicture, folder: Path, data_dir: Path, robot: str) -> Path:
    """Where a picture goes; it stays where it is if its folder is our own."""
    if folder == data_dir:
        return picture.file
    name = re.sub(r"[^\w-]", "_", robot)
    subfolder = CAMERA_FOLDER if picture.kind == "camera" else SCREENSHOT_FOLDER
    return data_dir / subfolder / name / picture.file.name


class _Writer:
    """Inserts what was found, inside a transaction."""

    def __init__(self, connection: sqlite3.Connection, found: Found, robot: str) -> None:
        self._connection = connection
        self._found = found
        self._robot = robot
        times_s = sorted(found.wall_times_s())
        self._first_s, self._last_s = times_s[0], times_s[-1]
        self.run_id = 0

    def write(
        self, instance: str, folder: Path, paths: list[str], progress: Progress | None
    ) -> None:
        session_id = self._begin(instance)
        text = json.dumps({"folder": str(folder), "note": _NOTE})
        self._insert("event", **self._at(self._first_s), kind="import", data=text)
        if state := self._found.state:
            at = self._at(state.wall_time_s)
            state_id = self._insert("state", **at, data=state.data, replaced=state.replaced)
            columns = StateColumns()
            times = at["sim_time_s"], state.wall_time_s
            columns.add([(state_id, *times, state.data, state.replaced)])
            seen = seen_in(columns, columns.values)
            enter_signals(self._connection, self._robot_id, seen)
        for picture, path in zip(self._found.pictures, paths, strict=True):
            self._insert_picture(picture, path)
        self._insert_commands(session_id)
        if self._found.log:
            self._insert_lines(self._found.log, progress)

    def _begin(self, instance: str) -> int:
        seen = {"first_seen_wall_time_s": self._first_s, "last_seen_wall_time_s": self._last_s}
        self._robot_id = self._insert("robot", name=self._robot, kind="Robot", **seen)
        started = {"robot_id": self._robot_id, "started_wall_time_s": self._first_s}
        ended = {"ended_wall_time_s": self._last_s, "end_reason": "finished"}
        where = {"pid": 0, "host": socket.gethostname(), "instance": instance, "supervisor": 0}
        session_id = self._insert(
            "session",
            uuid=new_uuid(),
            **started,
            **ended,
            **where,
            last_seen_wall_time_s=self._last_s,
        )
        self.run_id = self._insert(
            "run",
            uuid=new_uuid(),
            **started,
            **ended,
            session_id=session_id,
            start_reason="start",
            started_sim_time_s=0.0,
            last_wall_time_s=self._last_s,
            last_sim_time_s=self._last_s - self._first_s,
            row_count=int(self._found.state is not None),
        )
        return session_id

    def _insert_picture(self, picture: FoundPicture, path: str) -> None:
        size = {"width": picture.width, "height": picture.height, "size_bytes": picture.size_bytes}
        device = "camera" if picture.kind == "camera" else None
        at = self._at(picture.wall_time_s)
        self._insert("image", **at, kind=picture.kind, device=device, path=path, **size)

    def _insert_commands(self, session_id: int) -> None:
        for command in self._found.commands:
            self._insert(
                "command",
                robot_id=self._robot_id,
                action=command.action,
                params=command.params,
                status="expired",
                created_wall_time_s=command.wall_time_s,
                expires_wall_time_s=command.wall_time_s,
                finished_wall_time_s=time.time(),
                session_id=session_id,
                error=_NOT_RUN,
            )

    def _insert_lines(self, log: FoundLog, progress: Progress | None) -> None:
        def rows() -> Iterator[tuple[int, float, float, str]]:
            for number, (wall_time_s, message) in enumerate(log.read(), 1):
                yield self.run_id, wall_time_s - self._first_s, wall_time_s, message
                if progress is not None and (number % _PROGRESS_LINES == 0 or number == log.lines):
                    progress(number, log.lines)

        self._connection.executemany(_INSERT_LINE, rows())

    def _at(self, wall_time_s: float) -> dict[str, Any]:
        sim_time_s = wall_time_s - self._first_s
        return {"run_id": self.run_id, "sim_time_s": sim_time_s, "wall_time_s": wall_time_s}

    def _insert(self, table: str, **values: Any) -> int:
        names, marks = ", ".join(values), ", ".join("?" * len(values))
        statement = f"INSERT INTO {table} ({names}) VALUES ({marks})"
        row_id = self._connection.execute(statement, tuple(values.values())).lastrowid
        assert row_id is not None
        return row_id


# What such a folder holds; whatever cannot be read is refused with its file and line.


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
