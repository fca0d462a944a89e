"""Read and change the scene tree of a world."""

from __future__ import annotations

import time
from typing import Annotated, Any, Final

from anyio import to_thread
from pydantic import Field, WithJsonSchema

from webots_mcp.answers.answer_models import CommandAnswer
from webots_mcp.contract import OBSERVER
from webots_mcp.errors import AmbiguousRobotError, CommandRefusedError, InvalidInputError
from webots_mcp.questions.arguments import Cursor, RobotName
from webots_mcp.questions.declaration import CHANGES, DESTROYS, READS, Caller, question
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.loop_evidence import find_holder
from webots_mcp.store.recording import RecordingAccess, view_robot
from webots_mcp.store.robots import list_robots

Path = Annotated[
    str,
    Field(
        max_length=500,
        description="Path from a DEF name, a robot's or solid's name, a type or #number: "
        "ROVER.translation, BALL.children[0].appearance, WorldInfo.gravity.",
    ),
]
_NO_SUPERVISOR: Final = (
    "No live controller can read the scene of {}. Set the field 'supervisor' of a Robot node to "
    "TRUE and create that robot with Supervisor(), or open the world with an observer in it, made "
    "by 'webots-mcp init --observer WORLD'."
)


@question(
    "Get the scene",
    READS,
    command="scene",
    positional=("path",),
    options={"types": "--type", "names": "--name", "fields": "--field", "cursor": "--cursor"},
    example="--type 'Solid*' --field translation",
    quotes=True,
    tier="core",
)
async def webots_get_scene(
    recording: RecordingAccess,
    caller: Caller,
    path: Annotated[
        str | None, Field(description="Node to list, such as ROVER. Default: the whole world.")
    ] = None,
    depth: Annotated[
        (Annotated[int, Field(ge=1, le=24)]) | None,
        Field(description="Number of levels. Default: 2, or all with types or names."),
    ] = None,
    types: Annotated[
        list[str] | None, Field(max_length=50, description="Only nodes of these types: 'Solid*'.")
    ] = None,
    names: Annotated[
        list[str] | None, Field(max_length=50, description="Only nodes with these names: 'box*'.")
    ] = None,
    fields: Annotated[
        list[str] | None, Field(description="Fields to show of each node, such as translation.")
    ] = None,
    cursor: Cursor = None,
    robot: RobotName = None,
) -> CommandAnswer:
    """List what is in the world now: solids, robots, joints and devices, with the path of each.

    With `types` it finds nodes of any type, such as Robot or PBRAppearance. Asks a running
    Supervisor or observer. For all fields of one node use webots_get_field; to change one use
    webots_set_field.
    """
    asked = {"path": path, "depth": depth, "types": types, "names": names, "fields": fields}
    return await _ask(recording, caller, robot, "get_scene", cursor=cursor, **asked)


@question("Get a field", READS, quotes=True, tier="all")
async def webots_get_field(
    recording: RecordingAccess,
    caller: Caller,
    path: Path,
    start: Annotated[
        (Annotated[int, Field(ge=0)]) | None,
        Field(description="Number of entries or fields to skip."),
    ] = None,
    robot: RobotName = None,
) -> CommandAnswer:
    """Read a field of a node in the world, or all fields of a node, as they are now.

    To find nodes and their paths use webots_get_scene; to change a field use webots_set_field.
    """
    return await _ask(recording, caller, robot, "get_field", path=path, start=start)


@question("Set a field", CHANGES)
async def webots_set_field(
    recording: RecordingAccess,
    caller: Caller,
    path: Path,
    value: Annotated[
        Any,
        WithJsonSchema({}),
        Field(description="New value: 0.5, true, a text, or a list such as [0, 0, 1, 1.57]."),
    ],
    stop: Annotated[
        bool, Field(description="Also stop the node: set its velocity to zero.")
    ] = False,
    robot: RobotName = None,
) -> CommandAnswer:
    """Change a field of the world while it runs: move a robot, set a mass, a friction, a colour.

    Answers with the old value and the value one step later. A reset of the world undoes it. For
    paths use webots_get_scene; to create or remove nodes use webots_add_node and
    webots_remove_node.
    """
    return await _ask(
        recording, caller, robot, "set_field", path=path, value=value, stop=stop or None
    )


@question("Add a node", CHANGES, tier="all")
async def webots_add_node(
    recording: RecordingAccess,
    caller: Caller,
    vrml: Annotated[
        str,
        Field(description='Node as in a world file: DEF BOX Solid { name "box" children [...] }'),
    ],
    path: Annotated[
        str, Field(description="Node or field to add it to. Default: the top of the world.")
    ] = "root",
    robot: RobotName = None,
) -> CommandAnswer:
    """Add a node to the world, such as an obstacle, written as in a world file.

    Answers with its path. A PROTO must be declared in the world as IMPORTABLE EXTERNPROTO. A
    reset of the world removes the node.
    """
    return await _ask(recording, caller, robot, "add_node", vrml=vrml, path=path)


@question("Remove a node", DESTROYS, tier="all")
async def webots_remove_node(
    recording: RecordingAccess, caller: Caller, path: Path, robot: RobotName = None
) -> CommandAnswer:
    """Remove a node and everything in it from the world.

    A reload of the world brings it back, a reset does not.
    """
    return await _ask(recording, caller, robot, "remove_node", path=path)


# -- asking any live Supervisor of the simulation --


async def _ask(
    recording: RecordingAccess, caller: Caller, robot: str | None, action: str, **params: Any
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
            "Reading the scene needs a command to a controller, and a --read-only server sends "
            "none. webots_get_world_info has what was recorded."
        )
    name = await to_thread.run_sync(_find_supervisor, recording, robot)
    given = {key: value for key, value in params.items() if value is not None}
    return await Dispatcher(recording, caller.report).ask(name, action, 15.0, given)


def _find_supervisor(recording: RecordingAccess, robot: str | None) -> str:
    """Find the Supervisor to ask: the one that paused the simulation, as no other loop runs then.

    Else one with a fresh heartbeat, the named one, an observer (which has no other work), or the
    first, in this order.
    """
    now_s = time.time()
    with recording.reader() as connection:
        own = view_robot(connection, robot).session if robot is not None else None
        meant = [
            (each, each.session)
            for each in list_robots(connection, now_s)
            if each.session is not None and (own is None or each.session.instance == own.instance)
        ]
        found = [pair for pair in meant if pair[0].live and pair[1].supervisor]
        if not found:
            where = "this simulation" if robot is None else f"the simulation of robot {robot!r}"
            if meant and not any(each.live for each, _ in meant):
                last, _ = max(meant, key=lambda pair: pair[1].last_seen_wall_time_s)
                why = view_robot(connection, last.name).status.why
                raise CommandRefusedError(
                    f"No controller of {where} is live (robot {last.name!r}: {why}). Start the "
                    "simulation, then call again. webots_get_world_info has what was recorded."
                )
            view_robot(
                connection, robot
            )  # raises where nothing is recorded, and says how to record
            raise CommandRefusedError(_NO_SUPERVISOR.format(where))
        if len({session.instance for _, session in found}) > 1:
            listed = ", ".join(repr(each.name) for each, _ in found)
            raise AmbiguousRobotError(
                f"Supervisors of several simulations are live: {listed}. Choose a simulation, for "
                f"example with robot={found[0][0].name!r}."
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
