"""Events: what the bridge noticed when it happened."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any, Final

_COLUMNS: Final = "id, run_id, sim_time_s, wall_time_s, kind, name, data"
_NEWEST: Final = (
    f"SELECT {_COLUMNS} FROM event WHERE run_id = ? ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
_AFTER: Final = (
    f"SELECT {_COLUMNS} FROM event WHERE run_id = :run_id AND id > :after_id "
    "ORDER BY sim_time_s, id LIMIT :limit"
)
_NEWEST_ID: Final = "SELECT coalesce(max(id), 0) FROM event"


@dataclass(frozen=True)
class Event:
    """Something noticed in a run; `data` is JSON text."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    kind: str
    name: str | None
    data: str | None

    def details(self) -> Any:
        """What was noticed, decoded; None where nothing was added."""
        return json.loads(self.data) if self.data else None


def newest_events(connection: sqlite3.Connection, run_id: int, limit: int) -> list[Event]:
    """The latest events of a run, oldest first."""
    rows = connection.execute(_NEWEST, (run_id, limit)).fetchall()
    return [Event(*row) for row in reversed(rows)]


def events_after(
    connection: sqlite3.Connection, run_id: int, after_id: int, limit: int
) -> list[Event]:
    """The events of a run with greater ids, in order."""
    values = {"run_id": run_id, "after_id": after_id, "limit": limit}
    return [Event(*row) for row in connection.execute(_AFTER, values).fetchall()]


def newest_event_id(connection: sqlite3.Connection) -> int:
    """A cursor: events noticed from now on have greater ids."""
    return int(connection.execute(_NEWEST_ID).fetchone()[0])
