"""Importing the data folder of a bridge that writes JSON files, as one finished run.

    status.json            the newest state, one object, with an ISO `timestamp`
    logs/controller.log    lines "[HH:MM:SS] message"
    camera/*.png, screenshots/*.png
    commands.json          the newest command, if it was not taken

Such a folder has no simulation times: they are counted in seconds of wall time from the earliest
thing in it. `read_folder` checks everything before `import_folder` writes the first row.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import shutil
import socket
import sqlite3
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime, timedelta
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

Progress = Callable[[int, int], object]
Clock = tuple[int, int, int]  # hour, minute, second

DEFAULT_ROBOT: Final = "imported"
STATUS: Final = "status.json"
LOG: Final = "logs/controller.log"
COMMANDS: Final = "commands.json"
MAX_JSON_BYTES: Final = 16_000_000
MAX_LOG_BYTES: Final = 1_000_000_000
MAX_DEPTH: Final = 100
_SHOWN: Final = 100  # characters of a value that is wrong
_PROGRESS_LINES: Final = 1000
_STAMP: Final = re.compile(r"\[(\d\d):(\d\d):(\d\d)\] ?(.*)", re.DOTALL)
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


class FoundPicture(NamedTuple):
    """A complete PNG file; `kind` is camera or screenshot."""

    wall_time_s: float
    kind: str
    file: Path
    width: int
    height: int
    size_bytes: int


@dataclass(frozen=True)
class Found:
    """Everything that a folder holds; each begins with its wall time.

    Attributes:
        states: The newest state, if there is one, and what was replaced in it: JSON text, as the
            database holds it.
        lines: Log lines with their texts, which may be several lines.
        commands: Those that no controller had taken: action, and parameters as JSON text.
        pictures: Of the camera and of screenshots.
        fingerprint: By which the same folder is known again.
    """

    states: Sequence[tuple[float, str, str | None]]
    lines: Sequence[tuple[float, str]]
    commands: Sequence[tuple[float, str, str]]
    pictures: Sequence[FoundPicture]
    fingerprint: str


class Imported(NamedTuple):
    """What an import made."""

    robot: str
    run_id: int
    states: int
    lines: int
    commands: int
    pictures: int


# -- reading ---------------------------------------------------------------------------------------


def read_folder(folder: Path) -> Found:
    """Read a folder; every file in it is looked through.

    Raises:
        InvalidInputError: It is not there or holds nothing to import, or a file is not as it
            should be; the text names it and the line.
    """
    try:
        folder = folder.resolve(strict=True)
        return _read_folder(folder)
    except FileNotFoundError as error:
        raise InvalidInputError(
            f"{folder} cannot be imported: there is no such file or folder"
        ) from error
    except (OSError, RuntimeError) as error:  # a loop of links
        raise InvalidInputError(f"{folder} cannot be read: {error}") from error


def _read_folder(folder: Path) -> Found:
    digest = hashlib.sha256()
    texts = dict[str, bytes | None]()
    for name, most_bytes in ((STATUS, MAX_JSON_BYTES), (LOG, MAX_LOG_BYTES),
                             (COMMANDS, MAX_JSON_BYTES)):  # fmt: skip
        text = texts[name] = _bytes_of(folder / name, most_bytes)
        digest.update(name.encode() + text if text is not None else b"")
    states = list(_states_in(folder / STATUS, texts[STATUS]))
    near_s = states[0][0] if states else None
    lines = _lines_in(folder / LOG, texts[LOG], near_s)
    commands = list(_commands_in(folder / COMMANDS, texts[COMMANDS]))
    pictures = [
        _picture(kind, file)
        for kind, name in (("camera", CAMERA_FOLDER), ("screenshot", SCREENSHOT_FOLDER))
        for file in sorted((folder / name).glob("*.png"))
    ]
    if not (states or lines or commands or pictures):
        raise InvalidInputError(
            f"{folder} holds nothing to import: no {STATUS}, no {LOG}, no pictures in "
            f"{CAMERA_FOLDER}/ or {SCREENSHOT_FOLDER}/, no command in {COMMANDS}"
        )
    for picture in pictures:
        digest.update(f"{picture.file.name} {picture.size_bytes}".encode())
    return Found(states, lines, commands, pictures, digest.hexdigest())


def _bytes_of(file: Path, most_bytes: int) -> bytes | None:
    """What a file holds; None where there is none. A pipe or a device may never end."""
    if (size := _size_of(file)) is None:
        return None
    if size > most_bytes:
        raise InvalidInputError(f"{file} has {size:,} bytes, {most_bytes:,} is the limit")
    return file.read_bytes()


def _size_of(file: Path) -> int | None:
    try:
        status = file.stat()
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(status.st_mode):
        raise InvalidInputError(f"{file} is not a regular file: move it away and import the rest")
    return status.st_size


def _states_in(file: Path, text: bytes | None) -> Iterator[tuple[float, str, str | None]]:
    if text is None:
        return
    state = _parsed(file, text)
    if not isinstance(state, dict):
        raise InvalidInputError(f"{file}: a state is an object, this is a {type(state).__name__}")
    replaced: dict[str, str] = {}
    clean = _clean(cast("dict[str, Any]", state), (), replaced, file)
    moment_s = _moment(clean.get("timestamp"), file)
    yield moment_s, _encode(clean), _encode(replaced) if replaced else None


def _commands_in(file: Path, text: bytes | None) -> Iterator[tuple[float, str, str]]:
    content: Any = [] if text is None else _parsed(file, text)
    for command in cast("list[Any]", content if isinstance(content, list) else [content]):
        if not isinstance(command, dict) or "action" not in command:
            shown = repr(cast("object", command))[:_SHOWN]
            raise InvalidInputError(f"{file}: a command is an object with an action: {shown}")
        params: dict[str, Any] = _clean(command, (), {}, file)
        action, moment = str(params.pop("action")), params.pop("timestamp", None)
        if action != "none":  # what a bridge leaves where it took a command
            yield _moment(moment, file), action, _encode(params)


def _parsed(file: Path, text: bytes) -> Any:
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
    why = None
    if isinstance(value, dict):
        return {
            _clean(key, (*path, key), replaced, file): _clean(item, (*path, key), replaced, file)
            for key, item in cast("dict[str, Any]", value).items()
        }
    if isinstance(value, list):
        array = cast("list[Any]", value)
        return [_clean(item, (*path, str(i)), replaced, file) for i, item in enumerate(array)]
    if isinstance(value, str) and not is_text(value):
        value, why = _readable(value), "surrogate"
    elif isinstance(value, (int, float)) and (why := _no_number(value)):
        value = None
    if why:
        replaced[_readable(".".join(path))] = why
    return value


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


def _lines_in(file: Path, text: bytes | None, near_s: float | None) -> list[tuple[float, str]]:
    """The lines of a log; the last one is about as old as the newest state, or as the file."""
    entries = _entries(file, text or b"")
    if not entries:
        return []
    midnights, before, days = 0, entries[0][0], list[int]()
    for clock, _ in entries:
        midnights += clock < before  # the clock goes back once for each
        before = clock
        days.append(midnights)
    near_s = file.stat().st_mtime if near_s is None else near_s
    try:
        near = datetime.fromtimestamp(near_s).date()
        last_day = min((near + timedelta(days=offset) for offset in (0, -1, 1)),
                       key=lambda day: abs(_at(day, before) - near_s))  # fmt: skip
        first_day = last_day - timedelta(days=midnights)
        return [
            (_at(first_day + timedelta(days=day), clock), message)
            for day, (clock, message) in zip(days, entries, strict=True)
        ]
    except (OverflowError, ValueError) as error:
        raise InvalidInputError(
            f"{file}: its clock goes back {midnights:,} times, to before all calendars: {error}"
        ) from error


def _at(day: Any, clock: Clock) -> float:
    return datetime(day.year, day.month, day.day, *clock).timestamp()


def _entries(file: Path, text: bytes) -> list[tuple[Clock, str]]:
    """Clock time and message of each; lines without a time go on with the one before."""
    entries = list[tuple[Clock, list[str]]]()
    for number, line in enumerate(text.removesuffix(b"\n").split(b"\n"), 1):
        decoded = _decode(line)
        if stamp := _STAMP.fullmatch(decoded):
            hour, minute, second = map(int, stamp.groups()[:3])
            if hour > 23 or minute > 59 or second > 59:
                raise InvalidInputError(
                    f"{file}, line {number}: {stamp[0][:10]} is not a time of day"
                )
            entries.append(((hour, minute, second), [stamp[4]]))
        elif entries:
            entries[-1][1].append(decoded)
        elif decoded.strip():
            raise InvalidInputError(
                f"{file}, line {number}: expected '[HH:MM:SS] message', found {decoded[:60]!r}"
            )
    return [(clock, "\n".join(texts)) for clock, texts in entries]


def _decode(line: bytes) -> str:
    """UTF-8; a log that was written on Windows may be in its code page."""
    bare = line.rstrip(b"\r")
    try:
        text = bare.decode()
    except UnicodeDecodeError:
        text = bare.decode("cp1252", "replace")
    return text.replace("\0", "\\0")


def _picture(kind: str, file: Path) -> FoundPicture:
    if not is_text(file.name):
        raise InvalidInputError(f"the name of {str(file)!r} is not valid text: rename the file")
    size_bytes = _size_of(file) or 0
    try:
        with opened(file, ("PNG",)) as picture:
            picture.verify()
            return FoundPicture(file.stat().st_mtime, kind, file, *picture.size, size_bytes)
    except InvalidInputError as error:
        raise InvalidInputError(f"{error}: delete it and import the rest") from error


# -- writing ---------------------------------------------------------------------------------------


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
    found = read_folder(folder)
    with ExitStack() as taken_back:
        with transaction(connection):
            _require_new(connection, found, folder, robot)
            places = (folder.resolve(), data_dir.resolve())
            run_id = _write(connection, found, places, robot, progress, taken_back)
        taken_back.pop_all()  # it is whole: the copied pictures stay
    counts = map(len, (found.states, found.lines, found.commands, found.pictures))
    return Imported(robot, run_id, *counts)


def _require_new(connection: sqlite3.Connection, found: Found, folder: Path, robot: str) -> None:
    if before := connection.execute(_IMPORTED, (_instance(found),)).fetchone():
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


def _instance(found: Found) -> str:
    return f"import {found.fingerprint}"


def _write(
    connection: sqlite3.Connection,
    found: Found,
    places: tuple[Path, Path],
    robot: str,
    progress: Progress | None,
    taken_back: ExitStack,
) -> int:
    """A run of a robot of its own; returns its id."""
    folder, data_dir = places

    def insert(table: str, **values: Any) -> int:
        names, marks = ", ".join(values), ", ".join("?" * len(values))
        statement = f"INSERT INTO {table} ({names}) VALUES ({marks})"
        return connection.execute(statement, tuple(values.values())).lastrowid or 0

    all_of_it = (*found.states, *found.lines, *found.commands, *found.pictures)
    times_s = [each[0] for each in all_of_it]
    first_s, last_s = min(times_s), max(times_s)
    robot_id = insert("robot", name=robot, kind="Robot", first_seen_wall_time_s=first_s,
                      last_seen_wall_time_s=last_s)  # fmt: skip
    both = {"uuid": new_uuid(), "robot_id": robot_id, "started_wall_time_s": first_s,
            "ended_wall_time_s": last_s, "end_reason": "finished"}  # fmt: skip
    session_id = insert("session", **both, pid=0, host=socket.gethostname(), supervisor=0,
                        instance=_instance(found), last_seen_wall_time_s=last_s)  # fmt: skip
    both["uuid"] = new_uuid()
    run_id = insert("run", **both, session_id=session_id, start_reason="start",
                    started_sim_time_s=0.0, last_wall_time_s=last_s,
                    last_sim_time_s=last_s - first_s, row_count=len(found.states))  # fmt: skip

    def at(wall_s: float) -> dict[str, Any]:
        return {"run_id": run_id, "sim_time_s": wall_s - first_s, "wall_time_s": wall_s}

    about = json.dumps({"folder": str(folder), "note": _NOTE})
    insert("event", **at(first_s), kind="import", data=about)
    for wall_s, data, replaced in found.states:
        state_id = insert("state", **at(wall_s), data=data, replaced=replaced)
        columns = StateColumns()
        columns.add([(state_id, wall_s - first_s, wall_s, data, replaced)])
        enter_signals(connection, robot_id, seen_in(columns, columns.values))
    for wall_s, action, params in found.commands:
        insert("command", robot_id=robot_id, session_id=session_id, action=action, params=params,
               status="expired", created_wall_time_s=wall_s, expires_wall_time_s=wall_s,
               finished_wall_time_s=time.time(), error=_NOT_RUN)  # fmt: skip
    for picture in found.pictures:
        file = _copied(picture, _destination(picture, folder, data_dir, robot), taken_back)
        device = "camera" if picture.kind == "camera" else None
        path = file.relative_to(data_dir).as_posix()
        size = {"width": picture.width, "height": picture.height, "size_bytes": picture.size_bytes}
        insert("image", **at(picture.wall_time_s), kind=picture.kind, device=device, path=path,
               **size)  # fmt: skip

    def lines() -> Iterator[tuple[int, float, float, str]]:
        of = len(found.lines)
        for number, (wall_s, message) in enumerate(found.lines, 1):
            yield run_id, wall_s - first_s, wall_s, message
            if progress is not None and (number % _PROGRESS_LINES == 0 or number == of):
                progress(number, of)

    connection.executemany(_INSERT_LINE, lines())
    return run_id


def _destination(picture: FoundPicture, folder: Path, data_dir: Path, robot: str) -> Path:
    """Where a picture goes; it stays where it is if its folder is our own."""
    if folder == data_dir:
        return picture.file
    name = re.sub(r"[^\w-]", "_", robot)
    subfolder = CAMERA_FOLDER if picture.kind == "camera" else SCREENSHOT_FOLDER
    return data_dir / subfolder / name / picture.file.name


def _copied(picture: FoundPicture, file: Path, taken_back: ExitStack) -> Path:
    """The picture where it belongs; a file that was made for it goes again on an error."""
    if file == picture.file:
        return file
    if file.exists():
        raise InvalidInputError(f"{file} already exists: move it away first")
    taken_back.callback(file.unlink, missing_ok=True)
    try:
        make_folder(file.parent)
        shutil.copy2(picture.file, file)
        file.chmod(PRIVATE_FILE)
    except OSError as error:
        raise InvalidInputError(f"the pictures cannot be copied: {error}") from error
    return file
