"""Coarse rollups, merged from those of 10 s once these are over, in steps of about a millisecond.

Swings are looked for then as well, and stored with them.

The column `coarse_end` of a run shows up to where they are complete. It moves on here, and back
where a row comes late into what was merged already; then that is merged again.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, Final, NamedTuple

from webots_mcp.errors import warn
from webots_mcp.store.analysis.summary import Summary, merge
from webots_mcp.store.invalid_rows import MAX_SIM_TIME_S, is_over_a_value, valid_rows
from webots_mcp.store.rollup.buckets import COARSE_BUCKETS, COARSE_S, bucket_of
from webots_mcp.store.rollup.findings import FINDINGS, findings_to_store
from webots_mcp.store.rollup.tables import RUN_MARK, in_short_steps, run_mark
from webots_mcp.transactions import Step

_FIGURES: Final = ", ".join(Summary._fields)
_COLUMNS: Final = f"run_id, bucket, signal_id, {_FIGURES}, {', '.join(FINDINGS)}"
_COARSE_END: Final = "iif(typeof(coarse_end) = 'integer', coarse_end, NULL)"
_PENDING: Final = (
    f"SELECT id, robot_id, {_COARSE_END}, last_sim_time_s FROM run "
    f"WHERE typeof(last_sim_time_s) IN ('real', 'integer') AND last_sim_time_s < {MAX_SIM_TIME_S} "
    f"AND last_sim_time_s >= (coalesce({_COARSE_END}, 0) + 1) * {COARSE_S}"
)
_FIRST_RECENT: Final = "SELECT min(bucket) FROM recent_rollup WHERE run_id = ?"
_FIRST: Final = (  # signal by signal, each by the primary key
    "SELECT min(bucket) FROM (SELECT (SELECT min(bucket) FROM rollup WHERE run_id = :run "
    "AND signal_id = s.id AND bucket >= :first) AS bucket FROM signal s WHERE robot_id = :robot)"
)
_PARTS: Final = (
    f"SELECT s.id, {', '.join(f'u.{name}' for name in Summary._fields)} "
    "FROM signal s CROSS JOIN {table} u ON u.run_id = :run AND u.signal_id = s.id "
    "AND u.bucket >= :first AND u.bucket < :end WHERE s.robot_id = :robot ORDER BY s.id, u.bucket"
)
_TEMPORARY: Final = f"CREATE TEMP TABLE IF NOT EXISTS new_coarse ({_COLUMNS})"
_STORE: Final = Step(
    "store_coarse",
    ("run_id", "mark", "coarse_end", "new_end"),
    f"INSERT OR REPLACE INTO coarse_rollup ({_COLUMNS}) SELECT {_COLUMNS} FROM new_coarse",
    "UPDATE run SET coarse_end = NEW.new_end WHERE id = NEW.run_id",
    unless=f"({RUN_MARK.format('NEW.run_id')}) IS NOT NEW.mark "
    f"OR (SELECT {_COARSE_END} FROM run WHERE id = NEW.run_id) IS NOT NEW.coarse_end",
)
_LOWEST: Final = -(2**62)
_ANGLES: Final = Summary._fields.index("sines")  # the figures from there on only angles have


class _Run(NamedTuple):
    """A run that may have buckets to merge; `mark` is that of the rows in its rollups."""

    id: int
    robot_id: int
    coarse_end: int | None
    last_sim_time_s: float
    mark: int | None = None


def merge_coarse(connection: sqlite3.Connection, budget_rollups: int, pause_s: float) -> bool:
    """Merge rollups that are over; whether none is left to merge.

    Those of one coarse bucket are read and merged outside the write lock. They are stored only
    where no row has come into the run's rollups since.

    Args:
        connection: Of a maintainer (the role "writer"), in autocommit mode.
        budget_rollups: How many rollups of 10 s are read at most, give or take a coarse bucket;
            about 15 us each.
        pause_s: Between two steps, for others to write.

    Raises:
        sqlite3.Error: The database is locked or damaged; nothing of the step was stored.
    """
    left = budget_rollups
    for row in connection.execute(_PENDING).fetchall():
        run = _Run(*row)
        end = _end(connection, run)
        while run.coarse_end is None or run.coarse_end < end:
            if left <= 0:
                return False
            run = run._replace(mark=run_mark(connection, run.id))
            bucket = _first_to_merge(connection, run, end)
            merged = list(_merged(connection, run, bucket)) if bucket < end else []
            new_end = min(bucket + 1, end)
            if not _store(connection, run, merged, new_end, pause_s):
                return False
            left -= len(merged) * COARSE_BUCKETS
            run = run._replace(coarse_end=new_end)
    return True


def _end(connection: sqlite3.Connection, run: _Run) -> int:
    """The first coarse bucket that is not over."""
    end = bucket_of(run.last_sim_time_s, COARSE_S)
    recent = connection.execute(_FIRST_RECENT, (run.id,)).fetchone()[0]
    return end if recent is None else min(end, recent // COARSE_BUCKETS)


def _first_to_merge(connection: sqlite3.Connection, run: _Run, end: int) -> int:
    """The coarse bucket of the first rollup that is not merged; `end` where there is none."""
    first = _LOWEST if run.coarse_end is None else run.coarse_end * COARSE_BUCKETS
    values = {"run": run.id, "robot": run.robot_id, "first": first}
    found = connection.execute(_FIRST, values).fetchone()[0]
    return end if found is None else min(end, found // COARSE_BUCKETS)


def _merged(connection: sqlite3.Connection, run: _Run, bucket: int) -> Iterator[tuple[Any, ...]]:
    """Rows of the table: what a coarse bucket comes to, signal by signal."""
    first = bucket * COARSE_BUCKETS
    findings: list[dict[int, str]] = [{} for _ in FINDINGS]
    values = {
        "run": run.id, "robot": run.robot_id, "first": first, "end": first + COARSE_BUCKETS
    }  # fmt: skip
    try:
        merged = _merged_parts(connection.execute(_PARTS.format(table="rollup"), values).fetchall())
        rows = {signal_id: summary.rows for signal_id, summary in merged}
        findings = findings_to_store(connection, run.id, run.robot_id, bucket, rows)
    except Exception as error:
        if not is_over_a_value(error):
            raise
        with valid_rows(connection) as invalid:
            parts = connection.execute(_PARTS.format(table="valid_rollup"), values).fetchall()
            merged = _merged_parts([row for row in parts if _is_whole(Summary._make(row[1:]))])
        warn(f"left out of the coarse rollups: {'; '.join(invalid.described())}")
    for signal_id, summary in merged:
        found = (each.get(signal_id) for each in findings)
        yield (run.id, bucket, signal_id, *summary, *found)


def _merged_parts(rows: Sequence[Any]) -> list[tuple[int, Summary]]:
    return [
        (signal_id, merge([Summary._make(row[1:]) for row in parts]))
        for signal_id, parts in groupby(rows, lambda row: row[0])
    ]


def _is_whole(summary: Summary) -> bool:
    """Whether it has all figures of numbers, or none: of an invalid value it lacks one."""
    return summary.sum is None or (summary.present > 0 and None not in summary[:_ANGLES])


def _store(
    connection: sqlite3.Connection,
    run: _Run,
    merged: Sequence[tuple[Any, ...]],
    new_end: int,
    pause_s: float,
) -> bool:
    """Store a coarse bucket, some signals at a time; only the last of these steps moves the end."""
    connection.execute(_TEMPORARY)
    marks = ", ".join("?" * len(_COLUMNS.split(",")))
    left = len(merged)

    def store(rows: Sequence[tuple[Any, ...]]) -> bool:
        nonlocal left
        left -= len(rows)
        connection.execute("DELETE FROM temp.new_coarse")
        connection.executemany(f"INSERT INTO temp.new_coarse VALUES ({marks})", rows)
        end = new_end if left == 0 else run.coarse_end
        return _STORE.run(connection, run.id, run.mark, run.coarse_end, end)

    return in_short_steps(merged, store, pause_s) if merged else store(())
