"""Tools that look at the scene tree of a world, and change it."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, WithJsonSchema

from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.questions.argument_types import AnyNames, Cursor, RobotName
from webots_mcp.questions.declaring import CHANGES, DESTROYS, READS, Caller, question
from webots_mcp.steering.scene_requests import ask_scene
from webots_mcp.store.recording import Recording

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
    wanted = {"path": path, "depth": depth, "types": types, "names": names, "fields": fields}
    params = wanted | {"cursor": cursor}
    return await ask_scene(recording, caller.report, "get_scene", params, robot=robot)


@question("Get a field", READS)
async def webots_get_field(
    recording: Recording,
    caller: Caller,
    path: Path,
    start: Annotated[_Start | None, Field(description="From this entry or field on.")] = None,
    robot: RobotName = None,
) -> CommandAnswer:
    """The value of a field of the scene tree now, or of a node all its fields."""
    params = {"path": path, "start": start}
    return await ask_scene(recording, caller.report, "get_field", params, robot=robot)


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
    params = {"path": path, "value": value, "stop": stop or None}
    return await ask_scene(recording, caller.report, "set_field", params, robot=robot)


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
    params = {"vrml": vrml, "path": path}
    return await ask_scene(recording, caller.report, "add_node", params, robot=robot)


@question("Remove a node", DESTROYS)
async def webots_remove_node(
    recording: Recording, caller: Caller, path: Path, robot: RobotName = None
) -> CommandAnswer:
    """Remove a node with all in it; a reset brings it back if the answer says so."""
    params = {"path": path}
    return await ask_scene(recording, caller.report, "remove_node", params, robot=robot)
