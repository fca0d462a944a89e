"""What a controller writes while it runs: each kind of write by its name, with its statement.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

from typing import Any, Final, Literal, NamedTuple

from webots_mcp import queue

Kind = Literal[
    "run",
    "state",
    "event",
    "log",
    "image",
    "image forgotten",
    "run end",
    "session end",
    "actions",
    "parameter",
    "parameter values",
    "parameter next",
    "command issued",
    "command finished",
    "reload confirmed",
    "breakpoint hit",
    "breakpoint failed",
    "breakpoints forgotten",
    "kept stretch",
    "kept state",
]
Values = tuple[Any, ...] | dict[str, Any]

# Values in order follow on the run's id, where there is a run; named ones may use the ids of
# `run` and `session` too. Ids are those of the database at hand, so they never wait in a file.
STATEMENTS: Final[dict[Kind, str]] = {
    "run": (
        "INSERT INTO run (uuid, session_id, robot_id, world, basic_time_step_ms, start_reason, "
        "started_wall_time_s, started_sim_time_s, last_wall_time_s, last_sim_time_s) "
        "SELECT :uuid, id, robot_id, :world, :step_ms, :reason, :wall_time, :sim_time, "
        ":wall_time, :sim_time FROM session WHERE id = :session "
        # A conflict, instead of this question, would use up an id.
        "AND NOT EXISTS (SELECT 1 FROM run WHERE uuid = :uuid)"
    ),
    "state": (
        "INSERT INTO state (run_id, sim_time_s, wall_time_s, data, replaced) VALUES (?, ?, ?, ?, ?)"
    ),
    "event": (
        "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name, data) "
        "VALUES (?, ?, ?, ?, ?, ?)"
    ),
    "log": (
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message, logger) "
        "VALUES (?, ?, ?, ?, ?, ?, ?)"
    ),
    "image": (
        "INSERT INTO image (run_id, sim_time_s, wall_time_s, kind, device, path, width, height, "
        "size_bytes) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
    ),
    "image forgotten": "DELETE FROM image WHERE path = ?",
    # Without a number of rows they are counted: a dead process could not say how many.
    "run end": (
        "UPDATE run SET end_reason = :reason, ended_wall_time_s = :now, last_wall_time_s = :now, "
        "last_sim_time_s = :sim_time, row_count = coalesce(:rows, "
        "purged_rows + (SELECT count(*) FROM state WHERE run_id = :run)) WHERE id = :run"
    ),
    "session end": (
        "UPDATE session SET ended_wall_time_s = :now, last_seen_wall_time_s = :now, "
        "last_seen_monotonic_s = :monotonic, end_reason = :reason, rows_waiting = 0, "
        "rows_dropped = :dropped, last_error = :error WHERE id = :session"
    ),
    "actions": "UPDATE session SET actions = :actions WHERE id = :session",
    # What a session declared that ended before another began does not count any more.
    "parameter": (
        "INSERT INTO parameter (robot_id, session_id, name, kind, default_value, low, high, "
        "choices, doc, unit, declared_wall_time_s) SELECT robot_id, id, :name, :kind, :default, "
        ":low, :high, :choices, :doc, :unit, :now FROM session WHERE id = :session "
        "ON CONFLICT (robot_id, name) DO UPDATE SET session_id = excluded.session_id, "
        "kind = excluded.kind, default_value = excluded.default_value, low = excluded.low, "
        "high = excluded.high, choices = excluded.choices, doc = excluded.doc, "
        "unit = excluded.unit, declared_wall_time_s = excluded.declared_wall_time_s, "
        "next_value = NULL WHERE excluded.session_id >= parameter.session_id"
    ),
    # Many at once, all or none: each of `rows` is name, value, is it the default, by whom, command.
    "parameter values": (
        "INSERT INTO parameter_value (run_id, name, sim_time_s, wall_time_s, value, is_default, "
        "set_by, command_id) SELECT :run, json_extract(r.value, '$[0]'), :sim_time, :now, "
        "json_extract(r.value, '$[1]'), json_extract(r.value, '$[2]'), "
        "json_extract(r.value, '$[3]'), (SELECT id FROM command "
        "WHERE id = json_extract(r.value, '$[4]') AND session_id = :session) "
        "FROM json_each(:rows) r"
    ),
    "parameter next": (
        "UPDATE parameter SET next_value = r.next_value FROM (SELECT "
        "json_extract(value, '$[0]') AS name, json_extract(value, '$[1]') AS next_value "
        "FROM json_each(:rows)) AS r WHERE parameter.name = r.name AND session_id = :session "
        "AND robot_id = (SELECT robot_id FROM session WHERE id = :session)"
    ),
    "command issued": queue.ISSUE,
    "command finished": queue.FINISH,
    "reload confirmed": queue.CONFIRM_RELOAD,
    "breakpoint hit": "UPDATE breakpoint SET hit_count = hit_count + 1 WHERE id = ?",
    "breakpoint failed": "UPDATE breakpoint SET enabled = 0, error = ? WHERE id = ?",
    # What a controller's code has set ends with its session.
    "breakpoints forgotten": (
        "DELETE FROM breakpoint WHERE robot_id = (SELECT robot_id FROM session "
        "WHERE id = :session) AND created_by = :by AND coalesce(session_id, 0) < :session"
    ),
    "kept stretch": (
        "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, wall_time_s, "
        "reason) VALUES (:run, :uuid, :start, :end, :wall_time, :reason) ON CONFLICT (uuid) "
        "DO UPDATE SET end_sim_time_s = excluded.end_sim_time_s, reason = excluded.reason"
    ),
    "kept state": (
        "INSERT INTO kept_state (run_id, call, sim_time_s, wall_time_s, data, replaced) "
        "VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (run_id, call) DO NOTHING"
    ),
}


class Entry(NamedTuple):
    """One write of a session.

    Attributes:
        number: Rising within the session; what was taken in once is known by it.
        kind: Which of `STATEMENTS`.
        run: UUID of the run that it belongs to.
        values: Of the statement.
    """

    number: int
    kind: Kind
    run: str | None
    values: Values


def bind(run_id: int | None, session_id: int | None, values: Values) -> Values:
    """The values of a statement, with the ids of its run and session."""
    if isinstance(values, dict):
        return {"run": run_id, "session": session_id, **values}
    return values if run_id is None else (run_id, *values)
