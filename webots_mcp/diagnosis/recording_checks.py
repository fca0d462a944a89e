"""What this machine brings along, where a recording lies, who writes it, and what waits in it."""

from __future__ import annotations

import os
import platform
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.connection import (
    OLDEST_SQLITE,
    FrozenConnection,
    connect,
    is_there,
    journal_mode,
    require_current,
    schema_version,
)
from webots_mcp.contract import DATA_DIR_VARIABLE, HEARTBEAT_LATE_S, SCHEMA_VERSION
from webots_mcp.diagnosis import Examined, Finding, ago, check, last_seen_s, worst
from webots_mcp.errors import NoDatabaseError, SchemaTooNewError, SchemaTooOldError
from webots_mcp.requirements import install_line, missing_requirements, package_of
from webots_mcp.store.recording import GETTING_STARTED, View, name_of
from webots_mcp.store.robots import Session, fetch_session, handler_at_work, rows_waiting
from webots_mcp.waiting_file import count_rows, waiting_paths

_OLDEST_PYTHON: Final = (3, 10)
_NEWEST_PYTHON: Final = (3, 13)  # that it was tried with
# Two connections that write or checkpoint at once could damage a file before these versions
# (sqlite.org/wal.html, "The WAL-reset bug"); the two older branches were mended as well.
_WAL_RESET_MENDED: Final = (3, 51, 3)
_WAL_RESET_MENDED_IN_BRANCH: Final = {(3, 44): 6, (3, 50): 7}


@check("Python")
def python(_: Examined) -> Finding:
    """The Python that runs this; `Recording now` has that of the controllers."""
    seen = f"{platform.python_version()} at {sys.executable}"
    if sys.version_info[:2] < _OLDEST_PYTHON:
        return Finding("wrong", seen, "use Python 3.10 or newer")
    if sys.version_info[:2] > _NEWEST_PYTHON:
        return Finding("warning", f"{seen}: newer than what this was tried with", "use Python 3.13")
    return Finding("ok", seen)


@check("Packages")
def packages(_: Examined) -> Finding:
    """What the server and most commands need; a bridge does without."""
    missing = missing_requirements()
    if not missing:
        return Finding("ok", "all that the server needs are installed")
    seen = f"missing: {', '.join(map(package_of, missing))} (a bridge does without)"
    return Finding("wrong", seen, f"run {install_line(missing)}")


@check("SQLite")
def sqlite(_: Examined) -> Finding:
    """The SQLite of this Python."""
    return judge_sqlite(sqlite3.sqlite_version_info)


def judge_sqlite(version: tuple[int, ...]) -> Finding:
    """Whether a version can be used."""
    seen = ".".join(map(str, version))
    if version < OLDEST_SQLITE:
        return Finding(
            "wrong",
            f"{seen} is too old: 3.38 is needed",
            "use a Python with a newer one (python.org, conda and Debian 12 have it)",
        )
    if has_wal_reset_bug(version):
        seen += (
            ", which has the WAL-reset bug: webots-mcp checkpoints so that it cannot strike; let "
            "no other program write to the file while a robot records"
        )
    return Finding("ok", seen)


def has_wal_reset_bug(version: tuple[int, ...]) -> bool:
    """Whether a checkpoint during a commit can damage a file."""
    mended = _WAL_RESET_MENDED_IN_BRANCH.get((version[0], version[1]))
    return version < _WAL_RESET_MENDED and (mended is None or version[2] < mended)


# Names of file systems as the operating systems have them; in none does SQLite share memory.
_NETWORK: Final = (
    "nfs", "nfs4", "cifs", "smb2", "smb3", "smbfs", "afpfs", "webdav", "ncpfs", "afs", "ceph",
    "glusterfs", "lustre", "beegfs", "fuse.sshfs", "fuse.glusterfs", "fuse.s3fs", "fuse.rclone",
)  # fmt: skip
_SHARED_WITH_HOST: Final = ("vboxsf", "prl_fs", "fuse.vmhgfs-fuse", "vmhgfs")
_WINDOWS_FROM_WSL: Final = ("9p", "drvfs")
_WSL_FROM_WINDOWS: Final = ("//wsl$/", "//wsl.localhost/")
_FULL_BYTES: Final = 50_000_000
_LOW_BYTES: Final = 1_000_000_000
_LOCAL: Final = (
    f"record in a folder of this machine's own disk: {DATA_DIR_VARIABLE}, --data-dir, or "
    "MCPBridge(robot, data_dir=...), the same for controllers and server"
)


class Mount(NamedTuple):
    """A file system and its mount point, as psutil lists them."""

    point: str
    kind: str
    is_remote: bool = False


@check("Data folder")
def data_folder(subject: Examined) -> Finding:
    """Whether it is there, and may be written."""
    if subject.file is None:
        return Finding("ok", "the recording is in memory")
    folder = subject.file.parent
    seen = f"{folder}, chosen by: {subject.chosen_by}"
    if not folder.exists():
        return Finding(
            "warning",
            f"{seen}; it is not there yet",
            "start a controller with an MCPBridge, which makes it; if it records elsewhere, name "
            "that folder with --data-dir",
        )
    if not folder.is_dir():
        return Finding("wrong", f"{seen}; it is a file", "name the folder with --data-dir")
    if why := _why_unwritable(folder):
        return Finding(
            "wrong",
            f"{seen}; it cannot be written: {why}",
            "give this user the right to write there, or name another with --data-dir; a recording "
            "that only has to be read can: webots-mcp serve --read-only",
        )
    return Finding("ok", seen)


def _why_unwritable(folder: Path) -> str | None:
    """Whether a folder can be written, by trying: a read-only file system ignores its rights."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return error.strerror or str(error)


@check("File system")
def file_system(subject: Examined) -> Finding:
    """Whether processes can share memory there, which WAL needs."""
    if subject.file is None:
        return Finding("ok", "the recording is in memory")
    import psutil

    mounts = [
        Mount(part.mountpoint, part.fstype, "remote" in part.opts.split(","))
        for part in psutil.disk_partitions(all=True)
    ]
    is_wsl = "microsoft" in platform.release().lower()
    return judge_file_system(str(subject.file.parent), mounts, is_wsl=is_wsl)


def judge_file_system(folder: str, mounts: Iterable[Mount], *, is_wsl: bool) -> Finding:
    """Whether a recording may lie in a folder, on a machine with these file systems."""
    path = folder.replace("\\", "/")
    if path.lower().startswith(_WSL_FROM_WINDOWS):
        return _across_the_border(folder, "a folder of WSL, seen from Windows")
    if path.startswith("//"):
        return _on_the_network(folder, "a network drive")
    mount = _mount_of(path, mounts)
    if mount is None:
        return Finding("not checked", f"the system does not show on which drive {folder} is")
    kind = mount.kind.lower()
    if is_wsl and kind in _WINDOWS_FROM_WSL:
        return _across_the_border(folder, f"a drive of Windows, seen from WSL ({kind})")
    if mount.is_remote or kind in _NETWORK:
        return _on_the_network(folder, f"a network drive ({mount.kind} at {mount.point})")
    if kind in (*_SHARED_WITH_HOST, *_WINDOWS_FROM_WSL):
        seen = f"{folder} is shared with a virtual machine's host ({mount.kind} at {mount.point})"
        return Finding("warning", f"{seen}: both at once would not see each other's locks", _LOCAL)
    return Finding("ok", f"{mount.kind or 'of an unnamed kind'} at {mount.point}")


def _across_the_border(folder: str, what: str) -> Finding:
    seen = (
        f"{folder} is {what}: SQLite cannot share memory across that border, so that controllers "
        "and server lock each other out or damage the file"
    )
    return Finding("wrong", seen, f"run both on one side of it, and {_LOCAL}")


def _on_the_network(folder: str, what: str) -> Finding:
    seen = (
        f"{folder} is on {what}: SQLite's log needs memory that processes share, which network "
        "file systems do not have"
    )
    return Finding("wrong", seen, _LOCAL)


def _mount_of(path: str, mounts: Iterable[Mount]) -> Mount | None:
    """The one that begins nearest above the path."""
    above = [mount for mount in mounts if _is_in(path, mount.point.replace("\\", "/"))]
    return max(above, key=lambda mount: len(mount.point), default=None)


def _is_in(path: str, point: str) -> bool:
    if os.name == "nt" or point[1:2] == ":":
        path, point = path.lower(), point.lower()
    return f"{path}/".startswith(f"{point.rstrip('/')}/")


@check("Free space")
def free_space(subject: Examined) -> Finding:
    """Whether there is room for what will be recorded."""
    if subject.file is None:
        return Finding("ok", "the recording is in memory")
    folder = next(folder for folder in subject.file.parents if folder.exists())
    free = shutil.disk_usage(folder).free
    seen = f"{free / 1e9:.1f} GB free"
    fix = "make room: 'webots-mcp prune --dry-run' lists what could be deleted"
    if free < _FULL_BYTES:
        return Finding("wrong", f"{seen}: the disk is full", fix)
    return Finding(
        "warning" if free < _LOW_BYTES else "ok", seen, fix * (free < _LOW_BYTES) or None
    )


_GET_COMMAND: Final = (
    "call bridge.get_command() in every round of the controller's loop, or use "
    "MCPBridge.attach(robot), which does, before anything takes or replaces robot.step"
)
_LONG_AT_WORK_S: Final = 30.0
_NOT_POLLED_S: Final = 5.0
_UNFINISHED: Final = (
    "SELECT id, robot_id, action, status, session_id, created_wall_time_s, expires_wall_time_s, "
    "coalesce(claimed_wall_time_s, created_wall_time_s) FROM command "
    "WHERE status IN ('pending', 'claimed') ORDER BY id"
)


@check("Database")
def database(subject: Examined) -> Finding:
    """Whether there is one that can be read, and that readers and writers can share."""
    if isinstance(subject.unread, NoDatabaseError):
        seen = f"nothing was recorded at {name_of(subject.recording.database)} yet"
        return Finding("warning", seen, GETTING_STARTED)
    if subject.unread is not None and not _is_about_schema(subject):
        return Finding("wrong", str(subject.unread), "mend or move the file, or name another one")
    if subject.file is None:
        return Finding("ok", "in memory")
    with closing(connect(subject.file, "reader")) as connection:
        # A file that cannot be written is read as if it had no write-ahead log.
        mode = "wal" if isinstance(connection, FrozenConnection) else journal_mode(connection)
    size = subject.file.stat().st_size
    seen = f"{subject.file}, {size / 1e6:.1f} MB"
    if mode != "wal":
        seen += f"; journal mode {mode} instead of wal: readers and writers block each other"
        return Finding("wrong", seen, "record on a local disk; see the file system above")
    return Finding("ok", seen)


@check("Schema")
def schema(subject: Examined) -> Finding:
    """Whether the database has the tables of this version."""
    if subject.unread is not None and not _is_about_schema(subject):
        return Finding("not checked", "there is no recording that can be read")
    if subject.file is None or not is_there(subject.file):
        return Finding("ok", f"{SCHEMA_VERSION}")
    with closing(connect(subject.file, "reader")) as connection:
        version = schema_version(connection)
        try:
            require_current(connection)
        except (SchemaTooOldError, SchemaTooNewError) as error:
            seen = f"{version}, this webots-mcp needs {SCHEMA_VERSION}"
            return Finding("wrong", seen, str(error))
    return Finding("ok", f"{version}")


def _is_about_schema(subject: Examined) -> bool:
    return isinstance(subject.unread, (SchemaTooOldError, SchemaTooNewError))


@check("Recording now", needs_recording=True)
def recording_now(subject: Examined) -> Finding:
    """Who writes, and how old the newest is."""
    if subject.live:
        return Finding("ok", "; ".join(_described(view) for view in subject.live))
    if not subject.views:
        return Finding("warning", "no robot has been recorded yet", GETTING_STARTED)
    newest_s = max(last_seen_s(view) for view in subject.views)
    return Finding(
        "warning",
        f"no controller is recording; the last sign of life was {ago(subject.now_s - newest_s)}",
        "start the simulation in Webots; if its controllers record elsewhere, name that folder "
        "with --data-dir",
    )


def _described(view: View) -> str:
    session = view.session
    assert session is not None
    python = session.versions.get("python")
    return (
        f"{view.robot.name} (process {session.pid}{f', Python {python}' if python else ''}), last "
        f"sign of life {ago(session.silent_s(view.now_s))}"
    )


@check("Rows", needs_recording=True)
def rows(subject: Examined) -> Finding:
    """What was recorded and is not in the database."""
    findings = [_lost(view) for view in subject.views if view.session is not None]
    findings += _left_waiting(subject)
    return worst(
        [each for each in findings if each.verdict != "ok"]
        or [Finding("ok", "none wait or are dropped")]
    )


def _lost(view: View) -> Finding:
    session = view.session
    assert session is not None
    waiting = rows_waiting(view.connection, session) if view.robot.live else {"rows_waiting": 0}
    name, error = view.robot.name, session.last_error
    why = f" ({error[:200]})" if error else ""
    if session.rows_dropped:
        return Finding(
            "wrong" if view.robot.live else "warning",
            f"{session.rows_dropped} rows of {name} were dropped{why}",
            "see free space and the folder's rights; what was dropped is lost",
        )
    if waiting["rows_waiting"]:
        return Finding(
            "warning",
            f"{waiting['rows_waiting']} rows of {name} wait in {waiting['waiting_in']}{why}",
            "free the database: a full disk, or a program that holds a lock (a sqlite3 shell?); "
            "they are taken in with the next row",
        )
    return Finding("ok", name)


def _left_waiting(subject: Examined) -> list[Finding]:
    """Files that no living controller will empty."""
    if subject.file is None:
        return []
    waiting_in = [rows_waiting(v.connection, v.session).get("waiting_in") for v in subject.live]
    left = [path for path in waiting_paths(subject.file) if path.name not in waiting_in]
    unbegun = [
        Finding(
            "warning",
            f"{path.name} is empty: a controller could write neither to the database nor there, so "
            "rows may be lost that nothing counts",
            "see free space and the folder's rights; delete that file when no controller runs",
        )
        for path in left
        if _is_empty(path)
    ]
    return unbegun + [
        Finding(
            "warning",
            f"{count} rows of a controller that is gone wait in {path.name}",
            "start 'webots-mcp serve' (not --read-only) or a controller there: it takes them in",
        )
        for path in left
        if (count := count_rows(path))
    ]


def _is_empty(path: Path) -> bool:
    """Whether not even its header could be written, which is left where rows were taken in."""
    try:
        return path.stat().st_size == 0
    except OSError:  # another process has just deleted it
        return False


class _Unfinished(NamedTuple):
    """A command that is still to be answered."""

    id: int
    robot_id: int
    action: str
    status: str
    session_id: int | None
    created_s: float
    expires_s: float
    claimed_s: float


@check("Commands", needs_recording=True)
def commands(subject: Examined) -> Finding:
    """What waits for a controller, and for how long."""
    unfinished = [_Unfinished(*row) for row in subject.opened.execute(_UNFINISHED)]
    by_robot = {view.robot.id: view for view in subject.views}
    findings = [_judged(each, by_robot[each.robot_id]) for each in unfinished]
    if overdue := [each for each in findings if each.verdict != "ok"]:
        return worst(overdue)
    queued = sum(each.status == "pending" for each in unfinished)
    return Finding("ok", f"{queued} queued, {len(unfinished) - queued} claimed, none overdue")


def _judged(command: _Unfinished, view: View) -> Finding:
    what = f"command {command.id} ({command.action}) for {view.robot.name}"
    if command.status == "claimed":
        return _claimed(command, view, what)
    if command.expires_s >= view.now_s:
        return Finding("ok", what)
    seen = f"{what} waits since {ago(view.now_s - command.created_s)}"
    if not view.robot.live:
        return Finding("wrong", f"{seen}; its controller is gone", "start the controller again")
    if view.session is not None and view.session.last_poll_wall_time_s is None:
        return Finding("wrong", f"{seen}; its loop never calls get_command()", _GET_COMMAND)
    why = view.status.why or view.status.text
    return Finding("wrong", f"{seen}: {why}", "let the simulation continue, see Simulation")


def _claimed(command: _Unfinished, view: View, what: str) -> Finding:
    session = fetch_session(view.connection, command.session_id or 0)
    if session is None or not session.is_alive(view.now_s):
        seen = f"{what} was claimed by a controller that is gone: it is lost"
        return Finding("warning", seen, "ask again; a server that may write settles it")
    at_work_s = view.now_s - command.claimed_s
    if at_work_s < _LONG_AT_WORK_S:
        return Finding("ok", what)
    inside = handler_at_work(view.connection, session, view.now_s)
    seen = inside or f"{what} is under way since {ago(at_work_s)}"
    return Finding("warning", seen, "wait for it, or send cancel_run; a handler must return soon")


@check("get_command", needs_recording=True)
def get_command(subject: Examined) -> Finding:
    """Whether the loops of the living controllers ask for commands."""
    findings = [_polled(view, view.session) for view in subject.live if view.session]
    return worst(findings or [Finding("ok", "no controller lives that could be asked")])


def _polled(view: View, session: Session) -> Finding:
    polled_s = session.last_poll_wall_time_s
    if polled_s is None and session.age_s(session.started_wall_time_s, view.now_s) > _NOT_POLLED_S:
        seen = f"{view.robot.name}'s loop never called get_command(): it records and obeys nothing"
        return Finding("warning", seen, _GET_COMMAND)
    silent_s = 0.0 if polled_s is None else session.age_s(polled_s, view.now_s)
    if view.status.is_moving and silent_s > _NOT_POLLED_S + HEARTBEAT_LATE_S:
        seen = f"{view.robot.name}'s loop called get_command() last {ago(silent_s)}, and still runs"
        return Finding("warning", seen, _GET_COMMAND)
    return Finding("ok", f"{view.robot.name}'s loop asks for commands")
