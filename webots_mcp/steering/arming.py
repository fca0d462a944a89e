"""Setting and removing breakpoints: stored for the robot, and read again by its controller."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Any, Final

from anyio import to_thread

from webots_mcp import stored_breakpoints as stored
from webots_mcp.conditions import Condition, parse_condition
from webots_mcp.contract import BreakpointAction
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.questions.answers import BreakpointAnswer, CommandAnswer
from webots_mcp.questions.shortening import cut_text
from webots_mcp.steering.dispatch import Dispatcher, Report
from webots_mcp.steering.running import holds_since
from webots_mcp.store.reading.subject import Subject
from webots_mcp.store.recording import Recording, View
from webots_mcp.store.signals.catalogue import catalogue

BREAKPOINT_COLUMNS: Final = (
    "id", "condition", "action", "after_hits", "hit_count", "newest_hit_run_id", "newest_hit_s",
    "set_by", "off_because",
)  # fmt: skip
_ARM: Final = "arm_breakpoints"
_WAIT_S: Final = 5.0
_LONGEST_TEXT: Final = 300


async def set_breakpoint(
    recording: Recording,
    report: Report,
    condition: str,
    *,
    action: BreakpointAction = "pause",
    after_hits: int = 1,
    robot: str | None = None,
    set_by: str = "mcp",
) -> BreakpointAnswer:
    """Store a breakpoint, let the controller arm it, and report whether it did.

    Raises:
        InvalidInputError: The condition is not in the language, or there are too many already.
        NothingRecordedError: There is no robot.
    """
    parsed = parse_condition(condition)
    name, number, notes = await to_thread.run_sync(
        _store, recording, robot, parsed, action, after_hits, set_by
    )
    reply = await _arm(recording, report, name)
    armed = number in reply.armed
    if action == "pause" and reply.cannot_pause:
        notes.append(f"it will record its hits, but not pause: {reply.cannot_pause}")
    return BreakpointAnswer(
        **await to_thread.run_sync(_header, recording, name),
        breakpoint_id=number,
        condition=parsed.text,
        action=action,
        armed=armed,
        notes=notes or None,
        hint=None if armed else f"it is stored, but not armed yet: {reply.why_not}",
    )


async def remove_breakpoint(
    recording: Recording, report: Report, breakpoint_id: int, *, robot: str | None = None
) -> BreakpointAnswer:
    """Remove a breakpoint, and let the controller disarm it.

    Raises:
        InvalidInputError: The robot has no breakpoint of that id.
        NothingRecordedError: There is no robot.
    """
    name = await to_thread.run_sync(_remove, recording, robot, breakpoint_id)
    reply = await _arm(recording, report, name)
    return BreakpointAnswer(
        **await to_thread.run_sync(_header, recording, name),
        breakpoint_id=breakpoint_id,
        armed=breakpoint_id in reply.armed,
        hint=f"removed; {reply.why_not}" if reply.why_not else None,
    )


def breakpoint_rows(view: View) -> list[list[Any]]:
    """The robot's breakpoints, under `BREAKPOINT_COLUMNS`."""
    listed = stored.list_breakpoints(view.connection, view.robot.id)
    return [_row(view.connection, each) for each in listed]


@dataclass(frozen=True)
class _Reply:
    """The controller's reply to `arm_breakpoints`.

    Attributes:
        armed: The ids of the armed breakpoints.
        cannot_pause: Why the controller cannot pause; None where it can.
        why_not: Why it has not read its breakpoints again; empty where it has.
    """

    armed: tuple[int, ...] = ()
    cannot_pause: str | None = None
    why_not: str = ""


def _store(
    recording: Recording,
    robot: str | None,
    condition: Condition,
    action: BreakpointAction,
    after_hits: int,
    set_by: str,
) -> tuple[str, int, list[str]]:
    """Name of the robot, id of the breakpoint, and notes on its signals."""
    with recording.view(robot) as view:
        name, robot_id, notes = view.robot.name, view.robot.id, _notes(view, condition)
    with recording.writer() as connection:
        number = stored.set_breakpoint(connection, robot_id, condition, action, after_hits, set_by)
    return name, number, notes


def _notes(view: View, condition: Condition) -> list[str]:
    if view.run is None:
        return condition.describe_unknown(())
    subject = Subject(view.robot.id, view.robot.name, view.run.id)
    notes = condition.describe_unknown(catalogue(view.connection, subject))
    try:
        holds_since(view.connection, view.run.id, condition)
    except InvalidInputError as error:
        notes.append(f"it will be turned off by the next state like the last ones: {error}")
    return notes


def _remove(recording: Recording, robot: str | None, breakpoint_id: int) -> str:
    with recording.view(robot) as view:
        name, robot_id = view.robot.name, view.robot.id
    with recording.writer() as connection:
        stored.remove_breakpoint(connection, robot_id, breakpoint_id)
    return name


async def _arm(recording: Recording, report: Report, robot: str) -> _Reply:
    """Let the controller read its breakpoints again."""
    try:
        answer = await Dispatcher(recording, report).ask(robot, _ARM, _WAIT_S)
    except CommandRefusedError as refused:
        return _Reply(why_not=f"{refused}. A controller of this robot reads them when it starts")
    if answer.outcome != "done":
        return _Reply(why_not=f"{_reason(answer)}. It will read them at the next reset in any case")
    result: dict[str, Any] = answer.result
    return _Reply(tuple(result.get("armed", ())), result.get("cannot_pause"))


def _reason(answer: CommandAnswer) -> str:
    return answer.error or answer.hint or f"the controller's answer was {answer.outcome}"


def _header(recording: Recording, robot: str) -> dict[str, Any]:
    with recording.view(robot) as view:
        return view.header()


def _row(connection: sqlite3.Connection, each: stored.StoredBreakpoint) -> list[Any]:
    hit = stored.newest_hit(connection, each.robot_id, each.id) if each.hit_count else None
    run_id, time_s = hit or (None, None)
    return [
        each.id,
        cut_text(each.condition, _LONGEST_TEXT),
        each.action,
        each.after_hits,
        each.hit_count,
        run_id,
        time_s if time_s is None else round(time_s, 3),
        each.created_by,
        cut_text(each.error, _LONGEST_TEXT) if each.error else None,
    ]
