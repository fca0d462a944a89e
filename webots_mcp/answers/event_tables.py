"""Events and verdicts as tables that fit a number of tokens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from webots_mcp.answers.answer_models import AnswerTable, KindVerdicts
from webots_mcp.answers.budget import (
    DETAIL_BUDGET_TOKENS,
    detailed,
    seconds,
    short_name,
    shown,
    without_empty,
)
from webots_mcp.answers.shortening import tokens_of
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.events import Events, Found
from webots_mcp.judging.verdicts import Coverage, Verdicts
from webots_mcp.store.recording import RobotView
from webots_mcp.store.relative_times import wall_clock

EVENT_COLUMNS: Final = (
    "kind", "count", "run_id", "start_s", "wall_time", "duration_s", "ongoing", "name", "details",
)  # fmt: skip
_GROUP_BUDGET_TOKENS: Final = 200


def fitting_events(
    found: Found, limit: int, budget_tokens: int, view: RobotView, *, time_of_day: bool = False
) -> tuple[Events, AnswerTable | None]:
    """Return at most `limit` of what was found, and as much of it as fits the budget."""
    while True:
        reported = found.page(view.connection, limit)
        made = events_table(reported.events, view, time_of_day=time_of_day)
        tokens = tokens_of([made.rows if made else [], not_shown_of(reported), reported.cursor])
        if tokens <= budget_tokens or limit <= 1:
            return reported, made
        shown_now = len(reported.events)
        limit = max(1, min(shown_now - 1, int(shown_now * budget_tokens / tokens)))


def verdicts_of(verdicts: Verdicts, *, in_short: bool = False) -> KindVerdicts:
    """Return what became of each kind, as it is shown.

    Args:
        verdicts: What became of each kind that was asked for.
        in_short: The kinds that nothing is recorded for share one line without their reasons.
    """
    if in_short:
        reasons = {
            kind: ("no data is recorded for it",)
            if verdicts.why_unsearched(kind) and not each.reasons_for("unread")
            else said
            for kind, said in verdicts.reasons.items()
            for each in (verdicts.coverage.get(kind, Coverage()),)
        }
        verdicts = replace(verdicts, reasons=reasons)
    return KindVerdicts.with_parts(
        verdicts.none_in_part,
        found=verdicts.found or None,
        not_found=", ".join(verdicts.far) or None,
        nearest=verdicts.nearest or None,
        not_searched=verdicts.gaps or None,
    )


def not_shown_of(reported: Events) -> dict[str, str] | None:
    """Return how many of each kind are not shown, and from when to when they are.

    Of log lines the newest are shown, so an error that many warnings follow is named here.
    """
    return {
        kind: f"{each.count} {each.span}"
        + f", errors among them: {each.errors}" * bool(each.errors)
        for kind, each in reported.left_out.items()
    } or None


def events_table(
    events: Sequence[Event], view: RobotView, *, time_of_day: bool = False
) -> AnswerTable | None:
    """Events as rows under `EVENT_COLUMNS`, and the values around them.

    With the time of day, where it is asked for, at which each began.
    """
    around = list(dict.fromkeys(name for event in events for name in event.around))
    here = view.run.id if view.run else None
    elsewhere = any(event.run_id != here for event in events)
    rows = [
        [
            event.kind,
            None if event.count == 1 else event.count,
            event.run_id if elsewhere else None,
            seconds(event.start_s),
            wall_clock(event.wall_time_s) if time_of_day else None,
            (event.count == 1 and seconds(event.duration_s)) or None,
            event.ongoing or None,
            short_name(event.name),
            _details_of(event) or None,
            *(shown(event.around.get(name)) for name in around),
        ]
        for event in events
    ]
    columns = [*EVENT_COLUMNS, *(f"@{short_name(name)}" for name in around)]
    return without_empty(columns, rows)


def _details_of(event: Event) -> Any:
    """Return what stands for many events may be longer: it stands once."""
    budget_tokens = DETAIL_BUDGET_TOKENS if event.count == 1 else _GROUP_BUDGET_TOKENS
    return detailed(event.details, budget_tokens)
