"""The summaries of a run of another recording, whose rows are not all there to make them anew.

The other recording is attached as `source`. Its signals are found here by their names, or entered;
references to them are translated to the ids here.
"""

from __future__ import annotations

import sqlite3
from typing import Final

from webots_mcp.signal_kinds import unit_of, widen
from webots_mcp.store.chunks.taking_in import Ids
from webots_mcp.store.rollup.tables import ADD_COUNTS, IS_ID, fill, run_mark
from webots_mcp.store.signals.registry import Count, enter_signals

_TABLES: Final = ("rollup", "recent_rollup", "coarse_rollup", "change")
_COUNTS: Final = (
    "SELECT n.id, n.name, n.kind, s.kind, s.last_seen_wall_time_s, sum(u.row_count), "
    "sum(u.value_count), min(u.min), max(u.max) FROM (SELECT signal_id, row_count, value_count, "
    "min, max FROM main.chunk WHERE run_id = :run) u "
    "JOIN temp.signal_here m ON m.here = u.signal_id "
    "JOIN source.signal s ON s.id = m.there JOIN main.signal n ON n.id = m.here GROUP BY n.id"
)
_MARK: Final = "UPDATE main.run SET rolled_state_id = ?, coarse_end = ? WHERE id = ?"
_COARSE_END: Final = "SELECT coarse_end FROM source.run WHERE id = ?"


def take_in_summaries(
    connection: sqlite3.Connection, there: int, here: int, robot_id: int, ids: Ids
) -> None:
    """Take in rollups, change points and what the register knows of them.

    Args:
        connection: In a transaction; the other recording is attached, its chunks are here.
        there: The run's id in the other recording.
        here: Its id here; none of its state rows is here yet.
        robot_id: Its robot here.
        ids: What `take_in_chunks` gave.
    """
    for table in _TABLES:
        _copy(connection, table, there, here, ids.shift)
    fill(connection, "new_count", _counts(connection, here))
    connection.execute(ADD_COUNTS)
    enter_signals(connection, robot_id, ())
    mark = min(run_mark(connection, there, "source.") or 0, ids.last) + ids.shift
    (coarse_end,) = connection.execute(_COARSE_END, (there,)).fetchone()
    connection.execute(_MARK, (max(0, mark), coarse_end, here))


def _copy(connection: sqlite3.Connection, table: str, there: int, here: int, shift: int) -> None:
    listed = connection.execute("SELECT name FROM pragma_table_info(?)", (table,)).fetchall()
    columns = [f't."{name}"' for (name,) in listed]
    own = {'t."run_id"': "?", 't."signal_id"': "m.here", 't."state_id"': f"t.state_id + {shift}"}
    sound = f"AND {IS_ID.format('t.state_id')}" if table == "change" else ""
    connection.execute(
        f"INSERT INTO main.{table} SELECT {', '.join(own.get(name, name) for name in columns)} "
        f"FROM source.{table} t JOIN temp.signal_here m ON m.there = t.signal_id "
        f"WHERE t.run_id = ? {sound}",
        (here, there),
    )


def _counts(connection: sqlite3.Connection, here: int) -> list[Count]:
    """What the run adds to the register; how many values were replaced summaries do not tell."""
    counts: list[Count] = []
    for signal_id, name, kind, kind_there, seen_s, rows, present, least, most in connection.execute(
        _COUNTS, {"run": here}
    ):
        kind = widen(kind, kind_there)
        unit = unit_of(name, kind)
        counts.append(Count(signal_id, kind, unit, rows, rows - present, 0, seen_s, least, most))
    return counts
