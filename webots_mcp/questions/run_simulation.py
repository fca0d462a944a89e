"""The tool that lets the simulation run until something is the case, and says what happened."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, cast

from anyio import to_thread
from pydantic import Field

from webots_mcp.contract import MAX_RUN_S, Pace, Then
from webots_mcp.errors import CommandRefusedError, WebotsMCPError
from webots_mcp.questions.answers import ShownPicture
from webots_mcp.questions.argument_types import RobotName, TimeoutS, Value
from webots_mcp.questions.budget import seconds
from webots_mcp.questions.declaring import DESTROYS, Caller, question
from webots_mcp.questions.history_answers import RunAnswer
from webots_mcp.questions.pictures import load_picture
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.running import ACTION, require_possible
from webots_mcp.store.recording import Recording
from webots_mcp.store.run_rows import camera_frames, inside

_WAIT_S: Final = 60.0
_PICTURE_WAIT_S: Final = 8.0
_SAME_S: Final = 0.001  # times are told to the millisecond


@question(
    "Run until",
    DESTROYS,
    command="run",
    options={"parameters": "--set"},
    core=True,
    example="--until 'front_m < 0.1' --for 20 --reset --set kp=2",
)
async def webots_run(
    recording: Recording,
    caller: Caller,
    until: Annotated[
        str | None,
        Field(max_length=500, description="A condition, as of webots_breakpoint."),
    ] = None,
    for_s: Annotated[
        float | None,
        Field(gt=0, le=MAX_RUN_S, description="Simulated seconds; at most, with until."),
    ] = None,
    reset: Annotated[
        bool, Field(description="Reset the world first; for_s counts from there.")
    ] = False,
    pace: Annotated[Literal[Pace, "as_it_is"], Field(description="Of this run.")] = "fast",
    parameters: Annotated[
        dict[str, Value] | None,
        Field(description="Set these first, all or none."),
    ] = None,
    then: Annotated[Then, Field(description="At that step; go_on: at the old pace.")] = "pause",
    picture: Annotated[bool, Field(description="A screenshot of the end, too.")] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> RunAnswer:
    """Let the simulation run until a condition holds or a simulated time is over, then pause it.

    Says why it stopped, how far it came, the state at that step, and what happened meanwhile. Out
    of wall time it goes on: webots_list_commands(what="outcome") waits. Needs a Supervisor.
    """
    await to_thread.run_sync(lambda: require_possible(recording, robot, until, for_s, reset=reset))
    params = {
        "until": until,
        "for_s": for_s,
        "reset": reset,
        "pace": None if pace == "as_it_is" else pace,
        "parameters": parameters,
        "then": then,
    }
    dispatcher = Dispatcher(recording, caller.report)
    asked = {name: value for name, value in params.items() if value is not None}
    answer = cast("RunAnswer", await dispatcher.ask(robot, ACTION, timeout_wall_s, asked))
    if picture and answer.outcome == "done":
        await _add_picture(recording, dispatcher, answer)
    return answer


async def _add_picture(recording: Recording, dispatcher: Dispatcher, answer: RunAnswer) -> None:
    """A screenshot beside the data, or a camera frame of that step, or why there is neither."""
    try:
        shot = await dispatcher.ask(answer.robot, "screenshot", _PICTURE_WAIT_S, {"quality": 90})
        if shot.outcome != "done":
            raise CommandRefusedError(
                shot.error or shot.hint or f"the screenshot is {shot.outcome}"
            )
        file = inside(recording.data_dir, str(cast("dict[str, Any]", shot.result)["path"]))
        facts: dict[str, Any] = {"file": str(file), "sim_time_s": shot.sim_time_s}
        image, note = await to_thread.run_sync(load_picture, file)
    except WebotsMCPError as error:
        await to_thread.run_sync(_add_frame, recording, answer, str(error))
        return
    _attach(answer, image, facts, note, "webots_take_screenshot")


def _add_frame(recording: Recording, answer: RunAnswer, why: str) -> None:
    """What a camera saw at the step at which the run ended, where that was recorded."""
    ran = answer.ran or {}
    frame = None
    if ran.get("run_id") is not None:
        with recording.reader() as connection:
            found = camera_frames(connection, ran["run_id"], at_s=ran["to_s"])
        frame = next((each for each in found if abs(each.sim_time_s - ran["to_s"]) < _SAME_S), None)
    if frame is None:
        answer.picture = {"missing": why}
        return
    try:
        image, note = load_picture(frame.file(recording.data_dir))
    except WebotsMCPError as error:
        answer.picture = {"missing": f"{why}; {error}"}
        return
    file = str(recording.data_dir / frame.path)
    facts = {"camera": frame.device, "file": file, "sim_time_s": seconds(frame.sim_time_s)}
    _attach(answer, image, facts | {"no_screenshot": why}, note, "webots_get_camera")


def _attach(
    answer: RunAnswer, image: ShownPicture, facts: dict[str, Any], note: str, again: str
) -> None:
    answer.pictures.append(image)
    answer.picture = facts | ({"note": note} if note else {})
    answer.picture["see"] = f"beside this answer; if your client drops it, {again}"
