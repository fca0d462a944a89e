"""The trends of a run as tables that fit a number of tokens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.answers.answer_models import (
    RunTrendTables,
)
from webots_mcp.answers.budget import figure, fitting, seconds, short_name, shown, some, table
from webots_mcp.answers.shortening import compact_json, cut_for_a_model, is_for_a_person, tokens_of

if TYPE_CHECKING:
    from webots_mcp.judging.trends import RunTrends, StateTrend, Trend

TREND_COLUMNS: Final = ("signal", "says", "last", "mean", "deviation")
STATE_COLUMNS: Final = ("signal", "changes", "last", "since_s", "time_by_value_s")
MOST_SIGNALS: Final = 500
EMPTY: Final = '""'  # a name without a character


@dataclass(frozen=True)
class TrendSizes:
    """How much of the trends of a run is shown.

    Attributes:
        states_share: Maximum share of the budget for texts and flags.
        text_characters: Characters of the description of a trend.
        values: Values of a text or flag with their time.
        constants: Signals that never changed.
    """

    states_share: float = 0.25
    text_characters: int = 200
    values: int = 6
    constants: int = 20


_SIZES: Final = TrendSizes()


def trend_tables(run: RunTrends, limit: int, budget_tokens: int) -> RunTrendTables:
    """Return the trends of a run as tables that fit the budget."""
    changed = [state for state in run.states if state.changes]
    states = fitting(
        [_state_row(state) for state in changed], int(budget_tokens * _SIZES.states_share)
    )
    moving = _moving(run)
    constant, without_value = some(_constants(run), _SIZES.constants), some(run.without_value)
    left_tokens = budget_tokens - tokens_of([states, constant, without_value])
    rows = fitting([_trend_row(trend) for trend in moving[:limit]], left_tokens)
    return RunTrendTables(
        run_id=run.run_id,
        start_s=seconds(run.start_s),
        end_s=seconds(run.end_s if run.cut_at_s is None else run.cut_at_s),
        row_count=run.rows,
        resolution_s=run.resolution_s,
        numbers=table(TREND_COLUMNS, rows),
        states=table(STATE_COLUMNS, states),
        constant=constant or None,
        without_value=without_value or None,
        not_shown=_not_shown(run, len(rows), len(states)),
        rows_missing_from_s=seconds(run.cut_at_s),
    )


def _moving(run: RunTrends) -> list[Trend]:
    """Return those that changed, or lost their value: no constant is dead."""
    return [trend for trend in run.numbers if not trend.is_constant or trend.is_lacking]


def _constants(run: RunTrends) -> list[str]:
    """Return what never changed, each with its value."""
    numbers = [
        f"{trend.name or EMPTY} {figure(trend.summary.last):g} {trend.unit or ''}".rstrip()
        for trend in run.numbers
        if trend.is_constant and not trend.is_lacking
    ]
    states = [
        f"{each.name or EMPTY} {compact_json(each.last)}" for each in run.states if not each.changes
    ]
    return numbers + states


def _trend_row(trend: Trend) -> list[Any]:
    """Return a number as a row under `TREND_COLUMNS`; its text names extremes with times."""
    return [
        short_name(trend.name),
        cut_for_a_model(trend.says, _SIZES.text_characters),
        figure(trend.summary.last),
        figure(trend.mean),
        figure(trend.deviation),
    ]


def _state_row(state: StateTrend) -> list[Any]:
    """Return a text or a flag as a row under `STATE_COLUMNS`."""
    longest_first = [*state.time_by_value_s.items()]
    most = len(longest_first) if is_for_a_person() else _SIZES.values
    times = {shown(value): round(duration_s, 3) for value, duration_s in longest_first[:most]}
    if rest := longest_first[most:]:
        times[f"… {len(rest)} more values"] = round(sum(duration_s for _, duration_s in rest), 3)
    return [
        short_name(state.name),
        state.changes,
        shown(state.last),
        seconds(state.since_s),
        times,
    ]


def _not_shown(run: RunTrends, numbers: int, states: int) -> str | None:
    """Return how many of the signals that changed are not shown."""
    all_states = sum(bool(state.changes) for state in run.states)
    counts = (("numbers", numbers, _changed(run)), ("texts and flags", states, all_states))
    others = [
        f"{all_of - given} of {all_of} {what}" for what, given, all_of in counts if given < all_of
    ]
    return ", ".join(others) or None


def _changed(run: RunTrends) -> int:
    """Return how many numbers changed, also beyond those that were read."""
    return run.total - (len(run.numbers) - len(_moving(run)))
