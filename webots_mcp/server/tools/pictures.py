"""Tools that show pictures: content only, because clients drop pictures beside structured data."""

from __future__ import annotations

from typing import Annotated, Any, Final, cast

from anyio import to_thread
from mcp.server.mcpserver import Context, Image
from pydantic import Field

from webots_mcp.errors import CommandRefusedError
from webots_mcp.server.budget import some
from webots_mcp.server.declaring import ACTS, READS, tool
from webots_mcp.server.dispatch import Dispatcher
from webots_mcp.server.parameters import RobotName, RunId, TimeoutS
from webots_mcp.server.pictures import load_picture
from webots_mcp.server.results import CommandAnswer
from webots_mcp.server.shortening import compact_json
from webots_mcp.store.images import cameras, inside, newest_camera_image
from webots_mcp.store.recording import Recording, View

_WAIT_S: Final = 15.0
_MOST_RUNS: Final = 5


@tool("Get the camera picture", READS)
def webots_get_camera(
    recording: Recording,
    camera: Annotated[
        str, Field(max_length=200, description="Camera device; '' is whichever saved last.")
    ] = "",
    robot: RobotName = None,
    run_id: RunId = None,
) -> list[str | Image]:
    """The newest camera frame that the controller saved, as a picture, with its age."""
    with recording.view(robot, run_id) as view:
        run = view.require_run()
        image = newest_camera_image(view.connection, run.id, camera or None)
        if image is None:
            return [_no_frame(view, camera)]
        picture, note = load_picture(image.file(recording.data_dir))
        caption = view.header() | {
            "camera": image.device,
            "picture_sim_time_s": round(image.sim_time_s, 4),
            "picture_age_s": view.age_s(image.wall_time_s),
            "width_px": image.width,
            "height_px": image.height,
            "file": str(recording.data_dir / image.path),
            "note": note,
        }
        return [_caption(caption), picture]


@tool("Take a screenshot", ACTS)
async def webots_take_screenshot(
    recording: Recording,
    ctx: Context[Any],
    quality: Annotated[int, Field(ge=1, le=100, description="Of the simulator's file.")] = 90,
    robot: RobotName = None,
    timeout_s: TimeoutS = _WAIT_S,
) -> list[str | Image]:
    """A picture of the simulation's main view, now; needs a Supervisor.

    The picture is scaled to at most 1,000 pixels; the caption names the original file.
    """
    dispatcher = Dispatcher(recording, ctx.report_progress)
    answer = await dispatcher.ask(robot, "screenshot", timeout_s, {"quality": quality})
    return await to_thread.run_sync(_show, recording, answer)


def _show(recording: Recording, answer: CommandAnswer) -> list[str | Image]:
    said = answer.model_dump(mode="json", exclude_none=True)
    path = cast("dict[str, Any]", answer.result or {}).get("path")
    if answer.outcome != "done" or path is None:
        raise CommandRefusedError(f"no screenshot: {compact_json(said)}")
    file = inside(recording.data_dir, str(path))
    picture, note = load_picture(file)
    return [_caption(said | {"note": note, "file": str(file)}), picture]


def _caption(facts: dict[str, Any]) -> str:
    return compact_json({name: fact for name, fact in facts.items() if fact not in (None, "")})


def _no_frame(view: View, camera: str) -> str:
    """Why there is no picture, in the form of a caption."""
    known = cameras(view.connection, view.robot.id)
    saved = [f"run_id={run_id}: {names}" for run_id, names in known.items()]
    of_it = f" of {camera!r}" if camera else ""
    hint = (
        f"no frame{of_it} in this run; there are some of {some(saved, _MOST_RUNS)}"
        if known
        else "no camera frame was saved: call bridge.save_camera_frame(camera) in the "
        "controller's loop now and then, with the camera enabled"
    )
    return _caption(view.header() | {"camera": camera, "hint": hint})
