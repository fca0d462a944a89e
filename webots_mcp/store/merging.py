"""Taking in another recording: its sessions and runs, told from those that are there by UUID.

Whatever is already there is left as it is, so merging may be repeated, and may be killed anywhere:
each session comes in one transaction. Rollups are not copied, but made anew from the rows.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from webots_mcp.adoption import adopt
from webots_mcp.connection import transaction
from webots_mcp.contract import make_folder
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.settlement import settle
from webots_mcp.store.images import inside
from webots_mcp.store.recording import Recording
from webots_mcp.store.trials import fetch_trial_set, is_at_work

_SESSIONS: Final = "SELECT id, uuid, robot_id FROM source.session ORDER BY id"
_UNFIT: Final = (
    "SELECT (SELECT count(*) FROM source.session WHERE ended_wall_time_s IS NULL), "
    "(SELECT count(*) FROM source.run WHERE purged_rows > 0)"
)
_OF_RUN: Final = ("state", "kept_stretch", "kept_state", "log", "event", "parameter_value")
_BUSY: Final = (
    "SELECT EXISTS (SELECT 1 FROM main.session s JOIN main.robot b ON b.id = s.robot_id "
    "WHERE b.name = ? AND s.ended_wall_time_s IS NULL)"
)
_SET_BY: Final = (
    "SELECT id, command_id FROM main.parameter_value WHERE run_id = ? AND command_id IS NOT NULL"
)
_TRIAL_SETS: Final = "SELECT id, uuid FROM source.trial_set ORDER BY id"
_TRIALS: Final = (
    "SELECT t.id, t.uuid, n.id FROM source.trial t LEFT JOIN source.run r ON r.id = t.run_id "
    "LEFT JOIN main.run n ON n.uuid = r.uuid WHERE t.trial_set_id = ? ORDER BY t.id"
)
# A trial that waits here and is over there: the set was gone on with in a copy of the recording.
_RESULT: Final = ", ".join(
    ("status", "score", "ended_by", "ended_sim_time_s", "error", "started_wall_time_s",
     "finished_wall_time_s")
)  # fmt: skip
_TAKE_RESULT: Final = (
    f"UPDATE main.trial SET ({_RESULT}, run_id, pid, process) = (SELECT {_RESULT}, ?, NULL, NULL "
    "FROM source.trial WHERE id = ?) WHERE uuid = ? AND finished_wall_time_s IS NULL "
    "AND (SELECT finished_wall_time_s FROM source.trial WHERE id = ?) IS NOT NULL"
)
_RUNS: Final = (
    "SELECT n.uuid, n.id FROM source.run r JOIN main.run n ON n.uuid = r.uuid ORDER BY r.id"
)


def merge(connection: sqlite3.Connection, data_dir: Path, source: Path) -> dict[str, int]:
    """Take in all sessions of a recording that is over, and its trial sets.

    Args:
        connection: In the role "writer".
        data_dir: The folder of the pictures.
        source: The other database, of the same schema; its pictures lie beside it.

    Returns:
        By their UUIDs, the ids that its runs have here.

    Raises:
        InvalidInputError: A controller still records there, or rows were purged, of which the
            rollups would be lost.
    """
    with _attached(connection, source):
        _require_fit(connection, source)
        sessions = connection.execute(_SESSIONS).fetchall()
        for session_id, uuid, robot_id in sessions:
            if _id_of(connection, "session", uuid) is None:
                _copy_pictures(connection, data_dir, source.parent, session_id)
                with transaction(connection):
                    _take_in(connection, session_id, robot_id)
        with transaction(connection):
            _take_in_trials(connection)
        return dict(connection.execute(_RUNS).fetchall())


def settled(database: Path) -> Recording:
    """A recording with all that waited beside it, and its sessions ended that are over.

    Raises:
        DatabaseError: There is none, or it is none of ours.
    """
    recording = Recording(database, database.parent)
    with recording.writer() as connection:
        adopt(connection, database)
        settle(connection, time.time())
    return recording


@contextmanager
def _attached(connection: sqlite3.Connection, source: Path) -> Generator[None]:
    connection.execute("ATTACH DATABASE ? AS source", (str(source),))
    try:
        yield
    finally:
        connection.execute("DETACH DATABASE source")


def _require_fit(connection: sqlite3.Connection, source: Path) -> None:
    versions = [
        connection.execute(f"PRAGMA {name}.user_version").fetchone()[0]
        for name in ("main", "source")
    ]
    if versions[0] != versions[1]:
        raise InvalidInputError(f"{source} has another schema: run 'webots-mcp migrate' on it")
    recording, purged = connection.execute(_UNFIT).fetchone()
    if recording:
        raise InvalidInputError(f"a controller still records in {source}: merge it when it is over")
    if purged:
        raise InvalidInputError(f"{source} has purged rows: of them only rollups are left")


def _take_in(connection: sqlite3.Connection, session_id: int, robot_id: int) -> None:
    owner = {"robot_id": _robot(connection, robot_id)}
    new = _insert(connection, "session", "id = ?", session_id, owner)
    commands = _copy_commands(connection, session_id, owner | {"session_id": new})
    own = owner | {"session_id": new, "rolled_state_id": 0, "coarse_end": None}
    runs = connection.execute(
        "SELECT id, uuid FROM source.run WHERE session_id = ? ORDER BY id", (session_id,)
    ).fetchall()
    for run_id, uuid in runs:
        run = _insert(connection, "run", "id = ?", run_id, own)
        for table in _OF_RUN:
            _insert(connection, table, "run_id = ?", run_id, {"run_id": run})
        _copy_image_rows(connection, run_id, run, uuid)
        set_by = connection.execute(_SET_BY, (run,)).fetchall()
        renamed = [(commands.get(command_id), value_id) for value_id, command_id in set_by]
        connection.executemany("UPDATE parameter_value SET command_id = ? WHERE id = ?", renamed)
    _insert(connection, "parameter", "session_id = ?", session_id, owner | {"session_id": new})


def _take_in_trials(connection: sqlite3.Connection) -> None:
    """Trial sets and trials that are not there, each with its run as it is called here.

    Nobody works on them here: their simulators and the parameters of their controllers are gone.
    Trials of a set that is here as well keep their results; those that wait take the ones from
    there, unless a process is about to run them.
    """
    gone: dict[str, Any] = dict.fromkeys(
        ("host", "pid", "process", "robot_id", "session_id", "former_values")
    )
    for set_id, uuid in connection.execute(_TRIAL_SETS).fetchall():
        here = _id_of(connection, "trial_set", uuid)
        if here is None:
            here = _insert(connection, "trial_set", "id = ?", set_id, gone)
        for trial_id, trial_uuid, run_id in connection.execute(_TRIALS, (set_id,)).fetchall():
            if _id_of(connection, "trial", trial_uuid) is None:
                own = {"trial_set_id": here, "run_id": run_id, "pid": None, "process": None}
                _insert(connection, "trial", "id = ?", trial_id, own)
            elif not is_at_work(connection, fetch_trial_set(connection, here)):
                connection.execute(_TAKE_RESULT, (run_id, trial_id, trial_uuid, trial_id))


def _robot(connection: sqlite3.Connection, robot_id: int) -> int:
    """The robot of that name here; where one records just now, the next name as bridges take it."""
    row = connection.execute("SELECT name FROM source.robot WHERE id = ?", (robot_id,)).fetchone()
    name, number = str(row[0]), 1
    while connection.execute(_BUSY, (name,)).fetchone()[0]:
        number += 1
        name = f"{row[0]}#{number}"
    known = connection.execute("SELECT id FROM main.robot WHERE name = ?", (name,)).fetchone()
    if known:
        return int(known[0])
    return _insert(connection, "robot", "id = ?", robot_id, {"name": name})


def _copy_commands(
    connection: sqlite3.Connection, session_id: int, own: dict[str, Any]
) -> dict[int, int]:
    """By their ids there, the ids that the commands have here; a key that is taken stays theirs."""
    found = connection.execute(
        "SELECT id FROM source.command WHERE session_id = ? ORDER BY id", (session_id,)
    ).fetchall()
    own = own | {"idempotency_key": None}
    return {old: _insert(connection, "command", "id = ?", old, own) for (old,) in found}


def _insert(
    connection: sqlite3.Connection, table: str, where: str, key: int, own: dict[str, Any]
) -> int:
    """Copy rows, with values of their own in some columns; returns the id of the last one."""
    listed = connection.execute("SELECT name FROM pragma_table_info(?)", (table,)).fetchall()
    columns = [name for (name,) in listed if name != "id"]
    values = ", ".join("?" if name in own else name for name in columns)
    given = [own[name] for name in columns if name in own]
    insert = "INSERT OR IGNORE" if table == "parameter" else "INSERT"  # as it is declared here
    cursor = connection.execute(
        f"{insert} INTO main.{table} ({', '.join(columns)}) "
        f"SELECT {values} FROM source.{table} WHERE {where} ORDER BY id",
        (*given, key),
    )
    return cursor.lastrowid or 0


def _id_of(connection: sqlite3.Connection, table: str, uuid: str) -> int | None:
    row = connection.execute(f"SELECT id FROM main.{table} WHERE uuid = ?", (uuid,)).fetchone()
    return int(row[0]) if row else None


def _images(connection: sqlite3.Connection, where: str, key: int) -> list[tuple[int, str, str]]:
    return connection.execute(
        "SELECT i.id, i.path, r.uuid FROM source.image i JOIN source.run r ON r.id = i.run_id "
        f"WHERE {where} ORDER BY i.id",
        (key,),
    ).fetchall()


def _path_here(path: str, run_uuid: str) -> str:
    """Under another name than any that a bridge gives."""
    folder, _, name = path.rpartition("/")
    return f"{folder}/{run_uuid}.{name}"


def _copy_pictures(
    connection: sqlite3.Connection, data_dir: Path, source_dir: Path, session_id: int
) -> None:
    """Before their rows come: whoever is killed in between copies them once more."""
    for _, path, run_uuid in _images(connection, "r.session_id = ?", session_id):
        try:
            file = inside(source_dir, path)
        except NothingRecordedError:
            continue  # deleted since: its row stays as it was there, and says so when asked
        target = data_dir / _path_here(path, run_uuid)
        make_folder(target.parent)
        aside = target.with_suffix(".part")
        shutil.copyfile(file, aside)
        os.replace(aside, target)  # noqa: PTH105


def _copy_image_rows(connection: sqlite3.Connection, run_id: int, run: int, run_uuid: str) -> None:
    for image_id, path, _ in _images(connection, "r.id = ?", run_id):
        own = {"run_id": run, "path": _path_here(path, run_uuid)}
        _insert(connection, "image", "id = ?", image_id, own)
