"""What commands changed in the scene, so that it is put back when the world is reset.

A reset by Webots brings poses back and removes what was added. It neither sets other fields back
nor brings removed nodes back: that is done here, as long as the controller's process lives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Simulation

if TYPE_CHECKING:
    from webots_mcp.bridge.scene_restoring import FieldEdit, Removal, Restoration

MOST_EDITS: Final = 200  # that are put back


class SceneEdits:
    """Remembers changes of the scene, and has them put back after a reset.

    Args:
        simulation: Whose scene it is.
        clock: Tells when a step has been made, with which Webots sets fields.
        journal: Is told what was put back.
        failed: Is told of what could not be asked of Webots.

    Attributes:
        fields: What was set in this run, in that order.
        added: The paths of the nodes that were added in this run, by their numbers.
        removed: What was removed in this run or an earlier one.
    """

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        journal: Journal,
        failed: Callable[[str, Exception], None],
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._journal = journal
        self._failed = failed
        self._restoration: Restoration | None = None
        self._restored_at_step = 0
        self.fields: dict[tuple[int, str, int | None], FieldEdit] = {}
        self.added: dict[int, str] = {}
        self.removed: list[Removal] = []

    def remember_field(self, edit: FieldEdit) -> bool:
        """A field is about to be set; False if that will not be put back."""
        key = (edit.node_id, edit.name, edit.entry)
        known = self.fields.get(key)
        if known is None and self._is_full:
            return False
        self.fields[key] = edit if known is None else known._replace(value=edit.value)
        return True

    def remember_added(self, path: str, node_id: int) -> bool:
        """A node was added; False if that will not be taken back."""
        if self._is_full:
            return False
        self.added[node_id] = path
        return True

    def remember_removed(self, removal: Removal) -> bool:
        """A node was removed; False if it will not be brought back."""
        if self.added.pop(removal.node_id, None) is not None:
            return True  # it was not there when the run began
        if self._is_full or not removal.is_written_out:
            return False
        self.removed.append(removal)
        return True

    @property
    def _is_full(self) -> bool:
        return len(self.fields) + len(self.added) + len(self.removed) >= MOST_EDITS

    def begin_run(self) -> None:
        """The world was reset: put back what Webots left as commands had made it."""
        if not (self.fields or self.added or self.removed):
            return
        from webots_mcp.bridge.scene_restoring import Restoration  # only where there is something

        self._restoration = Restoration(self._simulation.robot, self._failed)
        self._restored_at_step = self._clock.steps_seen
        fields, self.fields = [*self.fields.values()], {}
        added, self.added = self.added, {}
        self.removed = self._restoration.put_back(fields, added, self.removed)

    def look(self) -> None:
        """Record what was put back, once the step has been made that sets fields."""
        restoration = self._restoration
        if restoration is not None and self._clock.steps_seen != self._restored_at_step:
            self._restoration = None
            self._journal.event("put_back", restoration.outcome())
