"""Breakpoints: stored for the robot, and armed by its controller.

The controller evaluates each condition at every call of `publish`.
"""

from __future__ import annotations

from typing import Annotated, Any, Final

from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.answer_models import (
    BreakpointAnswer,
    BreakpointsAnswer,
)
from webots_mcp.answers.budget import (
    fitting,
    header_of,
    table,
)
from webots_mcp.answers.shortening import cut_text
from webots_mcp.contract import BreakpointAction
from webots_mcp.database import stored_breakpoints as stored
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.questions.arguments import Id, RobotName
from webots_mcp.questions.declaration import CHANGES, READS, Caller, question
from webots_mcp.signals.conditions import Condition, parse_condition
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.run_command import holds_since
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.segment import Subject
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.requests import permit

BREAKPOINT_COLUMNS: Final = (
    "id", "condition", "action", "after_hits", "hit_count", "newest_hit_run_id", "newest_hit_s",
    "set_by", "off_because",
)  # fmt: skip
_LONGEST_CONDITION: Final = 300


@question("Set a breakpoint", CHANGES, tier="core")
async def webots_breakpoint(
    recording: RecordingAccess,
    condition: Annotated[
        str,
        Field(
            max_length=500,
            description="Condition on signals, such as front_m < 0.1, or front_m < 0.1 for 0.5 "
            "(held for 0.5 s), mode == 'turn' and displacement(3) < 0.05 (metres moved in 3 s), "
            "changed(mode), abs(rate(v)) > 2, missing(gps.x).",
        ),
    ],
    caller: Caller,
    action: Annotated[
        BreakpointAction,
        Field(
            description="What a hit does: pause, log only the hit, or keep every step around it."
        ),
    ] = "pause",
    after_hits: Annotated[
        int,
        Field(
            ge=1,
            le=1_000_000,
            description="Act from the Nth hit of a run on; earlier hits are only recorded.",
        ),
    ] = 1,
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Pause the simulation, or take note, at the moment when a condition begins to hold.

    Tested at each publish() call of the controller; each hit is an event with the values of that
    step. It stays armed after a reset or reload; to remove it use webots_remove_breakpoint. To
    search the past for a condition use webots_find_events with `where`.
    """
    parsed = parse_condition(condition)
    if action != "log":  # what the bridge does at a hit is not asked for again
        await to_thread.run_sync(permit, recording, action, dict[str, Any]())
    name, number, notes = await to_thread.run_sync(
        _store, recording, robot, parsed, action, after_hits, caller.client
    )
    reply, why_not = await _arm(recording, caller, name)
    if action == "pause" and reply.get("cannot_pause"):
        notes.append(f"it will record its hits, but not pause: {reply['cannot_pause']}")
    armed = number in reply.get("armed", ())
    return BreakpointAnswer(
        **await to_thread.run_sync(header_of, recording, name),
        breakpoint_id=number,
        condition=parsed.text,
        action=action,
        armed=armed,
        notes=notes or None,
        hint=None if armed else f"it is stored, but not armed yet: {why_not}",
    )


@question("List the breakpoints", READS, tier="all")
def webots_list_breakpoints(
    recording: RecordingAccess, robot: RobotName = None
) -> BreakpointsAnswer:
    """List the robot's breakpoints, how often each was hit, and when last.

    To remove one use webots_remove_breakpoint.
    """
    with recording.view(robot) as view:
        listed = stored.list_breakpoints(view.connection, view.robot.id)
        rows = [_breakpoint_row(view, each) for each in listed]
        shown = fitting(rows)
        more = f"{len(shown)} of {len(rows)}: webots_query_sql has all in table breakpoint"
        none = "this robot has none: webots_breakpoint sets one"
        hints = [more] * (len(shown) < len(rows))
        hints += [none] * (not rows) + [
            (
                "no controller of this robot runs to ask any: those that its code had set ended "
                "with it, those of webots_breakpoint stay and are armed when it starts again"
            )
        ] * (not view.robot.live)
        return BreakpointsAnswer(
            **view.header(),
            breakpoints=table(BREAKPOINT_COLUMNS, shown),
            hint="; ".join(hints) or None,
        )


@question("Remove a breakpoint", CHANGES)
async def webots_remove_breakpoint(
    recording: RecordingAccess,
    breakpoint_id: Annotated[
        Id, Field(description="Breakpoint to remove, from webots_breakpoint.")
    ],
    caller: Caller,
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Remove a breakpoint; the events of its hits stay, and a paused simulation stays paused.

    To let the simulation go on use webots_simulation_control("resume").
    """
    name = await to_thread.run_sync(_remove, recording, robot, breakpoint_id)
    reply, why_not = await _arm(recording, caller, name)
    hint = f"its controller may ask it until then: {why_not}" if why_not else None
    if not await to_thread.run_sync(_is_live, recording, name):
        hint = "no controller of this robot runs, so none asks it any more"
    return BreakpointAnswer(
        **await to_thread.run_sync(header_of, recording, name),
        breakpoint_id=breakpoint_id,
        armed=breakpoint_id in reply.get("armed", ()),
        hint=hint,
    )


def _store(
    recording: RecordingAccess, robot: str | None, condition: Condition, *asked: Any
) -> tuple[str, int, list[str]]:
    """Name of the robot, id of the breakpoint, and notes on its signals."""
    with recording.view(robot) as view:
        name, robot_id, notes = view.robot.name, view.robot.id, _notes(view, condition)
    with recording.writer() as connection:
        return name, stored.set_breakpoint(connection, robot_id, condition.text, *asked), notes


def _notes(view: RobotView, condition: Condition) -> list[str]:
    if view.run is None:
        return condition.describe_unknown(())
    subject = Subject(view.robot.id, view.robot.name, view.run.id)
    notes = condition.describe_unknown(catalogue(view.connection, subject))
    try:
        holds_since(view.connection, view.run.id, condition)
    except InvalidInputError as error:
        notes.append(f"it will be turned off by the next state like the last ones: {error}")
    return notes


def _remove(recording: RecordingAccess, robot: str | None, breakpoint_id: int) -> str:
    with recording.view(robot) as view:
        name, robot_id = view.robot.name, view.robot.id
    with recording.writer() as connection:
        stored.remove_breakpoint(connection, robot_id, breakpoint_id)
    return name


def _is_live(recording: RecordingAccess, robot: str) -> bool:
    with recording.view(robot) as view:
        return view.robot.live


async def _arm(
    recording: RecordingAccess, caller: Caller, robot: str
) -> tuple[dict[str, Any], str]:
    """Let the controller read its breakpoints again; its reply, or why there is none."""
    dispatcher = Dispatcher(recording, caller.report)
    try:
        answer = await dispatcher.ask(robot, "arm_breakpoints", 5.0)
    except CommandRefusedError as refused:
        return {}, f"{refused}. A controller of this robot reads them when it starts"
    if answer.outcome != "done":
        reason = answer.error or answer.hint or f"the controller's answer was {answer.outcome}"
        return {}, f"{reason}. It will read them at the next reset in any case"
    return answer.result, ""


def _breakpoint_row(view: RobotView, each: stored.StoredBreakpoint) -> list[Any]:
    """Return a breakpoint as a row under `BREAKPOINT_COLUMNS`."""
    hit = stored.newest_hit(view.connection, each.robot_id, each.id) if each.hit_count else None
    run_id, time_s = hit or (None, None)
    return [
        each.id,
        cut_text(each.condition, _LONGEST_CONDITION),
        each.action,
        each.after_hits,
        each.hit_count,
        run_id,
        time_s if time_s is None else round(time_s, 3),
        each.created_by,
        cut_text(each.error, _LONGEST_CONDITION) if each.error else None,
    ]
