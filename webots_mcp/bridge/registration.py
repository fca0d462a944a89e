"""Registers a controller process: its identity, its robot, and its session in the database."""

from __future__ import annotations

import json
import os
import sqlite3
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import (
    BY_PROCESS,
    CUSTOM_DATA,
    host_name,
    instance_of,
    is_extern,
    recorded_name,
)
from webots_mcp.database import session_cleanup
from webots_mcp.database.pause_states import PAUSED, STEPPING_WORLD
from webots_mcp.database.processes import process_identity
from webots_mcp.database.transactions import transaction
from webots_mcp.database.waiting_file import enter_robot, enter_session

# A successor in the same Webots within seconds means a reload; so does one after an issued reload
# command. A predecessor that was killed counts only where Webots starts the controllers: Webots
# kills one that does not end within a second, while an extern one was killed by a person.
_RELOADED: Final = (
    "SELECT 1 FROM session WHERE id = (SELECT max(id) FROM session WHERE robot_id = :robot) "
    "AND instance = :instance AND coalesce(ended_wall_time_s, last_seen_wall_time_s) > :earliest "
    "AND (:in_webots OR end_reason <> 'crashed') "
    "UNION SELECT 1 FROM command WHERE robot_id = :robot "
    "AND status = 'claimed' AND action = 'reload' AND issued_wall_time_s IS NOT NULL"
)
# A controller that is not a Supervisor cannot distinguish a reload from another quit by Webots, so
# it ended as `finished`. Its successor, which Webots started, shows that it was a reload.
_RELOADED_SESSION: Final = (
    "UPDATE session SET end_reason = 'reload' WHERE end_reason = 'finished' "
    "AND id = (SELECT max(id) FROM session WHERE robot_id = ?)"
)
_RELOADED_RUN: Final = (
    "UPDATE run SET end_reason = 'reload' WHERE end_reason = 'finished' "
    "AND id = (SELECT max(id) FROM run WHERE robot_id = ?)"
)
_LEFT_WAITING: Final = (
    "SELECT 1 FROM session WHERE id = (SELECT max(id) FROM session WHERE robot_id = ?) "
    "AND instance = ? AND pause_state = ?"
)
_LONGEST_RELOAD_S: Final = 10.0  # from the end of the old controller to the start of the new one

# -- the identity of a process ---------------------------------------------------------------------


class Identity(NamedTuple):
    """The facts about a controller process when its bridge starts."""

    robot_name: str
    kind: str
    supervisor: bool
    devices: dict[str, str]
    world: str | None
    basic_time_step_ms: float | None
    pid: int
    process: str | None
    host: str
    instance: str
    extern: bool
    controller: str | None
    controller_sha256: str | None
    git_commit: str | None
    versions: dict[str, str]
    throttle_interval: int


def identify(
    robot: Any, supervisor: bool, version: str, throttle_interval: int, kind: str | None = None
) -> Identity:
    """Collect the identity; what cannot be determined is None, never an error."""
    controller = controller_file()
    return Identity(
        robot_name=recorded_name(
            str(robot.getName() or os.environ.get("WEBOTS_ROBOT_NAME") or "robot")
        ),
        kind=kind or ("Supervisor" if supervisor else "Robot"),
        supervisor=supervisor,
        devices={str(name): type(device).__name__ for name, device in _devices(robot).items()},
        world=_plain_text(robot.getWorldPath()) if hasattr(robot, "getWorldPath") else None,
        basic_time_step_ms=float(robot.getBasicTimeStep()),
        pid=os.getpid(),
        process=process_identity(os.getpid()),
        host=host_name(),
        instance=instance_of(os.environ, os.getppid()),
        extern=is_extern(os.environ),
        controller=_plain_text(controller) if controller else None,
        controller_sha256=_sha256(controller) if controller else None,
        git_commit=_git_commit(controller.parent) if controller else None,
        versions={
            "python": sys.version.split()[0],
            "webots_mcp": version,
            "sqlite": sqlite3.sqlite_version,
        },
        throttle_interval=throttle_interval,
    )


def controller_file() -> Path | None:
    """Return the file of the main program; None where there is none, as at a prompt."""
    main = getattr(sys.modules.get("__main__"), "__file__", None) or sys.argv[0]
    path = Path(main).absolute() if main else None
    return path if path and path.is_file() else None


def _plain_text(path: object) -> str:
    """Return a path as valid text: file names may have any bytes, the database needs UTF-8."""
    return str(path).encode("utf-8", "replace").decode()


def _devices(robot: Any) -> dict[str, Any]:
    return getattr(robot, "devices", None) or {}


def same_simulation(instance: str, other: str) -> bool:
    """Return whether two instances are one Webots, or may be: some extern ones are not known."""
    return instance == other or any(BY_PROCESS in each for each in (instance, other))


def _sha256(file: Path) -> str | None:
    try:
        return _sha256_of(file.read_bytes())
    except OSError:
        return None


def _sha256_of(data: bytes) -> str:
    """Hash with the interpreter's own module: hashlib loads OpenSSL, which takes 5 ms and 4 MB."""
    for name in ("_sha2", "_sha256"):  # since Python 3.12, and before it
        try:
            return __import__(name).sha256(data).hexdigest()
        except ImportError:  # noqa: PERF203
            continue
    import hashlib

    return hashlib.sha256(data).hexdigest()


def _git_commit(folder: Path) -> str | None:
    """Return the commit that is checked out; read git's files, since a child process is slow."""
    try:
        for place in (folder, *folder.parents):
            if (place / ".git").exists():
                return _head(_git_dir(place / ".git"))
    except (OSError, ValueError):  # unreadable, or not text
        return None
    return None


def _git_dir(git: Path) -> Path:
    """Return git's folder; in a worktree or submodule `.git` is a file that names it."""
    if git.is_dir():
        return git
    return (git.parent / git.read_text("utf-8").partition("gitdir:")[2].strip()).resolve()


def _head(git: Path) -> str | None:
    head = (git / "HEAD").read_text("utf-8").strip()
    if not head.startswith("ref:"):
        return head
    ref = head[4:].strip()
    common = git / "commondir"
    base = (git / common.read_text("utf-8").strip()).resolve() if common.exists() else git
    if (base / ref).exists():
        return (base / ref).read_text("utf-8").strip()
    packed = base / "packed-refs"
    lines = packed.read_text("utf-8").splitlines() if packed.exists() else []
    return next((line.split()[0] for line in lines if line.endswith(f" {ref}")), None)


# Sessions of this process. Its pid alone does not identify it: in a container pids repeat.
_own_sessions: set[int] = set()


class Registration(NamedTuple):
    """The ids under which a process records."""

    robot_id: int
    robot_name: str
    session_id: int
    reloaded: bool
    paused_mode: str | None
    """The mode to go back to, where the session before this one left the simulation paused."""
    left_waiting: bool
    """The session before this one ended while the world waited for its steps."""


def register(
    connection: sqlite3.Connection, identity: Identity, session_uuid: str, actions: str
) -> Registration:
    """Enter a session; processes that start at the same time get sessions of different names.

    One transaction takes the write lock, ends the sessions of dead processes, and ends an
    unfinished session of the same robot as `superseded`. If a live process already has the name,
    `#2` (and so on) is appended.
    """
    now_s = time.time()
    # Before the transaction too: most of the work is then done without blocking other writers.
    session_cleanup.reap(connection, now_s)
    with transaction(connection):
        session_cleanup.reap(connection, now_s)
        makes_way = partial(_makes_way, identity=identity)
        name = session_cleanup.free_name(connection, identity.robot_name, makes_way)
        statement = "SELECT kind FROM robot WHERE name = ?"
        before = connection.execute(statement, (name,)).fetchone()
        robot_id = enter_robot(connection, describe_robot(identity, name), now_s)
        # A bridge is not the reloaded successor of an observer's reading of customData.
        is_same = before is None or (before[0] == CUSTOM_DATA) == (identity.kind == CUSTOM_DATA)
        reloaded = is_same and _is_reload(connection, identity, robot_id, now_s)
        if reloaded and _is_started_by_webots(identity):
            connection.execute(_RELOADED_SESSION, (robot_id,))
            connection.execute(_RELOADED_RUN, (robot_id,))
        paused_mode = _paused_mode(connection, identity, robot_id)
        waiting = connection.execute(
            _LEFT_WAITING, (robot_id, identity.instance, STEPPING_WORLD)
        ).fetchone()
        session = describe_session(identity, session_uuid, actions)
        session_id = enter_session(connection, robot_id, session)
    _own_sessions.add(session_id)
    return Registration(robot_id, name, session_id, reloaded, paused_mode, waiting is not None)


def deregister(session_id: int) -> None:
    """Note that this process no longer records under that session."""
    _own_sessions.discard(session_id)


def _is_reload(
    connection: sqlite3.Connection, identity: Identity, robot_id: int, now_s: float
) -> bool:
    values = {
        "robot": robot_id,
        "instance": identity.instance,
        "earliest": now_s - _LONGEST_RELOAD_S,
        "in_webots": _is_started_by_webots(identity),
    }
    return connection.execute(_RELOADED, values).fetchone() is not None


def _is_started_by_webots(identity: Identity) -> bool:
    return not identity.extern and "WEBOTS_INSTANCE_PATH" in os.environ


def _paused_mode(connection: sqlite3.Connection, identity: Identity, robot_id: int) -> str | None:
    """Return the mode before the pause that the robot's last session left in this Webots."""
    values = (robot_id, identity.instance, PAUSED)
    statement = (
        "SELECT coalesce(mode_before_pause, 'real_time') FROM session "
        "WHERE id = (SELECT max(id) FROM session WHERE robot_id = ?) AND instance = ? "
        "AND pause_state = ?"
    )
    row = connection.execute(statement, values).fetchone()
    return row[0] if row else None


def _makes_way(session: session_cleanup.OpenSession, identity: Identity) -> bool:
    """Return whether a session gives up its name: an observer's, or an old one of this process."""
    if session.kind == CUSTOM_DATA != identity.kind:
        return same_simulation(session.instance, identity.instance)
    is_here = (session.host, session.pid) == (identity.host, identity.pid)
    return is_here and session.session_id not in _own_sessions


def describe_robot(identity: Identity, name: str) -> dict[str, Any]:
    """Return the values of the robot's row."""
    devices = json.dumps(identity.devices, ensure_ascii=False)
    return {"name": name, "kind": identity.kind, "devices": devices}


def describe_session(identity: Identity, uuid: str, actions: str) -> dict[str, Any]:
    """Return the values of the session's row at its start."""
    now_s = time.time()
    return {
        "uuid": uuid,
        "pid": identity.pid,
        "process": identity.process,
        "host": identity.host,
        "instance": identity.instance,
        "extern": int(identity.extern),
        "controller": identity.controller,
        "controller_sha256": identity.controller_sha256,
        "git_commit": identity.git_commit,
        "versions": json.dumps(identity.versions),
        "supervisor": int(identity.supervisor),
        "actions": actions,
        "started_wall_time_s": now_s,
        "last_seen_wall_time_s": now_s,
        "last_seen_monotonic_s": time.monotonic(),
        "throttle_interval": identity.throttle_interval,
    }
