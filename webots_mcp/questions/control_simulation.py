"""Tools that steer the simulation and wait for what comes of it."""

from __future__ import annotations

from typing import Annotated, Final

from anyio import to_thread
from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from webots_mcp.contract import MAX_STEPS
from webots_mcp.errors import CommandRefusedError, InvalidInputError, NothingRecordedError
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.questions.argument_types import MAX_WAIT_S, RobotName, TimeoutS, WaitS
from webots_mcp.questions.declaring import DESTROYS, Caller, question
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import Attempt
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.recording import Recording, look
from webots_mcp.webots.orders import Order

Port = Annotated[
    Annotated[int, Field(ge=1, le=65535)] | None,
    Field(description="Of a Webots of another project."),
]
Force = Annotated[bool, Field(description="Press Webots' keys where nothing else works.")]

_WAIT_S: Final = 10.0
_RELOAD_WAIT_S: Final = 30.0


@question("Control the simulation", DESTROYS, core=True)
async def webots_simulation_control(
    recording: Recording,
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
        WaitS | None, Field(description="10, for reload 30, for step up to 90.")
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
    waiting_s = timeout_wall_s or await to_thread.run_sync(
        _usual_wait_s, recording, command, steps, robot
    )
    dispatcher = Dispatcher(recording, caller.report)
    attempt = Attempt(recording, dispatcher, robot, waiting_s, command, params, force, port)
    return await attempt.steer()


@question("Reload the world", DESTROYS)
async def webots_world_reload(
    recording: Recording,
    caller: Caller,
    force: SkipJsonSchema[Force] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _RELOAD_WAIT_S,
) -> CommandAnswer:
    """Load world and code anew, as webots_simulation_control("reload")."""
    dispatcher = Dispatcher(recording, caller.report)
    return await Attempt(recording, dispatcher, robot, timeout_wall_s, "reload", {}, force).steer()


@question("Reset the world", DESTROYS)
async def webots_world_reset(
    recording: Recording,
    caller: Caller,
    force: Force = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Back to time 0: webots_simulation_control("reset"), and with force for a stuck controller."""
    dispatcher = Dispatcher(recording, caller.report)
    return await Attempt(recording, dispatcher, robot, timeout_wall_s, "reset", {}, force).steer()


@question("Reset the controller's state", DESTROYS)
async def webots_reset_controller_state(
    recording: Recording,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Put the controller's own variables back; world and time go on as they are.

    Runs its action reset_state, else the callbacks of bridge.on_reload().
    """
    return await Dispatcher(recording, caller.report).ask(robot, "reset_state", timeout_wall_s)


def _usual_wait_s(recording: Recording, command: Order, steps: int, robot: str | None) -> float:
    """Long enough for steps at half of real time, and for a reload."""
    if command == "reload":
        return _RELOAD_WAIT_S
    if command != "step":
        return _WAIT_S
    with recording.reader() as connection:
        try:
            run = find_target(connection, robot, command).run
        except CommandRefusedError:  # another way may do it
            run = look(connection, robot).run
        except NothingRecordedError:
            run = None
        step_ms = (run.basic_time_step_ms if run else None) or 32.0  # Webots' default
    return min(_WAIT_S + 2 * steps * step_ms / 1000, MAX_WAIT_S)
