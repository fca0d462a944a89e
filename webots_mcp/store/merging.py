"""Merge another recording: its sessions and runs, which UUIDs distinguish from existing ones.

Existing rows stay unchanged, so merging can be repeated and can be killed at any moment: what is
new of a session arrives in one transaction. Chunks are made anew from the rows; those of a run that
has lost rows are copied. A bundle is made the same way: an empty recording merges one run.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import time
import zipfile
import zlib
from collections.abc import Generator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final, get_args

from webots_mcp.contract import DATABASE_NAME, REMOTE_SILENCE_S, host_name
from webots_mcp.database.connection import FrozenConnection, connect
from webots_mcp.database.files import PRIVATE_FILE, make_folder, whole_file
from webots_mcp.database.schema import create_schema, require_shipped
from webots_mcp.database.session_cleanup import end_session, reap
from webots_mcp.database.tapes.tape import (
    MAX_TAPE_BYTES,
    TAPE_ENDING,
    is_tape,
    tape_file,
    tape_files,
)
from webots_mcp.database.transactions import transaction
from webots_mcp.database.waiting_file import adopt
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.signals.meaning import MEANING_FIELDS
from webots_mcp.signals.register import Kind, Seen
from webots_mcp.store.chunks import (
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    DamagedChunkError,
    EncodedChunk,
    Statistics,
    decode,
    decoded_of,
    encode,
    statistics_of,
)
from webots_mcp.store.export import Progress
from webots_mcp.store.journal_intake import ingest_journals
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.registered_signals import enter_signals
from webots_mcp.store.run_rows import MAX_FILE_BYTES, PICTURES, inside
from webots_mcp.store.trial_sets import fetch_trial_set, is_at_work

# A run brings the rows of its time, and the commands that were sent for its session.
_NEW_REQUESTS: Final = (
    "SELECT id FROM source.request s WHERE NOT EXISTS (SELECT 1 FROM main.request n "
    "WHERE n.uuid = s.uuid) AND (:run IS NULL OR run_id = :run OR id IN (SELECT request_id FROM "
    "source.command WHERE session_id = (SELECT session_id FROM source.run WHERE id = :run))) "
    "ORDER BY id"
)
_OF_MEANING: Final = ", ".join(
    ("name", "source", *MEANING_FIELDS, "set_wall_time_s", "set_by", "why")
)
# A trial that waits here and is over there: the set was continued in a copy of the recording.
_RESULT: Final = ", ".join(
    ("status", "score", "ended_by", "ended_sim_time_s", "error", "started_wall_time_s",
     "finished_wall_time_s")
)  # fmt: skip
_LINK: Final = 0o120000  # mask of the file type in Unix, as archives store it
END_SESSIONS: Final = (  # with the last of their runs that is here
    "UPDATE session SET ended_wall_time_s = (SELECT max(ended_wall_time_s) FROM run "
    "WHERE session_id = session.id), end_reason = 'finished' WHERE ended_wall_time_s IS NULL"
)
_DAMAGED: Final = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)
_NEWEST_HERE: Final = "SELECT coalesce(max(id), 0) FROM main.state"
_RESERVED_HERE: Final = "SELECT coalesce(max(reserved_state_id), 0) FROM main.recording"
_GROUP: Final = (
    "start_sim_time_s, end_sim_time_s, row_count, stored_row_count, lost_value_count, "
    "stored_row_bytes, chunk_bytes, "
    "is_complete"
)
_PACKED: Final = "codec, numbers, codes, labels"
_VALUES: Final = f"{', '.join(Statistics._fields)}, {_PACKED}"


@dataclass(frozen=True)
class BundleLimits:
    """Limits of what is unpacked and copied; an archive beyond them is hostile.

    Attributes:
        piece_bytes: Bytes that are copied at a time.
        times: Factor by which an archive may grow; identical rows shrink to a fiftieth of their
            size.
        harmless_bytes: Size up to which any archive is unpacked.
        ids: Maximum distance between the first and last row id of a run; a real recording has no
            more.
    """

    piece_bytes: int = 1_000_000
    times: int = 100
    harmless_bytes: int = 100_000_000
    ids: int = 2**40


_BUNDLE: Final = BundleLimits()


def merge(
    connection: sqlite3.Connection,
    data_dir: Path,
    source: Path,
    *,
    run_id: int | None = None,
    address: str | None = None,
    pictures: Path | None = None,
    is_export: bool = False,
) -> dict[str, int]:
    """Merge all sessions of an ended recording and its trial sets, or one run of it.

    Args:
        connection: A connection in the role "writer".
        data_dir: The folder of the pictures.
        source: The other database, of the same schema.
        run_id: Only this run, which must be over, with its session, commands and trials.
        address: How SQLite opens the source, if its path is not enough.
        pictures: The folder of its pictures; None for the folder of the database.
        is_export: Whether the result is a bundle of this recording, so that nothing comes from
            elsewhere.

    Returns:
        The ids of its runs in this recording, by their UUIDs.

    Raises:
        InvalidInputError: A controller still records there, or the source is damaged.
    """
    with _attached(connection, address or str(source)):
        _require_fit(connection, source, run_id)
        with transaction(connection):
            for (request_id,) in connection.execute(_NEW_REQUESTS, {"run": run_id}).fetchall():
                _insert(connection, "request", "id = ?", request_id, {"run_id": None})
        for session_id, uuid, robot_id in connection.execute(
            "SELECT id, uuid, robot_id FROM source.session s WHERE :run IS NULL "
            "OR id = (SELECT session_id FROM source.run WHERE id = :run) ORDER BY id",
            {"run": run_id},
        ).fetchall():
            wanted = {"session": session_id, "run": run_id}
            runs = connection.execute(
                "SELECT id, uuid FROM source.run r WHERE session_id = :session AND (:run IS NULL "
                "OR id = :run) AND NOT EXISTS (SELECT 1 FROM main.run n WHERE n.uuid = r.uuid) "
                "ORDER BY id",
                wanted,
            ).fetchall()
            if not runs and _id_of(connection, "session", uuid) is not None:
                continue
            for run, run_uuid in runs:
                _copy_pictures(connection, data_dir, pictures or source.parent, run, run_uuid)
            _copy_tape(data_dir, pictures or source.parent, str(uuid), imported=not is_export)
            with transaction(connection):
                _ingest_run_rows(connection, wanted, uuid, robot_id, runs)
        with transaction(connection):
            query = (
                "UPDATE main.request SET run_id = (SELECT n.id FROM source.request s "
                "JOIN source.run r ON r.id = s.run_id JOIN main.run n ON n.uuid = r.uuid "
                "WHERE s.uuid = request.uuid) WHERE run_id IS NULL AND uuid IN (SELECT uuid "
                "FROM source.request)"
            )
            connection.execute(query)
            _ingest_trials(connection, run_id)
        return dict(
            connection.execute(
                "SELECT n.uuid, n.id FROM source.run r JOIN main.run n ON n.uuid = r.uuid "
                "ORDER BY r.id"
            ).fetchall()
        )


def settled(database: Path) -> RecordingAccess:
    """Copy a recording with all rows that waited next to it, and end the sessions that are over.

    A session of another host is over when its last heartbeat is more than 10 s old.

    Raises:
        DatabaseError: The recording does not exist or has another format.
    """
    recording = RecordingAccess(database, database.parent)
    with recording.writer() as connection:
        adopt(connection, database)
        ingest_journals(connection, database)
        now_s = time.time()
        # processes of another host cannot be queried
        silent = (host_name(), now_s - REMOTE_SILENCE_S)
        for (session_id,) in connection.execute(
            "SELECT id FROM session WHERE ended_wall_time_s IS NULL AND host IS NOT ? "
            "AND last_seen_wall_time_s < ?",
            silent,
        ).fetchall():
            end_session(connection, session_id, "crashed")
        reap(connection, now_s)
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
            f"{source} has schema {versions[1]}, but this webots-mcp needs {versions[0]}"
        )
    require_shipped(connection, schema="source")
    recording, nameless = connection.execute(
        "SELECT CASE WHEN :run IS NULL THEN "
        "(SELECT count(*) FROM source.session WHERE ended_wall_time_s IS NULL) ELSE "
        "(SELECT ended_wall_time_s IS NULL FROM source.run WHERE id = :run) END, "
        "(SELECT count(*) FROM source.run WHERE uuid IS NULL AND id = :run)",
        {"run": run_id},
    ).fetchone()
    subject = f"{source}" if run_id is None else f"run {run_id}"
    if recording:
        where = subject if run_id else f"in {subject}"
        raise InvalidInputError(
            f"A controller still records {where}. Merge it after that has ended."
        )
    if nameless:
        raise InvalidInputError(
            f"{subject} has no UUID, so it is unknown whether it was merged before"
        )


def _ingest_run_rows(
    connection: sqlite3.Connection,
    wanted: dict[str, int | None],
    uuid: str,
    robot_id: int,
    runs: list[tuple[int, str]],
) -> None:
    """Copy a session, unless it is here already, and those of its runs that are not."""
    session_id = wanted["session"] or 0
    here = _id_of(connection, "session", uuid)
    is_new = here is None
    if here is None:
        owner = {"robot_id": _robot(connection, robot_id)}
        here = _insert(connection, "session", "id = ?", session_id, owner)
    else:
        owner = {
            "robot_id": connection.execute(
                "SELECT robot_id FROM main.session WHERE id = ?", (here,)
            ).fetchone()[0]
        }
    commands = _copy_commands(connection, wanted, owner | {"session_id": here}, is_new=is_new)
    own = owner | {"session_id": here, "is_chunked": 0}
    for run_id, run_uuid in runs:
        run = _insert(connection, "run", "id = ?", run_id, own)
        _copy_states(connection, run_id, run, owner["robot_id"])
        for table in ("kept_stretch", "kept_state", "log", "event", "parameter_value"):
            _insert(connection, table, "run_id = ?", run_id, {"run_id": run})
        _copy_image_rows(connection, run_id, run, run_uuid)
        set_by = connection.execute(
            "SELECT id, command_id FROM main.parameter_value WHERE run_id = ? "
            "AND command_id IS NOT NULL",
            (run,),
        ).fetchall()
        renamed = [(commands.get(command_id), value_id) for value_id, command_id in set_by]
        connection.executemany("UPDATE parameter_value SET command_id = ? WHERE id = ?", renamed)
    _copy_meanings(connection, robot_id, owner["robot_id"])
    if is_new:
        _insert(connection, "parameter", "session_id = ?", session_id, owner | {"session_id": here})


def _copy_meanings(connection: sqlite3.Connection, there: int, here: int) -> None:
    """Copy what is declared of a robot's signals, unless the same source declared something here.

    What the project file of the other recording declares becomes a declaration for this robot
    alone, because this recording has another file.
    """
    # Of two meanings, that of the robot itself is used.
    connection.execute(
        f"INSERT OR IGNORE INTO main.meaning (robot_id, {_OF_MEANING}) "
        f"SELECT :here, {_OF_MEANING} FROM source.meaning WHERE robot_id = :there "
        "OR (robot_id IS NULL AND robot_name IN ('*', (SELECT name FROM source.robot "
        "WHERE id = :there))) ORDER BY robot_name IS NULL DESC, robot_name = '*', id",
        {"there": there, "here": here},
    )


def _ingest_trials(connection: sqlite3.Connection, run_id: int | None) -> None:
    """Copy trial sets and trials that are missing here, each with the id that its run has here.

    No process works on them here: their simulators and controllers have ended. Trials of a set that
    exists here keep their results. Waiting ones take the results of the other recording, unless a
    process is about to run them.
    """
    missing: dict[str, Any] = dict.fromkeys(
        ("host", "pid", "process", "robot_id", "session_id", "former_values")
    )
    for set_id, uuid in connection.execute(
        "SELECT id, uuid FROM source.trial_set s WHERE :run IS NULL OR EXISTS (SELECT 1 "
        "FROM source.trial WHERE trial_set_id = s.id AND run_id = :run) ORDER BY id",
        {"run": run_id},
    ).fetchall():
        here = _id_of(connection, "trial_set", uuid)
        if here is None:
            here = _insert(connection, "trial_set", "id = ?", set_id, missing)
        asked = {"set": set_id, "run": run_id}
        for trial_id, trial_uuid, run in connection.execute(
            "SELECT t.id, t.uuid, n.id FROM source.trial t LEFT "
            "JOIN source.run r ON r.id = t.run_id LEFT JOIN main.run n ON n.uuid = r.uuid "
            "WHERE t.trial_set_id = :set AND (:run IS NULL OR t.run_id = :run) ORDER BY t.id",
            asked,
        ).fetchall():
            if _id_of(connection, "trial", trial_uuid) is None:
                own = {"trial_set_id": here, "run_id": run, "pid": None, "process": None}
                _insert(connection, "trial", "id = ?", trial_id, own)
            elif not is_at_work(connection, fetch_trial_set(connection, here)):
                connection.execute(
                    "UPDATE main.trial "
                    f"SET ({_RESULT}, run_id, pid, process) = (SELECT {_RESULT}, ?, NULL, NULL "
                    "FROM source.trial WHERE id = ?) WHERE uuid = ? "
                    "AND finished_wall_time_s IS NULL AND (SELECT finished_wall_time_s "
                    "FROM source.trial WHERE id = ?) IS NOT NULL",
                    (run, trial_id, trial_uuid, trial_id),
                )


def _robot(connection: sqlite3.Connection, robot_id: int) -> int:
    """Return the robot of that name.

    If it is recording now, the next name that bridges would use.
    """
    row = connection.execute("SELECT name FROM source.robot WHERE id = ?", (robot_id,)).fetchone()
    name, number = str(row[0]), 1
    while connection.execute(
        "SELECT EXISTS (SELECT 1 FROM main.session s JOIN main.robot b ON b.id = s.robot_id "
        "WHERE b.name = ? AND s.ended_wall_time_s IS NULL)",
        (name,),
    ).fetchone()[0]:
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
    """Map the ids of commands there to their ids here.

    A key that is already taken stays as it is.
    """
    own = own | {"idempotency_key": None}
    ids: dict[int, int] = {}
    # The commands of a run set its parameters or were claimed during it. A waiting command is left
    # out: a controller would claim it here, where no caller sent it.
    for old, *facts in connection.execute(
        "SELECT id, created_wall_time_s, action, params FROM source.command c WHERE session_id = "
        ":session AND status <> 'pending' AND (:run IS NULL OR id IN (SELECT command_id FROM "
        "source.parameter_value WHERE run_id = :run) OR EXISTS (SELECT 1 FROM source.run r WHERE "
        "r.id = :run AND coalesce(c.claimed_wall_time_s, c.created_wall_time_s) >= "
        "r.started_wall_time_s AND coalesce(c.claimed_wall_time_s, c.created_wall_time_s) < "
        "coalesce((SELECT min(n.started_wall_time_s) FROM source.run n WHERE n.robot_id = "
        "r.robot_id AND n.id > r.id), 9e99))) ORDER BY id",
        wanted,
    ).fetchall():
        same = None
        if not is_new:
            same = connection.execute(
                "SELECT id FROM main.command WHERE session_id = ? AND created_wall_time_s = ? "
                "AND action = ? AND params = ?",
                (own["session_id"], *facts),
            ).fetchone()
        request = connection.execute(
            "SELECT n.id FROM source.command c JOIN source.request s ON s.id = c.request_id "
            "JOIN main.request n ON n.uuid = s.uuid WHERE c.id = ?",
            (old,),
        ).fetchone()
        own["request_id"] = request[0] if request else None
        ids[old] = same[0] if same else _insert(connection, "command", "id = ?", old, own)
    return ids


def _copy_states(connection: sqlite3.Connection, run_id: int, run: int, robot_id: int) -> None:
    """Copy the rows; if some were deleted, also the chunks of all."""
    (is_purged,) = connection.execute(
        "SELECT purged_rows > 0 FROM main.run WHERE id = ?", (run,)
    ).fetchone()
    shift = None
    if is_purged:
        shift = ingest_chunks(connection, run_id, run, robot_id)
    elif _number(connection, _RESERVED_HERE) > _number(connection, _NEWEST_HERE):
        shift = _reserve_ids(connection, run_id)  # SQLite would reuse ids that other rows had
    _insert(connection, "state", "run_id = ?", run_id, {"run_id": run}, shift)


def _insert(
    connection: sqlite3.Connection,
    table: str,
    where: str,
    key: int,
    own: dict[str, Any],
    shift: int | None = None,
) -> int:
    """Copy rows, with different values in some columns. Return the id of the last row.

    Their ids are new, or those of the source plus an offset.
    """
    listed = connection.execute("SELECT name FROM pragma_table_info(?)", (table,)).fetchall()
    columns = [name for (name,) in listed if name != "id" or shift is not None]
    named = {"id": f"id + {shift}"} | dict.fromkeys(own, "?")
    values = ", ".join(named.get(name, name) for name in columns)
    given = [own[name] for name in columns if name in own]
    # in the type that is declared here
    insert = "INSERT OR IGNORE" if table == "parameter" else "INSERT"
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
    """Return a path with a name that no bridge uses.

    A picture that was merged before keeps its path.
    """
    folder, _, name = path.rpartition("/")
    return path if name.startswith(f"{run_uuid}.") else f"{folder}/{run_uuid}.{name}"


def _copy_pictures(
    connection: sqlite3.Connection, data_dir: Path, source_dir: Path, run_id: int, run_uuid: str
) -> None:
    """Copy pictures before their rows, so that a repeated attempt after a kill copies missing ones.

    The other recording names its pictures, possibly with malicious paths. Only pictures are copied,
    into this folder, and never over another file.
    """
    for _, path, _ in _images(connection, "r.id = ?", run_id):
        try:
            file = inside(source_dir, path)
        except NothingRecordedError:
            # Deleted since: its row stays as it was and reports the missing file when asked.
            continue
        target = data_dir / _path_here(path, run_uuid)
        if not target.resolve().is_relative_to(data_dir.resolve()):
            raise InvalidInputError(f"{path!r} lies outside the data folder and is not copied.")
        if target.suffix.lower() not in PICTURES:
            raise InvalidInputError(f"{path!r} is not the name of a picture and is not copied.")
        if target.exists():
            continue  # complete, from a merge that was killed
        make_folder(target.parent)
        with whole_file(target) as aside:
            shutil.copyfile(file, aside)


def _copy_tape(data_dir: Path, source_dir: Path, session_uuid: str, *, imported: bool) -> None:
    """Copy the tape of a session, which has all its runs; an existing tape is the same."""
    found = (each for each in tape_files(source_dir, session_uuid) if each.is_file())
    file = next((each for each in found if not each.is_symlink()), None)
    target = tape_file(data_dir, session_uuid, imported=imported)
    if file is None or any(each.exists() for each in tape_files(data_dir, session_uuid)):
        return
    make_folder(target.parent)
    with whole_file(target) as aside:
        shutil.copyfile(file, aside)


def _copy_image_rows(connection: sqlite3.Connection, run_id: int, run: int, run_uuid: str) -> None:
    for image_id, path, _ in _images(connection, "r.id = ?", run_id):
        own = {"run_id": run, "path": _path_here(path, run_uuid)}
        _insert(connection, "image", "id = ?", image_id, own)


# One run as a file to send: a ZIP archive with a small recording of its own and its pictures.


def write_bundle(
    connection: sqlite3.Connection,
    database: Path,
    data_dir: Path,
    run_id: int,
    file: Path,
    progress: Progress | None = None,
) -> None:
    """Write everything of an ended run that `merge` copies, with its pictures, as a bundle.

    If its session still records, the session in the bundle ends with the run.

    Args:
        connection: A reader of the recording.
        database: The recording.
        data_dir: The folder of its pictures.
        run_id: The run.
        file: The file to write, in a folder with space for the uncompressed rows.
        progress: Called now and then with the number of packed bytes and the total.

    Raises:
        InvalidInputError: The run is still going on, or has no UUID.
    """
    with tempfile.TemporaryDirectory(prefix=".bundle-", dir=file.parent) as name:
        folder = Path(name)
        with small_recording(folder) as writer:
            frozen = "&immutable=1" if isinstance(connection, FrozenConnection) else ""
            address = f"{database.absolute().as_uri()}?mode=ro{frozen}"
            merge(
                writer, folder, database,
                run_id=run_id, address=address, pictures=data_dir, is_export=True,
            )  # fmt: skip
            writer.execute(END_SESSIONS)
        pack(folder, file, progress)


@contextmanager
def small_recording(folder: Path) -> Generator[sqlite3.Connection]:
    """Create a temporary recording in a folder, in one file."""
    with closing(connect(folder / DATABASE_NAME, "writer", create=True)) as writer:
        create_schema(writer)
        writer.execute("PRAGMA journal_mode=DELETE")  # one file, written once
        writer.execute("PRAGMA synchronous=OFF")  # a killed process leaves nothing worth keeping
        yield writer


def pack(folder: Path, file: Path, progress: Progress | None = None) -> None:
    """Pack the database of a folder, which no process has open, and its pictures.

    Args:
        folder: The folder of the recording.
        file: The file to write.
        progress: As in `write_bundle`.
    """
    found = [each for each in sorted(folder.rglob("*.*")) if _is_packed(each.relative_to(folder))]
    packed, of = 0, sum(each.stat().st_size for each in found)
    with zipfile.ZipFile(file, "w") as archive:
        for each in found:
            entry = zipfile.ZipInfo.from_file(each, each.relative_to(folder).as_posix())
            is_compressed = each.suffix.lower() in (*PICTURES, TAPE_ENDING)
            entry.compress_type = zipfile.ZIP_STORED if is_compressed else zipfile.ZIP_DEFLATED
            with each.open("rb") as source, archive.open(entry, "w") as target:
                while piece := source.read(_BUNDLE.piece_bytes):
                    target.write(piece)
                    packed += len(piece)
                    if progress is not None:
                        progress(packed, of)


def _is_packed(path: Path) -> bool:
    is_picture = len(path.parts) > 1 and path.suffix.lower() in PICTURES
    return str(path) == DATABASE_NAME or is_picture or is_tape(path)


def is_bundle(file: Path) -> bool:
    """Return whether a file is a bundle, or claims to be one.

    A damaged bundle is reported as such.
    """
    return file.suffix.lower() == ".zip" or zipfile.is_zipfile(file)


@contextmanager
def unpacked(file: Path) -> Generator[Path]:
    """Unpack a bundle for the duration of the block, with its pictures next to the database.

    Nothing is trusted. Before anything is written, the bundle is refused if it holds anything but
    our database and pictures, a path out of the folder, a link, or far more data than its size
    allows.

    Raises:
        InvalidInputError: The file is damaged or no bundle, or the disk has no space to unpack it.
    """
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as name:
        unpack(file, Path(name))
        yield Path(name) / DATABASE_NAME


def unpack(file: Path, folder: Path) -> None:
    """Unpack a bundle as `unpacked` does; a process killed meanwhile leaves no database there.

    Raises:
        InvalidInputError: As for `unpacked`.
    """
    aside = folder / f"{DATABASE_NAME}.part"
    try:
        with zipfile.ZipFile(file) as archive:
            _require_ours(file, archive)
            for entry in archive.infolist():
                is_database = entry.filename == DATABASE_NAME
                target = aside if is_database else folder / entry.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, target.open("wb") as sink:
                    target.chmod(PRIVATE_FILE)
                    shutil.copyfileobj(source, sink, _BUNDLE.piece_bytes)
        aside.replace(folder / DATABASE_NAME)
    except _DAMAGED as error:
        raise InvalidInputError(f"{file} is damaged or not a ZIP archive: {error}.") from error
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be unpacked in {folder}: {error}.") from error


def _require_ours(file: Path, archive: zipfile.ZipFile) -> None:
    entries = archive.infolist()
    names = [entry.filename for entry in entries]
    if DATABASE_NAME not in names:
        raise InvalidInputError(
            f"{file} holds no {DATABASE_NAME}: it is not a bundle of 'webots-mcp export -o RUN.zip'"
        )
    for entry in entries:
        if not _is_ours(entry):
            raise InvalidInputError(
                f"{file} holds {entry.filename!r}, which no bundle does: it is not unpacked"
            )
    if len(set(names)) < len(names):
        raise InvalidInputError(f"{file} holds a name twice, which no bundle does")
    size = sum(entry.file_size for entry in entries)
    if size > max(_BUNDLE.harmless_bytes, _BUNDLE.times * file.stat().st_size):
        raise InvalidInputError(
            f"{file} would unpack to {size:,} bytes, which no bundle of its size does"
        )


def _is_ours(entry: zipfile.ZipInfo) -> bool:
    path = PurePosixPath(entry.filename)
    if entry.filename == DATABASE_NAME:
        return not _is_link(entry)
    plain = not path.is_absolute() and ".." not in path.parts and len(path.parts) > 1
    named = plain and not any(sign in entry.filename for sign in "\\:\0")
    is_picture = path.suffix.lower() in PICTURES and entry.file_size <= MAX_FILE_BYTES
    fits = is_picture or (is_tape(path) and entry.file_size <= MAX_TAPE_BYTES)
    return named and fits and not _is_link(entry)


def _is_link(entry: zipfile.ZipInfo) -> bool:
    return entry.external_attr >> 16 & 0o170000 == _LINK


# The chunks of a merged run from a recording that has lost some of its rows. The other recording is
# attached as `source`. Its signals are found here by name or registered. Row groups refer to state
# rows by id, even to deleted ones. Therefore all ids of the run are raised by the same amount,
# beyond all ids ever assigned here, which preserves their order.


def ingest_chunks(connection: sqlite3.Connection, there: int, here: int, robot_id: int) -> int:
    """Copy the row groups and chunks of a run, and register its signals.

    Args:
        connection: A connection in a transaction, with the other recording attached.
        there: The id of the run in the other recording.
        here: Its id here; none of its state rows is here yet.
        robot_id: Its robot here.

    Returns:
        The amount by which the ids of its state rows are raised.

    Raises:
        InvalidInputError: Its ids are spread out as no bridge would assign them.
    """
    shift = _reserve_ids(connection, there)
    _ingest_signals(connection, there, robot_id)
    groups = connection.execute(
        "SELECT id, row_count FROM source.row_group WHERE run_id = ? AND is_complete = 1", (there,)
    ).fetchall()
    for group, rows in groups:
        values: dict[str, Any] = {"run": here, "shift": shift, "group": group}
        values["here"] = connection.execute(
            f"INSERT INTO main.row_group (run_id, last_state_id, max_state_id, {_GROUP}) "
            f"SELECT :run, last_state_id + :shift, max_state_id + :shift, {_GROUP} "
            "FROM source.row_group WHERE id = :group",
            values,
        ).lastrowid
        connection.execute(
            f"INSERT INTO main.chunk (group_id, run_id, signal_id, {_VALUES}) "
            f"SELECT :here, :run, m.here, {_VALUES} FROM source.chunk c "
            "JOIN temp.signal_here m ON m.there = c.signal_id WHERE c.group_id = :group",
            values,
        )
        _ingest_state_ids(connection, values, rows)
    return shift


def _ingest_signals(connection: sqlite3.Connection, there: int, robot_id: int) -> None:
    """Register the signals of a run, and map their ids there to those here."""
    asked = {"run": there, "here": robot_id}
    seen = {
        name: Seen(path, reduction, kind, (role or "").startswith("mode"), first_s)
        for name, path, reduction, kind, role, first_s in connection.execute(
            "SELECT name, path, reduction, kind, role, first_seen_wall_time_s FROM source.signal s "
            "WHERE robot_id = (SELECT robot_id FROM source.run WHERE id = :run) "
            f"AND typeof(name) = 'text' AND kind IN {get_args(Kind)} AND EXISTS (SELECT 1 "
            "FROM source.chunk WHERE run_id = :run AND signal_id = s.id) ORDER BY id",
            asked,
        )
    }
    enter_signals(connection, robot_id, seen)
    connection.execute(
        "CREATE TEMP TABLE IF NOT EXISTS signal_here (there INTEGER PRIMARY KEY, here)"
    )
    connection.execute("DELETE FROM temp.signal_here")
    connection.execute(
        "INSERT INTO temp.signal_here SELECT s.id, n.id FROM source.signal s JOIN main.signal n "
        "ON n.robot_id = :here AND n.name = s.name "
        "WHERE s.robot_id = (SELECT robot_id FROM source.run WHERE id = :run) "
        f"UNION ALL VALUES ({SIM_TIMES}, {SIM_TIMES}), ({WALL_TIMES}, {WALL_TIMES})",
        asked,
    )


def _ingest_state_ids(connection: sqlite3.Connection, values: dict[str, Any], rows: int) -> None:
    """Copy the chunk of the ids of a group's state rows, each id raised by the shift."""
    packed = connection.execute(
        f"SELECT {_PACKED} FROM source.chunk WHERE group_id = ? AND signal_id = {STATE_IDS}",
        (values["group"],),
    ).fetchone()
    if packed is None:
        return
    with suppress(DamagedChunkError):  # readers of the group then report that it is missing
        shifted = _shifted(packed, rows, values["shift"])
        connection.execute(
            f"INSERT INTO main.chunk (group_id, run_id, signal_id, {_VALUES}) "
            f"VALUES ({', '.join('?' * (3 + len(_VALUES.split(','))))})",
            (values["here"], values["run"], STATE_IDS, *shifted),
        )


def _shifted(packed: Sequence[Any], rows: int, shift: int) -> tuple[Any, ...]:
    """Return a chunk of ids raised by an offset."""
    numbers = decode(EncodedChunk(*packed), rows).numbers.tolist()
    ids = [int(number) + shift for number in numbers]
    return *statistics_of(decoded_of(ids)), *encode(ids)


def _reserve_ids(connection: sqlite3.Connection, there: int) -> int:
    last_here = max(_number(connection, _NEWEST_HERE), _number(connection, _RESERVED_HERE))
    first, last = connection.execute(
        "SELECT min(id), max(id) FROM (SELECT id FROM source.state WHERE run_id = :run UNION ALL "
        "SELECT max_state_id FROM source.row_group WHERE run_id = :run "
        f"UNION ALL SELECT CAST(min AS INTEGER) FROM source.chunk WHERE run_id = :run "
        f"AND signal_id = {STATE_IDS})",
        {"run": there},
    ).fetchone()
    if first is None:
        return 0
    if last - first > _BUNDLE.ids:
        raise InvalidInputError(
            f"the ids of run {there}'s state rows reach from {first} to {last}, which no bridge "
            "gives: the recording is damaged"
        )
    shift = last_here + 1 - first
    connection.execute(
        "UPDATE main.recording SET reserved_state_id = max(reserved_state_id, ?)", (last + shift,)
    )
    return shift


def _number(connection: sqlite3.Connection, query: str) -> int:
    return int(connection.execute(query).fetchone()[0])
