"""`timeline`: what happened, in order, page by page."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.registry import stored_kinds
from webots_mcp.store.detection.verdict import Verdicts
from webots_mcp.store.questions.events import Place, read_place, search_events
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.snapshot import in_one_snapshot

MOST_ENTRIES: Final = 500


@dataclass(frozen=True)
class Timeline:
    """A page of the timeline.

    Attributes:
        cursor: Give it as `after` for the next page; None after the last event.
        verdicts: What became of each kind in the whole range.
    """

    robot: str
    events: tuple[Event, ...]
    cursor: str | None
    verdicts: Verdicts
    notes: tuple[str, ...]


@in_one_snapshot
def timeline(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    options: EventOptions | None = None,
    *,
    limit: int = 50,
    after: str | None = None,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Timeline:
    """Events, commands, log lines and pictures of a range in the order in which they happened.

    Args:
        connection: Any.
        time_range: From `find_range`.
        options: What counts as an event; None for what was stored when it happened (runs, gaps,
            changes, commands, logs from the level info on, notices, pictures).
        limit: 1 to 500.
        after: The `cursor` of the page before.
        deadline_s: After it, what was found so far is the answer, and the notes say so.

    Raises:
        InvalidInputError: `limit` is out of bounds, or `after` is no cursor.
    """
    if not 1 <= limit <= MOST_ENTRIES:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_ENTRIES}")
    options = options or EventOptions(kinds=stored_kinds(), log_level="info")
    found = search_events(
        connection, time_range, options, around=(), group=False, deadline_s=deadline_s
    )
    border = _read_cursor(after) if after else None
    left = [entry for entry in found.entries if border is None or entry[0] > border]
    page = left[:limit]
    return Timeline(
        robot=time_range.robot,
        events=tuple(event for _, event in page),
        cursor=json.dumps(page[-1][0]) if len(left) > limit else None,
        verdicts=found.verdicts,
        notes=found.notes,
    )


def _read_cursor(text: str) -> Place:
    try:
        return read_place(json.loads(text))
    except (ValueError, TypeError) as error:
        raise InvalidInputError(
            f"{text!r} is not a cursor: give the `cursor` of the previous page unchanged"
        ) from error
