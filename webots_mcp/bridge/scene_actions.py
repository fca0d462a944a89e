"""The built-in actions on the scene tree, by name: read it, set fields, add and remove nodes.

Few controllers receive such a command, so the modules that do the work are imported with the first.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Clock, Simulation

if TYPE_CHECKING:
    from webots_mcp.bridge.scene_changes import SceneChanges


class SceneActions:
    """Reads the scene tree, and changes it until the next reset."""

    def __init__(
        self, simulation: Simulation, clock: Clock, journal: Journal, errors: ErrorReport
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._journal = journal
        self._errors = errors
        self._changes: SceneChanges | None = None  # until the first command that changes the scene

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {
            "get_scene": self.get_scene,
            "get_field": self.get_field,
            "set_field": self.set_field,
            "add_node": self.add_node,
            "remove_node": self.remove_node,
        }

    def begin_run(self) -> None:
        """Undo after a reset the changes that Webots has not undone."""
        if self._changes is not None:
            self._changes.begin_run()

    def get_scene(self, command: ClaimedCommand) -> Progress:
        """Find nodes of the tree, see `scene_reading.get_scene`."""
        from webots_mcp.bridge.scene_reading import get_scene

        return get_scene(self._simulation.robot, command.params)

    def get_field(self, command: ClaimedCommand) -> Progress:
        """Read a field or the fields of a node, see `scene_reading.get_field`."""
        from webots_mcp.bridge.scene_reading import get_field

        return get_field(self._simulation.robot, command.params)

    def set_field(self, command: ClaimedCommand) -> Progress:
        """Set the field, or the entry of a field, at a `path` to a `value`."""
        return self._changer().set_field(command)

    def add_node(self, command: ClaimedCommand) -> Progress:
        """Add the node in `vrml` to the children of the node, or to the field, at a `path`."""
        return self._changer().add_node(command)

    def remove_node(self, command: ClaimedCommand) -> Progress:
        """Remove the node at a `path`, with everything in it."""
        return self._changer().remove_node(command)

    def _changer(self) -> SceneChanges:
        """Return the part that changes the scene, which remembers the changes of this run."""
        if self._changes is None:
            from webots_mcp.bridge.scene_changes import SceneChanges
            from webots_mcp.bridge.scene_edits import SceneEdits

            edits = SceneEdits(self._simulation, self._journal, self._errors)
            self._changes = SceneChanges(self._simulation, self._clock, self._journal, edits)
        return self._changes
