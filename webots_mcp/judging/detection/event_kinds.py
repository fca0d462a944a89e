"""The list of all kinds of events. What reports, counts or draws events reads it.

A new kind is a module that holds an `EventKind`, and a line in `KINDS`.
"""

from __future__ import annotations

from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection import (
    condition,
    degradation,
    fall,
    gap,
    jump,
    oscillation,
    pace,
    sensors,
    slip,
    standstill,
    stored_events,
    targets,
)
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import EventKind

KINDS: Final[list[EventKind]] = [
    stored_events.RUN,
    gap.GAP,
    stored_events.CHANGE,
    standstill.STANDSTILL,
    standstill.STUCK,
    condition.CONDITION,
    condition.VIOLATIONS,
    sensors.MISSING,
    sensors.FLAT,
    jump.JUMP,
    oscillation.OSCILLATION,
    targets.OFF_TARGET,
    fall.FALL,
    slip.SLIP,
    degradation.DEGRADATION,
    pace.SLOW_SIMULATION,
    stored_events.COMMAND,
    stored_events.LOG,
    stored_events.NOTICED,
    stored_events.KEPT,
    stored_events.IMAGE,
]


def kind_named(name: str) -> EventKind:
    """The kind of that name.

    Raises:
        InvalidInputError: There is none.
    """
    found = next((kind for kind in KINDS if kind.name == name), None)
    if found is None:
        raise InvalidInputError(f"Unknown kind {name!r}. Kinds: {', '.join(kind_names())}.")
    return found


def kind_names() -> list[str]:
    """The names of all kinds."""
    return [kind.name for kind in KINDS]


def asked_kinds(options: EventOptions) -> list[EventKind]:
    """The kinds that the options name, in the order of the registry; else the usual ones.

    Raises:
        InvalidInputError: There is no kind of such a name.
    """
    wanted = {kind_named(name).name for name in options.kinds}
    return [kind for kind in KINDS if (kind.name in wanted if wanted else kind.usual(options))]


def stored_kinds() -> tuple[str, ...]:
    """The names of the kinds that were stored when they happened."""
    return tuple(kind.name for kind in KINDS if kind.stored)


def drawn_kinds() -> list[EventKind]:
    """Those that have a row below a plot: what a person would look for first comes first."""
    drawn = [(kind.drawn, kind) for kind in KINDS if kind.drawn is not None]
    return [kind for _, kind in sorted(drawn, key=lambda each: each[0])]
