"""The signals of a run: which there are, their values over time, and what each did in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.answers.answer_models import (
    AnswerPart,
    ChangeSeries,
    HistoryAnswer,
    NumberSeries,
    RowColumns,
    RunSeries,
    RunTrendTables,
    SignalsAnswer,
    TrendsAnswer,
)
from webots_mcp.answers.budget import (
    answer_about,
    figure,
    figures,
    fitting,
    notes_of,
    range_in,
    row_budget_tokens,
    seconds,
    short_name,
    shown,
    some,
    without_empty,
)
from webots_mcp.answers.shortening import tokens_of
from webots_mcp.answers.trend_tables import MOST_SIGNALS, trend_tables
from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.arguments import (
    AnyNames,
    Cursor,
    Limit,
    MaxPoints,
    Names,
    RobotName,
    RunId,
    ShownLimit,
)
from webots_mcp.questions.declaration import READS, question
from webots_mcp.store.reading.catalogue import SignalInfo, list_signals, signals_of
from webots_mcp.store.reading.ranges import Scope, TimeRange
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.signal_history import (
    DEFAULT_POINTS,
    ChangeColumns,
    NumberColumns,
    RunHistory,
    StatePage,
    query_history,
    query_rows,
)

SIGNAL_COLUMNS: Final = (
    "signal", "kind", "unit", "last", "min", "max", "missing", "meaning", "source",
)  # fmt: skip


@dataclass(frozen=True)
class HistorySizes:
    """How much of a history its answer shows.

    Attributes:
        gaps: Recording gaps.
        bucket_tokens: Budget of a bucket of a numeric signal: min, max, mean and last.
        signal_tokens: Budget of a signal without its buckets.
        trends: Signals with a trend, unless a limit is given.
    """

    gaps: int = 10
    bucket_tokens: int = 15
    signal_tokens: int = 60
    trends: int = 20


_SIZES: Final = HistorySizes()


@question(
    "List the signals",
    READS,
    quotes=True,
)
def webots_list_signals(
    recording: RecordingAccess,
    pattern: Annotated[
        str, Field(max_length=200, description="Only signals with this name; '*' means any text.")
    ] = "*",
    limit: Limit = 100,
    cursor: Cursor = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> SignalsAnswer:
    """List the signals of a run with last value, range and what each is taken to mean.

    Use it to find the names of signals. To see why a meaning is assumed, or to correct it, use
    webots_describe_signals. Arrays of more than 16 items are recorded as .count, .min, .max,
    .mean and .argmin.
    """
    with recording.view(robot, run_id) as view:
        return answer_about(view, SignalsAnswer, lambda: _found(view, pattern, limit, cursor or 0))


def _signal_row(info: SignalInfo, rows: int) -> list[Any]:
    """Return a signal of a run of that many rows, as a row under `SIGNAL_COLUMNS`."""
    return [
        short_name(info.name),
        info.kind,
        info.meaning.unit or info.unit,
        *(_value(info, each) for each in (shown(info.last), figure(info.min), figure(info.max))),
        _missing(info, rows),
        info.meaning.words,
        info.meaning.source,
    ]


def _value(info: SignalInfo, value: Any) -> Any:
    return bool(value) if info.kind == "bool" and value is not None else value


def _missing(info: SignalInfo, rows: int) -> str | None:
    """Return how many rows have no value of it, and when it had the first and the last."""
    if not info.missing:
        return None
    if info.first_s is None:
        return f"all {rows} rows without a value"
    span = f"first value at {seconds(info.first_s)} s, last at {seconds(info.last_s)} s"
    return f"{info.missing} of {rows} rows without a value; {span}"


def _found(view: RobotView, pattern: str, limit: int, start: int) -> dict[str, Any]:
    found = list_signals(
        view.connection,
        robot=view.robot.name,
        run_id=view.require_run().id,
        pattern=pattern,
        limit=start + limit,
    )
    rows = fitting([_signal_row(info, found.rows) for info in found.signals[start:]])
    end = start + len(rows)
    more = end < found.total
    return {
        "signals": without_empty(SIGNAL_COLUMNS, rows),
        "total": found.total,
        "cursor": end if more else None,
        "notes": notes_of(found.notes),
        "hint": _hint(start, end, found.total),
    }


def _hint(start: int, end: int, total: int) -> str | None:
    if total == 0:
        return "no state row with values was recorded in this run yet"
    if start >= total:
        return f"there are only {total}: leave cursor out"
    return (
        f"{end - start} of {total}: go on with cursor, or narrow pattern" if end < total else None
    )


# -- signals over time --


@question(
    "Query the history",
    READS,
    command="history",
    positional=("signals",),
    options={"signals": "SIGNAL", "max_points": "--points"},
    example="pose.x 'front*' --last 10",
    quotes=True,
)
def webots_query_history(
    recording: RecordingAccess,
    scope: Scope,
    signals: Names,
    max_points: MaxPoints = None,
    raw: Annotated[
        bool, Field(description="Return exact rows, in pages, instead of intervals.")
    ] = False,
    cursor: Cursor = None,
) -> HistoryAnswer:
    """Read the numbers of signals over time: minimum, maximum, mean and last value per interval.

    Covers the whole run unless a time range is given. Texts and flags are listed at the times at
    which they changed. For a description in words use webots_get_trends; for a picture use
    webots_plot.
    """
    if cursor is not None and not raw:
        raise InvalidInputError(
            "cursor continues only the rows of raw=true. Add raw=true, or leave cursor out."
        )
    with recording.view(scope.robot, scope.run_id) as view:

        def find() -> dict[str, Any]:
            asked = range_in(view, scope)
            if raw:
                return _page(view, asked, signals, max_points, cursor or 0)
            return _series(view, asked, signals, max_points)

        return answer_about(view, HistoryAnswer, find)


def _series(
    view: RobotView, asked: TimeRange, names: Sequence[str], max_points: int | None
) -> dict[str, Any]:
    """As many buckets as were asked for, or as fit; fewer where the answer would be too long."""
    budget_tokens = row_budget_tokens(max_points)
    points = min(max_points or DEFAULT_POINTS, _likely_points(view, asked, names, budget_tokens))
    while True:
        history = query_history(view.connection, asked, names, max_points=points)
        runs = [_run_series(run) for run in history.runs if run.rows or run.cut_at_s is not None]
        tokens = tokens_of([_as_dict(run) for run in runs])
        if tokens <= budget_tokens or points == 1:
            break
        points = max(1, int(points * 0.9 * budget_tokens / tokens))
    # Reported once for all runs: the names would take more space than the values.
    dropped = (_drop_signals(run, budget_tokens // len(runs)) for run in runs)
    left_out = [*dict.fromkeys(name for names in dropped for name in names)]
    where = f"run {runs[0].run_id}" if len(runs) == 1 else "one run or more"
    hints = [f"left out of {where}: {_others(left_out)}"] * bool(left_out)
    if max_points is not None and points < max_points:
        hints.append(f"{points} points instead of {max_points} fit: ask for fewer signals for more")
    hints += [] if runs else ["no row in that range: leave the range out, or see notes"]
    notes = notes_of(history.notes)
    return {"runs": runs or None, "notes": notes, "hint": "; ".join(hints) or None}


def _likely_points(
    view: RobotView, asked: TimeRange, names: Sequence[str], budget_tokens: int
) -> int:
    signals = signals_of(view.connection, asked, names)
    numbers = sum(signal.is_number for signal in signals)
    room = budget_tokens - _SIZES.signal_tokens * len(signals) * len(asked.segments)
    return max(1, room // (_SIZES.bucket_tokens * max(numbers, 1)))


def _as_dict(part: AnswerPart) -> dict[str, Any]:
    return part.model_dump(mode="json", exclude_none=True)


def _drop_signals(run: RunSeries, budget_tokens: int) -> list[str]:
    """Leave out the last signals where not even one point of each fits; their names."""
    over = tokens_of(_as_dict(run)) - budget_tokens
    left_out: list[str] = []
    for series in (run.states or {}, run.numbers or {}):
        for name in [*series][:0:-1]:
            if over <= 0:
                break
            over -= tokens_of({name: _as_dict(series.pop(name))})
            left_out.append(name)
    return left_out[::-1]


def _others(left_out: Sequence[str]) -> str:
    return f"{some(left_out)}; ask for them alone"


def _run_series(run: RunHistory) -> RunSeries:
    counts = _usual_counts(run.numbers)
    return RunSeries(
        run_id=run.run_id,
        start_s=seconds(run.start_s),
        end_s=seconds(run.end_s),
        step_s=run.step_s,
        sim_time_s=[seconds(time_s) for time_s in run.sim_time_s] if run.numbers else None,
        count=None if run.step_s is None else counts,
        numbers={
            str(short_name(columns.name)): _number_series(columns, counts, run)
            for columns in run.numbers
        }
        or None,
        states={str(short_name(columns.name)): _change_series(columns) for columns in run.changes}
        or None,
        row_count=run.rows,
        recording_gaps=[
            [seconds(gap.start_s), seconds(gap.end_s)] for gap in run.gaps[: _SIZES.gaps]
        ]
        or None,
        recording_gap_count=len(run.gaps) if len(run.gaps) > _SIZES.gaps else None,
        rows_missing_from_s=seconds(run.cut_at_s),
    )


def _usual_counts(numbers: Sequence[NumberColumns]) -> list[int] | None:
    """Return how many values the buckets of most signals have."""
    counts = Counter(tuple(columns.count) for columns in numbers)
    return list(counts.most_common(1)[0][0]) if counts else None


def _number_series(
    columns: NumberColumns, counts: list[int] | None, run: RunHistory
) -> NumberSeries:
    whole, replaced = columns.whole, columns.replaced or None
    if columns.too_large:
        return NumberSeries(replaced={**(replaced or {}), "beyond 1e100": columns.too_large})
    if not whole.present:
        was_read = run.cut_at_s is None and whole.rows > 0
        return NumberSeries(without_value=was_read or None, replaced=replaced)
    if run.step_s is None:
        return NumberSeries(unit=columns.unit, value=figures(columns.last), replaced=replaced)
    if whole.min == whole.max and columns.count == counts:
        return NumberSeries(unit=columns.unit, constant=figure(whole.min), replaced=replaced)
    return NumberSeries(
        unit=columns.unit,
        min=figures(columns.min),
        max=figures(columns.max),
        mean=figures(columns.mean),
        last=figures(columns.last),
        count=None if columns.count == counts else columns.count,
        whole={
            "min": figure(whole.min),
            "min_at_s": seconds(whole.min_sim_time_s),
            "max": figure(whole.max),
            "max_at_s": seconds(whole.max_sim_time_s),
            "mean": figure(whole.centre(columns.turn)),
        },
        replaced=replaced,
    )


def _change_series(columns: ChangeColumns) -> ChangeSeries:
    """Return a text or a flag as columns."""
    times_s = [seconds(point.sim_time_s) for point in columns.points]
    if columns.since_before and columns.total == len(times_s):
        times_s[:1] = [None]
    return ChangeSeries(
        since_s=times_s,
        value=[shown(point.value) for point in columns.points],
        total=columns.total if columns.total > len(columns.points) else None,
        time_by_value_s={
            shown(value): round(duration_s, 3)
            for value, duration_s in columns.time_by_value_s.items()
        },
    )


def _page(
    view: RobotView, asked: TimeRange, names: Sequence[str], limit: int | None, after_id: int
) -> dict[str, Any]:
    page = query_rows(
        view.connection, asked, names, limit=limit or DEFAULT_POINTS, after_id=after_id
    )
    budget_tokens = row_budget_tokens(limit)
    rows = _most(
        lambda rows: tokens_of(_as_dict(_row_columns(page, rows, view))), page, budget_tokens
    )
    cursor = page.ids[rows - 1] if 0 < rows < len(page.ids) else page.cursor
    shown = _row_columns(page, rows, view)
    left_out: list[str] = []
    if tokens_of(_as_dict(shown)) > budget_tokens:  # one row of many signals
        kept = dict(fitting([*shown.signals.items()], budget_tokens))
        left_out = [name for name in shown.signals if name not in kept]
        shown.signals = kept
    hints = [f"{rows} rows: go on with cursor" if cursor else _no_rows(page, rows, after_id)]
    hints += [f"left out: {_others(left_out)}"] * bool(left_out)
    return {
        "raw": shown,
        "cursor": cursor,
        "notes": notes_of(page.notes),
        "hint": "; ".join(filter(None, hints)) or None,
    }


def _no_rows(page: StatePage, rows: int, after_id: int) -> str | None:
    if rows:
        return None
    if page.cut:
        return "the time was over before any row was read: ask for a shorter range"
    return "no rows after that cursor" if after_id else "no row in that range"


def _most(tokens: Callable[[int], int], page: StatePage, budget_tokens: int) -> int:
    """Return how many of the page's first rows fit the budget; at least one."""
    rows = len(page.ids)
    while rows > 1 and (now := tokens(rows)) > budget_tokens:
        rows = max(1, min(rows - 1, int(rows * budget_tokens / now)))
    return rows


def _row_columns(page: StatePage, rows: int, view: RobotView) -> RowColumns:
    """Return the first rows; numbers as they were recorded."""
    run_ids = page.run_ids[:rows]
    here = view.run.id if view.run else None
    return RowColumns(
        run_id=None if set(run_ids) <= {here} else run_ids,
        sim_time_s=list(page.sim_time_s[:rows]),
        signals={
            str(short_name(name)): [
                shown(value) if isinstance(value, str) else value for value in values[:rows]
            ]
            for name, values in page.values.items()
        },
        replaced=page.replaced or None,
    )


# -- what each signal did, in words --


@question(
    "Get the trends",
    READS,
    command="trends",
    positional=("signals",),
    options={"signals": "SIGNAL"},
    quotes=True,
    tier="core",
)
def webots_get_trends(
    recording: RecordingAccess,
    scope: Scope,
    signals: AnyNames = None,
    limit: ShownLimit = None,
) -> TrendsAnswer:
    """Describe in words how each signal rises, falls, oscillates or stays constant, and since when.

    Signals that changed most come first; modes and flags are given with the time spent in each
    value. Covers the whole run unless a time range is given. For numbers over time use
    webots_query_history; for what went wrong use webots_find_events.
    """
    with recording.view(scope.robot, scope.run_id) as view:
        return answer_about(
            view,
            TrendsAnswer,
            lambda: _trends(view, range_in(view, scope), signals or ["*"], limit),
        )


def _trends(
    view: RobotView, asked: TimeRange, names: Sequence[str], limit: int | None
) -> dict[str, Any]:
    from webots_mcp.judging.trends import trends

    most = limit or _SIZES.trends
    found = trends(view.connection, asked, names, limit=MOST_SIGNALS, shown=most)
    budget_tokens = row_budget_tokens(limit) // max(len(found.runs), 1)
    recorded = [run for run in found.runs if run.rows or run.cut_at_s is not None]
    runs = [trend_tables(run, most, budget_tokens) for run in recorded]
    return {
        "runs": runs or None,
        "notes": notes_of(found.notes),
        "hint": _hint_of_trends(runs),
    }


def _hint_of_trends(runs: Sequence[RunTrendTables]) -> str | None:
    if not runs:
        return "no row in that range: leave the range out, or see notes"
    return (
        "signals=['...'] asks for others, limit for more"
        if any(run.not_shown for run in runs)
        else None
    )
