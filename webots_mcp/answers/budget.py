"""Answers that stay short: how many tokens each part may take, and as many rows as fit.

For a person at a terminal nothing is cut.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, TypeVar

from webots_mcp.answers.answer_models import Answer, AnswerTable
from webots_mcp.answers.shortening import (
    ShorteningLimits,
    compact_json,
    cut_for_a_model,
    cut_text,
    is_for_a_person,
    round_number,
    shorten,
    tokens_of,
)
from webots_mcp.errors import AmbiguousRobotError, NothingRecordedError
from webots_mcp.signals.naming import listed
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range, shown_time
from webots_mcp.store.recording import RecordingAccess, RobotView, storage, view_robot

RESULT_BUDGET_TOKENS: Final = 1_200
DETAIL_BUDGET_TOKENS: Final = 120
ANSWER_TOKENS: Final = 2_000
LARGE_ANSWER_TOKENS: Final = 10_000  # where it was said how much: clients warn of longer answers
BUDGET_TOKENS: Final = 1_100  # of rows; summary, header, notes and verdicts have the rest
_OTHERS_TOKENS: Final = ANSWER_TOKENS - BUDGET_TOKENS
_HEADER_TOKENS: Final = 220  # with a summary and a hint
_FOR_A_PERSON_TOKENS: Final = 10_000_000
LONGEST_NAME: Final = 80
_MOST_NOTES: Final = 5
MOST_RUNS: Final = 5  # that one answer describes


_AT_LENGTH: Final = (ShorteningLimits(items=2000, text=20_000, keys=1000, depth=20),)
_A = TypeVar("_A", bound=Answer)
_T = TypeVar("_T")


def answer_about(view: RobotView, model: type[_A], find: Callable[[], dict[str, Any]]) -> _A:
    """Return the header with what was found, or with the reason why nothing was recorded."""
    answer: dict[str, Any] = view.header() | view.position_by()
    try:
        answer |= find()
    except NothingRecordedError as error:
        answer["hint"] = str(error)
    return model(**answer)


def header_of(recording: RecordingAccess, robot: str | None) -> dict[str, Any]:
    """Return the header of a robot, now."""
    with recording.view(robot) as view:
        return view.header()


def header_of_only(connection: sqlite3.Connection) -> dict[str, Any]:
    """Return the header of the only robot that can be meant; empty where several can, or none."""
    try:
        return view_robot(connection, None).header()
    except (AmbiguousRobotError, NothingRecordedError):
        return {**storage(connection)}


def row_budget_tokens(
    asked: int | None = None, others: Any = None, usual_tokens: int = BUDGET_TOKENS
) -> int:
    """Return the token budget for rows; it is larger if a limit was given, or for a person.

    Args:
        asked: The most rows or points that were asked for.
        others: What the answer holds next to rows and header; if it is long, rows have less space.
        usual_tokens: The most, where it was not said how many rows.
    """
    if is_for_a_person():
        return _FOR_A_PERSON_TOKENS
    least_others = _HEADER_TOKENS + tokens_of(others)
    if asked is None:
        return min(usual_tokens, ANSWER_TOKENS - least_others)
    return LARGE_ANSWER_TOKENS - max(_OTHERS_TOKENS, least_others)


def detailed(value: Any, budget_tokens: int = DETAIL_BUDGET_TOKENS) -> Any:
    """Return a value of any kind, rounded, and for a model cut where it is long."""
    if is_for_a_person():
        return shorten(value, _FOR_A_PERSON_TOKENS, _AT_LENGTH).value
    return shorten(value, budget_tokens).value


def figure(value: float | None) -> float | None:
    """Return a number as it is shown; None where there is none, or none that JSON could hold.

    Adding zero makes -0.0 the 0.0 that it means.
    """
    return None if value is None or not math.isfinite(value) else round_number(value) + 0.0


def seconds(time_s: float | None) -> float | None:
    """Return a simulation time as it is shown: to the millisecond."""
    return None if time_s is None or not math.isfinite(time_s) else shown_time(time_s)


def figures(values: Sequence[float | None]) -> list[float | None]:
    """Return a column of numbers as they are shown."""
    return [figure(value) for value in values]


def shown(value: Any) -> Any:
    """Return a value of any kind, rounded, and for a model cut where it is long."""
    return detailed(value)


def short_name(name: str | None) -> str | None:
    """Return a name; an absurdly long one is cut."""
    return name and cut_for_a_model(name, LONGEST_NAME)


def fitting(items: Sequence[_T], budget_tokens: int | None = None) -> list[_T]:
    """Return the first items whose JSON fits the budget, at least one."""
    left = row_budget_tokens() if budget_tokens is None else budget_tokens
    kept: list[_T] = []
    for item in items:
        left -= tokens_of(item)
        if left < 0 and kept:
            break
        kept.append(item)
    return kept


def table(columns: Sequence[str], rows: Sequence[list[Any]]) -> AnswerTable | None:
    """Return a table, or None without rows."""
    return AnswerTable(columns=list(columns), rows=list(rows)) if rows else None


def without_empty(columns: Sequence[str], rows: Sequence[list[Any]]) -> AnswerTable | None:
    """Return a table without the columns that have no value in any row."""
    kept = [index for index in range(len(columns)) if any(row[index] is not None for row in rows)]
    return table([columns[index] for index in kept], [[row[i] for i in kept] for row in rows])


def condensed(columns: Sequence[str], rows: Sequence[list[Any]]) -> AnswerTable | None:
    """Return a table that says once what all its rows share; the first column names the row."""
    full = without_empty(columns, rows)
    if full is None or len(rows) < 2:
        return full
    values = [[row[index] for row in full.rows] for index in range(len(full.columns))]
    kept = [i for i, column in enumerate(values) if not i or len({*map(compact_json, column)}) > 1]
    shared = {name: values[i][0] for i, name in enumerate(full.columns) if i not in kept}
    reported = AnswerTable(
        columns=[full.columns[i] for i in kept], rows=[[row[i] for i in kept] for row in full.rows]
    )
    reported.in_every_row = shared or None
    return reported


def notes_of(notes: Sequence[str]) -> list[str] | None:
    """Return the notes of an answer, shortened for a model; None without any."""
    if is_for_a_person():
        return [*notes] or None
    left_out = len(notes) - _MOST_NOTES
    more = [f"and {left_out} more notes"] if left_out > 0 else []
    return [cut_text(note, 300) for note in notes[:_MOST_NOTES]] + more or None


def some(names: Sequence[str], most: int = 10) -> str:
    """Return the first names, and how many more there are; for a person all."""
    most = len(names) if is_for_a_person() else most
    return listed([cut_for_a_model(name, LONGEST_NAME) for name in names], most)


# -- the range of time that was asked about --


def range_in(view: RobotView, scope: Scope) -> TimeRange:
    """Return what a scope means for the robot of a view, in its newest few runs.

    Raises:
        InvalidRangeError: See `find_range`.
        NothingRecordedError: There is no row, or none in that wall time.
    """
    found = find_range(view.connection, scope, view.subject)
    if not found.segments:
        raise NothingRecordedError(
            f"{'; '.join(found.notes)}. webots_list_runs shows when each run was."
        )
    return newest_runs(found)


def newest_runs(found: TimeRange) -> TimeRange:
    """Return the range within its newest few runs; a note names earlier ones."""
    earlier = len(found.segments) - MOST_RUNS
    if earlier <= 0:
        return found
    runs = "1 earlier run" if earlier == 1 else f"{earlier} earlier runs"
    note = f"the range holds {runs} too (webots_list_runs): ask with run_id"
    return replace(found, segments=found.segments[-MOST_RUNS:], notes=(*found.notes, note))
