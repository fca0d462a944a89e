"""Commands that look at the scene of a simulation, and set its fields."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.cli.command import DATA_DIR, DATABASE, JSON, ROBOT, argument, command, value_of
from webots_mcp.cli.steering import require_done, show_progress, writable
from webots_mcp.cli.tables import print_table, printable, text_of

if TYPE_CHECKING:
    from webots_mcp.questions.answers import CommandAnswer

_WHERE: Final = (DATA_DIR, DATABASE, ROBOT, JSON)


@command(
    "scene", *_WHERE,
    argument("path", nargs="?", metavar="PATH", help="only what is in this node"),
    argument("--depth", type=int, metavar="N", help="N levels (2; all with --type or --name)"),
    argument("--type", action="append", dest="types", metavar="TYPE", help="'*' is any text"),
    argument("--name", action="append", dest="names", metavar="NAME", help="or DEF name"),
    argument("--field", action="append", dest="fields", metavar="FIELD", help="shown too"),
    argument("--cursor", type=int, metavar="N", help="go on after what was shown"),
)  # fmt: skip
def scene(arguments: argparse.Namespace) -> None:
    """Show what stands in the world now, with the paths to it.

    webots-mcp scene --type Robot --field translation
    """
    names = ("path", "depth", "types", "names", "fields", "cursor")
    _show(arguments, "get_scene", {each: getattr(arguments, each) for each in names})


@command(
    "field", *_WHERE,
    argument("path", metavar="PATH", help="such as ROVER.translation or BALL.physics.mass"),
    argument("value", nargs="?", metavar="VALUE", help="set it: '[0, 1, 0.04]', 0.5, true, a text"),
    argument("--start", type=int, metavar="N", help="show its entries from this one on"),
    argument("--stop", action="store_true", help="take the speed of its node too"),
)  # fmt: skip
def field(arguments: argparse.Namespace) -> None:
    """Show a field of the scene tree, or all fields of a node; or set one.

    webots-mcp field ROVER.translation '[0, 1, 0.04]'
    """
    if arguments.value is None:
        params = {"path": arguments.path, "start": arguments.start}
        return _show(arguments, "get_field", params)
    stop = arguments.stop or None
    params = {"path": arguments.path, "value": value_of(arguments.value), "stop": stop}
    _show(arguments, "set_field", params)


def _show(arguments: argparse.Namespace, action: str, params: dict[str, Any]) -> None:
    result = _asked(arguments, action, params)
    if arguments.json:
        print(json.dumps(result, ensure_ascii=False))
        return
    columns, rows = result.pop("columns", None), result.pop("rows", ())
    if columns is not None:
        print_table(columns, rows)
    for name, value in result.items():
        whole = json.dumps(value, ensure_ascii=False) if isinstance(value, list) else value
        print(f"{name}: {printable(whole) if isinstance(whole, str) else text_of(whole)}")


def _asked(arguments: argparse.Namespace, action: str, params: dict[str, Any]) -> dict[str, Any]:
    import anyio

    from webots_mcp.steering.scene import ask_scene

    async def ask() -> CommandAnswer:
        recording = writable(arguments)
        return await ask_scene(recording, show_progress, action, params, robot=arguments.robot)

    answer = anyio.run(ask)
    require_done(answer, arguments)
    return answer.result
