"""An inspection of a controller as a report and the page show it: lines, source and variables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from webots_mcp.plugins.report.words import format_value, time_at
from webots_mcp.store.inspections import Inspection


class ShownFrame(NamedTuple):
    """A function of the controller that was being executed: its line, source and variables."""

    place: str
    source: Sequence[str]
    variables: Sequence[tuple[str, str]]


class ShownVariables(NamedTuple):
    """What the variables of a controller held at an event."""

    title: str
    frames: Sequence[ShownFrame]


def shown_variables(inspection: Inspection) -> ShownVariables:
    """Return an inspection in words; its texts are recorded data."""
    frames = [
        ShownFrame(
            f"{each['at']}, {each['function']}()",
            each["source"],
            [(name, format_value(value)) for name, value in each["variables"].items()],
        )
        for each in inspection.frames
    ]
    at = f"{time_at(inspection.sim_time_s)} s ({inspection.cause}: {inspection.name})"
    return ShownVariables(f"Variables of the controller at {at}", frames)
