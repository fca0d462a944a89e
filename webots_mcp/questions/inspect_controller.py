"""The controller's own variables: at a recorded event, or now; and watching one of them.

Nothing can be set: parameters are for that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final, cast

from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.answer_models import CommandAnswer, InspectionAnswer
from webots_mcp.answers.budget import RESULT_BUDGET_TOKENS, fitting, header_of, seconds, table
from webots_mcp.answers.shortening import cut_text, shorten
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.questions.arguments import Id, RobotName, RunId, TimeoutS
from webots_mcp.questions.declaration import READS, SETS, Caller, question
from webots_mcp.questions.recorded_variables import find_recorded
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.inspections import Inspection, inspection_at, inspections_of
from webots_mcp.store.recording import RecordingAccess, RobotView

INSPECTION_COLUMNS: Final = ("event_id", "at_s", "cause", "name", "line")
_NOTHING: Final = (
    "no variables are recorded in this run. They are recorded at breakpoint hits "
    "(webots_breakpoint), violated expectations, logged errors and hangs"
)
_PATH: Final = Field(
    max_length=200,
    description="Variable of the controller, such as self.pid.integral or path[3].",
)


@dataclass(frozen=True)
class InspectionLimits:
    """Limits of an answer about the controller's variables.

    Attributes:
        wait_s: How long the answer of the bridge is awaited.
        list_tokens: Budget of a list of inspections.
        name_characters: Length at which a name is cut.
    """

    wait_s: float = 10.0
    list_tokens: int = 500
    name_characters: int = 120


_LIMITS: Final = InspectionLimits()


@question(
    "Inspect the controller",
    READS,
    command="inspect",
    positional=("path",),
    options={"event_id": "--event"},
    example="self.pid.integral",
    tier="all",
)
async def webots_inspect_controller(
    recording: RecordingAccess,
    caller: Caller,
    path: Annotated[str | None, _PATH] = None,
    event_id: Annotated[
        Id | None,
        Field(
            description="Event from webots_find_events of which to show the recorded variables. "
            "Default: the variables now."
        ),
    ] = None,
    robot: RobotName = None,
    run_id: RunId = None,
    timeout_wall_s: TimeoutS = _LIMITS.wait_s,
) -> InspectionAnswer:
    """Show the controller's own variables: which line it executed and what its variables held.

    Without arguments it asks the running or paused controller. With `event_id` or `run_id` it shows
    what was recorded at breakpoint hits, violations, errors and hangs. `path` asks for one
    variable, now or at an event. It runs no code of the controller and changes nothing. To record a
    variable as a signal use webots_watch.
    """
    if path is not None and event_id is None and run_id is not None:
        raise InvalidInputError(
            f"path {path!r} needs an event, because a run has variables of several. Give event_id "
            "and leave run_id out, or leave path out to list the events"
        )
    if event_id is not None:
        return await to_thread.run_sync(_recorded, recording, robot, event_id, path)
    live = run_id is None and not recording.read_only
    if live and await to_thread.run_sync(_is_live, recording, robot):
        return await _now(recording, caller, path, robot, timeout_wall_s)
    if path is not None:
        raise CommandRefusedError(
            f"path {path!r} needs a running Python controller with a bridge, and none runs. To see "
            "the variables recorded at breakpoint hits, errors and hangs, leave path out"
        )
    return await to_thread.run_sync(_newest, recording, robot, run_id)


@question(
    "Watch a variable", SETS, command="watch", positional=("path",),
    example="self.pid.integral", tier="all",
)  # fmt: skip
async def webots_watch(
    recording: RecordingAccess,
    path: Annotated[str, _PATH],
    caller: Caller,
    every: Annotated[
        int, Field(ge=1, le=1_000_000, description="Record the value with every Nth state.")
    ] = 1,
    stop: Annotated[bool, Field(description="Stop watching this path.")] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _LIMITS.wait_s,
) -> CommandAnswer:
    """Record a variable of the running controller as a signal from now on: watched.PATH.

    In the name of the signal a dot stands for brackets: path[3] becomes watched.path.3. Plots,
    events, breakpoints and comparisons take it like any signal. Recording ends with `stop`, or
    when the controller ends. To see a variable once use webots_inspect_controller.
    """
    params = {"path": path, "every": every} | ({"stop": True} if stop else {})
    return await Dispatcher(recording, caller.report).ask(robot, "watch", timeout_wall_s, params)


# -- as recorded -----------------------------------------------------------------------------------


def _recorded(
    recording: RecordingAccess, robot: str | None, event_id: int, path: str | None
) -> InspectionAnswer:
    with recording.view(robot) as view:
        found = inspection_at(view.connection, event_id)
        if found is None:
            listed = _listed(view, _run_of(view, None))
            ids = [row[0] for row in listed]
            known = f"the newest with variables are {', '.join(map(str, ids[:5]))}"
            raise InvalidInputError(
                f"event {event_id} has no variables of the controller: {known if ids else _NOTHING}"
            )
        answer = _answer(view, found, [])
    if path is not None:
        at = find_recorded(path, found.frames)
        answer.path, answer.value, answer.line, answer.frames = *at, None
    return answer


def _newest(recording: RecordingAccess, robot: str | None, run_id: int | None) -> InspectionAnswer:
    with recording.view(robot, run_id) as view:
        run = _run_of(view, run_id)
        found = inspections_of(view.connection, run, 1) if run is not None else []
        if not found:
            return InspectionAnswer(**view.header(), hint=_NOTHING)
        return _answer(view, found[0], _listed(view, run))


def _run_of(view: RobotView, run_id: int | None) -> int | None:
    return run_id if run_id is not None else view.run.id if view.run else None


def _listed(view: RobotView, run_id: int | None) -> list[list[Any]]:
    if run_id is None:
        return []
    return [
        [
            each.event_id,
            seconds(each.sim_time_s),
            each.cause,
            cut_text(each.name, _LIMITS.name_characters),
            each.place,
        ]
        for each in inspections_of(view.connection, run_id)
    ]


def _answer(view: RobotView, found: Inspection, others: list[list[Any]]) -> InspectionAnswer:
    header: dict[str, Any] = {**view.header(), "run_id": found.run_id}
    several = len(others) > 1
    return InspectionAnswer(
        **header,
        event_id=found.event_id,
        at_s=seconds(found.sim_time_s),
        cause=f"{found.cause}: {cut_text(found.name, _LIMITS.name_characters)}",
        frames=_fitting(found.frames),
        inspections=(
            table(INSPECTION_COLUMNS, fitting(others, _LIMITS.list_tokens)) if several else None
        ),
    )


def _fitting(frames: list[dict[str, Any]]) -> list[dict[str, Any]] | None:
    """Return the frames, shortened if they are long; the innermost ones keep their length."""
    shown = shorten(frames, RESULT_BUDGET_TOKENS).value
    return cast("list[dict[str, Any]]", shown) if isinstance(shown, list) else frames[:1]


# -- now -------------------------------------------------------------------------------------------


def _is_live(recording: RecordingAccess, robot: str | None) -> bool:
    with recording.view(robot) as view:
        return view.robot.live and view.session is not None and view.session.has_bridge


async def _now(
    recording: RecordingAccess,
    caller: Caller,
    path: str | None,
    robot: str | None,
    timeout_wall_s: float,
) -> InspectionAnswer:
    params = {} if path is None else {"path": path}
    dispatcher = Dispatcher(recording, caller.report)
    reply = await dispatcher.ask(robot, "inspect", timeout_wall_s, params)
    result = cast("dict[str, Any] | None", reply.result)
    if reply.outcome != "done" or result is None:
        raise CommandRefusedError(reply.error or reply.hint or f"the command is {reply.outcome}")
    header = await to_thread.run_sync(header_of, recording, reply.robot)
    if path is None:
        return InspectionAnswer(**header, at_s=header.get("sim_time_s"), frames=result["frames"])
    return InspectionAnswer(
        **header,
        at_s=header.get("sim_time_s"),
        path=result["path"],
        value=result["value"],
        line=result.get("at"),
    )
