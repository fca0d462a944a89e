"""Stretches of simulation time that are summed up: buckets of 10 s, and coarse ones of 500 s.

A coarse bucket holds exactly what the buckets of 10 s in it come to, so that a whole recording is
read fast. The column `coarse_end` of a run shows which coarse buckets exist.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.summary import COUNTS, Summary

BUCKET_S: Final = 10.0
COARSE_BUCKETS: Final = 50  # of 10 s in a coarse one: a round length, as those of answers are
COARSE_S: Final = COARSE_BUCKETS * BUCKET_S

_COARSE_END: Final = "SELECT coarse_end FROM run WHERE id = ?"
_OF_NUMBERS: Final = Summary._fields[COUNTS : Summary._fields.index("sines")]
# A sum without values, or without its extremes, is no summary: another program wrote there.
_BUCKETS: Final = (
    f"SELECT bucket, {', '.join(Summary._fields)} FROM {{table}} "
    "WHERE run_id = ? AND signal_id = ? AND bucket >= ? AND bucket < ? "
    f"AND (sum IS NULL OR present > 0 AND {' + '.join(_OF_NUMBERS)} IS NOT NULL) ORDER BY bucket"
)
_STORED: Final = (
    "SELECT {name} FROM coarse_rollup WHERE run_id = ? AND signal_id = ? "
    "AND bucket >= ? AND bucket < ? AND present > 0 ORDER BY bucket"
)
EVER: Final = range(-(2**62), 2**62)  # every bucket
# Of a few buckets of each signal, which the primary key finds signal by signal.
_TOTALS: Final = (
    "SELECT s.id AS signal_id, {figures} FROM run r CROSS JOIN signal s ON s.robot_id = r.robot_id "
    "CROSS JOIN {table} u ON u.run_id = r.id AND u.signal_id = s.id "
    "AND u.bucket >= {span.start} AND u.bucket < {span.stop} WHERE r.id = :run GROUP BY s.id"
)
_RECENT_TOTALS: Final = (
    "SELECT signal_id, {figures} FROM recent_rollup u WHERE run_id = :run "
    "AND bucket >= {span.start} AND bucket < {span.stop} GROUP BY signal_id"
)


class Grain(NamedTuple):
    """A length of buckets, and where the rollups of that length stand."""

    table: str
    bucket_s: float


FINE: Final = Grain("all_rollup", BUCKET_S)
COARSE: Final = Grain("coarse_rollup", COARSE_S)


def bucket_of(sim_time_s: float, bucket_s: float = BUCKET_S) -> int:
    """The number of the bucket that holds that time."""
    return int(sim_time_s // bucket_s)  # exact, which floor of a rounded quotient is not


def buckets(
    connection: sqlite3.Connection, run_id: int, signal_id: int, span: range, grain: Grain = FINE
) -> Iterator[tuple[int, Summary]]:
    """The rollups of a signal in a span of buckets, in order; empty ones are left out."""
    query = _BUCKETS.format(table=grain.table)
    rows = connection.execute(query, (run_id, signal_id, span.start, span.stop))
    return ((row[0], Summary._make(row[1:])) for row in rows)


def bucket_table(
    connection: sqlite3.Connection, run_id: int, signal_id: int, span: range, grain: Grain
) -> Array:
    """The same as rows of one array: the bucket, and the fields of its summary, NaN for None."""
    query = _BUCKETS.format(table=grain.table)
    rows = connection.execute(query, (run_id, signal_id, span.start, span.stop)).fetchall()
    return np.reshape(np.array(rows, np.float64), (len(rows), 1 + len(Summary._fields)))


def by_grain(connection: sqlite3.Connection, run_id: int, span: range) -> list[tuple[Grain, range]]:
    """A span of buckets of 10 s in as few rollups as there are: coarse ones between two borders."""
    first = -(-span.start // COARSE_BUCKETS)
    end = min(span.stop // COARSE_BUCKETS, _coarse_end(connection, run_id))
    if first >= end:
        return [(FINE, span)]
    borders = (first * COARSE_BUCKETS, end * COARSE_BUCKETS)
    parts = (
        (FINE, range(span.start, borders[0])),
        (COARSE, range(first, end)),
        (FINE, range(borders[1], span.stop)),
    )
    return [(grain, part) for grain, part in parts if part]


def stored_texts(
    connection: sqlite3.Connection, run_id: int, span: range, signal_id: int | None, name: str
) -> tuple[range, list[str | None]]:
    """What was found of a signal in the coarse buckets of a span of buckets of 10 s, in order.

    Args:
        connection: Any.
        run_id: Of which run.
        span: What is asked for.
        signal_id: Which signal.
        name: The column: swings.

    Returns:
        Which coarse buckets are there, and the texts of those with a value of the signal; None
        where it was not looked for.
    """
    parts = by_grain(connection, run_id, span)
    coarse = next((part for grain, part in parts if grain is COARSE), range(0))
    asked = (run_id, signal_id, coarse.start, coarse.stop)
    rows = connection.execute(_STORED.format(name=name), asked)
    return coarse, [text for (text,) in rows]


def totals(
    connection: sqlite3.Connection, run_id: int, span: range, figures: dict[str, str]
) -> dict[int, tuple[Any, ...]]:
    """What the rollups of each signal come to in a span of buckets of 10 s, by signal id.

    Args:
        connection: Any.
        run_id: Of which run.
        span: `EVER`, or some buckets.
        figures: Columns, and how each is put together: by sum, min or max.
    """
    inner = ", ".join(f"{how}(u.{name}) AS {name}" for name, how in figures.items())
    outer = ", ".join(f"{how}({name})" for name, how in figures.items())
    parts = [_RECENT_TOTALS.format(figures=inner, span=span)]
    for grain, part in by_grain(connection, run_id, span):
        table = "rollup" if grain is FINE else grain.table
        parts.append(_TOTALS.format(figures=inner, table=table, span=part))
    query = f"SELECT signal_id, {outer} FROM ({' UNION ALL '.join(parts)}) GROUP BY signal_id"
    return {row[0]: tuple(row[1:]) for row in connection.execute(query, {"run": run_id})}


def _coarse_end(connection: sqlite3.Connection, run_id: int) -> int:
    row = connection.execute(_COARSE_END, (run_id,)).fetchone()
    return row[0] if row and isinstance(row[0], int) else -(2**62)
