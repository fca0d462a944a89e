"""How the tests ask for events."""

from __future__ import annotations

import sqlite3
from typing import Any

from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.store.reading.ranges import Scope, find_range


def ask(connection: sqlite3.Connection, kind: Any, *, bounds: Any = None, **options: Any) -> Events:
    given: dict[str, Any] = bounds or {"run_id": 1}
    found = find_range(connection, Scope(**given))
    return find_events(connection, found, EventOptions(kinds=(kind,), **options), limit=200)


def spans(events: Events) -> list[tuple[float, float]]:
    return [(round(event.start_s, 1), round(event.end_s, 1)) for event in events.events]
