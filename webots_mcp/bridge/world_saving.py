"""The built-in action that saves the world in motion next to its file: save_world.

`worldSave` of Webots would make the copy the current world, which a reload opens, and this moment
the one to which a reset returns. So the nodes are exported one by one, which writes the same text
and changes nothing.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import WORLD_ENDING, recorded_name
from webots_mcp.database.files import full_path
from webots_mcp.errors import CommandRefusedError, InvalidInputError

_HEADER: Final = re.compile(r"#VRML_SIM R(?P<year>20\d\d)[ab]?\S* utf8")
_EXTERNPROTO: Final = re.compile(r'^\s*(?:IMPORTABLE\s+)?EXTERNPROTO\s+"[^"]*"', re.MULTILINE)
_OLDEST: Final = "2022"  # worlds of earlier releases have other axes, which Webots converts


class WorldSaving:
    """Saves the world as it is now, under another name and in the same folder."""

    def __init__(
        self, simulation: Simulation, clock: Clock, pause: Pause, throttle: Throttle
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._pause = pause
        self._throttle = throttle

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {"save_world": self.save_world}

    def save_world(self, command: ClaimedCommand) -> Progress:
        """Write the world to a new file in the folder of the current one.

        Raises:
            InvalidInputError: The name is none of a world file.
            CommandRefusedError: Time passes, a file of that name exists, or Webots exports nothing.
        """
        if not self._pause.active:
            raise CommandRefusedError(
                "save_world needs a simulation that stands still, and it runs. Pause it first: "
                "webots_simulation_control(command='pause')"
            )
        world = full_path(self._simulation.robot.getWorldPath())
        file = _new_file(world, command.params["name"])
        head, nodes = _head_of(world), _nodes_of(self._simulation.robot)
        _write(file, "\n".join([*head, "", *nodes, ""]))
        return {
            "file": str(file),
            "world": str(world),
            "robot": recorded_name(str(self._simulation.robot.getName())),
            "sim_time_s": self._clock.sim_time_s,
            "calls": self._throttle.calls_in_run,
            "running_mode": self._pause.running_mode,
        }
        yield


def _new_file(world: Path, name: object) -> Path:
    if not isinstance(name, str) or Path(name).name != name or not name.endswith(WORLD_ENDING):
        raise InvalidInputError(
            f"name must be the name of a new file that ends with {WORLD_ENDING}, without a folder, "
            f"not {name!r:.200}"
        )
    return world.parent / name


def _head_of(world: Path) -> list[str]:
    """Return the first line of a world file, and the PROTO nodes that it declares."""
    try:
        text = world.read_text("utf-8")
    except (OSError, ValueError) as error:
        raise CommandRefusedError(
            f"{world} cannot be read, and the saved world needs its first lines: {error}"
        ) from error
    first = text.partition("\n")[0].strip()
    found = _HEADER.match(first)
    if found is None or found["year"] < _OLDEST:
        raise CommandRefusedError(
            f"{world} begins with {first[:40]!r}: worlds from before R{_OLDEST}a have other axes. "
            "Open it in Webots and save it once"
        )
    return [first, "", *(each.strip() for each in _EXTERNPROTO.findall(text))]


def _nodes_of(robot: Any) -> list[str]:
    """Return the text of each node at the top of the scene tree, hidden fields included."""
    children = robot.getRoot().getField("children")
    texts = [children.getMFNode(index).exportString() for index in range(children.getCount())]
    if not texts or not all(texts):
        raise CommandRefusedError(
            "Webots exported no text of a node (exportString), so the world cannot be saved. Its "
            "console may have the reason"
        )
    return texts


def _write(file: Path, text: str) -> None:
    try:
        with file.open("x", encoding="utf-8") as new:
            try:
                new.write(text)
                new.flush()
            except BaseException:  # half a world is of no use, and nothing else removes it
                file.unlink(missing_ok=True)
                raise
    except FileExistsError:
        raise CommandRefusedError(
            f"{file} exists, and no file is overwritten. Give another name"
        ) from None
    except (OSError, ValueError) as error:
        raise CommandRefusedError(f"the world cannot be saved as {file}: {error}") from error
