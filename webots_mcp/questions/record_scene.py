"""Filming the whole simulation with Webots' own recorders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, cast

from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.answer_models import CommandAnswer
from webots_mcp.errors import CommandRefusedError
from webots_mcp.questions.arguments import RobotName, TimeoutS
from webots_mcp.questions.declaration import CHANGES, Caller, question
from webots_mcp.simulator.instances import instances
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.recording import RecordingAccess

RecordingKind = Literal["movie", "animation"]
_WAIT_S: Final = 60.0


@question(
    "Record the scene",
    CHANGES,
    command="record-scene",
    positional=("action",),
    example="start --kind animation",
    tier="all",
)
async def webots_record_scene(
    recording: RecordingAccess,
    action: Annotated[
        Literal["start", "stop"],
        Field(
            description="Use start to film from now on, stop to end the film and write its file."
        ),
    ],
    caller: Caller,
    kind: Annotated[
        RecordingKind | None,
        Field(
            description="A movie is an MP4 of the main view, an animation an HTML page in which "
            "the scene can be turned. Default: movie."
        ),
    ] = None,
    width_px: Annotated[
        int, Field(ge=16, le=4096, description="Width of a movie in pixels.")
    ] = 1280,
    height_px: Annotated[
        int, Field(ge=16, le=4096, description="Height of a movie in pixels.")
    ] = 720,
    quality: Annotated[
        int, Field(ge=1, le=100, description="Quality of a movie from 1 to 100.")
    ] = 90,
    speed: Annotated[
        int, Field(ge=1, le=100, description="Speed of a movie; 2 is twice the simulated time.")
    ] = 1,
    caption: Annotated[bool, Field(description="Show that speed in a movie.")] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Film the whole simulation while it runs, as a movie or as a 3D animation for a browser.

    For what was recorded before use webots_get_clip; for one picture use webots_take_screenshot.
    Needs a robot that is a Supervisor. One recording is possible at a time; `stop` waits until
    Webots has written the file, whose path and size are in `result`. A reload would discard it
    and is refused meanwhile.
    """
    if action == "start" and kind == "animation":
        await to_thread.run_sync(_require_no_stream, recording, robot)
    params: dict[str, Any] = {"do": action} | ({"kind": kind} if kind else {})
    if action == "start" and kind != "animation":
        params |= {"width": width_px, "height": height_px, "quality": quality, "speed": speed}
        params |= {"caption": True} if caption else {}
    dispatcher = Dispatcher(recording, caller.report)
    answer = await dispatcher.ask(robot, "record_scene", timeout_wall_s, params)
    result = cast("dict[str, Any]", answer.result or {})
    if path := result.get("path"):
        answer.result = result | {"file": str(recording.data_dir / Path(str(path)))}
    if answer.outcome == "done" and action == "start":
        answer.hint = "let the simulation run, then end it with webots_record_scene(action='stop')"
    return answer


def _require_no_stream(recording: RecordingAccess, robot: str | None) -> None:
    """Refuse an animation in a Webots that streams, where this machine shows that it does.

    Raises:
        CommandRefusedError: It was started with --stream.
    """
    with recording.view(robot) as view:
        session = view.session
    if session is None:
        return
    if any(each.streams and each.name == session.instance for each in instances()):
        raise CommandRefusedError(
            "Webots was started with --stream, and it cannot record an animation while it streams "
            "the scene. Record a movie (kind='movie'), or start Webots without --stream."
        )
