"""The answer about a command that was sent: its outcome, what to do next, and of a `run` the facts.

A `run` is answered with why it stopped, how far it came, the state at its end and what happened.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, cast

from webots_mcp.answers.answer_models import CommandAnswer, RunAnswer
from webots_mcp.answers.budget import RESULT_BUDGET_TOKENS, detailed, figure, seconds, shown, table
from webots_mcp.answers.event_tables import fitting_events, not_shown_of
from webots_mcp.answers.movement import movement
from webots_mcp.answers.shortening import WHOLE, cut_text, shorten
from webots_mcp.answers.trend_tables import MOST_SIGNALS, trend_tables
from webots_mcp.contract import HEARTBEAT_LATE_S
from webots_mcp.database.queue import QueuedCommand
from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.events import search_events
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.signals.naming import flatten
from webots_mcp.steering.run_command import (
    ACTION,
    RunProgress,
    find_progress,
    newest_rows,
    params_of,
    result_of,
)
from webots_mcp.store.loop_evidence import handler_at_work
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.reading.segment import Subject
from webots_mcp.store.recording import RobotView
from webots_mcp.store.relative_times import ago
from webots_mcp.store.robot_status import PRESS_PLAY, find_block
from webots_mcp.store.run_rows import state_at

# The mode of the simulation after a command; a `run` sets what its `then` says.
_MODES: Final = {"pause": "pause", "step": "pause", "resume": "real_time", "fast": "fast"}


@dataclass(frozen=True)
class RunAnswerSizes:
    """How much of a `run` its answer shows: together about 1,500 tokens.

    Attributes:
        state_tokens: Budget of the state at the end.
        trends_tokens: Budget of the trends.
        trends_signals: Signals with a trend.
        events_tokens: Budget of the events.
        events: Events in all.
        rows: Rows before the end.
        row_signals: Columns of these rows: signals of the condition.
        cell_tokens: Budget of one value in such a row.
    """

    state_tokens: int = 400
    trends_tokens: int = 450
    trends_signals: int = 8
    events_tokens: int = 400
    events: int = 12
    rows: int = 6
    row_signals: int = 8
    cell_tokens: int = 16


_SIZES: Final = RunAnswerSizes()


def command_answer(view: RobotView, command: QueuedCommand, waited_s: float) -> CommandAnswer:
    """Return the answer about a command after that many wall seconds of waiting."""
    failed = command.status != "done" and command.error is not None
    facts: dict[str, Any] = {
        **view.header(),
        "command_id": command.id,
        "action": command.action,
        "outcome": command.status,
        "waited_wall_s": waited_s,
        "error": cut_text(command.error or "", 2_000) if failed else None,
        "hint": _hint(view, command),
    }
    if command.action == ACTION:
        return RunAnswer(**facts, **_run_facts(view, command))
    answer = CommandAnswer(**facts, result=shown_result(command))
    correct_mode(view, command, answer)
    return answer


def shown_result(command: QueuedCommand, budget_tokens: int = RESULT_BUDGET_TOKENS) -> Any:
    """Return the result of a command with exact numbers; long values are shortened."""
    if command.result is None:
        return None
    return shorten(command.decoded_result(), budget_tokens, WHOLE).value


def correct_mode(view: RobotView, command: QueuedCommand, answer: CommandAnswer) -> None:
    """Correct the mode in the answer about a command that a later command has followed."""
    if command.action not in _MODES or command.status not in ("done", "failed"):
        return
    later = view.connection.execute(
        "SELECT id, action, status, params, result FROM command WHERE id > :id AND status IN "
        "('pending', 'claimed', 'done') AND action IN ('pause', 'step', 'resume', 'fast', 'run') "
        "AND robot_id IN (SELECT o.robot_id FROM session o JOIN session s "
        "ON s.instance = o.instance WHERE s.id = :session AND o.ended_wall_time_s IS NULL) "
        "ORDER BY id DESC LIMIT 1",
        {"id": command.id, "session": command.session_id},
    ).fetchone()
    if later is None:
        return
    later_id, action, status, params, result = later
    known: dict[str, Any] = json.loads(result) if status == "done" and result else {}
    then = json.loads(params).get("then", "pause")
    mode = known.get("mode") or _MODES.get(action, "pause" if then == "pause" else None)
    if mode is None:
        return
    if command.status == "done" and answer.result:
        answer.result = cast("dict[str, Any]", answer.result) | {"mode": mode}
    when = "now" if status == "done" else "once that has been done"
    note = f"command {later_id} ({action}) came after it: the mode is {mode} {when}"
    if note not in (answer.hint or ""):
        answer.hint = "; ".join(filter(None, (answer.hint, note)))


# -- what to do next --------------------------------------------------------------------------


def _hint(view: RobotView, command: QueuedCommand) -> str | None:
    """Say what to do next, where the outcome alone does not say it."""
    if command.status == "pending":
        return "no controller has claimed it yet"
    if command.status == "done":
        # The values of the result that had to be replaced, or what was not done as it was asked.
        return command.error or result_of(command).get("warning")
    if command.status == "failed":
        described = view.session is not None and command.action in view.session.actions
        return "webots_list_commands has the action's description" if described else None
    if command.status == "claimed":
        block = find_block(view.connection, view.session, view.run, view.now_s)
        why = f"{block.why}: {block.fix}" if block else "the controller is still running it"
        return (
            f"{why}; keep waiting with "
            f"webots_wait_for_command(command_id={command.id}); do not send it again"
        )
    if command.status == "lost":
        return _hint_after_loss(view)
    return _hint_unclaimed(view)


def _hint_after_loss(view: RobotView) -> str:
    """Say what to do after a lost command, which may have run: start, check, then send again."""
    check = "check the robot's state before you send it again"
    if view.robot.live:
        return check
    return f"start its controller (reload the world in Webots; an extern one by hand), then {check}"


def _hint_unclaimed(view: RobotView) -> str:
    """Say what keeps the controller's loop from claiming commands."""
    session = view.session
    if block := find_block(view.connection, session, view.run, view.now_s):
        return f"{block.fix}, then ask again"
    if session is None or not view.robot.live:
        return "start its controller, then ask again"
    if handler_at_work(view.connection, session, view.now_s):
        return "wait until that handler has returned, then ask again"
    if not session.heartbeat_is_fresh(view.now_s):
        return PRESS_PLAY
    if session.last_poll_wall_time_s is None:
        return "the controller's loop never calls bridge.get_command(): add that line to its loop"
    silent_s = session.age_s(session.last_poll_wall_time_s, view.now_s)
    if silent_s > HEARTBEAT_LATE_S:
        return f"its loop runs, but last called bridge.get_command() {ago(silent_s)}"
    return "its loop runs but did not claim it in time: ask again with a longer timeout_wall_s"


# -- facts about a run ------------------------------------------------------------------------


def _run_facts(view: RobotView, command: QueuedCommand) -> dict[str, Any]:
    """Return why a `run` command stopped, its progress, its values and its events."""
    progress, result = find_progress(view.connection, command), result_of(command)
    stopped, why = _stop_reason(command, result)
    facts: dict[str, Any] = {"stopped": stopped, "stop_reason": why}
    if progress.run_id is None or stopped is None:
        return facts
    facts |= {
        "ran": {
            "run_id": progress.run_id,
            "start_s": seconds(progress.from_s),
            "end_s": seconds(progress.to_s),
            "advanced_s": seconds(progress.advanced_s),
            "real_time_factor": figure(progress.factor),
        },
        "values": shown(result.get("values")) if result.get("values") else None,
        "mode": result.get("mode"),
    }
    if command.is_final:
        facts |= _what_happened(view, command, progress, progress.run_id)
    return facts


def _stop_reason(
    command: QueuedCommand, result: Mapping[str, Any]
) -> tuple[str | None, str | None]:
    if command.status == "claimed":
        return "wall time limit reached", "it continues, and ends as requested"
    if command.status == "lost":
        return "run ended", command.error
    return result.get("ended"), result.get("why")


def _what_happened(
    view: RobotView, command: QueuedCommand, progress: RunProgress, run_id: int
) -> dict[str, Any]:
    """Return the state at the end, trends and events in between, and the rows before the end."""
    end_s = progress.to_s + SAME_TIME_S
    facts: dict[str, Any] = {"rows": _rows_before_end(view, command, run_id, end_s)}
    if state := state_at(view.connection, run_id, end_s):
        short = shorten(state.value(), _SIZES.state_tokens)
        facts |= {
            "state": short.value,
            "state_at_s": seconds(state.sim_time_s),
            "shortened": short.rule,
        }
    scope = Scope(start_s=progress.from_s, end_s=max(progress.to_s, progress.from_s) + 0.001)
    subject = Subject(view.robot.id, view.robot.name, run_id)
    try:
        asked = find_range(view.connection, scope, subject)
    except NothingRecordedError:
        return facts
    return facts | _trends_and_events(view, command, asked)


def _rows_before_end(view: RobotView, command: QueuedCommand, run_id: int, end_s: float) -> Any:
    """Return the last rows with the signals of the condition; None without a condition."""
    until = params_of(command).get("until")
    rows = newest_rows(view.connection, run_id, _SIZES.rows, end_s)
    if until is None or not rows:
        return None
    names = parse_condition(until).signals[: _SIZES.row_signals]
    lines: list[list[Any]] = []
    for sim_time_s, data in reversed(rows):
        values = flatten(json.loads(data))
        cells = (detailed(values.get(name), _SIZES.cell_tokens) for name in names)
        lines.append([seconds(sim_time_s), *cells])
    return table(("sim_time_s", *names), lines)


def _trends_and_events(view: RobotView, command: QueuedCommand, asked: TimeRange) -> dict[str, Any]:
    from webots_mcp.judging.trends import trends

    (of_run,) = trends(view.connection, asked, limit=MOST_SIGNALS, shown=_SIZES.trends_signals).runs
    found = search_events(view.connection, asked)
    of_others = found.only([event for event in found.events if not _is_own(event, command)])
    shown_events, events = fitting_events(of_others, _SIZES.events, _SIZES.events_tokens, view)
    has_trends = of_run.rows or of_run.cut_at_s is not None
    return {
        "movement": movement(view, asked),
        "trends": trend_tables(of_run, _SIZES.trends_signals, _SIZES.trends_tokens)
        if has_trends
        else None,
        "events": events,
        "not_shown": not_shown_of(shown_events),
    }


def _is_own(event: Event, command: QueuedCommand) -> bool:
    """Return whether an event is the command itself, or the pause that it began or ended."""
    if event.kind == "command":
        return event.details.get("id") == command.id
    data: dict[str, Any] = event.details.get("data") or {}
    return event.kind == "bridge_event" and data.get("command_id") == command.id
