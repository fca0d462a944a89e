"""Taking in another recording: its sessions and runs, distinguished from existing ones by UUID.

Whatever is already there is left as it is, so merging may be repeated, and may be killed anywhere:
what is new of a session comes in one transaction. Chunks are made anew from the rows; those of a
run that has lost rows come as they are. A bundle is made the same way: an empty recording takes in
one run.
"""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from webots_mcp.contract import make_folder, whole_file
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.liveness import reap
from webots_mcp.schema import require_shipped
from webots_mcp.store.chunks.merged_run import take_in_chunks
from webots_mcp.store.images import PICTURES, inside
from webots_mcp.store.recording import Recording
from webots_mcp.store.trials import fetch_trial_set, is_at_work
from webots_mcp.transactions import transaction
from webots_mcp.waiting_file import adopt

_SESSIONS: Final = (
    "SELECT id, uuid, robot_id FROM source.session s WHERE :run IS NULL "
    "OR id = (SELECT session_id FROM source.run WHERE id = :run) ORDER BY id"
)
_NEW_RUNS: Final = (
    "SELECT id, uuid FROM source.run r WHERE session_id = :session AND (:run IS NULL OR id = :run) "
    "AND NOT EXISTS (SELECT 1 FROM main.run n WHERE n.uuid = r.uuid) ORDER BY id"
)
_UNFIT: Final = (
    "SELECT CASE WHEN :run IS NULL THEN "
    "(SELECT count(*) FROM source.session WHERE ended_wall_time_s IS NULL) ELSE "
    "(SELECT ended_wall_time_s IS NULL FROM source.run WHERE id = :run) END, "
    "(SELECT count(*) FROM source.run WHERE uuid IS NULL AND id = :run)"
)
# Those of one run: what its parameters were set by, and what was claimed while it went on.
_COMMANDS: Final = (
    "SELECT id, created_wall_time_s, action, params FROM source.command c "
    "WHERE session_id = :session AND (:run IS NULL "
    "OR id IN (SELECT command_id FROM source.parameter_value WHERE run_id = :run) "
    "OR EXISTS (SELECT 1 FROM source.run r WHERE r.id = :run "
    "AND coalesce(c.claimed_wall_time_s, c.created_wall_time_s) >= r.started_wall_time_s "
    "AND coalesce(c.claimed_wall_time_s, c.created_wall_time_s) < coalesce((SELECT "
    "min(n.started_wall_time_s) FROM source.run n WHERE n.robot_id = r.robot_id AND n.id > r.id), "
    "9e99))) ORDER BY id"
)
_SAME_COMMAND: Final = (
    "SELECT id FROM main.command WHERE session_id = ? AND created_wall_time_s = ? AND action = ? "
    "AND params = ?"
)
_IS_PURGED: Final = "SELECT purged_rows > 0 FROM main.run WHERE id = ?"
_OF_RUN: Final = ("kept_stretch", "kept_state", "log", "event", "parameter_value")
_BUSY: Final = (
    "SELECT EXISTS (SELECT 1 FROM main.session s JOIN main.robot b ON b.id = s.robot_id "
    "WHERE b.name = ? AND s.ended_wall_time_s IS NULL)"
)
_ROBOT_OF: Final = "SELECT robot_id FROM main.session WHERE id = ?"
_SET_BY: Final = (
    "SELECT id, command_id FROM main.parameter_value WHERE run_id = ? AND command_id IS NOT NULL"
)
_TRIAL_SETS: Final = (
    "SELECT id, uuid FROM source.trial_set s WHERE :run IS NULL "
    "OR EXISTS (SELECT 1 FROM source.trial WHERE trial_set_id = s.id AND run_id = :run) ORDER BY id"
)
_TRIALS: Final = (
    "SELECT t.id, t.uuid, n.id FROM source.trial t LEFT JOIN source.run r ON r.id = t.run_id "
    "LEFT JOIN main.run n ON n.uuid = r.uuid WHERE t.trial_set_id = :set "
    "AND (:run IS NULL OR t.run_id = :run) ORDER BY t.id"
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


def merge(
    connection: sqlite3.Connection,
    data_dir: Path,
    source: Path,
    *,
    run_id: int | None = None,
    address: str | None = None,
    pictures: Path | None = None,
) -> dict[str, int]:
    """Take in all sessions of a recording that is over, and its trial sets; or one run of it.

    Args:
        connection: In the role "writer".
        data_dir: The folder of the pictures.
        source: The other database, of the same schema.
        run_id: Only this run, which has to be over, with its session, commands and trials.
        address: How SQLite is to open it, where its path is not enough.
        pictures: The folder of its pictures; None for the one that it lies in.

    Returns:
        By their UUIDs, the ids that its runs have here.

    Raises:
        InvalidInputError: A controller still records there, or what is there is damaged.
    """
    with _attached(connection, address or str(source)):
        _require_fit(connection, source, run_id)
        for session_id, uuid, robot_id in connection.execute(_SESSIONS, {"run": run_id}).fetchall():
            wanted = {"session": session_id, "run": run_id}
            runs = connection.execute(_NEW_RUNS, wanted).fetchall()
            if not runs and _id_of(connection, "session", uuid) is not None:
                continue
            for run, run_uuid in runs:
                _copy_pictures(connection, data_dir, pictures or source.parent, run, run_uuid)
            with transaction(connection):
                _take_in(connection, wanted, uuid, robot_id, runs)
        with transaction(connection):
            _take_in_trials(connection, run_id)
        return dict(connection.execute(_RUNS).fetchall())


def settled(database: Path) -> Recording:
    """A recording with all rows that waited next to it, and its sessions ended that are over.

    Raises:
        DatabaseError: There is none, or it is none of ours.
    """
    recording = Recording(database, database.parent)
    with recording.writer() as connection:
        adopt(connection, database)
        reap(connection, time.time())
    return recording


@contextmanager
def _attached(connection: sqlite3.Connection, address: str) -> Generator[None]:
    connection.execute("ATTACH DATABASE ? AS source", (address,))
    try:
        yield
    finally:
        connection.execute("DETACH DATABASE source")


def _require_fit(connection: sqlite3.Connection, source: Path, run_id: int | None) -> None:
    versions = [
        connection.execute(f"PRAGMA {name}.user_version").fetchone()[0]
        for name in ("main", "source")
    ]
    if versions[0] != versions[1]:
        raise InvalidInputError(
            f"{source} has schema {versions[1]}, this webots-mcp needs {versions[0]}"
        )
    require_shipped(connection, schema="source")
    recording, nameless = connection.execute(_UNFIT, {"run": run_id}).fetchone()
    subject = f"{source}" if run_id is None else f"run {run_id}"
    if recording:
        where = subject if run_id else f"in {subject}"
        raise InvalidInputError(f"a controller still records {where}: merge it when that has ended")
    if nameless:
        raise InvalidInputError(
            f"{subject} has no UUID, so it is unknown whether it was merged before"
        )


def _take_in(
    connection: sqlite3.Connection,
    wanted: dict[str, int | None],
    uuid: str,
    robot_id: int,
    runs: list[tuple[int, str]],
) -> None:
    """A session, unless it is here, and those of its runs that are not."""
    session_id = wanted["session"] or 0
    here = _id_of(connection, "session", uuid)
    is_new = here is None
    if here is None:
        owner = {"robot_id": _robot(connection, robot_id)}
        here = _insert(connection, "session", "id = ?", session_id, owner)
    else:
        owner = {"robot_id": connection.execute(_ROBOT_OF, (here,)).fetchone()[0]}
    commands = _copy_commands(connection, wanted, owner | {"session_id": here}, is_new=is_new)
    own = owner | {"session_id": here, "is_chunked": 0}
    for run_id, run_uuid in runs:
        run = _insert(connection, "run", "id = ?", run_id, own)
        _copy_states(connection, run_id, run, owner["robot_id"])
        for table in _OF_RUN:
            _insert(connection, table, "run_id = ?", run_id, {"run_id": run})
        _copy_image_rows(connection, run_id, run, run_uuid)
        set_by = connection.execute(_SET_BY, (run,)).fetchall()
        renamed = [(commands.get(command_id), value_id) for value_id, command_id in set_by]
        connection.executemany("UPDATE parameter_value SET command_id = ? WHERE id = ?", renamed)
    if is_new:
        _insert(connection, "parameter", "session_id = ?", session_id, owner | {"session_id": here})


def _take_in_trials(connection: sqlite3.Connection, run_id: int | None) -> None:
    """Trial sets and trials that are not there, each with its run as it is called here.

    No process works on them here: their simulators and controllers have ended.
    Trials of a set that is here as well keep their results; those that wait take the ones from
    there, unless a process is about to run them.
    """
    gone: dict[str, Any] = dict.fromkeys(
        ("host", "pid", "process", "robot_id", "session_id", "former_values")
    )
    for set_id, uuid in connection.execute(_TRIAL_SETS, {"run": run_id}).fetchall():
        here = _id_of(connection, "trial_set", uuid)
        if here is None:
            here = _insert(connection, "trial_set", "id = ?", set_id, gone)
        asked = {"set": set_id, "run": run_id}
        for trial_id, trial_uuid, run in connection.execute(_TRIALS, asked).fetchall():
            if _id_of(connection, "trial", trial_uuid) is None:
                own = {"trial_set_id": here, "run_id": run, "pid": None, "process": None}
                _insert(connection, "trial", "id = ?", trial_id, own)
            elif not is_at_work(connection, fetch_trial_set(connection, here)):
                connection.execute(_TAKE_RESULT, (run, trial_id, trial_uuid, trial_id))


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
    connection: sqlite3.Connection,
    wanted: dict[str, int | None],
    own: dict[str, Any],
    *,
    is_new: bool,
) -> dict[int, int]:
    """By their ids there, the ids that the commands have here; a key that is taken stays theirs."""
    own = own | {"idempotency_key": None}
    ids: dict[int, int] = {}
    for old, *facts in connection.execute(_COMMANDS, wanted).fetchall():
        same = None
        if not is_new:
            same = connection.execute(_SAME_COMMAND, (own["session_id"], *facts)).fetchone()
        ids[old] = same[0] if same else _insert(connection, "command", "id = ?", old, own)
    return ids


def _copy_states(connection: sqlite3.Connection, run_id: int, run: int, robot_id: int) -> None:
    """The rows; where some are gone, with the chunks of all."""
    (is_purged,) = connection.execute(_IS_PURGED, (run,)).fetchone()
    shift = None
    if is_purged:
        shift = take_in_chunks(connection, run_id, run, robot_id)
    _insert(connection, "state", "run_id = ?", run_id, {"run_id": run}, shift)


def _insert(
    connection: sqlite3.Connection,
    table: str,
    where: str,
    key: int,
    own: dict[str, Any],
    shift: int | None = None,
) -> int:
    """Copy rows, with values of their own in some columns.

    Their ids are new ones, or those from there and so much more; returns that of the last one.
    """
    listed = connection.execute("SELECT name FROM pragma_table_info(?)", (table,)).fetchall()
    columns = [name for (name,) in listed if name != "id" or shift is not None]
    named = {"id": f"id + {shift}"} | dict.fromkeys(own, "?")
    values = ", ".join(named.get(name, name) for name in columns)
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
    """Under another name than any that a bridge gives; one that was taken in before keeps it."""
    folder, _, name = path.rpartition("/")
    return path if name.startswith(f"{run_uuid}.") else f"{folder}/{run_uuid}.{name}"


def _copy_pictures(
    connection: sqlite3.Connection, data_dir: Path, source_dir: Path, run_id: int, run_uuid: str
) -> None:
    """Before their rows come: after a kill in between, the next attempt copies the missing ones.

    The other recording says how its pictures are called, which may be a lie: only pictures are
    taken, into this folder, and in no other file's place.
    """
    for _, path, _ in _images(connection, "r.id = ?", run_id):
        try:
            file = inside(source_dir, path)
        except NothingRecordedError:
            continue  # deleted since: its row stays as it was there, and says so when asked
        target = data_dir / _path_here(path, run_uuid)
        if not target.resolve().is_relative_to(data_dir.resolve()):
            raise InvalidInputError(f"{path!r} lies outside the data folder and is not copied")
        if target.suffix.lower() not in PICTURES:
            raise InvalidInputError(f"{path!r} is not the name of a picture and is not copied")
        if target.exists():
            continue  # a whole one, from an import that was killed
        make_folder(target.parent)
        with whole_file(target) as aside:
            shutil.copyfile(file, aside)


def _copy_image_rows(connection: sqlite3.Connection, run_id: int, run: int, run_uuid: str) -> None:
    for image_id, path, _ in _images(connection, "r.id = ?", run_id):
        own = {"run_id": run, "path": _path_here(path, run_uuid)}
        _insert(connection, "image", "id = ?", image_id, own)
