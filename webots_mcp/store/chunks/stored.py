"""The chunks of a run as they are stored: which groups of rows there are, and what is in them."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.chunks.codec import DamagedChunkError, Decoded, Encoded, decode
from webots_mcp.store.chunks.statistics import Statistics

SIM_TIMES: Final = 0  # in the place of a signal's id
WALL_TIMES: Final = -1
STATE_IDS: Final = -2

_GROUPS: Final = (
    "SELECT id, start_sim_time_s, end_sim_time_s, last_state_id, max_state_id, row_count "
    "FROM row_group WHERE run_id = ? AND is_complete = 1 AND start_sim_time_s < ? "
    "AND end_sim_time_s >= ? ORDER BY start_sim_time_s, end_sim_time_s, id"
)
_IN_CHUNKS: Final = (
    "SELECT max(end_sim_time_s), max(max_state_id) FROM row_group WHERE run_id = :run "
    "AND is_complete = 1"
)
_LAST_AT: Final = (
    "SELECT max(last_state_id) FROM row_group WHERE run_id = ? AND is_complete = 1 "
    "AND end_sim_time_s = ?"
)
IS_MARK: Final = (  # no other program's value, beyond which no row would be looked at
    "typeof(state_id) = 'integer' AND state_id >= 0 AND state_id <= "
    "(SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = 'state')"
)
_WATERMARK: Final = f"SELECT state_id FROM watermark WHERE name = 'chunk' AND {IS_MARK}"
_OF_SIGNAL: Final = "FROM chunk WHERE run_id = ? AND signal_id = ? AND group_id BETWEEN ? AND ?"
_PLACES: Final = (
    "SELECT id, start_sim_time_s, end_sim_time_s, row_count, max_state_id FROM row_group "
    "WHERE run_id = ? AND is_complete = 1 AND start_sim_time_s < ? AND end_sim_time_s >= ? "
    "ORDER BY start_sim_time_s"
)
_STATISTICS: Final = f"SELECT group_id, {', '.join(Statistics._fields)} {_OF_SIGNAL}"
_LONG_STEPS: Final = f"SELECT group_id {_OF_SIGNAL} AND largest_step > ?"
_VALUES: Final = f"SELECT group_id, codec, numbers, codes, labels {_OF_SIGNAL}"
_FEW_VALUES: Final = f"{_VALUES} AND group_id IN (SELECT value FROM json_each(?))"
_FEW: Final = 0.25  # of the groups between two: they are asked for one by one
_SIGNALS_IN: Final = "SELECT DISTINCT signal_id FROM chunk WHERE run_id = ? AND signal_id > 0"


class Group(NamedTuple):
    """Rows that follow each other, of which each signal has a chunk. Columns of `row_group`."""

    id: int
    start_s: float
    end_s: float
    last_state_id: int
    max_state_id: int
    row_count: int


class Reached(NamedTuple):
    """Which rows of a run are in chunks: those up to a place, but for rows that came later.

    Attributes:
        end_s: Simulation time of the last of them; -inf before the first chunk.
        last_state_id: Its id; rows of one time are in the order of their ids.
        max_state_id: Rows up to that place with greater ids came late and are in none.
        max_in_groups: The greatest id of a row that is in a chunk.
    """

    end_s: float
    last_state_id: int
    max_state_id: int
    max_in_groups: int


def groups_in(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[Group]:
    """The groups of a run that reach into [start_s, end_s), in order of time."""
    rows = connection.execute(_GROUPS, (run_id, end_s, start_s)).fetchall()
    return list(map(Group._make, rows))


def groups_as_array(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> Array:
    """The same as columns: id, times of the first and last row in s, how many rows, greatest id."""
    rows = connection.execute(_PLACES, (run_id, end_s, start_s)).fetchall()
    table: Array = np.reshape(np.array(rows, np.float64), (-1, 5))
    return table[np.lexsort((table[:, 0], table[:, 2], table[:, 1]))]


def reached(connection: sqlite3.Connection, run_id: int) -> Reached:
    """Up to where a run is in chunks."""
    end_s, max_id = connection.execute(_IN_CHUNKS, {"run": run_id}).fetchone()
    if end_s is None:
        return Reached(float("-inf"), 0, 0, 0)
    (last_id,) = connection.execute(_LAST_AT, (run_id, end_s)).fetchone()
    return Reached(end_s, last_id, max(max_id, watermark(connection)), max_id)


def watermark(connection: sqlite3.Connection) -> int:
    """Rows with ids up to it have been looked at, of all runs: none of them comes late any more."""
    row = connection.execute(_WATERMARK).fetchone()
    return int(row[0]) if row else 0


def signals_in(connection: sqlite3.Connection, run_id: int) -> set[int]:
    """The ids of the signals that have chunks in a run."""
    return {signal_id for (signal_id,) in connection.execute(_SIGNALS_IN, (run_id,))}


def statistics_in(
    connection: sqlite3.Connection, run_id: int, signal_id: int, between: tuple[int, int]
) -> Array:
    """What a signal comes to in the groups between two ids: a row for each that has it.

    The first column is the id of the group, the others are the fields of `Statistics`.
    """
    rows = connection.execute(_STATISTICS, (run_id, signal_id, *between)).fetchall()
    return np.reshape(np.array(rows, np.float64), (-1, 1 + len(Statistics._fields)))


def groups_with_steps(
    connection: sqlite3.Connection, run_id: int, signal_id: int, between: tuple[int, int], by: float
) -> list[int]:
    """The groups between two ids in which a signal once changes by more than that."""
    asked = (run_id, signal_id, *between, by)
    return [group_id for (group_id,) in connection.execute(_LONG_STEPS, asked)]


def values_in(
    connection: sqlite3.Connection, run_id: int, signal_id: int, wanted: Mapping[int, int]
) -> Iterator[tuple[int, Decoded | DamagedChunkError]]:
    """The values of a signal in some groups, by their ids, in no order; none of those that lack it.

    Of a chunk that cannot be read comes the error that says why.

    Args:
        connection: Any.
        run_id: Of which run.
        signal_id: Of which signal; or times or ids.
        wanted: How many rows each group has, by its id.
    """
    query, asked = _VALUES, [run_id, signal_id, min(wanted, default=0), max(wanted, default=-1)]
    if len(wanted) < _FEW * (asked[3] - asked[2]):
        query, asked = _FEW_VALUES, [*asked, json.dumps([*wanted])]
    for group_id, *encoded in connection.execute(query, asked):
        rows = wanted.get(group_id)
        if rows is None:
            continue
        try:
            yield group_id, decode(Encoded(*encoded), rows)
        except DamagedChunkError as error:
            yield group_id, error
