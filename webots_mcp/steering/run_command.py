"""The command `run`: whether it can end as requested, and how far it has come.

`run` lets the simulation run until a condition holds or a simulated time is over.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import MAX_RUN_S
from webots_mcp.database.queue import QueuedCommand
from webots_mcp.errors import (
    CommandRefusedError,
    ConditionFailedError,
    InvalidInputError,
    UnknownSignalError,
)
from webots_mcp.signals.conditions import Condition, parse_condition
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import TimeRange, whole_run
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.runs import pace
from webots_mcp.store.sessions import fetch_session

ACTION: Final = "run"
_KEEP_THE_STATE: Final = (  # actions after which the newest row still shows the state
    "pause", "resume", "fast", "step", "run", "cancel_run", "screenshot", "take_frame",
    "record_scene", "save_world", "arm_breakpoints", "keep", "get_scene", "get_field",
)  # fmt: skip


class RunProgress(NamedTuple):
    """The progress of a `run` command.

    Attributes:
        run_id: The run in which it advances; None before the controller has claimed it.
        from_s: The simulation time at which it began, in seconds.
        to_s: The simulation time that it has reached, in seconds.
        factor: Simulated seconds per wall second; None where it is unknown.
    """

    run_id: int | None
    from_s: float
    to_s: float
    factor: float | None

    @property
    def advanced_s(self) -> float:
        """How much simulation time has passed, in seconds."""
        return max(self.to_s - self.from_s, 0.0)


def require_possible(
    recording: RecordingAccess,
    robot: str | None,
    until: str | None,
    for_s: float | None,
    *,
    reset: bool,
    parameters: bool = False,
) -> None:
    """Refuse a run that could not end as requested, before anything is sent.

    Args:
        recording: The recording of the robot.
        robot: Its name; None for the only one that can be meant.
        until: The condition at which the run ends.
        for_s: The simulated seconds after which it ends.
        reset: Whether the run begins with a reset.
        parameters: Whether the run begins by setting parameters.

    Raises:
        InvalidInputError: Neither a condition nor a time is given, or the condition is invalid or
            reads signals that were never published.
        CommandRefusedError: No controller of the robot could run it, or the condition holds
            already.
    """
    if until is None and for_s is None:
        raise InvalidInputError(
            "It is not said when to stop. Give for_s=10 (simulated seconds), until='x > 1' (a "
            "condition), or both."
        )
    if for_s is not None and not 0 < for_s <= MAX_RUN_S:
        raise InvalidInputError(
            f"for_s must be simulated seconds above 0 and at most {MAX_RUN_S:.0f}, not {for_s}."
        )
    condition = None if until is None else parse_condition(until)
    with recording.reader() as connection:
        view = find_target(connection, robot, ACTION)
        if condition is not None:
            _require_known(view, condition)
            if not (reset or parameters):
                _require_open(view, condition)


def known_names(view: RobotView) -> set[str]:
    """Return the signals that a robot published in its five newest runs; empty before any row."""
    newest = "SELECT id FROM run WHERE robot_id = ? ORDER BY id DESC LIMIT 5"
    runs = view.connection.execute(newest, (view.robot.id,)).fetchall()
    found = (whole_run(view.connection, run_id) for (run_id,) in runs)
    segments = tuple(segment for segment in found if segment is not None)
    if not segments:
        return set()
    asked = TimeRange(view.robot.id, view.robot.name, segments, "simulation")
    return set(known_signals(view.connection, asked))


def holds_since(connection: sqlite3.Connection, run_id: int, condition: Condition) -> float | None:
    """Return since when a condition holds at the newest row of a run; None if it does not.

    Only the last minute of simulation time is read.

    Raises:
        InvalidInputError: It cannot be evaluated on such values.
    """
    newest = newest_rows(connection, run_id, 4_000)
    rows = [row for row in newest if row[0] >= newest[0][0] - 60.0]
    evaluator, since_s = condition.evaluator(), None
    try:
        for sim_time_s, data in reversed(rows):
            if not evaluator.holds(json.loads(data), sim_time_s):
                since_s = None
            elif since_s is None:
                since_s = float(sim_time_s)
    except ConditionFailedError as error:
        raise InvalidInputError(f"{error} (Checked with the values published so far.)") from error
    return since_s


def newest_rows(
    connection: sqlite3.Connection, run_id: int, limit: int, end_s: float = math.inf
) -> list[tuple[float, str]]:
    """Return simulation time and data of the last rows of a run until a time, newest first."""
    return connection.execute(
        "SELECT sim_time_s, data FROM state WHERE run_id = ? AND sim_time_s <= ? "
        "ORDER BY sim_time_s DESC, id DESC LIMIT ?",
        (run_id, end_s, limit),
    ).fetchall()


def find_progress(connection: sqlite3.Connection, command: QueuedCommand) -> RunProgress:
    """Return the progress in the bridge's result; until there is one, that of the heartbeat."""
    if result := result_of(command):
        run_id = result.get("run_id") or _run_that_ended(connection, command)
        return RunProgress(run_id, result["from_s"], result["sim_time_s"], result.get("factor"))
    if command.session_id is None:
        return RunProgress(None, 0.0, 0.0, None)
    run = connection.execute(
        "SELECT id, last_sim_time_s, started_wall_time_s FROM run WHERE session_id = ? "
        "ORDER BY id DESC LIMIT 1",
        (command.session_id,),
    ).fetchone()
    session = fetch_session(connection, command.session_id)
    if run is None or session is None:
        return RunProgress(None, 0.0, 0.0, None)
    return _progress_of_newest_run(command, run, session.sim_time_s or 0.0)


def describe_progress(
    connection: sqlite3.Connection, command: QueuedCommand
) -> tuple[float, float | None, str]:
    """Return the simulated seconds so far, the wanted ones (None without a limit), and a text."""
    progress, params = find_progress(connection, command), params_of(command)
    until, for_s = params.get("until"), params.get("for_s")
    if progress.run_id is None:
        return 0.0, for_s, "waiting for the controller"
    of = f" of {for_s:g}" if for_s else ""
    text = f"{progress.advanced_s:.1f}{of} s simulated" + (f", until {until}" if until else "")
    return progress.advanced_s, for_s, text


def result_of(command: QueuedCommand) -> dict[str, Any]:
    """Return the bridge's result of a finished command; empty without one."""
    result = command.decoded_result()
    return cast("dict[str, Any]", result) if isinstance(result, dict) else {}


def params_of(command: QueuedCommand) -> Mapping[str, Any]:
    """Return the parameters of a command."""
    return json.loads(command.params)


def _require_known(view: RobotView, condition: Condition) -> None:
    """Refuse signals that were never published: most likely a name is misspelt."""
    known = known_names(view)  # empty before the first row, when nothing can be said
    if known and (unknown := condition.describe_unknown(known)):
        raise UnknownSignalError(
            f"{'. '.join(unknown)}. Robot {view.robot.name!r} never published it, so "
            f"until={condition.text!r} "
            "could never become true."
        )


def _require_open(view: RobotView, condition: Condition) -> None:
    """Refuse a condition that holds at the newest row: the run would be over at once.

    A condition with `changed` may hold: a change lasts one step, so the next one is awaited. One
    that held before the newest command may hold no more: the controller evaluates it on its next
    state.
    """
    if view.run is None or "changed(" in condition.text or _is_outdated(view):
        return
    since_s = holds_since(view.connection, view.run.id, condition)
    if since_s is None:
        return
    raise CommandRefusedError(
        f"{condition.text!r} already holds: at the newest row, since {since_s:.3f} s of simulation "
        f"time. Run until 'not ({condition.text})' first, give for_s alone, or give reset=true to "
        "begin a new run and evaluate it there."
    )


def _is_outdated(view: RobotView) -> bool:
    """Return whether a command that may have changed the state was answered after the newest row.

    Until the next row it is unknown what it changed.
    """
    if view.state is None:
        return False
    listed = ", ".join("?" * len(_KEEP_THE_STATE))
    ((answered_s,),) = view.connection.execute(
        "SELECT max(finished_wall_time_s) FROM command WHERE robot_id = ? AND status = 'done' "
        f"AND action NOT IN ({listed})",
        (view.robot.id, *_KEEP_THE_STATE),
    ).fetchall()
    return answered_s is not None and answered_s >= view.state.wall_time_s


def _run_that_ended(connection: sqlite3.Connection, command: QueuedCommand) -> int | None:
    """Return the run in which it ended, if the bridge did not know its id: its row was waiting."""
    return connection.execute(
        "SELECT max(id) FROM run WHERE session_id = ? AND started_wall_time_s <= ?",
        (command.session_id, command.finished_wall_time_s),
    ).fetchone()[0]


def _progress_of_newest_run(
    command: QueuedCommand, run: tuple[int, float, float], heartbeat_sim_time_s: float
) -> RunProgress:
    run_id, last_s, began_wall_s = run
    claimed_wall_s, to_s = command.claimed_wall_time_s or 0.0, max(last_s, heartbeat_sim_time_s)
    has_reset = began_wall_s >= claimed_wall_s
    from_s = 0.0 if has_reset else command.claimed_sim_time_s or 0.0
    wall_s = (command.finished_wall_time_s or time.time()) - max(claimed_wall_s, began_wall_s)
    if params_of(command).get("reset") and not has_reset:
        to_s = from_s
    return RunProgress(run_id, from_s, to_s, pace(to_s - from_s, wall_s))
