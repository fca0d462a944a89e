"""The changes that commands made to the scene, which are undone when the world is reset.

A reset by Webots restores poses and removes added nodes. It does not restore other fields or
removed nodes: that is done here, as long as the controller's process lives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.webots_api import Simulation

if TYPE_CHECKING:
    from webots_mcp.bridge.scene_restoring import FieldEdit, Removal, Restoration

MOST_EDITS: Final = 200  # that are put back


class SceneEdits:
    """Remembers changes of the scene, and undoes them after a reset.

    Args:
        simulation: Has the scene.
        clock: Counts the steps: Webots sets fields with the next one.
        journal: Receives an event with what was put back.
        failed: Receives each error of a call to Webots.

    Attributes:
        fields: The fields that were set in this run, in that order.
        added: The paths of the nodes that were added in this run, by their numbers.
        removed: The nodes that were removed in this run or an earlier one.
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
        """Remember that a field is about to be set; False if that will not be undone."""
        key = (edit.node_id, edit.name, edit.entry)
        known = self.fields.get(key)
        if known is None and self._is_full:
            return False
        self.fields[key] = edit if known is None else known._replace(value=edit.value)
        return True

    def remember_added(self, path: str, node_id: int) -> bool:
        """Remember an added node; False if that will not be undone."""
        if self._is_full:
            return False
        self.added[node_id] = path
        return True

    def remember_removed(self, removal: Removal) -> bool:
        """Remember a removed node; False if it will not be restored."""
        if self.added.pop(removal.node_id, None) is not None:
            return True  # it did not exist when the run began
        if self._is_full or not removal.is_written_out:
            return False
        self.removed.append(removal)
        return True

    @property
    def _is_full(self) -> bool:
        return len(self.fields) + len(self.added) + len(self.removed) >= MOST_EDITS

    def begin_run(self) -> None:
        """The world was reset: undo the changes that Webots has not undone."""
        if not (self.fields or self.added or self.removed):
            return
        from webots_mcp.bridge.scene_restoring import Restoration  # only here: seldom needed

        self._restoration = Restoration(self._simulation.robot, self._failed)
        self._restored_at_step = self._clock.steps_seen
        fields, self.fields = [*self.fields.values()], {}
        added, self.added = self.added, {}
        self.removed = self._restoration.put_back(fields, added, self.removed)

    def look(self) -> None:
        """Record what was put back, after the step with which Webots sets the fields."""
        restoration = self._restoration
        if restoration is not None and self._clock.steps_seen != self._restored_at_step:
            self._restoration = None
            self._journal.event("put_back", restoration.outcome())
