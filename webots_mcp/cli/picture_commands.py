"""Define the commands that fetch a picture: the robot's camera, or the simulator's 3D view."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from webots_mcp.cli.options import (
    Count,
    Json,
    Parameter,
    RunId,
    ToRobot,
    Waiting,
)
from webots_mcp.cli.terminal import print_answer, print_json
from webots_mcp.database.files import placed
from webots_mcp.errors import NothingRecordedError

if TYPE_CHECKING:
    from webots_mcp.questions.declaration import Question

_WAITING: Final = Waiting()
_ROBOT: Final = ToRobot()


def camera(
    name: Annotated[str, Parameter("CAMERA", help="Camera name. Default: any camera.")] = "",
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(("-o", "--output"), metavar="FILE", help="File to write. Default: camera.jpg."),
    ] = None,
    fresh: Annotated[
        bool,
        Parameter("--fresh", negative=(), help="Take a new picture instead of the newest one."),
    ] = False,
    at_s: Annotated[
        float | None,
        Parameter("--at", metavar="S", help="Picture nearest to this simulated time, in seconds."),
    ] = None,
    frames: Annotated[
        Count,
        Parameter(
            "--frames",
            metavar="N",
            help="Number of pictures around that time, on one sheet. Default: 1.",
        ),
    ] = 1,
    run_id: RunId = None,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Save a picture of the robot's own camera: the newest, a new one, or an earlier one.

    webots-mcp camera --at 12.4 -o moment.jpg
    """
    from webots_mcp.questions.show_pictures import webots_get_camera

    given: dict[str, Any] = {"camera": name, "fresh": fresh, "at_s": at_s, "frames": frames}
    given |= {"robot": asked.robot, "run_id": run_id}
    _save(webots_get_camera, given, asked, output or Path("camera"), as_json=json)


def screenshot(
    *,
    output: Annotated[
        Path | None,
        Parameter(
            ("-o", "--output"), metavar="FILE", help="File to write. Default: screenshot.jpg."
        ),
    ] = None,
    quality: Annotated[
        Count, Parameter("--quality", metavar="N", help="JPEG quality from 1 to 100. Default: 90.")
    ] = 90,
    asked: Waiting = _WAITING,
    json: Json = False,
) -> None:
    """Save a screenshot of the simulation's 3D view as it is now.

    The controller that records must be a Supervisor.

        webots-mcp screenshot -o arena.jpg
    """
    from webots_mcp.questions.show_pictures import webots_take_screenshot

    given = {"quality": quality, "robot": asked.robot, "timeout_wall_s": asked.timeout_wall_s}
    _save(webots_take_screenshot, given, asked, output or Path("screenshot"), as_json=json)


def _save(
    question: Question, given: dict[str, Any], asked: ToRobot, file: Path, *, as_json: bool
) -> None:
    """Request a picture, write it and describe it; the file extension follows its format.

    Raises:
        NothingRecordedError: There is no picture; the text explains why.
    """
    from webots_mcp.cli.question_commands import ask

    reply = ask(question, given, asked)
    texts = [each for each in reply.shown if isinstance(each, str)]
    picture = next((each for each in reply.shown if not isinstance(each, str)), None)
    facts: dict[str, Any] = {}
    for text in texts:  # the facts are JSON, as in the answer for a model
        with contextlib.suppress(ValueError):
            facts |= json.loads(text)
    if picture is None:
        why = facts.get("hint") or facts.get("error")
        raise NothingRecordedError(why or "; ".join(texts) or "no picture was recorded")
    if not file.suffix:
        file = file.with_suffix("." + picture.format.replace("jpeg", "jpg"))
    with placed(file) as aside:
        aside.write_bytes(picture.data)
    facts["file"] = str(file)
    if as_json:
        return print_json(facts)
    print_answer({"summary": f"Wrote {file}."} | facts)
