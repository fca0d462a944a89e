"""Steering the simulation and Webots, and waiting for what comes of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, cast

import anyio
from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.answer_models import CommandAnswer, RunAnswer
from webots_mcp.answers.shortening import cut_text
from webots_mcp.contract import MAX_RUN_S, MAX_STEPS, Pace, Then
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.questions.arguments import MAX_WAIT_S, RobotName, TimeoutS, Value, WaitS
from webots_mcp.questions.declaration import CHANGES, DESTROYS, Caller, question
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
    Field(description="Port of a Webots with --stream to control, if it runs another project."),
]
Force = Annotated[bool, Field(description="If nothing else works, press keys in Webots' window.")]


@dataclass(frozen=True)
class ControlTimes:
    """How long questions wait by default, in seconds of wall time.

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


@question("Control the simulation", DESTROYS, tier="core")
async def webots_simulation_control(
    recording: RecordingAccess,
    command: Annotated[
        Order, Field(description="What to do. reset and reload begin a new run at time 0.")
    ],
    caller: Caller,
    steps: Annotated[
        Annotated[int, Field(ge=1, le=MAX_STEPS)] | None,
        Field(description="Number of steps of the controller's loop, for command step."),
    ] = None,
    force: Force = False,
    port: Port = None,
    robot: RobotName = None,
    timeout_wall_s: Annotated[
        WaitS | None,
        Field(description="Maximum wall-clock seconds to wait. Default 10; reload 30; step 90."),
    ] = None,
) -> CommandAnswer:
    """Pause, resume, run fast, step, reset or reload the simulation, and wait for the outcome.

    To run until a condition holds use webots_run. `reload` restarts the controllers with their
    code as it is now; an extern controller ends and must be started by hand. Needs a Supervisor,
    an observer (webots-mcp init --observer) or a Webots started with --stream; `route` says which
    was used.
    """
    if steps is not None and command != "step":
        raise InvalidInputError(
            f"steps is possible only with command='step', not with {command!r}. Leave steps out."
        )
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
    """Load the world and the controllers' code anew, at time 0.

    Use it after an edit of a controller; an extern controller ends and must be started by hand.
    webots_simulation_control("reload") is the same: use either. To keep the running code use
    webots_world_reset.
    """
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
    """Put the world back to time 0; the controllers keep their code.

    webots_simulation_control("reset") is the same: use either. To start changed code use
    webots_world_reload; for the controller's own variables use webots_reset_controller_state.
    """
    dispatcher = Dispatcher(recording, caller.report)
    return await Attempt(recording, dispatcher, robot, timeout_wall_s, "reset", {}, force).steer()


@question("Reset the controller's state", DESTROYS)
async def webots_reset_controller_state(
    recording: RecordingAccess,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.command_s,
) -> CommandAnswer:
    """Reset the controller's own variables, while the world and simulated time go on.

    Runs the controller's action reset_state, or else its bridge.on_reload() callbacks. To put the
    world back to time 0 use webots_world_reset.
    """
    return await Dispatcher(recording, caller.report).ask(robot, "reset_state", timeout_wall_s)


# -- Webots itself: started on a world, another world in it, ended --


World = Annotated[
    str, Field(max_length=1000, description="Path of the world file, such as worlds/arena.wbt.")
]


@question("Launch Webots on a world", CHANGES)
async def webots_launch_world(
    recording: RecordingAccess,
    world: World,
    caller: Caller,
    mode: Annotated[
        Mode | None, Field(description="Mode to start in. Default: as set in Webots.")
    ] = None,
    headless: Annotated[
        bool, Field(description="Start without a window and without rendering.")
    ] = False,
    stream: Annotated[
        bool,
        Field(
            description="Allow control without a Supervisor; the network can then read the world."
        ),
    ] = False,
    timeout_wall_s: TimeoutS = _TIMES.start_s,
) -> CommandAnswer:
    """Start Webots on a world file and wait until the first controller records.

    Use it if no Webots runs; for another world in a running Webots use webots_load_world. Only
    one Webots can be started; it is ended together with this server.
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


@question("Load another world", DESTROYS, tier="all")
async def webots_load_world(
    recording: RecordingAccess,
    world: World,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.world_s,
) -> CommandAnswer:
    """Open another world in the running Webots; all its controllers end.

    Needs a Supervisor, or a Webots started with --stream. If no Webots runs use
    webots_launch_world.
    """
    project = await to_thread.run_sync(project_of, recording)
    file, _ = await to_thread.run_sync(require_world, world, project)
    return await _request(recording, caller, robot, timeout_wall_s).load(file)


@question("Quit Webots", DESTROYS, tier="all")
async def webots_quit(
    recording: RecordingAccess,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.world_s,
) -> CommandAnswer:
    """End Webots: the one that webots_launch_world started, or one whose robot is a Supervisor.

    To only stop simulated time use webots_simulation_control("pause").
    """
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
        waited_wall_s=round(time.monotonic() - started_s, 3),
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
    example="--until 'front_m < 0.1' --for 20 --reset --set kp=2",
    quotes=True,
    of_controller="parameters",
)
async def webots_run(
    recording: RecordingAccess,
    caller: Caller,
    until: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Stop when this condition holds; see webots_breakpoint.",
        ),
    ] = None,
    for_s: Annotated[
        float | None,
        Field(gt=0, le=MAX_RUN_S, description="Simulated seconds to run; with until, the maximum."),
    ] = None,
    reset: Annotated[bool, Field(description="Reset the world to time 0 first.")] = False,
    pace: Annotated[Literal[Pace, "as_it_is"], Field(description="Speed of this run.")] = "fast",
    parameters: Annotated[
        dict[str, Value] | None,
        Field(description="Parameters to set first, such as {'kp': 3.0}."),
    ] = None,
    then: Annotated[
        Then,
        Field(description="At the end: pause, go_on at the former speed, or be as_before."),
    ] = "pause",
    picture: Annotated[bool, Field(description="Add a screenshot of the end.")] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _TIMES.run_s,
) -> RunAnswer:
    """Run the simulation until a condition holds or for some simulated seconds, then pause it.

    Answers why it stopped, how far it came, the state at that step and what happened meanwhile.
    If timeout_wall_s is over first, it goes on, and webots_list_commands shows its outcome later.
    Needs a Supervisor. To stop at a condition without starting a run use webots_breakpoint.
    """
    sets = bool(parameters)
    await to_thread.run_sync(
        lambda: require_possible(recording, robot, until, for_s, reset=reset, parameters=sets)
    )
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
