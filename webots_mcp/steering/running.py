"""The `run` command: what is refused before it is sent, its progress, and its outcome."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, cast

from webots_mcp.conditions import Condition, parse_condition
from webots_mcp.conditions.signal_values import SAME_TIME_S
from webots_mcp.contract import MAX_RUN_S
from webots_mcp.errors import (
    CommandRefusedError,
    ConditionFailedError,
    InvalidInputError,
    NothingRecordedError,
    UnknownSignalError,
)
from webots_mcp.naming import flatten
from webots_mcp.questions.budget import detailed, figure, seconds, shown, table
from webots_mcp.questions.find_events import fitting_events, not_shown_of
from webots_mcp.questions.get_trends import MOST_SIGNALS, trend_tables
from webots_mcp.questions.shortening import shorten
from webots_mcp.queue import Command
from webots_mcp.steering.target_robot import find_target
from webots_mcp.steering.watching import movement
from webots_mcp.store.detection.events import search_events
from webots_mcp.store.detection.kinds import Event
from webots_mcp.store.questions.runs import pace
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, Subject, TimeRange, find_range, whole_run
from webots_mcp.store.recording import Recording, View
from webots_mcp.store.robots import fetch_session
from webots_mcp.store.run_rows import State, state_at
from webots_mcp.store.sessions import fetch_session

ACTION: Final = "run"
_ROWS_AROUND: Final = 6
_STATE_TOKENS: Final = 400
_TRENDS_TOKENS: Final = 450
_EVENTS_TOKENS: Final = 400
_CELL_TOKENS: Final = 16  # of a row before the end
_SHOWN_SIGNALS: Final = 8
_SHOWN_EVENTS: Final = 12
_MOST_COLUMNS: Final = 8
_REMEMBERED_S: Final = 60.0  # how far back rows are read to see whether a condition holds already
_MOST_REMEMBERED_ROWS: Final = 4_000
_RUNS_SEARCHED: Final = 5

_OF_SESSION: Final = (
    "SELECT id, started_sim_time_s, last_sim_time_s, started_wall_time_s FROM run "
    "WHERE session_id = ? ORDER BY id DESC LIMIT 1"
)
_BEGUN_BY: Final = "SELECT max(id) FROM run WHERE session_id = ? AND started_wall_time_s <= ?"
_LAST_ROWS: Final = (
    "SELECT sim_time_s, data FROM state WHERE run_id = ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
_NEWEST_RUNS: Final = "SELECT id FROM run WHERE robot_id = ? ORDER BY id DESC LIMIT ?"


# -- before it is sent ------------------------------------------------------------------------


def require_possible(
    recording: Recording, robot: str | None, until: str | None, for_s: float | None, *, reset: bool
) -> None:
    """Refuse a run that could not end as requested, before anything is sent.

    Raises:
        InvalidInputError: Neither a condition nor a time is given, or the condition is invalid or
            reads signals that were never published.
        CommandRefusedError: No controller of the robot could run it, or the condition holds
            already.
    """
    if until is None and for_s is None:
        raise InvalidInputError(
            "give until=... (a condition), for_s=... (simulated seconds), or both"
        )
    if for_s is not None and not 0 < for_s <= MAX_RUN_S:
        raise InvalidInputError(
            f"for_s must be simulated seconds above 0 and at most {MAX_RUN_S:.0f}, not {for_s}"
        )
    condition = None if until is None else parse_condition(until)
    with recording.reader() as connection:
        view = find_target(connection, robot, ACTION)
        if condition is not None:
            _require_known(view, condition)
            if not reset:
                _require_open(view, condition)


def _require_known(view: View, condition: Condition) -> None:
    """Refuse signals that were never published: most likely a name is misspelt."""
    known = known_names(view)  # empty before the first row, when nothing can be said
    if known and (unknown := condition.describe_unknown(known)):
        raise UnknownSignalError(
            "; ".join(unknown)
            + f": {'it was' if len(unknown) == 1 else 'they were'} never published by robot "
            f"{view.robot.name!r}, so the condition could never hold"
        )


def known_names(view: View) -> set[str]:
    """The signals that a robot published in its newest runs; empty before the first row."""
    runs = view.connection.execute(_NEWEST_RUNS, (view.robot.id, _RUNS_SEARCHED)).fetchall()
    found = (whole_run(view.connection, run_id) for (run_id,) in runs)
    segments = tuple(segment for segment in found if segment is not None)
    if not segments:
        return set()
    asked = TimeRange(view.robot.id, view.robot.name, segments, "simulation")
    return set(known_signals(view.connection, asked))


def _require_open(view: View, condition: Condition) -> None:
    """Refuse a condition that holds at the newest row: the run would be over at once.

    A condition with `changed` may hold: a change lasts one step, so the next one is awaited.
    """
    if view.run is None or "changed(" in condition.text:
        return
    since_s = holds_since(view.connection, view.run.id, condition)
    if since_s is None:
        return
    raise CommandRefusedError(
        f"{condition.text!r} already holds, at the newest row since {since_s:.3f} s of simulation "
        f"time: run until 'not ({condition.text})' first, give for_s alone, or give reset=true, so "
        "that it is evaluated after the reset"
    )


def holds_since(connection: sqlite3.Connection, run_id: int, condition: Condition) -> float | None:
    """Since when a condition holds in the last rows of a run; None where it does not.

    Raises:
        InvalidInputError: It cannot be evaluated on such values.
    """
    newest = connection.execute(_LAST_ROWS, (run_id, 1e300, _MOST_REMEMBERED_ROWS)).fetchall()
    rows = [row for row in newest if row[0] >= newest[0][0] - _REMEMBERED_S]
    evaluator, since_s = condition.evaluator(), None
    try:
        for sim_time_s, data in reversed(rows):
            if not evaluator.holds(json.loads(data), sim_time_s):
                since_s = None
            elif since_s is None:
                since_s = float(sim_time_s)
    except ConditionFailedError as error:
        raise InvalidInputError(f"{error} (in the values published so far)") from error
    return since_s


# -- while it is running ----------------------------------------------------------------------


class Progress(NamedTuple):
    """The progress of a `run` command.

    Attributes:
        run_id: The run in which it advances; None before the controller has claimed it.
        from_s: The simulation time at which it began, in seconds.
        to_s: The simulation time that it has reached, in seconds.
        factor: Simulated per wall seconds; None where it is unknown.
    """

    run_id: int | None
    from_s: float
    to_s: float
    factor: float | None

    @property
    def advanced_s(self) -> float:
        """Simulated seconds."""
        return max(self.to_s - self.from_s, 0.0)


def _progress_in(connection: sqlite3.Connection, command: Command) -> Progress:
    """The progress in the bridge's result; until there is one, as the heartbeat shows it."""
    if result := _result_of(command):
        run_id = result.get("run_id") or _run_of(connection, command)
        return Progress(run_id, result["from_s"], result["sim_time_s"], result.get("factor"))
    if command.session_id is None:
        return Progress(None, 0.0, 0.0, None)
    row = connection.execute(_OF_SESSION, (command.session_id,)).fetchone()
    session = fetch_session(connection, command.session_id)
    if row is None or session is None:
        return Progress(None, 0.0, 0.0, None)
    return _observed_progress(command, row, session.sim_time_s or 0.0)


def _run_of(connection: sqlite3.Connection, command: Command) -> int | None:
    """The run in which it ended, where the bridge did not know its id: its row was waiting."""
    times = (command.session_id, command.finished_wall_time_s)
    return connection.execute(_BEGUN_BY, times).fetchone()[0]


def _observed_progress(
    command: Command, run: tuple[int, float, float, float], beat_s: float
) -> Progress:
    run_id, _, last_s, began_wall_s = run
    claimed_wall_s, to_s = command.claimed_wall_time_s or 0.0, max(last_s, beat_s)
    has_reset = began_wall_s >= claimed_wall_s
    from_s = 0.0 if has_reset else command.claimed_sim_time_s or 0.0
    wall_s = (command.finished_wall_time_s or time.time()) - max(claimed_wall_s, began_wall_s)
    if _params_of(command).get("reset") and not has_reset:
        to_s = from_s
    return Progress(run_id, from_s, to_s, pace(to_s - from_s, wall_s))


def progress_of(
    connection: sqlite3.Connection, command: Command
) -> tuple[float, float | None, str]:
    """Simulated seconds so far, the wanted ones (None without a limit), and a text."""
    progress = _progress_in(connection, command)
    until, for_s = (_params_of(command).get(name) for name in ("until", "for_s"))
    if progress.run_id is None:
        return 0.0, for_s, "waiting for the controller"
    of = f" of {for_s:g}" if for_s else ""
    word = f"{progress.advanced_s:.1f}{of} s simulated" + (f", until {until}" if until else "")
    return progress.advanced_s, for_s, word


def _result_of(command: Command) -> dict[str, Any]:
    """The bridge's result of a finished run; empty where there is none."""
    result = command.decoded_result()
    return cast("dict[str, Any]", result) if isinstance(result, dict) else {}


def _params_of(command: Command) -> Mapping[str, Any]:
    """The parameters of a command."""
    return json.loads(command.params)


# -- when it is over --------------------------------------------------------------------------


def run_facts(view: View, command: Command) -> dict[str, Any]:
    """The facts of an answer about a `run` command: why it stopped, its progress, its events."""
    progress, result = _progress_in(view.connection, command), _result_of(command)
    stopped, why = _stop_reason(command, result)
    facts: dict[str, Any] = {"stopped": stopped, "stop_reason": why}
    if progress.run_id is None or stopped is None:
        return facts
    facts |= {
        "ran": {
            "run_id": progress.run_id,
            "from_s": seconds(progress.from_s),
            "to_s": seconds(progress.to_s),
            "advanced_s": seconds(progress.advanced_s),
            "factor": figure(progress.factor),
        },
        "values": shown(result.get("values")) if result.get("values") else None,
        "mode": result.get("mode"),
    }
    return facts | _what_happened(view, command, progress) if command.is_final else facts


def _stop_reason(command: Command, result: Mapping[str, Any]) -> tuple[str | None, str | None]:
    if command.status == "claimed":
        return "wall time limit reached", "it continues, and ends as requested"
    if command.status == "lost":
        return "run ended", command.error
    return result.get("ended"), result.get("why")


def _what_happened(view: View, command: Command, progress: Progress) -> dict[str, Any]:
    """The state at the end, trends and events in between, and the rows before the end."""
    assert progress.run_id is not None
    subject = Subject(view.robot.id, view.robot.name, progress.run_id)
    end_s = progress.to_s + SAME_TIME_S
    facts: dict[str, Any] = {"rows": _last_rows(view, command, progress, end_s)}
    if state := state_at(view.connection, progress.run_id, end_s):
        facts |= _as_shown(state)
    scope = Scope(start_s=progress.from_s, end_s=max(progress.to_s, progress.from_s) + 0.001)
    try:
        asked = find_range(view.connection, scope, subject)
    except NothingRecordedError:
        return facts
    return facts | _in_between(view, command, asked)


def _as_shown(state: State) -> dict[str, Any]:
    short = shorten(state.value(), _STATE_TOKENS)
    return {
        "state": short.value,
        "state_at_s": seconds(state.sim_time_s),
        "shortened": short.rule,
    }


def _in_between(view: View, command: Command, asked: TimeRange) -> dict[str, Any]:
    (of_run,) = trends(view.connection, asked, limit=MOST_SIGNALS).runs
    found = search_events(view.connection, asked)
    of_others = found.only([each for each in found.events if not _is_own(each, command)])
    shown_events, events = fitting_events(of_others, _SHOWN_EVENTS, _EVENTS_TOKENS, view)
    return {
        "movement": movement(view, asked),
        "trends": trend_tables(of_run, _SHOWN_SIGNALS, _TRENDS_TOKENS)
        if of_run.rows or of_run.cut_at_s is not None
        else None,
        "events": events,
        "not_shown": not_shown_of(shown_events),
    }


def _is_own(event: Event, command: Command) -> bool:
    """Whether it is the command itself, or the pause that it began or ended."""
    if event.kind == "command":
        return event.details.get("id") == command.id
    data: dict[str, Any] = event.details.get("data") or {}
    return event.kind == "bridge_event" and data.get("command_id") == command.id


def _last_rows(view: View, command: Command, progress: Progress, end_s: float) -> Any:
    """The last rows, of the condition's signals."""
    until = _params_of(command).get("until")
    rows = view.connection.execute(_LAST_ROWS, (progress.run_id, end_s, _ROWS_AROUND)).fetchall()
    if until is None or not rows:
        return None
    condition = parse_condition(until)
    names = condition.signals[:_MOST_COLUMNS]
    lines: list[list[Any]] = []
    for sim_time_s, data in reversed(rows):
        values = flatten(json.loads(data))
        lines.append(
            [seconds(sim_time_s), *(detailed(values.get(name), _CELL_TOKENS) for name in names)]
        )
    return table(("sim_time_s", *names), lines)
