"""Steering the simulation and Webots, and waiting for what comes of it."""

from __future__ import annotations

import time
from typing import Annotated, Any, Final, Literal, cast

import anyio
from anyio import to_thread
from pydantic import Field, WithJsonSchema

from webots_mcp.contract import MAX_RUN_S, MAX_STEPS, OBSERVER, Pace, Then
from webots_mcp.errors import AmbiguousRobotError, CommandRefusedError, InvalidInputError
from webots_mcp.launch import Launch, SessionStart, require_world
from webots_mcp.questions.answers import CommandAnswer, RunAnswer
from webots_mcp.questions.budget import cut_text
from webots_mcp.questions.declaring import (
    CHANGES,
    DESTROYS,
    MAX_WAIT_S,
    READS,
    AnyNames,
    Caller,
    Cursor,
    RobotName,
    TimeoutS,
    Value,
    WaitS,
    merged,
    question,
)
from webots_mcp.steering.dispatch import ACTION, Dispatcher, require_possible
from webots_mcp.steering.routes import Attempt, WorldRequest, project_of
from webots_mcp.store.recording import Recording, look
from webots_mcp.store.robots import find_holder, list_robots
from webots_mcp.webots.orders import Order
from webots_mcp.webots.starting import Mode, Start, free_port

Port = Annotated[
    Annotated[int, Field(ge=1, le=65535)] | None,
    Field(description="Of a Webots of another project."),
]
Force = Annotated[bool, Field(description="Press Webots' keys where nothing else works.")]

_WAIT_S: Final = 10.0
_RELOAD_WAIT_S: Final = 30.0
_USUAL_WAIT_S: Final[dict[Order, float]] = {"reload": _RELOAD_WAIT_S, "step": MAX_WAIT_S}


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
    waiting_s = timeout_wall_s or _USUAL_WAIT_S.get(command, _WAIT_S)
    dispatcher = Dispatcher(recording, caller.report)
    attempt = Attempt(recording, dispatcher, robot, waiting_s, command, params, force, port)
    return await attempt.steer()


@question("Reload the world", DESTROYS)
async def webots_world_reload(
    recording: Recording,
    caller: Caller,
    force: Force = False,
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


# -- Webots itself: started on a world, another world in it, ended --

_STARTING_S: Final = 60.0  # Webots downloads what it has not cached
_WORLD_WAIT_S: Final = 30.0
_LOOK_EVERY_S: Final = 0.2
_LONGEST_LINE: Final = 200

World = Annotated[str, Field(max_length=1000, description="A .wbt file.")]


@question("Launch Webots on a world", CHANGES)
async def webots_launch_world(
    recording: Recording,
    world: World,
    caller: Caller,
    mode: Annotated[Mode | None, Field(description="To begin with; else as it prefers.")] = None,
    headless: Annotated[bool, Field(description="Without its window and 3D view.")] = False,
    stream: Annotated[
        bool, Field(description="Obey without a controller; opens the project to the net.")
    ] = False,
    timeout_wall_s: TimeoutS = _STARTING_S,
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
    recording: Recording,
    world: World,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WORLD_WAIT_S,
) -> CommandAnswer:
    """Open another world in the running Webots; all controllers end.

    By a controller that is a Supervisor, else by Webots if started with --stream.
    """
    project = await to_thread.run_sync(project_of, recording)
    file, _ = await to_thread.run_sync(require_world, world, project)
    return await _request(recording, caller, robot, timeout_wall_s).load(file)


@question("Quit Webots", DESTROYS)
async def webots_quit(
    recording: Recording,
    caller: Caller,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WORLD_WAIT_S,
) -> CommandAnswer:
    """End Webots: the one of webots_launch_world; another only by a robot that is a Supervisor."""
    return await _request(recording, caller, robot, timeout_wall_s).quit()


def _request(
    recording: Recording, caller: Caller, robot: str | None, timeout_wall_s: float
) -> WorldRequest:
    dispatcher = Dispatcher(recording, caller.report)
    return WorldRequest(recording, dispatcher, robot, timeout_wall_s, caller.companions.webots)


async def _wait(launched: Launch, caller: Caller, until_s: float) -> SessionStart | None:
    """Until a controller records; None where the time was over first.

    Raises:
        CommandRefusedError: Webots has ended.
    """
    begun_s = time.monotonic()
    while True:
        is_over = launched.webots.is_over  # before the look: what came last is seen
        first = await to_thread.run_sync(launched.first_record)
        if first is not None or time.monotonic() > until_s:
            return first
        if is_over:
            await to_thread.run_sync(launched.webots.end)
            await to_thread.run_sync(launched.record_last_words)
            raise CommandRefusedError(await to_thread.run_sync(launched.silence))
        lines = launched.webots.lines
        said = cut_text(lines[-1].text, _LONGEST_LINE) if lines else "Webots starts"
        await caller.report(time.monotonic() - begun_s, until_s - begun_s, said)
        await anyio.sleep(_LOOK_EVERY_S)


def _answer(
    recording: Recording, launched: Launch, first: SessionStart | None, started_s: float
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


def _then(launched: Launch) -> str:
    """How a start in pause goes on."""
    if launched.start.mode != "pause":
        return ""
    by_us = 'webots_simulation_control("resume") plays it'
    alone = "press play in its window, or quit it and start it in another mode or with stream"
    return f". {by_us if launched.start.streams else alone}"


def _described(launched: Launch) -> dict[str, Any]:
    address = launched.webots.address
    return {
        "world": str(launched.world),
        "port": address.port if address else launched.start.port,
        "pid": launched.webots.pid,
    }


# -- running until something is the case --

_RUN_WAIT_S: Final = 60.0


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
        str | None, Field(max_length=500, description="A condition, as of webots_breakpoint.")
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
        dict[str, Value] | None, Field(description="Set these first, all or none.")
    ] = None,
    then: Annotated[Then, Field(description="At that step; go_on: at the old pace.")] = "pause",
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _RUN_WAIT_S,
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
    return cast("RunAnswer", await dispatcher.ask(robot, ACTION, timeout_wall_s, asked))


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


# -- the scene -------------------------------------------------------------------------------------


Path = Annotated[
    str,
    Field(
        max_length=500,
        description="ROVER.translation, BALL.children[0].appearance, WorldInfo, #12: by DEF, name "
        "of a robot or solid, type, or number.",
    ),
]
_Count = Annotated[int, Field(ge=1, le=24)]
_Start = Annotated[int, Field(ge=0)]


@question(
    "Get the scene",
    READS,
    command="scene",
    positional=("path",),
    options={"types": "--type", "names": "--name", "fields": "--field", "cursor": "--cursor"},
    example="--type 'Solid*' --field translation",
)
async def webots_get_scene(
    recording: Recording,
    caller: Caller,
    path: Annotated[str | None, Field(description="Only in this node.")] = None,
    depth: Annotated[_Count | None, Field(description="Levels; 2 unless types or names.")] = None,
    types: AnyNames = None,
    names: AnyNames = None,
    fields: Annotated[
        list[str] | None, Field(description="Shown too, such as translation.")
    ] = None,
    cursor: Cursor = None,
    robot: RobotName = None,
) -> CommandAnswer:
    """What stands in the world now: solids, robots, joints, devices, and the paths to them.

    With types, such as Robot or PBRAppearance, any node. Asked of a live Supervisor or observer.
    """
    asked = {"path": path, "depth": depth, "types": types, "names": names, "fields": fields}
    return await _ask(recording, caller, robot, "get_scene", cursor=cursor, **asked)


@question("Get a field", READS)
async def webots_get_field(
    recording: Recording,
    caller: Caller,
    path: Path,
    start: Annotated[_Start | None, Field(description="From this entry or field on.")] = None,
    robot: RobotName = None,
) -> CommandAnswer:
    """The value of a field of the scene tree now, or of a node all its fields."""
    return await _ask(recording, caller, robot, "get_field", path=path, start=start)


@question("Set a field", CHANGES)
async def webots_set_field(
    recording: Recording,
    caller: Caller,
    path: Path,
    value: Annotated[
        Any, WithJsonSchema({}), Field(description="0.5, true, a text, [0, 0, 1, 1.57].")
    ],
    stop: Annotated[bool, Field(description="Take the speed of the node too.")] = False,
    robot: RobotName = None,
) -> CommandAnswer:
    """Move a robot, change a colour, a mass, friction: any field that Webots lets be set.

    The answer has the old value, and what the field holds a step later. Recorded as an event; a
    reset puts it back.
    """
    return await _ask(
        recording, caller, robot, "set_field", path=path, value=value, stop=stop or None
    )


@question("Add a node", CHANGES)
async def webots_add_node(
    recording: Recording,
    caller: Caller,
    vrml: Annotated[
        str, Field(description='As in a world file: DEF BOX Solid { name "box" children [...] }')
    ],
    path: Annotated[str, Field(description="Node or field that takes it.")] = "root",
    robot: RobotName = None,
) -> CommandAnswer:
    """Add a node to the children of another, or at the top; the answer has the path to it.

    A PROTO has to be declared in the world as IMPORTABLE EXTERNPROTO. A reset removes the node.
    """
    return await _ask(recording, caller, robot, "add_node", vrml=vrml, path=path)


@question("Remove a node", DESTROYS)
async def webots_remove_node(
    recording: Recording, caller: Caller, path: Path, robot: RobotName = None
) -> CommandAnswer:
    """Remove a node with all in it; a reload of the world brings it back, a reset does not."""
    return await _ask(recording, caller, robot, "remove_node", path=path)


# -- asking any live Supervisor of the simulation --

_SCENE_WAIT_S: Final = 15.0  # of wall time
_NO_SUPERVISOR: Final = (
    "no live controller can read the scene of {}: set the field 'supervisor' of a Robot node to "
    "TRUE and create that robot with Supervisor(), or open the world with an observer in it, made "
    "by webots-mcp init --observer WORLD"
)


async def _ask(
    recording: Recording, caller: Caller, robot: str | None, action: str, **params: Any
) -> CommandAnswer:
    """Let a Supervisor read the scene, or change it; parameters that are None are left out.

    Raises:
        InvalidInputError: There is no such robot, several simulations are possible, or this server
            is read-only.
        CommandRefusedError: No live controller can read the scene.
        NothingRecordedError: No robot was ever recorded.
    """
    if recording.read_only:
        raise InvalidInputError(
            "reading the scene needs a command to a controller, and a --read-only server sends "
            "none; webots_get_world_info has what was recorded"
        )
    name = await to_thread.run_sync(_find_supervisor, recording, robot)
    given = {key: value for key, value in params.items() if value is not None}
    return await Dispatcher(recording, caller.report).ask(name, action, _SCENE_WAIT_S, given)


def _find_supervisor(recording: Recording, robot: str | None) -> str:
    """The Supervisor to ask: the one that has paused the simulation, as no other loop runs then.

    Else one with a fresh heartbeat, the named one, an observer (which has no other work), or the
    first, in this order.
    """
    now_s = time.time()
    with recording.reader() as connection:
        own = look(connection, robot).session if robot is not None else None
        found = [
            (each, each.session)
            for each in list_robots(connection, now_s)
            if each.live and each.session is not None and each.session.supervisor
            if own is None or each.session.instance == own.instance
        ]
        if not found:
            look(connection, robot)  # raises where nothing is recorded, and says how to record
            where = "this simulation" if robot is None else f"the simulation of robot {robot!r}"
            raise CommandRefusedError(_NO_SUPERVISOR.format(where))
        if len({session.instance for _, session in found}) > 1:
            listed = ", ".join(repr(each.name) for each, _ in found)
            raise AmbiguousRobotError(
                f"Supervisors of several simulations are live: {listed}; choose a simulation with "
                "robot=..."
            )
        holder = find_holder(connection, found[0][1], now_s)
    ranked = [
        (
            holder is None or session.id != holder.id,
            not session.heartbeat_is_fresh(now_s),
            each.name != robot,
            each.kind != OBSERVER,
        )
        for each, session in found
    ]
    return found[ranked.index(min(ranked))][0].name


SCENE: Final = merged(
    webots_get_scene,
    choice="what",
    meaning="field: the value at path, of a node all its fields.",
    parts={"nodes": webots_get_scene, "field": webots_get_field},
    text="""\
What stands in the world now: solids, robots, joints, devices, and the paths to them.

With types, such as Robot or PBRAppearance, any node. Asked of a live Supervisor or observer.""",
)
EDIT: Final = merged(
    webots_set_field,
    name="webots_edit_scene",
    title="Edit the scene",
    choice="action",
    meaning="set: path, value; add: vrml, path; remove: path.",
    parts={"set": webots_set_field, "add": webots_add_node, "remove": webots_remove_node},
    text="""\
Set a field (a place, colour, mass, friction), add a node, or remove one with all in it.

Answers with the old value and what the field holds a step later, or the new node's path. A reset
undoes it, a removal if the answer says so. A PROTO has to be an IMPORTABLE EXTERNPROTO.""",
)
