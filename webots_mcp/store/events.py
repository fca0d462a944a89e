"""Events: what the bridge noticed when it happened."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.store.rows import columns_of


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


_COLUMNS: Final = columns_of(Event)
_NEWEST: Final = (
    f"SELECT {_COLUMNS} FROM event WHERE run_id = ? ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)


def newest_events(connection: sqlite3.Connection, run_id: int, limit: int) -> list[Event]:
    """The latest events of a run, oldest first; with a limit of -1 all of them."""
    rows = connection.execute(_NEWEST, (run_id, limit)).fetchall()
    return [Event(*row) for row in reversed(rows)]
