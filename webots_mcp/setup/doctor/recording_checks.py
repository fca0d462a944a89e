"""Check a recording: whether it can be read, which processes write to it, and what waits in it.

Each check names the robot or the file that it is about.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.contract import CUSTOM_DATA, HEARTBEAT_LATE_S, SCHEMA_VERSION
from webots_mcp.database.connection import FrozenConnection, connect, is_there, journal_mode
from webots_mcp.database.maintenance import FREE_THE_LOG, held_log
from webots_mcp.database.schema import require_current, schema_version
from webots_mcp.database.waiting_file import count_rows, waiting_paths
from webots_mcp.errors import NoDatabaseError, SchemaTooNewError, SchemaTooOldError
from webots_mcp.setup.doctor import (
    Diagnosis,
    Examined,
    check,
    last_seen_s,
    ok,
    unclear,
    warning,
    wrong,
)
from webots_mcp.store.journal_intake import kept_journals
from webots_mcp.store.loop_evidence import handler_at_work, rows_waiting
from webots_mcp.store.recording import GETTING_STARTED, RobotView, name_of
from webots_mcp.store.relative_times import ago
from webots_mcp.store.robots import nothing_recorded
from webots_mcp.store.sessions import fetch_session

_GET_COMMAND: Final = (
    "call bridge.get_command() in every round of the controller's loop, or use "
    "MCPBridge.attach(robot), which does, before anything takes or replaces robot.step"
)
_NOT_POLLED_S: Final = 5.0


@check("Database", well="in memory")
def database(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether there is one that can be read, and that readers and writers can share."""
    if isinstance(subject.unread, NoDatabaseError):
        seen = f"nothing was recorded at {name_of(subject.recording.database)} yet"
        yield warning(seen, GETTING_STARTED)
    elif subject.unread is not None and not _is_about_schema(subject):
        yield wrong(str(subject.unread), "mend or move the file, or name another one")
    elif subject.file is not None:
        with closing(connect(subject.file, "reader")) as connection:
            # A file that cannot be written is read as if it had no write-ahead log.
            mode = "wal" if isinstance(connection, FrozenConnection) else journal_mode(connection)
        seen = f"{subject.file}, {subject.file.stat().st_size / 1e6:.1f} MB"
        if held := held_log(subject.file):
            yield warning(held, FREE_THE_LOG)
        elif mode == "wal":
            yield ok(seen)
        else:
            seen += f"; journal mode {mode} instead of wal: readers and writers block each other"
            yield wrong(seen, "record on a local disk; see the file system above")


@check("Schema", well=f"{SCHEMA_VERSION}")
def schema(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether the database has the tables of this version."""
    if subject.unread is not None and not _is_about_schema(subject):
        yield unclear("there is no recording that can be read")
    elif subject.file is not None and is_there(subject.file):
        with closing(connect(subject.file, "reader")) as connection:
            version = schema_version(connection)
            try:
                require_current(connection)
                yield ok(f"{version}")
            except (SchemaTooOldError, SchemaTooNewError) as error:
                seen = f"{version}, this webots-mcp needs {SCHEMA_VERSION}"
                yield wrong(seen, str(error))


def _is_about_schema(subject: Examined) -> bool:
    return isinstance(subject.unread, (SchemaTooOldError, SchemaTooNewError))


@check("Recording now", needs_recording=True)
def recording_now(subject: Examined) -> Iterator[Diagnosis]:
    """Who writes, and how old the newest is."""
    if not subject.views:
        yield warning(nothing_recorded(subject.opened), GETTING_STARTED)
    elif not subject.live:
        silent_s = subject.now_s - max(last_seen_s(view) for view in subject.views)
        yield warning(
            f"no controller is recording; the last sign of life was {ago(silent_s)}",
            "start the simulation in Webots; if its controllers record elsewhere, name that folder "
            "with --data-dir",
        )
    for view in subject.live:
        if session := view.session:
            python = session.versions.get("python")
            process = f"process {session.pid}{f', Python {python}' if python else ''}"
            if view.robot.kind == CUSTOM_DATA:
                process = f"recorded by the observer from customData, {process}"
            silent = ago(session.silent_s(view.now_s))
            yield ok(f"{view.robot.name} ({process}), last sign of life {silent}")


@check("Rows", needs_recording=True, well="none wait or are dropped")
def rows(subject: Examined) -> Iterator[Diagnosis]:
    """Report what was recorded and is not in the database."""
    waiting_in: list[object] = []
    for view in subject.views:
        if (session := view.session) is None:
            continue
        waiting = rows_waiting(view.connection, session) if view.robot.live else {}
        waiting_in.append(waiting.get("waiting_in"))
        name, error = view.robot.name, session.last_error
        why = f" ({error[:200]})" if error else ""
        if session.rows_dropped:
            seen = f"{session.rows_dropped} rows of {name} were dropped{why}"
            fix = "see free space and the folder's rights; what was dropped is lost"
            yield wrong(seen, fix) if view.robot.live else warning(seen, fix)
        elif view.robot.kind == CUSTOM_DATA and view.robot.live and error and "(seq)" in error:
            yield warning(
                error[:200],
                "give the observer's Robot node 'synchronization TRUE' and the robot's step in ms "
                "as controllerArgs, or let the robot write less often",
            )
        elif waiting.get("rows_waiting"):
            yield warning(
                f"{waiting['rows_waiting']} rows of {name} wait in {waiting['waiting_in']}{why}",
                "free the database: a full disk, or a program that holds a lock (a sqlite3 "
                "shell?); they are taken in with the next row",
            )
    for path in waiting_paths(subject.file) if subject.file else []:
        if path.name not in waiting_in:  # no living controller will empty it
            yield from _left_waiting(path)
    for name, why in (kept_journals(subject.file) if subject.file else {}).items():
        yield warning(
            f"{name} could not be read and was left as it is: {why}",
            "correct the program that writes it ('webots-mcp help journal'); then move or delete "
            "the file",
        )


def _left_waiting(path: Path) -> Iterator[Diagnosis]:
    if _is_empty(path):
        yield warning(
            f"{path.name} is empty: a controller could write neither to the database nor there, so "
            "rows may be lost that nothing counts",
            "see free space and the folder's rights; delete that file when no controller runs",
        )
    elif count := count_rows(path):
        yield warning(
            f"{count} rows of a controller that is gone wait in {path.name}",
            "start 'webots-mcp serve' (not --read-only) or a controller there: it takes them in",
        )


def _is_empty(path: Path) -> bool:
    """Return whether not even its header could be written; an ingested file keeps it."""
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
def commands(subject: Examined) -> Iterator[Diagnosis]:
    """Report what waits for a controller, and for how long."""
    unfinished = [
        _Unfinished(*row)
        for row in subject.opened.execute(
            "SELECT id, robot_id, action, status, session_id, created_wall_time_s, "
            "expires_wall_time_s, coalesce(claimed_wall_time_s, created_wall_time_s) FROM command "
            "WHERE status IN ('pending', 'claimed') ORDER BY id"
        )
    ]
    by_robot = {view.robot.id: view for view in subject.views}
    for each in unfinished:
        judge = _claimed if each.status == "claimed" else _pending
        yield from judge(each, by_robot[each.robot_id])
    queued = sum(each.status == "pending" for each in unfinished)
    yield ok(f"{queued} queued, {len(unfinished) - queued} claimed, none overdue")


def _pending(command: _Unfinished, view: RobotView) -> Iterator[Diagnosis]:
    if command.expires_s >= view.now_s:
        return
    seen = f"{_named(command, view)} waits since {ago(view.now_s - command.created_s)}"
    if not view.robot.live:
        yield wrong(f"{seen}; its controller is gone", "start the controller again")
    elif view.session is not None and view.session.last_poll_wall_time_s is None:
        yield wrong(f"{seen}; its loop never calls get_command()", _GET_COMMAND)
    else:
        why = view.status.why or view.status.text
        yield wrong(f"{seen}: {why}", "let the simulation continue, see Simulation")


def _claimed(command: _Unfinished, view: RobotView) -> Iterator[Diagnosis]:
    session = fetch_session(view.connection, command.session_id or 0)
    at_work_s = view.now_s - command.claimed_s
    if session is None or not session.is_alive(view.now_s):
        seen = f"{_named(command, view)} was claimed by a controller that is gone: it is lost"
        yield warning(seen, "ask again; a server that may write settles it")
    elif at_work_s >= 30.0:
        inside = handler_at_work(view.connection, session, view.now_s)
        seen = inside or f"{_named(command, view)} is under way since {ago(at_work_s)}"
        yield warning(seen, "wait for it, or send cancel_run; a handler must return soon")


def _named(command: _Unfinished, view: RobotView) -> str:
    return f"command {command.id} ({command.action}) for {view.robot.name}"


@check("get_command", needs_recording=True, well="no controller lives that could be asked")
def get_command(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether the loops of the living controllers ask for commands."""
    for view in subject.live:
        if (session := view.session) is None:
            continue
        if not session.has_bridge:
            yield ok(f"{view.robot.name} has no bridge, and takes no commands")
            continue
        loop, polled_s = f"{view.robot.name}'s loop", session.last_poll_wall_time_s
        began_s = session.started_wall_time_s if polled_s is None else polled_s
        silent_s = session.age_s(began_s, view.now_s)
        if polled_s is None and silent_s > _NOT_POLLED_S:
            seen = f"{loop} never called get_command(): it records and obeys nothing"
            yield warning(seen, _GET_COMMAND)
        elif polled_s and view.status.is_moving and silent_s > _NOT_POLLED_S + HEARTBEAT_LATE_S:
            seen = f"{loop} called get_command() last {ago(silent_s)}, and still runs"
            yield warning(seen, _GET_COMMAND)
        else:
            yield ok(f"{loop} asks for commands")
