"""Tools that show pictures: content only, because clients drop pictures next to structured data."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, cast

from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.answer_models import CommandAnswer, RunAnswer, ShownPicture
from webots_mcp.answers.budget import notes_of, seconds, some
from webots_mcp.answers.shortening import compact_json
from webots_mcp.contract import KEPT_FRAME
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError
from webots_mcp.plotting import PlotKind, plot
from webots_mcp.plotting.canvas import HEIGHT_PX, LEAST_HEIGHT_PX, LEAST_WIDTH_PX, MOST_PX, WIDTH_PX
from webots_mcp.questions.arguments import (
    ComparedRunIds,
    Id,
    RobotName,
    RunId,
    Seconds,
    TimeoutS,
)
from webots_mcp.questions.declaration import CHANGES, READS, Caller, question
from webots_mcp.questions.scored_runs import spelled_out
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.reading.segment import full_rate_segments, just_after
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.run_rows import StoredImage, camera_frames, cameras, inside, opened

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class PictureLimits:
    """How pictures are sent, and how long one is waited for.

    Attributes:
        wait_s: Wall time for a screenshot or a frame.
        end_wait_s: Wall time for a screenshot at the end of a run.
        far_s: Simulation time from which on a picture is not of the requested moment.
        same_s: Simulation time within which two moments are the same: answers have times to the
            millisecond.
        side_px: Longest side of a picture, in pixels.
        file_bytes: Size of a file that is sent as it is: more than such a picture has pixels, so a
            larger one holds something else.
        jpeg_quality: Quality of JPEG, from 1 to 100.
        plotted_runs: Runs that are drawn over each other.
        gap_px: Gap between pictures of a sheet, in pixels.
    """

    wait_s: float = 15.0
    end_wait_s: float = 8.0
    far_s: float = 1.0
    same_s: float = 0.001
    side_px: int = 1000
    file_bytes: int = 4_000_000
    jpeg_quality: int = 85
    plotted_runs: int = 10
    gap_px: int = 4


_LIMITS: Final = PictureLimits()


@question("Get the camera picture", READS)
async def webots_get_camera(
    recording: RecordingAccess,
    caller: Caller,
    camera: Annotated[
        str, Field(max_length=200, description="Name of the camera. Default: any.")
    ] = "",
    fresh: Annotated[
        bool, Field(description="Take a new picture now; also of lidars and range finders.")
    ] = False,
    at_s: Annotated[
        Seconds | None,
        Field(description="Show the picture nearest to this simulated time in seconds."),
    ] = None,
    frames: Annotated[
        int, Field(ge=1, le=16, description="Number of pictures around that time, on one sheet.")
    ] = 1,
    robot: RobotName = None,
    run_id: RunId = None,
) -> list[str | ShownPicture]:
    """Show a picture of the robot's own camera: the newest, a new one, or those around a moment.

    For the view of the whole simulation use webots_take_screenshot.
    """
    if not fresh:
        past = partial(_show_recorded, recording, camera, at_s, frames, robot, run_id)
        return await to_thread.run_sync(past)
    if recording.read_only or at_s is not None or run_id is not None or frames != 1:
        raise InvalidInputError(
            (
                "fresh=true needs a command to the controller, and a --read-only server sends "
                "none. Leave fresh out to show recorded pictures."
            )
            if recording.read_only
            else (
                "fresh=true takes one picture now, so it excludes at_s, frames and run_id. Leave "
                "those out, or leave fresh out to show recorded pictures."
            )
        )
    dispatcher = Dispatcher(recording, caller.report)
    answer = await dispatcher.ask(robot, "take_frame", _LIMITS.wait_s, {"camera": camera})
    return await to_thread.run_sync(_show, recording, answer)


def _show_recorded(
    recording: RecordingAccess,
    camera: str,
    at_s: float | None,
    frames: int,
    robot: str | None,
    run_id: int | None,
) -> list[str | ShownPicture]:
    with recording.view(robot, run_id) as view:
        run = view.require_run()
        found = camera_frames(view.connection, run.id, camera or None, at_s=at_s, count=frames)
        if not found:
            return [_no_frame(view, camera)]
        if len(found) > 1:
            picture, shown = _sheet(recording, found)
        else:
            picture, shown = _single(recording, view, found[0])
        reported = _told_of(view, found) | shown | _far_off(at_s, found)
        return [_caption(view.header() | reported), picture]


def _far_off(at_s: float | None, found: list[StoredImage]) -> dict[str, Any]:
    """That the nearest picture is not of the time that was asked for."""
    apart_s = 0.0 if at_s is None else min(abs(each.sim_time_s - at_s) for each in found)
    if apart_s <= _LIMITS.far_s:
        return {}
    return {"hint": f"no picture is nearer to {at_s:g} s than {seconds(apart_s)} s"}


def _told_of(view: RobotView, found: list[StoredImage]) -> dict[str, Any]:
    """Return the camera, and the full-rate segment that its frames belong to."""
    first, last = found[0], found[-1]
    if first.kind != KEPT_FRAME:
        return {"camera": first.device}
    within = (first.run_id, first.sim_time_s, just_after(last.sim_time_s))
    reasons = [each.reason for each in full_rate_segments(view.connection, *within)]
    return {"camera": first.device, "kept": "; ".join(reasons)}


def _single(
    recording: RecordingAccess, view: RobotView, image: StoredImage
) -> tuple[ShownPicture, dict[str, Any]]:
    picture, note = _load_picture(image.file(recording.data_dir))
    return picture, {
        "picture_sim_time_s": seconds(image.sim_time_s),
        "picture_age_wall_s": view.age_s(image.wall_time_s),
        "width_px": image.width,
        "height_px": image.height,
        "file": str(recording.data_dir / image.path),
        "note": note,
    }


def _sheet(
    recording: RecordingAccess, found: list[StoredImage]
) -> tuple[ShownPicture, dict[str, Any]]:
    picture = _load_sheet([image.file(recording.data_dir) for image in found])
    return picture, {
        "pictures_sim_time_s": [seconds(image.sim_time_s) for image in found],
        "note": "row by row, from left to right",
    }


@question("Take a screenshot", CHANGES, tier="core")
async def webots_take_screenshot(
    recording: RecordingAccess,
    caller: Caller,
    quality: Annotated[
        int, Field(ge=1, le=100, description="Quality of the JPEG from 1 to 100.")
    ] = 90,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _LIMITS.wait_s,
) -> list[str | ShownPicture]:
    """Take a screenshot of the simulation's 3D view as it is now, at most 1,000 pixels wide.

    Needs a robot that is a Supervisor. For the robot's own camera use webots_get_camera.
    """
    dispatcher = Dispatcher(recording, caller.report)
    answer = await dispatcher.ask(robot, "screenshot", timeout_wall_s, {"quality": quality})
    return await to_thread.run_sync(_show, recording, answer)


def _show(recording: RecordingAccess, answer: CommandAnswer) -> list[str | ShownPicture]:
    said = answer.model_dump(mode="json", exclude_none=True)
    path = cast("dict[str, Any]", answer.result or {}).get("path")
    if answer.outcome != "done" or path is None:
        why = f"{answer.error}. " if answer.error else ""
        raise CommandRefusedError(f"No picture was taken. {why}{compact_json(said)}")
    file = inside(recording.data_dir, str(path))
    picture, note = _load_picture(file)
    return [_caption(said | {"note": note, "file": str(file)}), picture]


def _caption(facts: dict[str, Any]) -> str:
    return compact_json({name: fact for name, fact in facts.items() if fact not in (None, "")})


def _no_frame(view: RobotView, camera: str) -> str:
    """Return why there is no picture, in the form of a caption."""
    known = cameras(view.connection, view.robot.id)
    saved = [f"run_id={run_id}: {names}" for run_id, names in known.items()]
    of_it = f" of {camera!r}" if camera else ""
    hint = (
        f"no frame{of_it} in this run; there are some of {some(saved, 5)}"
        if known
        else "no camera frame was saved: fresh=true takes one of an enabled camera now, "
        "bridge.save_camera_frame(camera) in the controller's loop records them, "
        "bridge.keep_camera(camera) those of full-rate segments"
    )
    return _caption(view.header() | {"camera": camera, "hint": hint})


# -- the end of a run ------------------------------------------------------------------------------


async def show_end(recording: RecordingAccess, dispatcher: Dispatcher, answer: RunAnswer) -> None:
    """Add a screenshot to the answer of a run, else a camera frame of its last step.

    Where there is neither, the answer says why.
    """
    try:
        shot = await dispatcher.ask(answer.robot, "screenshot", _LIMITS.end_wait_s, {"quality": 90})
        path = cast("dict[str, Any]", shot.result or {}).get("path")
        if shot.outcome != "done" or path is None:
            why = shot.error or shot.hint or f"the screenshot is {shot.outcome}"
            raise CommandRefusedError(why)
        file = inside(recording.data_dir, str(path))
        picture, note = await to_thread.run_sync(_load_picture, file)
    except WebotsMCPError as error:
        await to_thread.run_sync(_show_frame, recording, answer, str(error))
        return
    facts = {"file": str(file), "sim_time_s": shot.sim_time_s}
    _attach(answer, picture, facts, note, "webots_take_screenshot")


def _show_frame(recording: RecordingAccess, answer: RunAnswer, why: str) -> None:
    """Add what a camera saw at the step at which the run ended, if that was recorded."""
    ran = answer.ran or {}
    frame = None
    if ran.get("run_id") is not None:
        with recording.reader() as connection:
            found = camera_frames(connection, ran["run_id"], at_s=ran["end_s"])
        frame = next(
            (each for each in found if abs(each.sim_time_s - ran["end_s"]) < _LIMITS.same_s), None
        )
    if frame is None:
        answer.picture = {"missing": why}
        return
    try:
        picture, note = _load_picture(frame.file(recording.data_dir))
    except WebotsMCPError as error:
        answer.picture = {"missing": f"{why}; {error}"}
        return
    file = str(recording.data_dir / frame.path)
    facts = {"camera": frame.device, "file": file, "sim_time_s": seconds(frame.sim_time_s)}
    _attach(answer, picture, facts | {"no_screenshot": why}, note, "webots_get_camera")


def _attach(
    answer: RunAnswer, picture: ShownPicture, facts: dict[str, Any], note: str, again: str
) -> None:
    answer.pictures.append(picture)
    see = {"see": f"beside this answer; if your client does not show it, {again}"}
    answer.picture = facts | ({"note": note} if note else {}) | see


# -- plots -----------------------------------------------------------------------------------------


@question("Plot", READS, tier="core")
def webots_plot(
    recording: RecordingAccess,
    scope: Scope,
    kind: Annotated[
        PlotKind,
        Field(description="signals: curves. trajectory: path from above. runs: a score."),
    ] = "signals",
    signals: Annotated[
        list[str] | None,
        Field(
            max_length=50,
            description="Signals to draw; '*' means any text. Default: those that changed most. "
            "For runs a score.",
        ),
    ] = None,
    run_ids: ComparedRunIds = None,
    trial_set: Annotated[
        Id | None,
        Field(description="Draw the scores of this set of trials."),
    ] = None,
    width_px: Annotated[
        int, Field(ge=LEAST_WIDTH_PX, le=MOST_PX, description="Width of the picture in pixels.")
    ] = WIDTH_PX,
    height_px: Annotated[
        int, Field(ge=LEAST_HEIGHT_PX, le=MOST_PX, description="Height of the picture in pixels.")
    ] = HEIGHT_PX,
) -> list[str | ShownPicture]:
    """Draw signals over time, or the robot's path seen from above, as a picture.

    Several run_ids are drawn over each other. For the numbers behind the curves use
    webots_query_history; for a description in words use webots_get_trends.
    """
    draw = partial(plot, kind=kind, signals=signals or (), width_px=width_px, height_px=height_px)
    if trial_set is not None:  # which may be of a robot that was removed
        with recording.reader() as connection:
            picture = draw(connection, trial_set=trial_set)
        facts = {"shows": picture.caption, "notes": notes_of(picture.notes) or []}
        return [_caption(facts), ShownPicture(data=picture.data, format="png")]
    ids, named = spelled_out(run_ids)
    if kind != "runs" and len(ids or ()) > _LIMITS.plotted_runs:
        raise InvalidInputError(
            f"{len(ids or ())} runs cannot be drawn over each other. Give at most "
            f"{_LIMITS.plotted_runs}, or draw a score over all of them with kind='runs'."
        )
    first = scope.run_id or next(iter((named if kind == "runs" else ids) or ()), None)
    with recording.view(scope.robot, first) as view:
        view.require_run()
        meant = scope if first else replace(scope, robot=view.robot.name)
        picture = draw(view.connection, scope=meant, run_ids=ids or ())
        facts = (
            view.header()
            | view.position_by()
            | {"shows": picture.caption, "notes": notes_of(picture.notes)}
        )
        return [_caption(facts), ShownPicture(data=picture.data, format="png")]


# -- pictures for a model: small enough, in a format that clients show -------------


def _load_sheet(files: Sequence[Path]) -> ShownPicture:
    """Arrange pictures next to each other, from left to right and from top to bottom, as one.

    Raises:
        InvalidInputError: A file holds no complete picture, or is too large.
    """
    from PIL import Image as Pictures

    columns = math.ceil(math.sqrt(len(files)))
    side_px = _LIMITS.side_px // columns - _LIMITS.gap_px
    parts = [_thumbnail(file, side_px) for file in files]
    width, height = (max(part.size[i] for part in parts) + _LIMITS.gap_px for i in (0, 1))
    sheet = Pictures.new("RGB", (columns * width, math.ceil(len(parts) / columns) * height))
    for number, part in enumerate(parts):
        sheet.paste(part, (number % columns * width, number // columns * height))
    png = io.BytesIO()
    sheet.save(png, "PNG")
    return ShownPicture(data=png.getvalue(), format="png")


def _thumbnail(file: Path, side_px: int) -> Image:
    with opened(file) as picture:
        scaled = picture.convert("RGB")
    scaled.thumbnail((side_px, side_px))
    return scaled


def _load_picture(file: Path) -> tuple[ShownPicture, str]:
    """Return a picture within 1,000 pixels, and a note where it had to be scaled (else empty).

    Raises:
        InvalidInputError: The file holds no complete picture, or is too large.
    """
    with opened(file) as picture:
        picture.load()
        short = max(picture.size) <= _LIMITS.side_px
        if short and picture.format and file.stat().st_size <= _LIMITS.file_bytes:
            return ShownPicture(data=file.read_bytes(), format=picture.format.lower()), ""
        scaled = picture.convert("RGB")
        scaled.thumbnail((_LIMITS.side_px, _LIMITS.side_px))
        jpeg = io.BytesIO()
        scaled.save(jpeg, "JPEG", quality=_LIMITS.jpeg_quality)
    (width, height), (true_width, true_height) = scaled.size, picture.size
    note = f"shown at {width} x {height} of {true_width} x {true_height} pixels"
    return ShownPicture(data=jpeg.getvalue(), format="jpeg"), note
