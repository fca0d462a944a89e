"""Tools that stop the simulation, or take note, when a condition begins to hold."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Annotated, Any, Final

from anyio import to_thread
from mcp.server.mcpserver import Context
from pydantic import Field

from webots_mcp.conditions import Condition, parse_condition
from webots_mcp.contract import BreakpointAction
from webots_mcp.errors import CommandRefusedError
from webots_mcp.server.declaring import ACTS, READS, tool
from webots_mcp.server.dispatch import Dispatcher
from webots_mcp.server.parameters import Id, RobotName
from webots_mcp.server.results import BreakpointAnswer, BreakpointsAnswer, CommandAnswer, Table
from webots_mcp.server.shortening import cut_text
from webots_mcp.store.breakpoints import (
    StoredBreakpoint,
    list_breakpoints,
    newest_hit,
    remove_breakpoint,
    set_breakpoint,
)
from webots_mcp.store.reading.subject import Subject
from webots_mcp.store.recording import Recording, View
from webots_mcp.store.signals.catalogue import catalogue

COLUMNS: Final = (
    "id", "condition", "action", "after_hits", "hits", "newest_hit_run_id", "newest_hit_s",
    "set_by", "off_because",
)  # fmt: skip
_ARM: Final = "arm_breakpoints"
_WAIT_S: Final = 5.0
_LONGEST_TEXT: Final = 300

BreakpointId = Annotated[Id, Field(description="From webots_breakpoint.")]


@tool("Set a breakpoint", ACTS)
async def webots_breakpoint(
    recording: Recording,
    condition: Annotated[
        str,
        Field(
            max_length=500,
            description="On signals: front_m < 0.1 for 0.5; mode == 'turn' and displacement(3) "
            "< 0.05; changed(mode); abs(rate(v)) > 2; missing(gps.x); pose.0 > 1.",
        ),
    ],
    ctx: Context[Any],
    action: Annotated[
        BreakpointAction,
        Field(description="keep records the seconds around at full rate, log only the hit."),
    ] = "pause",
    after_hits: Annotated[
        int, Field(ge=1, le=1_000_000, description="Act from this hit of a run on.")
    ] = 1,
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Pause, or take note, when a condition begins to hold; asked at every publish() call.

    Each hit is an event with the values and the simulation time of that very step. It is stored,
    and armed again after a reset or reload.
    """
    parsed = parse_condition(condition)
    name, stored, notes = await to_thread.run_sync(
        _store, recording, robot, parsed, action, after_hits
    )
    told = await _arm(recording, ctx, name)
    armed = stored in told.armed
    if action == "pause" and told.cannot_pause:
        notes.append(f"it will only record: {told.cannot_pause}")
    return BreakpointAnswer(
        **await to_thread.run_sync(_header, recording, name),
        breakpoint_id=stored,
        condition=parsed.text,
        action=action,
        armed=armed,
        notes=notes or None,
        hint=None if armed else f"it is stored, but not armed yet: {told.why_not}",
    )


@tool("List the breakpoints", READS)
def webots_list_breakpoints(recording: Recording, robot: RobotName = None) -> BreakpointsAnswer:
    """The robot's breakpoints, how often each was hit, and when last."""
    with recording.view(robot) as view:
        rows = [
            _row(view.connection, each) for each in list_breakpoints(view.connection, view.robot.id)
        ]
        return BreakpointsAnswer(
            **view.header(),
            breakpoints=Table(columns=list(COLUMNS), rows=rows) if rows else None,
            hint=None if rows else "this robot has none: webots_breakpoint sets one",
        )


@tool("Remove a breakpoint", ACTS)
async def webots_remove_breakpoint(
    recording: Recording,
    breakpoint_id: BreakpointId,
    ctx: Context[Any],
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Remove a breakpoint. The events of its hits stay; a paused simulation stays paused."""
    name = await to_thread.run_sync(_remove, recording, robot, breakpoint_id)
    told = await _arm(recording, ctx, name)
    return BreakpointAnswer(
        **await to_thread.run_sync(_header, recording, name),
        breakpoint_id=breakpoint_id,
        armed=breakpoint_id in told.armed,
        hint=f"removed; {told.why_not}" if told.why_not else None,
    )


@dataclass(frozen=True)
class _Told:
    """What the controller said of its breakpoints.

    Attributes:
        armed: Their ids.
        why_not: Why it has not read them anew; empty where it has.
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
) -> tuple[str, int, list[str]]:
    """Name of the robot, id of the breakpoint, and what there is to say of its signals."""
    with recording.view(robot) as view:
        name, robot_id, notes = view.robot.name, view.robot.id, _notes(view, condition)
    with recording.writer() as connection:
        return (
            name,
            set_breakpoint(connection, robot_id, condition, action, after_hits, "mcp"),
            notes,
        )


def _notes(view: View, condition: Condition) -> list[str]:
    if view.run is None:
        return condition.describe_unknown(())
    subject = Subject(view.robot.id, view.robot.name, view.run.id)
    return condition.describe_unknown(catalogue(view.connection, subject))


def _remove(recording: Recording, robot: str | None, breakpoint_id: int) -> str:
    with recording.view(robot) as view:
        name, robot_id = view.robot.name, view.robot.id
    with recording.writer() as connection:
        remove_breakpoint(connection, robot_id, breakpoint_id)
    return name


async def _arm(recording: Recording, ctx: Context[Any], robot: str) -> _Told:
    """Have the controller read its breakpoints anew."""
    try:
        answer = await Dispatcher(recording, ctx.report_progress).ask(robot, _ARM, _WAIT_S)
    except CommandRefusedError as refused:
        return _Told(why_not=f"{refused}. A controller of this robot reads them when it starts")
    if answer.outcome != "done":
        return _Told(why_not=f"{_reason(answer)}. With the next reset it reads them all the same")
    result: dict[str, Any] = answer.result
    return _Told(tuple(result.get("armed", ())), result.get("cannot_pause"))


def _reason(answer: CommandAnswer) -> str:
    return answer.error or answer.hint or f"the controller's answer was {answer.outcome}"


def _header(recording: Recording, robot: str) -> dict[str, Any]:
    with recording.view(robot) as view:
        return view.header()


def _row(connection: sqlite3.Connection, each: StoredBreakpoint) -> list[Any]:
    hit = newest_hit(connection, each.robot_id, each.id) if each.hits else None
    run_id, time_s = hit or (None, None)
    return [
        each.id,
        cut_text(each.condition, _LONGEST_TEXT),
        each.action,
        each.after_hits,
        each.hits,
        run_id,
        time_s if time_s is None else round(time_s, 3),
        each.created_by,
        cut_text(each.error, _LONGEST_TEXT) if each.error else None,
    ]
