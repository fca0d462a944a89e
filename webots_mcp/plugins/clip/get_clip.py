"""The tool that shows the seconds around a moment, and saves them as an animated picture."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import Field

from webots_mcp.answers.answer_models import ShownPicture
from webots_mcp.answers.budget import notes_of, seconds
from webots_mcp.answers.shortening import compact_json
from webots_mcp.database.files import make_folder, whole_file
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.clip.clip_limits import CLIP_LIMITS, CONTENT_LIMITS, ClipFormat, ClipView
from webots_mcp.questions.arguments import Id, RobotName, RunId, Seconds
from webots_mcp.questions.declaration import READS, question
from webots_mcp.store.recording import RecordingAccess, RobotView

if TYPE_CHECKING:
    from webots_mcp.plugins.clip.clip import Clip
    from webots_mcp.plugins.clip.moment import Moment

FOLDER: Final = "clips"  # in the data folder
MOST_CLIPS: Final = 50  # files that are kept there; older ones are deleted


@question("Get a clip", READS, tier="all")
def webots_get_clip(
    recording: RecordingAccess,
    event_id: Annotated[
        Id | None,
        Field(description="Stored event to show; webots_find_events gives its event_id."),
    ] = None,
    at_s: Annotated[
        Seconds | None,
        Field(
            description="Simulated time in seconds to show instead, such as the start_s of an "
            "event. Default: the newest breakpoint hit or violation, else the end of the run."
        ),
    ] = None,
    before_s: Annotated[
        float,
        Field(ge=0, le=CLIP_LIMITS.longest_s, description="Simulated seconds to show before it."),
    ] = 3.0,
    after_s: Annotated[
        float,
        Field(ge=0, le=CLIP_LIMITS.longest_s, description="Simulated seconds to show after it."),
    ] = 2.0,
    signals: Annotated[
        list[str] | None,
        Field(
            max_length=CONTENT_LIMITS.signals,
            description="Up to three signals to draw as curves. Default: those of the event, then "
            "those that changed most.",
        ),
    ] = None,
    camera: Annotated[
        str,
        Field(
            max_length=200,
            description="Name of the camera. Default: the one with most frames in that time.",
        ),
    ] = "",
    view: Annotated[
        ClipView | None,
        Field(
            description="camera: its recorded frames. map: the robot from above on its path. "
            "Default: camera if it has frames in that time, else map."
        ),
    ] = None,
    speed: Annotated[
        float,
        Field(ge=0.05, le=20, description="Speed of the animation; 0.5 is half of real time."),
    ] = 1.0,
    image_format: Annotated[ClipFormat, Field(description="Format of the saved file.")] = "webp",
    robot: RobotName = None,
    run_id: RunId = None,
) -> list[str | ShownPicture]:
    """Show what happened around a moment, as a sheet of up to 16 numbered frames with curves.

    The same is saved as an animated picture, whose path and size are in the answer. For one
    picture use webots_get_camera; for curves of a whole run use webots_plot. A film of the whole
    simulation view is made by webots_record_scene while it runs.
    """
    from webots_mcp.plugins.clip.clip import make_clip

    asked = _event(recording, event_id, at_s)
    if asked is not None and run_id not in (None, asked.run_id):
        raise InvalidInputError(
            f"Event {event_id} is of run {asked.run_id}, not of run {run_id}. Leave run_id out."
        )
    with recording.view(robot, asked.run_id if asked else run_id) as shown:
        moment = asked or _moment(shown, at_s)
        clip = make_clip(
            shown.connection,
            recording.data_dir,
            moment,
            before_s=before_s,
            after_s=after_s,
            signals=signals or (),
            camera=camera,
            view=view,
            speed=speed,
            image_format=image_format,
        )
        saved = _save(recording, clip)
        facts = shown.header() | facts_of(clip) | saved
    caption = {name: fact for name, fact in facts.items() if fact not in (None, "", [])}
    return [compact_json(caption), ShownPicture(data=clip.sheet, format=clip.sheet_format)]


def facts_of(clip: Clip) -> dict[str, Any]:
    """Return what a clip shows, as its caption says it."""
    content = clip.content
    what = f" ({content.moment.what})" if content.moment.what else ""
    start, end, at = (
        f"{each:.3f}" for each in (content.start_s, content.end_s, content.moment.at_s)
    )
    return {
        "shows": f"{content.view} from {start} to {end} s around {at} s{what}",
        "camera": content.camera or None,
        "signals": clip.signals,
        "mode": content.mode.name if content.mode else None,
        "sheet_sim_time_s": [seconds(each) for each in clip.sheet_times],
        "frames": len(clip.frame_times),
        "width_px": clip.width,
        "height_px": clip.height,
        "size_bytes": len(clip.data),
        "notes": notes_of(clip.notes),
    }


def _event(recording: RecordingAccess, event_id: int | None, at_s: float | None) -> Moment | None:
    if event_id is None:
        return None
    if at_s is not None:
        raise InvalidInputError(
            "event_id and at_s name two moments, and a clip shows one. Leave one of them out."
        )
    from webots_mcp.plugins.clip.moment import moment_of_event

    with recording.reader() as connection:
        return moment_of_event(connection, event_id)


def _moment(shown: RobotView, at_s: float | None) -> Moment:
    from webots_mcp.plugins.clip.moment import moment_at, newest_moment

    run = shown.require_run()
    if at_s is None:
        return newest_moment(shown.connection, run)
    return moment_at(shown.connection, run, at_s)


def _save(recording: RecordingAccess, clip: Clip) -> dict[str, Any]:
    """Write the animation into the data folder; return its path, or why it is not there."""
    if recording.read_only:
        return {"file": None, "not_saved": "this server is --read-only"}
    folder = recording.data_dir / FOLDER
    file = folder / file_name(clip)
    try:
        make_folder(folder)
        with whole_file(file) as aside:
            aside.write_bytes(clip.data)
        _forget_oldest(folder)
    except OSError as error:
        return {"file": None, "not_saved": f"{file} cannot be written: {error.strerror or error}"}
    return {"file": str(file)}


def file_name(clip: Clip) -> str:
    """Return the name of a clip's file, such as run-3-at-12.480s-9c1f5a.webp.

    Clips of one moment with other cameras, curves or lengths get other names.
    """
    moment, digest = clip.content.moment, hashlib.sha256(clip.data).hexdigest()[:6]
    return f"run-{moment.run_id}-at-{moment.at_s:.3f}s-{digest}.{clip.format}"


def _forget_oldest(folder: Path) -> None:
    """Delete the oldest clips beyond the newest fifty; other files stay."""
    clips = [each for form in ("webp", "gif") for each in folder.glob(f"run-*-at-*s*.{form}")]
    for file in sorted(clips, key=lambda each: each.stat().st_mtime_ns)[:-MOST_CLIPS]:
        file.unlink(missing_ok=True)
