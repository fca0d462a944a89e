"""A folder becomes a run of a robot of its own: all of it, or nothing."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
import socket
import sqlite3
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import (
    CAMERA_FOLDER,
    PRIVATE_FILE,
    SCREENSHOT_FOLDER,
    make_folder,
    new_uuid,
)
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.chunks.columns import StateColumns
from webots_mcp.store.json_folder.folder_reading import (
    COMMANDS,
    LOG,
    STATUS,
    Found,
    FoundLog,
    FoundPicture,
    is_text,
    is_there,
    read_folder,
)
from webots_mcp.store.signals import enter_signals, seen_in
from webots_mcp.transactions import transaction

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
