"""The tool that draws: content only, because clients drop pictures beside structured data."""

from __future__ import annotations

from typing import Annotated

from mcp.server.mcpserver import Image
from pydantic import Field

from webots_mcp.plotting import Picture, PlotKind, plot
from webots_mcp.server.budget import notes_of
from webots_mcp.server.declaring import READS, tool
from webots_mcp.server.parameters import (
    AnyNames,
    EndS,
    LastS,
    RobotName,
    RunId,
    RunIds,
    Since,
    StartS,
    Until,
)
from webots_mcp.server.shortening import compact_json
from webots_mcp.store.recording import Recording, View


@tool("Plot", READS)
def webots_plot(
    recording: Recording,
    kind: Annotated[
        PlotKind,
        Field(description="Signals over time, or the way of the robot seen from above."),
    ] = "signals",
    signals: AnyNames = None,
    last_s: LastS = None,
    start_s: StartS = None,
    end_s: EndS = None,
    since: Since = None,
    until: Until = None,
    run_ids: RunIds = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> list[str | Image]:
    """A picture of signals over time (mean line, min-max band, modes, events), or of the way.

    Without signals those that changed most; a trajectory finds the position by itself, or takes
    the two signals x and y. Several run_ids are laid over each other, each from its start.
    """
    runs = [*([run_id] if run_id else []), *(run_ids or [])]
    with recording.view(robot, runs[0] if runs else None) as view:
        view.require_run()
        picture = plot(
            view.connection,
            kind,
            signals or (),
            robot=robot if runs else view.robot.name,
            run_ids=runs,
            start_s=start_s,
            end_s=end_s,
            last_s=last_s,
            since=since,
            until=until,
        )
        return [_caption(view, picture), Image(data=picture.data, format="png")]


def _caption(view: View, picture: Picture) -> str:
    facts = view.header() | {"shows": picture.caption, "notes": notes_of(picture.notes)}
    return compact_json({name: fact for name, fact in facts.items() if fact is not None})
