"""The tool that draws: content only, because clients drop pictures beside structured data."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from mcp.server.mcpserver import Image
from pydantic import Field

from webots_mcp.plotting import (
    HEIGHT_PX,
    LEAST_HEIGHT_PX,
    LEAST_WIDTH_PX,
    MOST_PX,
    WIDTH_PX,
    Picture,
    PlotKind,
    plot,
)
from webots_mcp.server.budget import notes_of
from webots_mcp.server.declaring import READS, tool
from webots_mcp.server.parameters import (
    AnyNames,
    RunIds,
)
from webots_mcp.server.shortening import compact_json
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.recording import Recording, View


@tool("Plot", READS)
def webots_plot(
    recording: Recording,
    scope: Scope,
    kind: Annotated[
        PlotKind,
        Field(description="Signals over time, or the way of the robot seen from above."),
    ] = "signals",
    signals: AnyNames = None,
    run_ids: RunIds = None,
    width_px: Annotated[
        int, Field(ge=LEAST_WIDTH_PX, le=MOST_PX, description="A wider picture shows more detail.")
    ] = WIDTH_PX,
    height_px: Annotated[
        int, Field(ge=LEAST_HEIGHT_PX, le=MOST_PX, description="A higher one has room for more.")
    ] = HEIGHT_PX,
) -> list[str | Image]:
    """A picture of signals over time (mean line, min-max band, modes, events), or of the way.

    Without signals those that changed most; a trajectory finds the position by itself, or takes
    the two signals x and y. Several run_ids are laid over each other, each from its start.
    """
    first = scope.run_id or next(iter(run_ids or ()), None)
    with recording.view(scope.robot, first) as view:
        view.require_run()
        picture = plot(
            view.connection,
            kind,
            signals or (),
            scope=scope if first else replace(scope, robot=view.robot.name),
            run_ids=run_ids or (),
            width_px=width_px,
            height_px=height_px,
        )
        return [_caption(view, picture), Image(data=picture.data, format="png")]


def _caption(view: View, picture: Picture) -> str:
    facts = view.header() | {"shows": picture.caption, "notes": notes_of(picture.notes)}
    return compact_json({name: fact for name, fact in facts.items() if fact is not None})
