"""The chunks of a merged run: of one of another recording, whose rows are not all there any more.

The other recording is attached as `source`. Its signals are found here by their names, or entered.
Row groups name state rows by ids, also those that are gone: so all ids of the run rise alike here,
beyond those that were ever given, and what came before what remains so.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final, get_args

from webots_mcp.errors import InvalidInputError
from webots_mcp.signal_kinds import Kind
from webots_mcp.signal_register import Seen
from webots_mcp.store.chunks.codec import DamagedChunkError, Encoded, decode, decoded_of, encode
from webots_mcp.store.chunks.statistics import Statistics, statistics_of
from webots_mcp.store.chunks.stored import SIM_TIMES, STATE_IDS, WALL_TIMES
from webots_mcp.store.signals import enter_signals

# Ids between the first and the last row of a run; other robots could not have recorded more.
_MOST_IDS: Final = 2**40
_IDS: Final = (
    "SELECT min(id), max(id) FROM (SELECT id FROM source.state WHERE run_id = :run UNION ALL "
    "SELECT max_state_id FROM source.row_group WHERE run_id = :run "
    f"UNION ALL SELECT CAST(min AS INTEGER) FROM source.chunk WHERE run_id = :run "
    f"AND signal_id = {STATE_IDS})"
)
_LAST_HERE: Final = "SELECT coalesce(max(seq), 0) FROM main.sqlite_sequence WHERE name = 'state'"
_RESERVE: Final = (
    "DELETE FROM main.sqlite_sequence WHERE name = 'state'",
    "INSERT INTO main.sqlite_sequence (name, seq) VALUES ('state', ?)",
)
_SIGNALS: Final = (
    "SELECT name, path, reduction, kind, role, first_seen_wall_time_s FROM source.signal s "
    "WHERE robot_id = (SELECT robot_id FROM source.run WHERE id = :run) "
    f"AND typeof(name) = 'text' AND kind IN {get_args(Kind)} "
    "AND EXISTS (SELECT 1 FROM source.chunk WHERE run_id = :run AND signal_id = s.id) ORDER BY id"
)
_MAP: Final = "CREATE TEMP TABLE IF NOT EXISTS signal_here (there INTEGER PRIMARY KEY, here)"
_FILL_MAP: Final = (
    "INSERT INTO temp.signal_here SELECT s.id, n.id FROM source.signal s JOIN main.signal n "
    "ON n.robot_id = :here AND n.name = s.name "
    "WHERE s.robot_id = (SELECT robot_id FROM source.run WHERE id = :run) "
    f"UNION ALL VALUES ({SIM_TIMES}, {SIM_TIMES}), ({WALL_TIMES}, {WALL_TIMES})"
)
_GROUP: Final = (
    "start_sim_time_s, end_sim_time_s, row_count, stored_row_count, lost_value_count, "
    "stored_row_bytes, chunk_bytes, "
    "is_complete"
)
_GROUPS: Final = "SELECT id, row_count FROM source.row_group WHERE run_id = ? AND is_complete = 1"
_COPY_GROUP: Final = (
    f"INSERT INTO main.row_group (run_id, last_state_id, max_state_id, {_GROUP}) "
    f"SELECT :run, last_state_id + :shift, max_state_id + :shift, {_GROUP} "
    "FROM source.row_group WHERE id = :group"
)
_PACKED: Final = "codec, numbers, codes, labels"
_VALUES: Final = f"{', '.join(Statistics._fields)}, {_PACKED}"
_COPY_CHUNKS: Final = (
    f"INSERT INTO main.chunk (group_id, run_id, signal_id, {_VALUES}) "
    f"SELECT :here, :run, m.here, {_VALUES} FROM source.chunk c "
    "JOIN temp.signal_here m ON m.there = c.signal_id WHERE c.group_id = :group"
)
_STATE_IDS: Final = (
    f"SELECT {_PACKED} FROM source.chunk WHERE group_id = ? AND signal_id = {STATE_IDS}"
)
_INSERT: Final = (
    f"INSERT INTO main.chunk (group_id, run_id, signal_id, {_VALUES}) "
    f"VALUES ({', '.join('?' * (3 + len(_VALUES.split(','))))})"
)


def take_in_chunks(connection: sqlite3.Connection, there: int, here: int, robot_id: int) -> int:
    """Take in the row groups and chunks of a run, and the names of their signals.

    Args:
        connection: In a transaction; the other recording is attached.
        there: The run's id in the other recording.
        here: Its id here; none of its state rows is here yet.
        robot_id: Its robot here.

    Returns:
        By how much the ids of its state rows rise here.

    Raises:
        InvalidInputError: Its ids are spread as no bridge gives them.
    """
    shift = _reserve_ids(connection, there)
    asked = {"run": there, "here": robot_id}
    seen = {
        name: Seen(path, reduction, kind, (role or "").startswith("mode"), first_s)
        for name, path, reduction, kind, role, first_s in connection.execute(_SIGNALS, asked)
    }
    enter_signals(connection, robot_id, seen)
    connection.execute(_MAP)
    connection.execute("DELETE FROM temp.signal_here")
    connection.execute(_FILL_MAP, asked)
    for group, rows in connection.execute(_GROUPS, (there,)).fetchall():
        values: dict[str, Any] = {"run": here, "shift": shift, "group": group}
        values["here"] = connection.execute(_COPY_GROUP, values).lastrowid
        connection.execute(_COPY_CHUNKS, values)
        packed = connection.execute(_STATE_IDS, (group,)).fetchone()
        if packed is not None:
            with suppress(DamagedChunkError):  # who reads them is told that they are missing
                shifted = _shifted(packed, rows, shift)
                connection.execute(_INSERT, (values["here"], here, STATE_IDS, *shifted))
    return shift


def _shifted(packed: Sequence[Any], rows: int, shift: int) -> tuple[Any, ...]:
    """A chunk of ids that are so much greater."""
    numbers = decode(Encoded(*packed), rows).numbers.tolist()
    ids = [int(number) + shift for number in numbers]
    return *statistics_of(decoded_of(ids)), *encode(ids)


def _reserve_ids(connection: sqlite3.Connection, there: int) -> int:
    (last_here,) = connection.execute(_LAST_HERE).fetchone()
    first, last = connection.execute(_IDS, {"run": there}).fetchone()
    if first is None:
        return 0
    if last - first > _MOST_IDS:
        raise InvalidInputError(
            f"the ids of run {there}'s state rows reach from {first} to {last}, which no bridge "
            "gives: the recording is damaged"
        )
    shift = last_here + 1 - first
    delete, insert = _RESERVE
    connection.execute(delete)
    connection.execute(insert, (last + shift,))
    return shift
