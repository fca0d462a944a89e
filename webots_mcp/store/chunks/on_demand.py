"""Making chunks on demand, where no server does it in the background.

What is in no chunk is read row by row until a deadline, and what was not read is left out of the
answer. A server makes chunks of what comes; of a recording that none looks after, who asks does it.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from webots_mcp.connection import FrozenConnection
from webots_mcp.errors import DatabaseError
from webots_mcp.leases import holder_of
from webots_mcp.maintenance import Maintainer
from webots_mcp.store.chunks.aside import chunks_aside
from webots_mcp.store.chunks.making import make_chunks
from webots_mcp.store.chunks.stored import watermark
from webots_mcp.store.recording import Recording
from webots_mcp.store.robots import list_robots
from webots_mcp.transactions import FAILURES

LEAST_ROWS: Final = 2000  # a question reads fewer as they are
_BATCH_ROWS: Final = 2000
_PAUSE_S: Final = 0.002  # between two short writes, for robots to write theirs
_LEFT: Final = (  # ids are given without gaps, but for rows that were deleted
    "SELECT max(0, (SELECT coalesce(max(id), 0) FROM state) - :mark - (SELECT "
    "coalesce(sum(row_count), 0) FROM row_group WHERE is_complete = 1 AND max_state_id > :mark))"
)


def make_missing_chunks(
    recording: Recording,
    progress: Callable[[int, int], object] | None = None,
    *,
    limit_s: float = math.inf,
    called_off: Callable[[], bool] = lambda: False,
    write: bool = True,
) -> str:
    """Put the states that are there now and in no chunk yet into chunks, unless a server does.

    It may end at any moment, also by an exception: the chunks that are made stay, and the next call
    goes on from there.

    Args:
        recording: Of the current schema.
        progress: Called now and then with how many rows are done, and how many there are to do.
        limit_s: Wall seconds after which it stops.
        called_off: Asked between two batches whether to stop.
        write: Where false, or where the file cannot be written, the chunks are made in a temporary
            file of this process.

    Returns:
        How many states are left in no chunk, and why; "" where there are none, or so few that a
        question reads all of them.

    Raises:
        DatabaseError: There is no such recording, or it cannot be read.
    """
    with recording.reader() as connection:
        total = left = _rows_left(connection)
        holder = holder_of(connection, "maintainer") or ""
        is_frozen = isinstance(connection, FrozenConnection)
    if total < LEAST_ROWS:
        return ""
    if holder.startswith("server ") and not is_frozen:
        return _say(total, "the server that maintains the recording makes them")
    until_s, why = time.monotonic() + limit_s, ""
    try:
        with _opened(recording, write=write, frozen=is_frozen) as connection:
            live = not is_frozen and any(
                robot.live for robot in list_robots(connection, time.time())
            )
            while not why:
                done = make_chunks(connection, _BATCH_ROWS, _PAUSE_S if live else 0.0).done
                left = 0 if done else min(left, _rows_left(connection))
                if progress is not None:
                    progress(total - left, total)
                if done:
                    return ""
                if called_off() or time.monotonic() > until_s:
                    why = "ask again to continue"
    except (DatabaseError, *FAILURES) as error:
        why = str(error)
    return _say(left, why) if left >= LEAST_ROWS else ""


def _rows_left(connection: sqlite3.Connection) -> int:
    """About how many rows are in no chunk."""
    return int(connection.execute(_LEFT, {"mark": watermark(connection)}).fetchone()[0])


@contextmanager
def _opened(recording: Recording, *, write: bool, frozen: bool) -> Generator[sqlite3.Connection]:
    """A connection to make chunks on, with a maintainer that keeps the log short meanwhile."""
    database = recording.database
    if isinstance(database, Path) and (frozen or not write):
        with chunks_aside(database, frozen=frozen) as connection:
            yield connection
        return
    # Idle while a bridge is it.
    maintainer = Maintainer(database, "question") if isinstance(database, Path) else None
    with recording.writer() as connection:
        if maintainer is not None:
            maintainer.start()
        try:
            yield connection
        finally:
            if maintainer is not None:
                maintainer.stop()


def _say(rows: int, why: str) -> str:
    return f"the newest {rows} rows are in no chunk yet: {why}"
