"""Answer `list_runs` and `annotate_run`: which runs exist, with which code, and how they ended."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.database.pause_states import paused_s
from webots_mcp.database.session_cleanup import find_dead_sessions
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.parameter import Value
from webots_mcp.store.reading.segment import in_one_snapshot
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.run_parameters import HAD_VALUES, as_filter, notable_parameters
from webots_mcp.store.run_rows import OWN_MS, STEP_WAIT_MS, fetch_run

MOST_RUNS: Final = 200

_RUNS: Final = (
    "SELECT r.id, b.name, r.session_id, s.controller, s.controller_sha256, s.git_commit, r.world, "
    "r.start_reason, r.end_reason, r.label, r.note, r.purged_rows, "
    f"{OWN_MS}, {STEP_WAIT_MS}, "
    # Rows, times and the last report are those of a heartbeat, which newer rows may follow.
    "r.row_count + CASE WHEN r.ended_wall_time_s IS NULL THEN (SELECT count(*) FROM state "
    "WHERE run_id = r.id AND sim_time_s > CASE WHEN r.row_count > 0 THEN r.last_sim_time_s "
    "ELSE -9e999 END) ELSE 0 END, "
    "r.started_wall_time_s, max(r.last_wall_time_s, coalesce((SELECT wall_time_s FROM state "
    "WHERE run_id = r.id ORDER BY sim_time_s DESC, id DESC LIMIT 1), 0)), "
    "r.started_sim_time_s, max(r.last_sim_time_s, coalesce((SELECT max(sim_time_s) FROM state "
    "WHERE run_id = r.id), r.started_sim_time_s)) "
    "FROM run r JOIN session s ON s.id = r.session_id JOIN robot b ON b.id = r.robot_id "
)
_WHAT: Final = (
    "run_id", "robot", "session_id", "controller", "controller_sha256", "git_commit", "world",
    "start_reason", "end_reason", "label", "note", "purged_rows",
    "own_ms", "step_wait_ms", "row_count",
)  # fmt: skip


@dataclass(frozen=True)
class AnnotationLimits:
    """Limits of what a person writes about a run, in characters.

    Attributes:
        label: Maximum length of a label.
        note: Maximum length of a note.
    """

    label: int = 100
    note: int = 4000


_ANNOTATION: Final = AnnotationLimits()


@dataclass(frozen=True)
class RunInfo:
    """A run.

    Attributes:
        end_reason: None while it is running; if its process has ended, the reason that will be
            recorded.
        duration_s: Simulated seconds.
        own_ms: Mean wall time of a step in the controller's own code; None if few were seen.
        step_wait_ms: Mean wall time in `step` itself.
        held_s: Wall time during which a command paused the simulation.
        row_count: Number of state rows; retention has deleted `purged_rows` of them.
        notable: Number of stored problems: warnings, errors, dropped rows, failed or lost commands,
            storage trouble.
        parameters: Parameters that are not as declared, or differ between the listed runs; a text
            describes changes in the middle of the run.
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
    label: str | None
    note: str | None
    purged_rows: int
    own_ms: float | None
    step_wait_ms: float | None
    row_count: int
    started_wall_time_s: float
    wall_duration_s: float
    held_s: float
    duration_s: float
    notable: dict[str, int]
    parameters: dict[str, Value | str]

    @property
    def real_time_factor(self) -> float | None:
        """Simulated seconds per second of wall time, without the time it was held."""
        return pace(self.duration_s, self.wall_duration_s - self.held_s)


@dataclass(frozen=True)
class RunList:
    """Runs, newest first.

    Attributes:
        total: The number of all runs.
        cursor: The `before_id` of older runs; None after the oldest.
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
    parameters: Mapping[str, Value] | None = None,
) -> RunList:
    """List runs, the newest first.

    Args:
        connection: An open database.
        robot: The robot; None for all robots.
        limit: 1 to 200.
        before_id: Only runs with smaller ids: the `cursor` of the page before.
        parameters: Only runs in which these parameters had these values at some time.

    Raises:
        UnknownRobotError: No robot has that name.
        InvalidInputError: `limit` is out of bounds, or no parameter was ever called so.
    """
    if not 1 <= limit <= MOST_RUNS:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_RUNS}.")
    robot_id = None if robot is None else resolve_robot(connection, robot, time.time()).id
    asked = {"robot": robot_id, "parameters": as_filter(connection, parameters or {})}
    page = {**asked, "before": before_id, "limit": limit + 1}
    rows: list[Any] = connection.execute(
        f"{_RUNS} WHERE (:robot IS NULL OR r.robot_id = :robot) AND (:before IS NULL OR r.id < "
        f":before) AND {HAD_VALUES} ORDER BY r.id DESC LIMIT :limit",
        page,
    ).fetchall()
    runs = tuple(_infos(connection, rows[:limit]))
    total = connection.execute(
        f"SELECT count(*) FROM run r WHERE (:robot IS NULL OR robot_id = :robot) AND {HAD_VALUES}",
        asked,
    ).fetchone()[0]
    return RunList(runs, total, runs[-1].run_id if len(rows) > limit else None)


def run_info(connection: sqlite3.Connection, run_id: int) -> RunInfo:
    """Return one run.

    Raises:
        UnknownRunError: No run has that id.
    """
    (run,) = run_infos(connection, [run_id])
    return run


def run_infos(connection: sqlite3.Connection, run_ids: Sequence[int]) -> list[RunInfo]:
    """Return several runs in the given order.

    Raises:
        UnknownRunError: One of these ids does not exist.
    """
    ids = [fetch_run(connection, run_id).id for run_id in run_ids]
    return _infos(
        connection,
        [connection.execute(f"{_RUNS} WHERE r.id = ?", (each,)).fetchone() for each in ids],
    )


def annotate_run(
    connection: sqlite3.Connection,
    run_id: int,
    *,
    label: str | None = None,
    note: str | None = None,
) -> None:
    """Give a run a label (short, to find it by) or a note; an empty text removes it.

    Args:
        connection: A connection in the role "writer".
        run_id: The run.
        label: At most 100 characters; None leaves it unchanged.
        note: At most 4,000 characters; None leaves it unchanged.

    Raises:
        UnknownRunError: No run has that id.
        InvalidInputError: Neither is given, or one is too long.
    """
    if label is None and note is None:
        raise InvalidInputError(
            "Nothing to store. Give a label, a note or both, for example label='baseline'."
        )
    for name, text, longest in (
        ("label", label, _ANNOTATION.label),
        ("note", note, _ANNOTATION.note),
    ):
        if text is not None and len(text) > longest:
            raise InvalidInputError(
                f"The {name} has {len(text)} characters, and at most {longest} are kept. "
                "Shorten it."
            )
    values = {"run": run_id, "label": label, "note": note}
    with transaction(connection):  # the write waits for the lock, and Ctrl-C ends that
        if not connection.execute(
            "UPDATE run SET label = CASE WHEN :label IS NULL THEN label ELSE nullif(:label, '') "
            "END, note = CASE WHEN :note IS NULL THEN note ELSE nullif(:note, '') END WHERE id = "
            ":run",
            values,
        ).rowcount:
            fetch_run(connection, run_id)  # the error lists the existing runs


def pace(duration_s: float, wall_s: float) -> float | None:
    """Return the real-time factor; None if the wall time is under a second."""
    return duration_s / wall_s if wall_s >= 1 else None


def _infos(connection: sqlite3.Connection, rows: Sequence[tuple[Any, ...]]) -> list[RunInfo]:
    ended = dict(find_dead_sessions(connection))
    parameters = notable_parameters(connection, [row[0] for row in rows])
    return [_info(connection, row, ended, parameters[row[0]]) for row in rows]


def _info(
    connection: sqlite3.Connection,
    row: tuple[Any, ...],
    ended: dict[int, str],
    parameters: dict[str, Value | str],
) -> RunInfo:
    """Return the info of a run; `ended` has the outcome of sessions that still seem open."""
    *what, started_wall_s, last_wall_s, started_s, last_s = row
    named = dict(zip(_WHAT, what, strict=True))
    named["end_reason"] = named["end_reason"] or ended.get(named["session_id"])
    return RunInfo(
        **named,
        started_wall_time_s=started_wall_s,
        wall_duration_s=last_wall_s - started_wall_s,
        held_s=paused_s(connection, row[0], last_wall_s),
        duration_s=last_s - started_s,
        notable=dict(
            connection.execute(
                "SELECT 'log ' || level, count(*) FROM log WHERE run_id = :run "
                "AND level IN ('warning', 'error', 'critical') GROUP BY level UNION ALL "
                "SELECT kind, count(*) FROM event WHERE run_id = :run "
                "AND kind NOT IN ('change', 'start', 'reset', 'reload', 'inspection', 'episode', "
                "'record_scene', 'restored') "
                "GROUP BY kind UNION ALL "
                "SELECT 'command ' || status, count(*) FROM command c JOIN run r ON r.id = :run "
                "AND r.session_id = c.session_id WHERE c.status IN ('failed', 'lost') "
                "AND c.claimed_wall_time_s BETWEEN r.started_wall_time_s AND r.last_wall_time_s "
                "GROUP BY status",
                {"run": row[0]},
            ).fetchall()
        ),
        parameters=parameters,
    )


# Statistics of whole runs in groups: path, modes and events of an interval.


# -- `score_run`: the score of a finished run, by an expression over signals and events ------------
