"""The summaries of a run of another recording, whose rows are not all there to make them anew.

The other recording is attached as `source`. Its signals are found here by their names, or entered;
references to them are translated to the ids here.
"""

from __future__ import annotations

import sqlite3
from typing import Final, NamedTuple, get_args

from webots_mcp.errors import InvalidInputError
from webots_mcp.signal_kinds import Kind, unit_of, widen
from webots_mcp.signal_register import MAX_SIGNALS
from webots_mcp.store.rollup.tables import ADD_COUNTS, IS_ID, fill, run_mark
from webots_mcp.store.signals.registry import Count, enter_signals

# Ids between the first and the last row of a run; other robots could not have recorded more.
_MOST_IDS: Final = 2**40
_IDS: Final = (
    "SELECT min(id), max(id) FROM (SELECT id FROM source.state WHERE run_id = :run UNION ALL "
    f"SELECT state_id FROM source.change WHERE run_id = :run AND {IS_ID.format('state_id')})"
)
_LAST_HERE: Final = "SELECT coalesce(max(seq), 0) FROM main.sqlite_sequence WHERE name = 'state'"
_RESERVE: Final = (
    "DELETE FROM main.sqlite_sequence WHERE name = 'state'",
    "INSERT INTO main.sqlite_sequence (name, seq) VALUES ('state', ?)",
)
_USED: Final = " OR ".join(
    f"EXISTS (SELECT 1 FROM source.{table} WHERE run_id = :run AND signal_id = s.id)"
    for table in ("rollup", "recent_rollup", "change")
)
_DESCRIBED: Final = (
    "name, kind, unit, path, reduce, role, first_seen_wall_time_s, last_seen_wall_time_s"
)
_ENTER: Final = (
    f"INSERT INTO main.signal (robot_id, {_DESCRIBED}) SELECT :here, {_DESCRIBED} "
    "FROM source.signal s WHERE robot_id = (SELECT robot_id FROM source.run WHERE id = :run) "
    f"AND kind IN {get_args(Kind)} AND ({_USED}) "
    "AND NOT EXISTS (SELECT 1 FROM main.signal WHERE robot_id = :here "
    "AND name = s.name) ORDER BY id "
    f"LIMIT max(0, {MAX_SIGNALS} - (SELECT count(*) FROM main.signal WHERE robot_id = :here))"
)
_MAP: Final = "CREATE TEMP TABLE IF NOT EXISTS signal_here (there INTEGER PRIMARY KEY, here)"
_FILL_MAP: Final = (
    "INSERT INTO temp.signal_here SELECT s.id, n.id FROM source.signal s JOIN main.signal n "
    "ON n.robot_id = :here AND n.name = s.name "
    "WHERE s.robot_id = (SELECT robot_id FROM source.run WHERE id = :run)"
)
_TABLES: Final = ("rollup", "recent_rollup", "coarse_rollup", "change")
_COUNTS: Final = (
    "SELECT n.id, n.name, n.kind, s.kind, s.last_seen_wall_time_s, sum(u.rows), sum(u.present), "
    "min(u.min), max(u.max) FROM (SELECT signal_id, rows, present, min, max FROM main.rollup "
    "WHERE run_id = :run UNION ALL SELECT signal_id, rows, present, min, max "
    "FROM main.recent_rollup WHERE run_id = :run) u "
    "JOIN temp.signal_here m ON m.here = u.signal_id "
    "JOIN source.signal s ON s.id = m.there JOIN main.signal n ON n.id = m.here GROUP BY n.id"
)
_MARK: Final = "UPDATE main.run SET rolled_state_id = ?, coarse_end = ? WHERE id = ?"
_COARSE_END: Final = "SELECT coarse_end FROM source.run WHERE id = ?"


class _Ids(NamedTuple):
    """The ids of the state rows of a run there, and by how much they rise."""

    last: int
    shift: int


def take_in_summaries(connection: sqlite3.Connection, there: int, here: int, robot_id: int) -> int:
    """Take in rollups, change points and what the register knows of them.

    Change points name state rows by ids, also those that are gone. So all ids of the run rise alike
    here, beyond those that were ever given: what came before what remains so.

    Args:
        connection: In a transaction; the other recording is attached.
        there: The run's id in the other recording.
        here: Its id here; none of its state rows is here yet.
        robot_id: Its robot here.

    Returns:
        By how much the ids of its state rows are to rise.

    Raises:
        InvalidInputError: Its ids are spread as no bridge gives them.
    """
    ids = _reserved_ids(connection, there)
    asked = {"run": there, "here": robot_id}
    connection.execute(_ENTER, asked)
    connection.execute(_MAP)
    connection.execute("DELETE FROM temp.signal_here")
    connection.execute(_FILL_MAP, asked)
    for table in _TABLES:
        _copy(connection, table, there, here, ids.shift)
    fill(connection, "new_count", _counts(connection, here))
    connection.execute(ADD_COUNTS)
    enter_signals(connection, robot_id, ())
    mark = min(run_mark(connection, there, "source.") or 0, ids.last) + ids.shift
    (coarse_end,) = connection.execute(_COARSE_END, (there,)).fetchone()
    connection.execute(_MARK, (max(0, mark), coarse_end, here))
    return ids.shift


def _reserved_ids(connection: sqlite3.Connection, there: int) -> _Ids:
    (last_here,) = connection.execute(_LAST_HERE).fetchone()
    first, last = connection.execute(_IDS, {"run": there}).fetchone()
    if first is None:
        return _Ids(last_here, 0)
    if last - first > _MOST_IDS:
        raise InvalidInputError(
            f"the ids of run {there}'s state rows reach from {first} to {last}, which no bridge "
            "gives: the recording is damaged"
        )
    shift = last_here + 1 - first
    delete, insert = _RESERVE
    connection.execute(delete)
    connection.execute(insert, (last + shift,))
    return _Ids(last, shift)


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
    """What the run adds to the register; how many of its values were odd summaries do not tell."""
    counts: list[Count] = []
    for signal_id, name, kind, kind_there, seen_s, rows, present, least, most in connection.execute(
        _COUNTS, {"run": here}
    ):
        kind = widen(kind, kind_there)
        unit = unit_of(name, kind)
        counts.append(Count(signal_id, kind, unit, rows, rows - present, 0, seen_s, least, most))
    return counts
