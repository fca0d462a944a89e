"""Steering the simulation and Webots, and waiting for what comes of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, cast

import anyio
from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.models import CommandAnswer, RunAnswer
from webots_mcp.answers.shortening import cut_text
from webots_mcp.contract import MAX_RUN_S, MAX_STEPS, Pace, Then
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.questions.arguments import MAX_WAIT_S, RobotName, TimeoutS, Value, WaitS
from webots_mcp.questions.declaring import CHANGES, DESTROYS, Caller, merged, question
from webots_mcp.questions.show_pictures import show_end
from webots_mcp.simulator.launch import SessionStart, WebotsLaunch, require_world
from webots_mcp.simulator.orders import Order
from webots_mcp.simulator.starting import Mode, Start, free_port
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.launcher import project_of
from webots_mcp.steering.routes import Attempt
from webots_mcp.steering.run_command import ACTION, require_possible
from webots_mcp.steering.world_request import WorldRequest
from webots_mcp.store.recording import RecordingAccess

Port = Annotated[
    Annotated[int, Field(ge=1, le=65535)] | None,
    Field(description="Of a Webots of another project."),
]
Force = Annotated[bool, Field(description="Press Webots' keys where nothing else works.")]


@dataclass(frozen=True)
class ControlTimes:
    """How long questions wait unless told otherwise, in seconds of wall time.

    Attributes:
        command_s: For a command.
        reload_s: For a reload.
        start_s: For Webots to start: it downloads what it has not cached.
        world_s: For another world, or for the end of Webots.
        run_s: For a run.
        poll_s: Between two checks whether a controller records.
    """

    command_s: float = 10.0
    reload_s: float = 30.0
    start_s: float = 60.0
    world_s: float = 30.0
    run_s: float = 60.0
    poll_s: float = 0.2


_TIMES: Final = ControlTimes()


@question("Control the simulation", DESTROYS, core=True)
async def webots_simulation_control(
    recording: RecordingAccess,
    command: Annotated[Order, Field(description="reset and reload begin a new run at time 0.")],
    caller: Caller,
    steps: Annotated[
        Annotated[int, Field(ge=1, le=MAX_STEPS)] | None,
        Field(description="For step: rounds of the controller's loop."),
    ] = None,
    force: Force = False,
    port: Port = None,
    robot: RobotName = None,
    timeout_wall_s: Annotated[
        WaitS | None, Field(description="10, for reload 30, for step 90.")
    ] = None,
) -> CommandAnswer:
    """Pause, resume, run fast, step, reset or reload, and wait for the outcome.

    By a Supervisor, else an observer in the world (webots-mcp init --observer), else by Webots
    itself if started with --stream; `route` says which. `reload`
    restarts the controllers that Webots starts with their code as it is now; an extern controller
    ends, and somebody has to start it by hand.
    """
    if steps is not None and command != "step":
        raise InvalidInputError(f"steps is for command='step', not for {command!r}: leave it out")
    steps = steps or 1
    params = {"steps": steps} if command == "step" else {}
    waiting_s = timeout_wall_s or {"reload": _TIMES.reload_s, "step": MAX_WAIT_S}.get(
        command, _TIMES.command_s
    )
    dispatcher = Dispatcher(recording, caller.report)
    attempt = Attempt(recording, dispatcher, robot, waiting_s, command, params, force, port)
    return await attempt.steer()


@question("Reload the world", DESTROYS)
async def webots_world_reload(
    recording: RecordingAccess,
    caller: Caller,
    force: Force = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.reload_s,
) -> CommandAnswer:
    """Load world and code anew, as webots_simulation_control("reload")."""
    dispatcher = Dispatcher(recording, caller.report)
    return await Attempt(recording, dispatcher, robot, timeout_wall_s, "reload", {}, force).steer()


@question("Reset the world", DESTROYS)
async def webots_world_reset(
    recording: RecordingAccess,
    caller: Caller,
    force: Force = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.command_s,
) -> CommandAnswer:
    """Back to time 0: webots_simulation_control("reset"), and with force for a stuck controller."""
    dispatcher = Dispatcher(recording, caller.report)
    return await Attempt(recording, dispatcher, robot, timeout_wall_s, "reset", {}, force).steer()


@question("Reset the controller's state", DESTROYS)
async def webots_reset_controller_state(
    recording: RecordingAccess,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.command_s,
) -> CommandAnswer:
    """Put the controller's own variables back; world and time go on as they are.

    Runs its action reset_state, else the callbacks of bridge.on_reload().
    """
    return await Dispatcher(recording, caller.report).ask(robot, "reset_state", timeout_wall_s)


# -- Webots itself: started on a world, another world in it, ended --


World = Annotated[str, Field(max_length=1000, description="A .wbt file.")]


@question("Launch Webots on a world", CHANGES)
async def webots_launch_world(
    recording: RecordingAccess,
    world: World,
    caller: Caller,
    mode: Annotated[Mode | None, Field(description="To begin with; else as it prefers.")] = None,
    headless: Annotated[bool, Field(description="Without its window and 3D view.")] = False,
    stream: Annotated[
        bool, Field(description="Obey without a controller; opens the project to the net.")
    ] = False,
    timeout_wall_s: TimeoutS = _TIMES.start_s,
) -> CommandAnswer:
    """Start Webots and wait until the first controller records, or say why none does.

    It ends with this server, or when it is quit. One at a time.
    """
    launcher = caller.companions.webots
    project = await to_thread.run_sync(project_of, recording)
    file, _ = await to_thread.run_sync(require_world, world, project)
    port = await to_thread.run_sync(free_port)
    start = Start(file, mode, headless, stream, port)
    started_s = time.monotonic()
    launched = await to_thread.run_sync(launcher.begin, start)
    first = await _wait(launched, caller, started_s + timeout_wall_s)
    return await to_thread.run_sync(_answer, recording, launched, first, started_s)


@question("Load another world", DESTROYS)
async def webots_load_world(
    recording: RecordingAccess,
    world: World,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.world_s,
) -> CommandAnswer:
    """Open another world in the running Webots; all controllers end.

    By a controller that is a Supervisor, else by Webots if started with --stream.
    """
    project = await to_thread.run_sync(project_of, recording)
    file, _ = await to_thread.run_sync(require_world, world, project)
    return await _request(recording, caller, robot, timeout_wall_s).load(file)


@question("Quit Webots", DESTROYS)
async def webots_quit(
    recording: RecordingAccess,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.world_s,
) -> CommandAnswer:
    """End Webots: the one of webots_launch_world; another only by a robot that is a Supervisor."""
    return await _request(recording, caller, robot, timeout_wall_s).quit()


def _request(
    recording: RecordingAccess, caller: Caller, robot: str | None, timeout_wall_s: float
) -> WorldRequest:
    dispatcher = Dispatcher(recording, caller.report)
    return WorldRequest(recording, dispatcher, robot, timeout_wall_s, caller.companions.webots)


async def _wait(launched: WebotsLaunch, caller: Caller, until_s: float) -> SessionStart | None:
    """Until a controller records; None where the time was over first.

    Raises:
        CommandRefusedError: Webots has ended.
    """
    begun_s = time.monotonic()
    while True:
        is_over = launched.webots.is_over  # checked first, so that rows of its last moment are read
        first = await to_thread.run_sync(launched.first_record)
        if first is not None or time.monotonic() > until_s:
            return first
        if is_over:
            await to_thread.run_sync(launched.webots.end)
            await to_thread.run_sync(launched.record_unfollowed_output)
            raise CommandRefusedError(await to_thread.run_sync(launched.silence))
        lines = launched.webots.lines
        said = cut_text(lines[-1].text, 200) if lines else "Webots starts"
        await caller.report(time.monotonic() - begun_s, until_s - begun_s, said)
        await anyio.sleep(_TIMES.poll_s)


def _answer(
    recording: RecordingAccess, launched: WebotsLaunch, first: SessionStart | None, started_s: float
) -> CommandAnswer:
    header: dict[str, Any] = {}
    if first is not None:
        with recording.view(first.robot) as view:
            header = view.header()
    return CommandAnswer(
        **header,
        action="launch",
        outcome="done" if first else "claimed",
        waited_s=round(time.monotonic() - started_s, 3),
        result=_described(launched),
        route="process",
        evidence=f"{first.robot} records: run {first.run_id}" if first else None,
        hint=None if first else f"Webots runs, but {launched.silence()}{_then(launched)}",
    )


def _then(launched: WebotsLaunch) -> str:
    """Return how a start in pause goes on."""
    if launched.start.mode != "pause":
        return ""
    by_us = 'webots_simulation_control("resume") plays it'
    alone = "press play in its window, or quit it and start it in another mode or with stream"
    return f". {by_us if launched.start.streams else alone}"


def _described(launched: WebotsLaunch) -> dict[str, Any]:
    address = launched.webots.address
    return {
        "world": str(launched.world),
        "port": address.port if address else launched.start.port,
        "pid": launched.webots.pid,
    }


# -- running until something is the case --


@question(
    "Run until",
    DESTROYS,
    command="run",
    options={"parameters": "--set"},
    core=True,
    example="--until 'front_m < 0.1' --for 20 --reset --set kp=2",
    quotes=True,
    of_controller="parameters",
)
async def webots_run(
    recording: RecordingAccess,
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
    picture: Annotated[bool, Field(description="Show the end as a screenshot too.")] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.run_s,
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
        await show_end(recording, dispatcher, answer)
    return answer


WORLD: Final = merged(
    webots_launch_world,
    choice="action",
    meaning="load: another world in the Webots that runs; quit: end it.",
    parts={"launch": webots_launch_world, "load": webots_load_world, "quit": webots_quit},
    text="""\
Start Webots on a world and wait until the first controller records.

It ends with this server, or by quit. One at a time. Another Webots obeys by a Supervisor, or if
started with --stream.""",
)
