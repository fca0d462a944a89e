"""The tool that tells what happened in order, page by page."""

from __future__ import annotations

from typing import Any, Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.argument_types import (
    LogLevel,
    ShownLimit,
    TextCursor,
)
from webots_mcp.questions.bounds import range_in
from webots_mcp.questions.budget import answer_about, notes_of, room_tokens
from webots_mcp.questions.declaring import READS, question
from webots_mcp.questions.find_events import TimelineKinds, events_table, verdicts_of
from webots_mcp.questions.history_answers import TimelineAnswer
from webots_mcp.questions.shortening import tokens_of
from webots_mcp.store.detection.events import stored_kinds, timeline
from webots_mcp.store.detection.kinds import EventOptions
from webots_mcp.store.reading.ranges import Scope, TimeRange
from webots_mcp.store.recording import Recording, View

DEFAULT_LIMIT: Final = 50


@question("Get the timeline", READS)
def webots_get_timeline(
    recording: Recording,
    scope: Scope,
    kinds: TimelineKinds = None,
    log_level: LogLevel = "info",
    limit: ShownLimit = None,
    cursor: TextCursor = "",
) -> TimelineAnswer:
    """Changes, commands, log lines, pictures, gaps, begin and end of runs in one order, paged.

    A log of what was noted, from the start of the run on. To search for what went wrong, also what
    nobody noted: webots_find_events.
    """
    if "threshold" in (kinds or ()):
        raise InvalidInputError(
            "a threshold has no place here: ask webots_find_events(where='pose.x > 1')"
        )
    options = EventOptions(kinds=tuple(kinds or stored_kinds()), log_level=log_level)
    with recording.view(scope.robot, scope.run_id) as view:
        return answer_about(
            view,
            TimelineAnswer,
            lambda: _found(view, range_in(view, scope), options, limit, cursor),
        )


def _found(
    view: View, asked: TimeRange, options: EventOptions, limit: int | None, cursor: str
) -> dict[str, Any]:
    """A page; a shorter one where it would be too long."""
    budget_tokens = room_tokens(limit)
    entries = limit or DEFAULT_LIMIT
    while True:
        page = timeline(view.connection, asked, options, limit=entries, after=cursor or None)
        events = events_table(page.events, view)
        tokens = tokens_of(events.rows) if events else 0
        if tokens <= budget_tokens or entries == 1:
            break
        entries = max(1, int(entries * 0.95 * budget_tokens / tokens))
    return {
        "events": events,
        "verdicts": verdicts_of(page.verdicts),
        "cursor": page.cursor,
        "notes": notes_of(page.notes),
        "hint": "nothing after that cursor" if cursor and not events else None,
    }
