"""What went wrong, and what was noted, in order."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Any, Final

from pydantic import AfterValidator, Field

from webots_mcp.answers.answer_models import EventsAnswer, TimelineAnswer
from webots_mcp.answers.budget import answer_about, notes_of, range_in, row_budget_tokens, seconds
from webots_mcp.answers.event_tables import events_table, fitting_events, not_shown_of, verdicts_of
from webots_mcp.answers.shortening import tokens_of
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection.event_kinds import KINDS, kind_names, stored_kinds
from webots_mcp.judging.detection.event_options import EventOptions, both_of
from webots_mcp.judging.detection.events import search_events, timeline
from webots_mcp.questions.arguments import (
    AnyNames,
    LogLevel,
    Mode,
    Position,
    ShownLimit,
    TextCursor,
    TimeOfDay,
)
from webots_mcp.questions.declaration import READS, question
from webots_mcp.store.reading.ranges import (
    USE_EVERY_ROW,
    Scope,
    TimeRange,
    recorded_bounds,
)
from webots_mcp.store.recording import RecordingAccess, RobotView

DEFAULT_LIMIT: Final = 50
_ROWS_TOKENS: Final = 1_050  # a long summary and all verdicts leave this within 1,500


def _as_kind(name: str) -> str:
    if name not in kind_names():
        raise ValueError(f"be one of {', '.join(map(repr, kind_names()))}")
    return name


Kind = Annotated[
    str,
    AfterValidator(_as_kind),
    Field(json_schema_extra={"enum": [*kind_names()]}),
]
Kinds = Annotated[
    list[Kind] | None,
    Field(
        description="Kinds of events. Default: all but image. "
        f"{'; '.join(f'{kind.name}: {kind.means}' for kind in KINDS if kind.means)}."
    ),
]
TimelineKinds = Annotated[
    list[Annotated[str, AfterValidator(_as_kind)]] | None,
    Field(description="Kinds, as of webots_find_events. Default: all that are recorded."),
]


@question(
    "Find events",
    READS,
    command="events",
    options={"group": "--one-by-one", "cursor": "--after", "missing_s": "--missing"},
    example="--where 'front_m < 0.1 for 0.5' --last 60",
    quotes=True,
    tier="core",
)
def webots_find_events(
    recording: RecordingAccess,
    scope: Scope,
    kinds: Kinds = None,
    where: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Also find when this condition held, such as front_m < 0.1 for 0.5 (at "
            "least 0.5 s). With kinds=['condition'] nothing else is searched.",
        ),
    ] = None,
    signals: AnyNames = None,
    stuck_s: Annotated[
        float, Field(gt=0, description="Seconds a robot must stand to count as standing still.")
    ] = EventOptions.stuck_s,
    stuck_m: Annotated[
        float, Field(gt=0, description="Metres it may move meanwhile.")
    ] = EventOptions.stuck_m,
    missing_s: Annotated[
        float, Field(gt=0, description="Seconds without a value that count as missing.")
    ] = EventOptions.missing_s,
    position: Position = None,
    mode: Mode = None,
    log_level: LogLevel = "warning",
    group: Annotated[bool, Field(description="Combine similar events into one row.")] = True,
    limit: ShownLimit = None,
    cursor: TextCursor = "",
    time_of_day: TimeOfDay = False,
) -> EventsAnswer:
    """Find what went wrong, since when and how often: stuck, falls, sensor faults and more.

    Searches the values of the whole run unless a time range is given. `verdicts` says of each
    kind whether it was found, not found, or not searched and why. For a verdict on the whole run
    use webots_check_run; for what was noted in order of time use webots_get_timeline.
    """
    if kinds and where is not None and "condition" not in kinds:
        raise InvalidInputError(
            f"where={where!r} is searched only as the kind 'condition', which kinds does not name. "
            f"Leave kinds out, or give kinds={json.dumps([*kinds, 'condition'])}"
        )
    options = EventOptions(
        kinds=tuple(kinds or (("condition",) if where is not None else ())),
        where=where,
        signals=tuple(signals or ("*",)),
        stuck_s=stuck_s,
        stuck_m=stuck_m,
        missing_s=missing_s,
        position=both_of(position),
        mode=mode,
        log_level=log_level,
    )
    with recording.view(scope.robot, scope.run_id) as view:
        return answer_about(
            view,
            EventsAnswer,
            lambda: _found(view, range_in(view, scope), options, group, limit, cursor, time_of_day),
        )


def _found(
    view: RobotView,
    asked: TimeRange,
    options: EventOptions,
    group: bool,
    limit: int | None,
    cursor: str,
    time_of_day: bool,
) -> dict[str, Any]:
    found = search_events(view.connection, asked, options, group=group, after=cursor or None)
    verdicts, notes = verdicts_of(found.verdicts), notes_of(_notes(found.notes, options))
    others = [verdicts.model_dump(exclude_none=True), notes]
    budget_tokens = row_budget_tokens(limit, others, _ROWS_TOKENS)
    reported, events = fitting_events(
        found, limit or DEFAULT_LIMIT, budget_tokens, view, time_of_day=time_of_day
    )
    hints = ["ask again with this cursor for what is not shown"] if reported.cursor else []
    if any(event.count > 1 for event in reported.events):
        hints.append(
            "group=false tells alike events one by one: name the kinds, or a shorter range"
        )
    if cursor and found.verdicts.found and not events:
        hints.append("nothing was left out before that cursor")
    return {
        "events": events,
        "verdicts": verdicts,
        "start_s": _begin_of(view, asked),
        "not_shown": not_shown_of(reported),
        "cursor": reported.cursor,
        "notes": notes,
        "hint": "; ".join(hints) or None,
    }


def _notes(notes: Sequence[str], options: EventOptions) -> list[str]:
    """Return the notes without those on the rate of rows, where no values were searched."""
    are_stored = bool(options.kinds) and {*options.kinds} <= {*stored_kinds()}
    return [each for each in notes if not (are_stored and each.endswith(USE_EVERY_ROW))]


def _begin_of(view: RobotView, asked: TimeRange) -> float | None:
    """Return where the range begins; None where its run does, or there are several runs."""
    if len(asked.segments) != 1:
        return None
    (segment,) = asked.segments
    bounds = recorded_bounds(view.connection, segment.run_id)
    return seconds(segment.start_s) if bounds and segment.start_s > bounds[0] else None


# -- what was noted, in order, page by page --


@question("Get the timeline", READS, quotes=True, tier="all")
def webots_get_timeline(
    recording: RecordingAccess,
    scope: Scope,
    kinds: TimelineKinds = None,
    log_level: LogLevel = "info",
    limit: ShownLimit = None,
    cursor: TextCursor = "",
    time_of_day: TimeOfDay = False,
) -> TimelineAnswer:
    """List in order of time what was noted: mode changes, commands, log lines, pictures.

    It does not search the values: for faults that nobody noted use webots_find_events.
    """
    options = EventOptions(kinds=tuple(kinds or stored_kinds()), log_level=log_level)
    with recording.view(scope.robot, scope.run_id) as view:
        return answer_about(
            view,
            TimelineAnswer,
            lambda: _timeline(view, range_in(view, scope), options, limit, cursor, time_of_day),
        )


def _timeline(
    view: RobotView,
    asked: TimeRange,
    options: EventOptions,
    limit: int | None,
    cursor: str,
    time_of_day: bool,
) -> dict[str, Any]:
    """Return a page; a shorter one where it would be too long."""
    budget_tokens = row_budget_tokens(limit)
    entries = limit or DEFAULT_LIMIT
    while True:
        page = timeline(view.connection, asked, options, limit=entries, after=cursor or None)
        events = events_table(page.events, view, time_of_day=time_of_day)
        tokens = tokens_of(events.rows) if events else 0
        if tokens <= budget_tokens or entries == 1:
            break
        entries = max(1, int(entries * 0.95 * budget_tokens / tokens))
    return {
        "events": events,
        "verdicts": verdicts_of(page.verdicts),
        "cursor": page.cursor,
        "notes": notes_of(_notes(page.notes, options)),
        "hint": "nothing after that cursor" if cursor and not events else None,
    }
