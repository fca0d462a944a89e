"""What the signals of a robot mean: as declared, else as their names tell."""

from __future__ import annotations

from collections.abc import Mapping

from webots_mcp.signals.meaning import Meaning, meanings_by_name
from webots_mcp.store.signals import RegisteredSignal, stored_roles


def meanings_of(known: Mapping[str, RegisteredSignal]) -> dict[str, Meaning]:
    """Return the meaning of each signal of a robot.

    Args:
        known: All its signals, or those of a run.
    """
    kinds = {name: signal.kind for name, signal in known.items()}
    return meanings_by_name(kinds, stored_roles(dict(known)))
