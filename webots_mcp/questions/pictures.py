"""Recorded pictures as a model can look at them: small enough, in a format that clients show."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

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
from webots_mcp.store.run_rows import opened

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

LONGEST_SIDE_PX: Final = 1000
MAX_SENT_BYTES: Final = 4_000_000  # more than such a picture has pixels: something else is in it
_JPEG_QUALITY: Final = 85
_GAP_PX: Final = 4


def load_sheet(files: Sequence[Path]) -> ShownPicture:
    """Pictures beside each other, from left to right and from top to bottom, as one.

    Raises:
        InvalidInputError: A file holds no complete picture, or is too large.
    """
    from PIL import Image as Pictures

    columns = math.ceil(math.sqrt(len(files)))
    side_px = LONGEST_SIDE_PX // columns - _GAP_PX
    parts = [_thumbnail(file, side_px) for file in files]
    width, height = (max(part.size[i] for part in parts) + _GAP_PX for i in (0, 1))
    sheet = Pictures.new("RGB", (columns * width, math.ceil(len(parts) / columns) * height))
    for number, part in enumerate(parts):
        sheet.paste(part, (number % columns * width, number // columns * height))
    png = io.BytesIO()
    sheet.save(png, "PNG")
    return ShownPicture(data=png.getvalue(), format="png")


def _thumbnail(file: Path, side_px: int) -> Picture:
    with opened(file) as picture:
        scaled = picture.convert("RGB")
    scaled.thumbnail((side_px, side_px))
    return scaled


def load_picture(file: Path) -> tuple[ShownPicture, str]:
    """A picture within 1,000 pixels, and a note where it had to be scaled (else empty).

    Raises:
        InvalidInputError: The file holds no complete picture, or is too large.
    """
    with opened(file) as picture:
        picture.load()
        short = max(picture.size) <= LONGEST_SIDE_PX
        if short and picture.format and file.stat().st_size <= MAX_SENT_BYTES:
            return ShownPicture(data=file.read_bytes(), format=picture.format.lower()), ""
        scaled = picture.convert("RGB")
        scaled.thumbnail((LONGEST_SIDE_PX, LONGEST_SIDE_PX))
        jpeg = io.BytesIO()
        scaled.save(jpeg, "JPEG", quality=_JPEG_QUALITY)
    (width, height), (true_width, true_height) = scaled.size, picture.size
    note = f"shown at {width} x {height} of {true_width} x {true_height} pixels"
    return ShownPicture(data=jpeg.getvalue(), format="jpeg"), note


# The tool that draws: content only, because clients drop pictures beside structured data.


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
