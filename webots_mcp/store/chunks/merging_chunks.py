"""The row groups of a run of another recording, with their chunks, as rows of this one.

The other recording is attached as `source`. What changes are ids: of the run, of its signals, and
of its state rows, which all rise alike.
"""

from __future__ import annotations

import sqlite3
from typing import Any, Final

from webots_mcp.store.chunks.codec import DamagedChunkError, Encoded, decode, decoded_of, encode
from webots_mcp.store.chunks.statistics import Statistics, statistics_of
from webots_mcp.store.chunks.stored import SIM_TIMES, STATE_IDS, WALL_TIMES

_BYTES: Final = ", ".join(Encoded._fields)
_HELD: Final = f"{', '.join(Statistics._fields)}, {_BYTES}"
_GROUPS: Final = (
    "SELECT id, row_count FROM source.row_group WHERE run_id = ? AND is_complete = 1 ORDER BY id"
)
_COPY_GROUP: Final = (
    "INSERT INTO main.row_group (run_id, start_sim_time_s, end_sim_time_s, last_state_id, "
    "max_state_id, row_count, is_complete) SELECT :here, start_sim_time_s, end_sim_time_s, "
    "last_state_id + :shift, max_state_id + :shift, row_count, 1 FROM source.row_group "
    "WHERE id = :there"
)
_TIMES: Final = f"INSERT INTO temp.signal_here VALUES ({SIM_TIMES}, {SIM_TIMES}), " + (
    f"({WALL_TIMES}, {WALL_TIMES})"
)
_COPY_CHUNKS: Final = (
    f"INSERT INTO main.chunk (group_id, run_id, signal_id, {_HELD}) "
    f"SELECT :group, :here, m.here, {_HELD} FROM source.chunk c "
    "JOIN temp.signal_here m ON m.there = c.signal_id WHERE c.group_id = :there ORDER BY c.id"
)
_IDS: Final = f"SELECT {_BYTES} FROM source.chunk WHERE group_id = ? AND signal_id = {STATE_IDS}"
_PUT_IDS: Final = (
    f"INSERT INTO main.chunk (group_id, run_id, signal_id, {_HELD}) "
    f"VALUES ({', '.join('?' * (3 + len(Statistics._fields) + len(Encoded._fields)))})"
)


def take_in_chunks(connection: sqlite3.Connection, there: int, here: int, shift: int) -> None:
    """Copy the groups of a run, where `temp.signal_here` says how its signals are called here.

    Args:
        connection: In a transaction; the other recording is attached.
        there: The run's id in the other recording.
        here: Its id here.
        shift: By how much the ids of its state rows rise.
    """
    connection.execute(_TIMES)
    for group_id, rows in connection.execute(_GROUPS, (there,)).fetchall():
        named = {"here": here, "there": group_id, "shift": shift}
        group = connection.execute(_COPY_GROUP, named).lastrowid
        connection.execute(_COPY_CHUNKS, named | {"group": group})
        for encoded in connection.execute(_IDS, (group_id,)).fetchall():
            risen = _risen(encoded, rows, shift)
            connection.execute(_PUT_IDS, (group, here, STATE_IDS, *risen))


def _risen(encoded: tuple[Any, ...], rows: int, shift: int) -> tuple[Any, ...]:
    """Ids of state rows with their statistics; those that cannot be read stay damaged."""
    try:
        ids = [int(each) + shift for each in decode(Encoded(*encoded), rows).numbers.tolist()]
    except (DamagedChunkError, ValueError):
        return (*Statistics(rows, 0), *encoded)
    return (*statistics_of(decoded_of(ids)), *encode(ids))
