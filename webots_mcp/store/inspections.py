"""Read recorded inspections: the controller's own variables at a hit, an error or a hang."""

from __future__ import annotations

import json
import sqlite3
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import INSPECTION_EVENT

_COLUMNS: Final = "id, run_id, sim_time_s, wall_time_s, name, data"
_COMPARED: Final = 200  # characters of a name: an inspection is named like its event
_AT: Final = (  # of an event, because the inspection is written right after it
    f"SELECT {', '.join(f'i.{name}' for name in _COLUMNS.split(', '))} FROM event i JOIN event e "
    f"ON e.id = :id WHERE i.kind = '{INSPECTION_EVENT}' AND i.id >= e.id AND i.run_id = e.run_id "
    "AND i.sim_time_s = e.sim_time_s AND "
    f"substr(i.name, 1, {_COMPARED}) = substr(e.name, 1, {_COMPARED}) ORDER BY i.id LIMIT 1"
)
_OF_RUN: Final = (
    f"SELECT {_COLUMNS} FROM event WHERE run_id = ? AND kind = '{INSPECTION_EVENT}' "
    "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
MOST_LISTED: Final = 50


class Inspection(NamedTuple):
    """What the controller's code was doing at an event.

    Attributes:
        event_id: Its row in the table `event`.
        cause: `breakpoint`, `violation`, `error` or `hang`.
        name: What happened: a condition, an expectation, a log line or a place.
        frames: The controller's own frames, the innermost first: `at`, `function`, `source` and
            `variables` of each.
    """

    event_id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    cause: str
    name: str
    frames: list[dict[str, Any]]

    @property
    def place(self) -> str | None:
        """The innermost line, such as `nav.py:123, turn()`."""
        if not self.frames:
            return None
        return f"{self.frames[0]['at']}, {self.frames[0]['function']}()"


def inspection_at(connection: sqlite3.Connection, event_id: int) -> Inspection | None:
    """Return an inspection by its own id or by that of its event."""
    row = connection.execute(_AT, {"id": event_id}).fetchone()
    return None if row is None else _inspection(row)


def inspections_of(
    connection: sqlite3.Connection, run_id: int, limit: int = MOST_LISTED
) -> list[Inspection]:
    """Return the inspections of a run, newest first."""
    return [_inspection(row) for row in connection.execute(_OF_RUN, (run_id, limit))]


def reference_to(event_id: int, data: object) -> dict[str, Any]:
    """Return the reference to an inspection in a list of events: how to ask for its variables.

    Args:
        event_id: The event of the inspection.
        data: The data of that event.
    """
    said = cast("dict[str, Any]", data if isinstance(data, dict) else {})
    place = Inspection(0, 0, 0.0, 0.0, "", "", _frames_of(said)).place
    return {"event_id": event_id, "line": place}


def _inspection(row: tuple[Any, ...]) -> Inspection:
    event_id, run_id, sim_time_s, wall_time_s, name, text = row
    try:
        data = json.loads(text or "{}")
    except (ValueError, RecursionError):  # another program's
        data = {}
    said = cast("dict[str, Any]", data if isinstance(data, dict) else {})
    cause = str(said.get("cause", "unknown"))
    return Inspection(
        event_id, run_id, sim_time_s, wall_time_s, cause, str(name or ""), _frames_of(said)
    )


def _frames_of(data: dict[str, Any]) -> list[dict[str, Any]]:
    frames = data.get("frames")
    each = cast("list[Any]", frames) if isinstance(frames, list) else []
    return [_frame(cast("dict[str, Any]", frame)) for frame in each if isinstance(frame, dict)]


def _frame(found: dict[str, Any]) -> dict[str, Any]:
    """Return a frame with all its members, whatever program wrote it."""
    source, variables = found.get("source"), found.get("variables")
    return {
        "at": str(found.get("at")),
        "function": str(found.get("function")),
        "source": list(map(str, cast("list[Any]", source))) if isinstance(source, list) else [],
        "variables": variables if isinstance(variables, dict) else {},
    }
