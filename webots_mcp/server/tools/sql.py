"""The tool that runs a SELECT."""

from __future__ import annotations

import math
from typing import Annotated, Final

from pydantic import Field

from webots_mcp.server.boundary import READS, tool
from webots_mcp.server.fitting import LONGEST_NAME, header_of_only
from webots_mcp.server.history_results import SqlAnswer
from webots_mcp.server.parameters import ShownLimit
from webots_mcp.server.results import Table
from webots_mcp.server.shortening import cut_text
from webots_mcp.store.history.sql import Cell, query_sql
from webots_mcp.store.recording import Recording

DEFAULT_ROWS: Final = 100
_BUDGET_BYTES: Final = 4_400  # of values: quotes and brackets come to it
_LARGE_BUDGET_BYTES: Final = 20_000
_MOST_COLUMNS: Final = 60


class SqlTools:
    """What the other tools do not cover."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    @tool("Query by SQL", READS)
    def webots_query_sql(
        self,
        sql: Annotated[str, Field(min_length=1, max_length=10_000, description="One SELECT.")],
        limit: ShownLimit = None,
    ) -> SqlAnswer:
        """Read by SQL (SQLite) what the other tools do not cover; nothing but reading is allowed.

        Tables: robot, session (a controller process), run(id, robot_id, session_id, rows, label,
        last_sim_time_s), state(run_id, sim_time_s, wall_time_s, data: JSON), signal(name, path),
        rollup(run_id, signal_id, bucket of 10 s, min, max, sum, present), change, log, event,
        command, image. Views: robot_now, robot_run, robot_trajectory, robot_period, robot_event,
        robot_log, robot_command. Ask by run_id and sim_time_s: they are indexed. Values of a state:
        json_extract(data, '$.pose[0]'). All columns: the resource webots://schema.
        """
        with self._recording.reader() as connection:
            budget = _BUDGET_BYTES if limit is None else _LARGE_BUDGET_BYTES
            found = query_sql(connection, sql, max_rows=limit or DEFAULT_ROWS, max_bytes=budget)
            columns = [cut_text(name, LONGEST_NAME) for name in found.columns[:_MOST_COLUMNS]]
            rows = [[_cell(cell) for cell in row[:_MOST_COLUMNS]] for row in found.rows]
            more = len(found.columns) > _MOST_COLUMNS
            return SqlAnswer(
                **header_of_only(connection),
                result=Table(columns=columns, rows=rows),
                truncated=found.truncated,
                shortened=found.shortened or None,
                hint=f"only the first {_MOST_COLUMNS} columns are shown" if more else _none(rows),
            )


def _cell(cell: Cell) -> Cell:
    """A value that JSON can hold."""
    return str(cell) if isinstance(cell, float) and not math.isfinite(cell) else cell


def _none(rows: list[list[Cell]]) -> str | None:
    return None if rows else "no row: webots_list_runs and webots_list_signals tell what there is"
