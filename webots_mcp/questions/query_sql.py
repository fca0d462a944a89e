"""The tool that runs a SELECT."""

from __future__ import annotations

import re
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Any, Final

import anyio
from anyio import to_thread
from anyio.lowlevel import RunVar
from pydantic import Field

from webots_mcp.answers.answer_models import AnswerTable, SqlAnswer
from webots_mcp.answers.budget import LONGEST_NAME, fitting, header_of_only, row_budget_tokens
from webots_mcp.answers.shortening import cut_for_a_model, is_for_a_person, tokens_of
from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.arguments import ShownLimit
from webots_mcp.questions.declaration import READS, question
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.sql import (
    FOLDER,
    LINE,
    Cell,
    SqlResult,
    Statement,
    as_file,
    decode,
    require_select,
)

_turns: Final[RunVar[anyio.Semaphore]] = RunVar("statements that may run at once")


@dataclass(frozen=True)
class QuerySizes:
    """How much of a result is read and shown, and how long a statement may take.

    Attributes:
        rows: Rows, unless a limit is given.
        values_bytes: Size of the values that are read, of which as much is shown as fits.
        large_values_bytes: The same where a limit is given.
        person_values_bytes: The same for a person.
        columns: Columns.
        at_once: Statements that run at once: they take memory and a processor each.
        wait_s: Wall time of waiting for other statements.
        process_s: Wall time of the process; its own deadline counts from when it has started.
    """

    rows: int = 100
    values_bytes: int = 5_000
    large_values_bytes: int = 20_000
    person_values_bytes: int = 10_000_000
    columns: int = 60
    at_once: int = 2
    wait_s: float = 30.0
    process_s: float = 20.0


_SIZES: Final = QuerySizes()


@question(
    "Query by SQL",
    READS,
    command="sql",
    positional=("sql",),
    options={"sql": "STATEMENT"},
    example='"SELECT sim_time_s, data FROM state ORDER BY id DESC LIMIT 5"',
    quotes=True,
    tier="all",
)
async def webots_query_sql(
    recording: RecordingAccess,
    sql: Annotated[
        str, Field(min_length=1, max_length=10_000, description="One SELECT statement of SQLite.")
    ],
    limit: ShownLimit = None,
) -> SqlAnswer:
    """Read the database with one SELECT statement (SQLite), for what other tools cannot answer.

    Tables: robot, session, run(id, robot_id, session_id, row_count, label, last_sim_time_s),
    state(run_id, sim_time_s, wall_time_s, data: JSON), signal(name, path), log, event, command,
    image. Views: robot_now, robot_run, robot_trajectory, robot_statistics(run_id, signal,
    start_s, end_s, min, max, mean of 1,024 rows), robot_period, robot_event, robot_log,
    robot_command. Indexed by run_id and sim_time_s. Values: json_extract(data, '$.pose[0]'). All
    columns: the resource webots://schema.
    """
    max_bytes = _SIZES.values_bytes if limit is None else _SIZES.large_values_bytes
    most_columns = _SIZES.columns
    if is_for_a_person():
        max_bytes, most_columns = _SIZES.person_values_bytes, sys.maxsize
    require_select(sql)
    header, deleted = await to_thread.run_sync(_header, recording)
    found = await _run(recording, sql, limit or _SIZES.rows, max_bytes)
    columns = [cut_for_a_model(name, LONGEST_NAME) for name in found.columns[:most_columns]]
    rows = [list(row[:most_columns]) for row in found.rows]
    budget_tokens = row_budget_tokens(limit, columns)
    rows = fitting(rows, budget_tokens)
    longest = None
    if len(rows) == 1 and tokens_of(rows) > budget_tokens:
        longest = budget_tokens // len(columns)  # a character has at most a token
        rows = [[_cut(each, longest) for each in rows[0]]]
    more = len(found.columns) > most_columns
    wide = f"only the first {_SIZES.columns} columns are shown" if more else None
    less = (
        (
            f"retention has deleted {deleted} states (run.purged_rows), which no table or view of "
            "states has: robot_statistics, webots_query_history and webots_get_trends have what "
            "chunks hold of them"
        )
        if deleted
        and re.search(r"\b(state|all_state|robot_now|robot_trajectory)\b", sql, re.IGNORECASE)
        else None
    )
    return SqlAnswer(
        **header,
        result=AnswerTable(columns=columns, rows=rows),
        truncated=_truncated(found, len(rows), longest),
        hint="; ".join(filter(None, (less, wide or _none(rows)))) or None,
    )


def _header(recording: RecordingAccess) -> tuple[dict[str, Any], int]:
    """And how many states retention has deleted."""
    with recording.reader() as connection:
        (deleted,) = connection.execute(
            "SELECT coalesce(sum(max(0, purged_rows)), 0) FROM run"
        ).fetchone()
        return header_of_only(connection), deleted


async def _run(recording: RecordingAccess, sql: str, max_rows: int, max_bytes: int) -> SqlResult:
    """Run it in a process of its own, which ends with its deadline or with the asker."""
    async with _turn():
        with as_file(recording.database) as file:
            asked = Statement(str(file), sql, max_rows, max_bytes, QUESTION_DEADLINE_S)
            with anyio.move_on_after(_SIZES.process_s):
                ended = await anyio.run_process(
                    LINE, input=asked.encoded(), check=False, stderr=None, cwd=FOLDER
                )
                return decode(ended.stdout, ended.returncode, asked)
    raise InvalidInputError(
        f"No process answered within {_SIZES.process_s:g} s, because this machine "
        "is overloaded. Try again later."
    )


@asynccontextmanager
async def _turn() -> AsyncGenerator[None]:
    """Wait until few enough statements run; they take memory and a processor each."""
    turns = _turns.get(None)
    if turns is None:
        _turns.set(turns := anyio.Semaphore(_SIZES.at_once))
    with anyio.move_on_after(_SIZES.wait_s) as waiting:
        await turns.acquire()
    if waiting.cancelled_caught:
        raise InvalidInputError(
            f"Other statements were running for {_SIZES.wait_s:g} s. Send one at a "
            "time, and try again."
        )
    try:
        yield
    finally:
        turns.release()


def _cut(cell: Cell, longest: int) -> Cell:
    return f"{cell[:longest]}…" if isinstance(cell, str) and len(cell) > longest else cell


def _truncated(found: SqlResult, shown: int, longest: int | None) -> str | None:
    why = found.truncated
    if shown < len(found.rows):
        why = f"only {shown} rows: their values are too long; name fewer columns"
    cut = f"{found.shortened} long values are cut" if found.shortened else None
    if longest is not None:
        cut = f"texts over {longest} characters are cut: name fewer columns"
    return "; ".join(filter(None, (why, cut))) or None


def _none(rows: list[list[Cell]]) -> str | None:
    return None if rows else "no row: webots_list_runs and webots_get_trends tell what there is"
