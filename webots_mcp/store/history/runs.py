"""`list_runs` and `annotate_run`: what was run, with which code, and how it ended."""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.history.snapshot import in_one_snapshot
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.runs import fetch_run

MOST_RUNS: Final = 200
MAX_LABEL: Final = 100
MAX_NOTE: Final = 4000

_RUNS: Final = (
    "SELECT r.id, b.name, r.session_id, s.controller, s.controller_sha256, s.git_commit, r.world, "
    "r.start_reason, r.end_reason, r.started_wall_time_s, r.last_wall_time_s, "
    "r.started_sim_time_s, max(r.last_sim_time_s, coalesce((SELECT max(sim_time_s) FROM state "
    "WHERE run_id = r.id), r.started_sim_time_s)), r.rows, r.label, r.note "
    "FROM run r JOIN session s ON s.id = r.session_id JOIN robot b ON b.id = r.robot_id "
)
_PAGE: Final = (
    f"{_RUNS} WHERE (:robot IS NULL OR r.robot_id = :robot) AND (:before IS NULL OR r.id < :before)"
    " ORDER BY r.id DESC LIMIT :limit"
)
_ONE: Final = f"{_RUNS} WHERE r.id = ?"
_TOTAL: Final = "SELECT count(*) FROM run WHERE :robot IS NULL OR robot_id = :robot"
_NOTABLE: Final = (
    "SELECT 'log ' || level, count(*) FROM log WHERE run_id = :run "
    "AND level IN ('warning', 'error') GROUP BY level UNION ALL "
    "SELECT kind, count(*) FROM event WHERE run_id = :run "
    "AND kind NOT IN ('change', 'start', 'reset', 'reload') GROUP BY kind UNION ALL "
    "SELECT 'command ' || status, count(*) FROM command c JOIN run r ON r.id = :run "
    "AND r.session_id = c.session_id WHERE c.status IN ('failed', 'lost') "
    "AND c.claimed_wall_time_s BETWEEN r.started_wall_time_s AND r.last_wall_time_s "
    "GROUP BY status"
)
_ANNOTATE: Final = (
    "UPDATE run SET label = CASE WHEN :label IS NULL THEN label ELSE nullif(:label, '') END, "
    "note = CASE WHEN :note IS NULL THEN note ELSE nullif(:note, '') END WHERE id = :run"
)


@dataclass(frozen=True)
class RunInfo:
    """A run.

    Attributes:
        end_reason: None while it goes on.
        duration_s: Simulated seconds.
        real_time_factor: Simulated seconds per second of wall time; None if no time passed.
        rows: State rows, as of the last heartbeat while it goes on.
        notable: How often what needs attention was stored: warnings, errors, dropped rows,
            failed or lost commands, trouble with storage.
    """

    run_id: int
    robot: str
    session_id: int
    controller: str | None
    controller_sha256: str | None
    git_commit: str | None
    world: str | None
    start_reason: str
    end_reason: str | None
    started_wall_time_s: float
    wall_duration_s: float
    duration_s: float
    real_time_factor: float | None
    rows: int
    label: str | None
    note: str | None
    notable: dict[str, int]


@dataclass(frozen=True)
class RunList:
    """Runs, the newest first.

    Attributes:
        total: How many there are in all.
        cursor: Give it as `before_id` for older ones; None after the oldest.
    """

    runs: tuple[RunInfo, ...]
    total: int
    cursor: int | None


@in_one_snapshot
def list_runs(
    connection: sqlite3.Connection,
    *,
    robot: str | None = None,
    limit: int = 20,
    before_id: int | None = None,
) -> RunList:
    """List runs, the newest first.

    Args:
        connection: Any.
        robot: Whose; None for all robots.
        limit: 1 to 200.
        before_id: Only runs with smaller ids: the `cursor` of the page before.

    Raises:
        UnknownRobotError: No robot has that name.
        InvalidInputError: `limit` is out of bounds.
    """
    if not 1 <= limit <= MOST_RUNS:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_RUNS}")
    robot_id = None if robot is None else resolve_robot(connection, robot, time.time()).id
    page = {"robot": robot_id, "before": before_id, "limit": limit + 1}
    rows: list[Any] = connection.execute(_PAGE, page).fetchall()
    runs = tuple(_info(connection, row) for row in rows[:limit])
    total = connection.execute(_TOTAL, {"robot": robot_id}).fetchone()[0]
    return RunList(runs, total, runs[-1].run_id if len(rows) > limit else None)


def run_info(connection: sqlite3.Connection, run_id: int) -> RunInfo:
    """One run.

    Raises:
        UnknownRunError: There is none of that id.
    """
    return _info(
        connection, connection.execute(_ONE, (fetch_run(connection, run_id).id,)).fetchone()
    )


def annotate_run(
    connection: sqlite3.Connection,
    run_id: int,
    *,
    label: str | None = None,
    note: str | None = None,
) -> RunInfo:
    """Give a run a label (short, to find it by) or a note; an empty text takes it away.

    Args:
        connection: In the role "writer".
        run_id: Which run.
        label: At most 100 characters; None leaves it as it is.
        note: At most 4,000 characters; None leaves it as it is.

    Raises:
        UnknownRunError: There is none of that id.
        InvalidInputError: Neither is given, or one is too long.
    """
    if label is None and note is None:
        raise InvalidInputError("give a label or a note (an empty text takes it away)")
    for name, text, longest in (("label", label, MAX_LABEL), ("note", note, MAX_NOTE)):
        if text is not None and len(text) > longest:
            raise InvalidInputError(
                f"the {name} has {len(text)} characters; at most {longest} are kept"
            )
    fetch_run(connection, run_id)
    connection.execute(_ANNOTATE, {"run": run_id, "label": label, "note": note})
    return run_info(connection, run_id)


def _info(connection: sqlite3.Connection, row: tuple[Any, ...]) -> RunInfo:
    *what, started_wall_s, last_wall_s, started_s, last_s, rows, label, note = row
    wall_s, duration_s = last_wall_s - started_wall_s, last_s - started_s
    return RunInfo(
        *what,
        started_wall_time_s=started_wall_s,
        wall_duration_s=wall_s,
        duration_s=duration_s,
        real_time_factor=duration_s / wall_s if wall_s > 0 else None,
        rows=rows,
        label=label,
        note=note,
        notable=dict(connection.execute(_NOTABLE, {"run": row[0]}).fetchall()),
    )
