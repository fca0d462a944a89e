"""The scene tree of a world: looking at it, and changing it."""

from __future__ import annotations

import time
from typing import Annotated, Any, Final

from anyio import to_thread
from pydantic import Field, WithJsonSchema

from webots_mcp.answers.models import CommandAnswer
from webots_mcp.contract import OBSERVER
from webots_mcp.errors import AmbiguousRobotError, CommandRefusedError, InvalidInputError
from webots_mcp.questions.arguments import AnyNames, Cursor, RobotName
from webots_mcp.questions.declaring import CHANGES, DESTROYS, READS, Caller, merged, question
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.loop_evidence import find_holder
from webots_mcp.store.recording import RecordingAccess, view_robot
from webots_mcp.store.robots import list_robots

Path = Annotated[
    str,
    Field(
        max_length=500,
        description="ROVER.translation, BALL.children[0].appearance, WorldInfo, #12: by DEF, name "
        "of a robot or solid, type, or number.",
    ),
]
_NO_SUPERVISOR: Final = (
    "no live controller can read the scene of {}: set the field 'supervisor' of a Robot node to "
    "TRUE and create that robot with Supervisor(), or open the world with an observer in it, made "
    "by webots-mcp init --observer WORLD"
)
_NONE_LIVE: Final = (
    "no controller of {} is live (robot {!r}: {}): start the simulation, then ask again; "
    "webots_get_world_info has what was recorded"
)


@question(
    "Get the scene",
    READS,
    command="scene",
    positional=("path",),
    options={"types": "--type", "names": "--name", "fields": "--field", "cursor": "--cursor"},
    example="--type 'Solid*' --field translation",
    quotes=True,
)
async def webots_get_scene(
    recording: RecordingAccess,
    caller: Caller,
    path: Annotated[str | None, Field(description="Only in this node.")] = None,
    depth: Annotated[
        (Annotated[int, Field(ge=1, le=24)]) | None,
        Field(description="Levels; 2 unless types or names."),
    ] = None,
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


@question("Get a field", READS, quotes=True)
async def webots_get_field(
    recording: RecordingAccess,
    caller: Caller,
    path: Path,
    start: Annotated[
        (Annotated[int, Field(ge=0)]) | None, Field(description="From this entry or field on.")
    ] = None,
    robot: RobotName = None,
) -> CommandAnswer:
    """The value of a field of the scene tree now, or of a node all its fields."""
    return await _ask(recording, caller, robot, "get_field", path=path, start=start)


@question("Set a field", CHANGES)
async def webots_set_field(
    recording: RecordingAccess,
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
    recording: RecordingAccess,
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
    recording: RecordingAccess, caller: Caller, path: Path, robot: RobotName = None
) -> CommandAnswer:
    """Remove a node with all in it; a reload of the world brings it back, a reset does not."""
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
            "reading the scene needs a command to a controller, and a --read-only server sends "
            "none; webots_get_world_info has what was recorded"
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
                raise CommandRefusedError(_NONE_LIVE.format(where, last.name, why))
            view_robot(
                connection, robot
            )  # raises where nothing is recorded, and says how to record
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
