"""The supervisor: a robot that may look at the whole world and change it."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from typing import Any, Final

from .arguments import integer, number, text
from .console import say
from .lacking import lacks
from .node import Node, node_of
from .robot import Robot

_NULL_NODE: Final = (0, "", "", "")


@lacks(
    "animationStartRecording animationStopRecording movieFailed movieIsReady movieStartRecording "
    "movieStopRecording virtualRealityHeadsetGetOrientation virtualRealityHeadsetGetPosition "
    "virtualRealityHeadsetIsUsed worldSave"
)
class Supervisor(Robot):
    """A robot with more methods; the world decides whether it may use them."""

    SIMULATION_MODE_PAUSE = 0
    SIMULATION_MODE_REAL_TIME = 1
    SIMULATION_MODE_FAST = 2

    def __init__(self) -> None:
        super().__init__()
        self._nodes: dict[str, Any] = {}

    # Nodes ---------------------------------------------------------------------------------------

    def getRoot(self) -> Node:
        """The node around everything; its `children` are the top of the scene tree."""
        return self._known("node_get_root")

    def getSelf(self) -> Node:
        """The robot's own node."""
        return self._known("node_get_self")

    def _known(self, operation: str) -> Node:
        """A node that is asked for once; after that it can be had between requests too."""
        found = self._nodes.get(operation) or self._session.ask(operation)
        if found is not None:
            self._nodes[operation] = found
        return node_of(self._session, found or _NULL_NODE)

    def getFromDef(self, d: str) -> Node | None:
        """The node with this DEF name (`A.B`: B inside A); None if there is none."""
        return self._node(self._session.ask("node_get_from_def", text(d)))

    def getFromId(self, id: int) -> Node | None:  # noqa: A002 - Webots' name
        """The node with this number; None if there is none."""
        return self._node(self._session.ask("node_get_from_id", integer(id)))

    def getFromDevice(self, tag: int) -> Node | None:
        """The node of a device: wants the number `device._tag`, not the device."""
        return self._node(self._session.ask("node_get_from_device", integer(tag)))

    def getSelected(self) -> Node | None:
        """None: there is no window to select a node in."""
        return None

    def _node(self, found: Any) -> Node | None:
        return None if found is None else node_of(self._session, found)

    # The simulation ------------------------------------------------------------------------------

    def simulationGetMode(self) -> int:
        """The mode as of the last answer of the simulator."""
        return self._session.mode

    def simulationSetMode(self, mode: int) -> None:
        """Pause, run in real time or run fast; any other number pauses."""
        self._session.ask("simulation_set_mode", integer(mode))

    @property
    def simulation_mode(self) -> int:
        """The mode as of the last answer of the simulator."""
        return self.simulationGetMode()

    @simulation_mode.setter
    def simulation_mode(self, mode: int) -> None:
        self.simulationSetMode(mode)

    def simulationReset(self) -> None:
        """Reset the world at the end of the next physics step; controllers go on."""
        self._session.ask("simulation_reset")

    def simulationResetPhysics(self) -> None:
        """Stop everything that moves."""
        self._session.ask("simulation_reset_physics")

    def simulationQuit(self, status: int) -> None:
        """End the simulation with an exit status."""
        self._session.ask("simulation_quit", integer(status))

    def worldReload(self) -> None:
        """Read the world from its file again; the next step returns -1."""
        self._session.ask("world_reload")

    def worldLoad(self, filename: str) -> None:
        """Load another world after the next physics step."""
        self._session.ask("world_load", text(filename))

    # Pictures ------------------------------------------------------------------------------------

    def exportImage(self, filename: str, quality: int) -> None:
        """Have the simulator write a .png or .jpg picture, with the next rendering."""
        filename, quality = text(filename), integer(quality)
        if not 1 <= quality <= 100:
            say(f"Error: wb_supervisor_export_image(): quality {quality} is not between 1 and 100.")
            return
        self._session.ask("export_image", filename, quality)

    def setLabel(
        self,
        id: int,  # noqa: A002 - Webots' name
        label: str,
        x: float,
        y: float,
        size: float,
        color: int,
        transparency: float = 0.0,
        font: str = "Arial",
    ) -> None:
        """Write a text over the picture; ids are 0 to 99; x, y and size from 0 to 1."""
        number(transparency)
        text(font)
        place = (number(x), number(y), number(size))
        self._session.ask("set_label", integer(id), text(label), *place, integer(color))
