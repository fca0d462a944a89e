"""The tool that says what each signal did."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from webots_mcp.server.bounds import range_in
from webots_mcp.server.budget import (
    BUDGET,
    LARGE_BUDGET,
    answer_about,
    figure,
    fitting,
    notes_of,
    seconds,
    short_name,
    shown,
    some,
    without_empty,
)
from webots_mcp.server.declaring import READS, tool
from webots_mcp.server.history_results import RunTrendTables, TrendsAnswer
from webots_mcp.server.parameters import (
    AnyNames,
    ShownLimit,
)
from webots_mcp.server.shortening import cut_text
from webots_mcp.store.questions.trend import Trend
from webots_mcp.store.questions.trends import RunTrends, StateTrend, trends
from webots_mcp.store.reading.ranges import Scope, TimeRange
from webots_mcp.store.recording import Recording, View

TREND_COLUMNS: Final = (
    "signal", "says", "shape", "first", "last", "min", "min_at_s", "max", "max_at_s", "mean",
    "deviation", "slope_per_s", "r2", "crossings", "spikes", "missing_share",
)  # fmt: skip
STATE_COLUMNS: Final = ("signal", "changes", "last", "since_s", "time_by_value_s")
DEFAULT_LIMIT: Final = 20
MOST_SIGNALS: Final = 500
_STATES_SHARE: Final = 0.25  # of the budget
_LONGEST_SAYING: Final = 200
_SHOWN_VALUES: Final = 6


@tool("Get the trends", READS)
def webots_get_trends(
    recording: Recording,
    scope: Scope,
    signals: AnyNames = None,
    limit: ShownLimit = None,
) -> TrendsAnswer:
    """What each signal did over a stretch of time, by default the whole run, in one line each.

    What changed most comes first: rises, falls, swings (period, amplitude), rests since when,
    spikes, missing values; of modes and flags the changes and the time in each value.
    """
    with recording.view(scope.robot, scope.run_id) as view:
        return answer_about(
            view,
            TrendsAnswer,
            lambda: _found(view, range_in(view, scope), signals or ["*"], limit),
        )


def _found(view: View, asked: TimeRange, names: Sequence[str], limit: int | None) -> dict[str, Any]:
    found = trends(view.connection, asked, names, limit=MOST_SIGNALS)
    budget = (BUDGET if limit is None else LARGE_BUDGET) // max(len(found.runs), 1)
    runs = [trend_tables(run, limit or DEFAULT_LIMIT, budget) for run in found.runs if run.rows]
    return {
        "runs": runs or None,
        "notes": notes_of(found.notes),
        "hint": _hint(runs) if runs else "no row in that range: leave the range out, or see notes",
    }


def trend_tables(run: RunTrends, limit: int, budget: int) -> RunTrendTables:
    """The trends of a run as tables that fit the budget, in characters."""
    states = fitting([state_row(state) for state in run.states], int(budget * _STATES_SHARE))
    moving = [trend for trend in run.numbers if trend.shape != "constant"]
    asked = moving or run.numbers
    rows = fitting([trend_row(trend) for trend in asked[:limit]], int(budget * (1 - _STATES_SHARE)))
    return RunTrendTables(
        run_id=run.run_id,
        start_s=seconds(run.start_s),
        end_s=seconds(run.end_s),
        rows=run.rows,
        resolution_s=run.resolution_s,
        numbers=without_empty(TREND_COLUMNS, rows),
        total=run.total,
        constant=len(run.numbers) - len(moving) or None,
        states=without_empty(STATE_COLUMNS, states),
        states_total=len(run.states) if len(run.states) > len(states) else None,
        silent=some(run.silent) if run.silent else None,
        cut_at_s=seconds(run.cut_at_s),
    )


def trend_row(trend: Trend) -> list[Any]:
    """A number as a row under `TREND_COLUMNS`."""
    summary = trend.summary
    return [
        short_name(trend.name),
        cut_text(trend.says, _LONGEST_SAYING),
        trend.shape,
        figure(summary.first),
        figure(summary.last),
        figure(summary.min),
        seconds(summary.min_sim_time_s),
        figure(summary.max),
        seconds(summary.max_sim_time_s),
        figure(trend.mean),
        figure(trend.deviation),
        figure(trend.slope_per_s),
        figure(trend.r2),
        trend.crossings or None,
        len(trend.spikes or ()) or None,
        figure(trend.missing_share) or None,
    ]


def state_row(state: StateTrend) -> list[Any]:
    """A text or a flag as a row under `STATE_COLUMNS`."""
    times = [
        (shown(value), round(duration_s, 3)) for value, duration_s in state.time_by_value_s.items()
    ]
    return [
        short_name(state.name),
        state.changes,
        shown(state.last),
        seconds(state.since_s),
        dict(times[:_SHOWN_VALUES]),
    ]


def _hint(runs: Sequence[RunTrendTables]) -> str | None:
    hints = [
        f"run {run.run_id}: {told} of {run.total - (run.constant or 0)} signals that changed; "
        "signals=['...'] asks for others, limit for more"
        for run in runs
        if (told := len(run.numbers.rows) if run.numbers else 0) < run.total - (run.constant or 0)
    ]
    return "; ".join(hints) or None
