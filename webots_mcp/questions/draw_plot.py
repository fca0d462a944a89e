"""The tool that draws: content only, because clients drop pictures beside structured data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

from pydantic import Field

from webots_mcp.plotting import (
    HEIGHT_PX,
    LEAST_HEIGHT_PX,
    LEAST_WIDTH_PX,
    MOST_PX,
    WIDTH_PX,
    Picture,
    PlotKind,
    Sheet,
    plot,
    plot_trials,
)
from webots_mcp.questions.answers import ShownPicture
from webots_mcp.questions.budget import compact_json, notes_of
from webots_mcp.questions.declaring import READS, AnyNames, RunIds, TrialSetId, question
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.recording import Recording, View


@question("Plot", READS)
def webots_plot(
    recording: Recording,
    scope: Scope,
    kind: Annotated[
        PlotKind,
        Field(description="trajectory: the way from above."),
    ] = "signals",
    signals: AnyNames = None,
    run_ids: RunIds = None,
    trial_set: TrialSetId = None,
    width_px: Annotated[
        int, Field(ge=LEAST_WIDTH_PX, le=MOST_PX, description="Pixels.")
    ] = WIDTH_PX,
    height_px: Annotated[
        int, Field(ge=LEAST_HEIGHT_PX, le=MOST_PX, description="Pixels.")
    ] = HEIGHT_PX,
) -> list[str | ShownPicture]:
    """A picture of signals over time (mean, min-max band, modes, events), way, or trials.

    Without signals those that changed most; a trajectory finds the position, or takes two signals.
    Several run_ids are laid over each other. trial_set: scores over one or two parameters, as
    signals.
    """
    if trial_set is not None:
        return _trials(recording, trial_set, signals or (), (width_px, height_px))
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
        return [_caption(view, picture), ShownPicture(data=picture.data, format="png")]


def _trials(
    recording: Recording, set_id: int, names: Sequence[str], size_px: tuple[int, int]
) -> list[str | ShownPicture]:
    """The scores of a trial set, which may be of a robot that is gone."""
    with recording.reader() as connection:
        picture = plot_trials(connection, set_id, names, sheet=Sheet(*size_px))
    return [
        compact_json({"shows": picture.caption, "notes": notes_of(picture.notes) or []}),
        ShownPicture(data=picture.data, format="png"),
    ]


def _caption(view: View, picture: Picture) -> str:
    facts = view.header() | {"shows": picture.caption, "notes": notes_of(picture.notes)}
    return compact_json({name: fact for name, fact in facts.items() if fact is not None})
