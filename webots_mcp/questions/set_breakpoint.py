"""Tools that stop the simulation, or take note, when a condition begins to hold."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from webots_mcp.contract import BreakpointAction
from webots_mcp.questions.answers import BreakpointAnswer, BreakpointsAnswer
from webots_mcp.questions.argument_types import Id, RobotName
from webots_mcp.questions.budget import fitting, table
from webots_mcp.questions.declaring import CHANGES, READS, Caller, question
from webots_mcp.steering import arming
from webots_mcp.store.recording import Recording

BreakpointId = Annotated[Id, Field(description="From webots_breakpoint.")]


@question("Set a breakpoint", CHANGES)
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
    caller: Caller,
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
    return await arming.set_breakpoint(
        recording,
        caller.report,
        condition,
        action=action,
        after_hits=after_hits,
        robot=robot,
        set_by=caller.client,
    )


@question("List the breakpoints", READS)
def webots_list_breakpoints(recording: Recording, robot: RobotName = None) -> BreakpointsAnswer:
    """The robot's breakpoints, how often each was hit, and when last."""
    with recording.view(robot) as view:
        rows = arming.breakpoint_rows(view)
        shown = fitting(rows)
        more = f"{len(shown)} of {len(rows)}: webots_query_sql has all in table breakpoint"
        none = "this robot has none: webots_breakpoint sets one"
        return BreakpointsAnswer(
            **view.header(),
            breakpoints=table(arming.BREAKPOINT_COLUMNS, shown),
            hint=more if len(shown) < len(rows) else None if rows else none,
        )


@question("Remove a breakpoint", CHANGES)
async def webots_remove_breakpoint(
    recording: Recording,
    breakpoint_id: BreakpointId,
    caller: Caller,
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Remove a breakpoint. The events of its hits stay; a paused simulation stays paused."""
    report = caller.report
    return await arming.remove_breakpoint(recording, report, breakpoint_id, robot=robot)
