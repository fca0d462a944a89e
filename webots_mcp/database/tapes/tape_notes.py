"""What the bridge and a tape exchange: commands that were served, parameters that were set.

The bridge imports this module alone; both names are None in a process without a tape.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

Note = Callable[[str, Any], None]


class ReplayedNotes(Protocol):
    """What the bridge takes from a tape that is replayed, in the round in which it happened."""

    def command_due(self) -> tuple[str, dict[str, Any]] | None:
        """Return the next command of this round, its action and parameters, once."""
        ...

    def bridge_begins(self) -> None:
        """Take note that a bridge is made."""
        ...

    def publishes(self, state: Mapping[Any, Any]) -> None:
        """Take note of what the controller itself publishes."""
        ...

    def parameters_due(self) -> dict[str, Any]:
        """Return the parameters that were set in this round, once."""
        ...


note: Note | None = None
"""Appends to the tape that is recorded: `command` or `parameters`, and what was in it."""
replayed: ReplayedNotes | None = None
"""The tape that is replayed."""
