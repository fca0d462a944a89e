"""Making chunks on demand, where no server does it in the background.

What is in no chunk is read row by row until a deadline, and what was not read is left out of the
answer. A server makes chunks of what comes; of a recording that none looks after, who asks does it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from webots_mcp.connection import FrozenConnection
from webots_mcp.errors import DatabaseError
from webots_mcp.leases import holder_of
from webots_mcp.maintenance import Maintainer
from webots_mcp.store.chunks.making import make_chunks
from webots_mcp.store.chunks.stored import watermark
from webots_mcp.store.recording import Recording
from webots_mcp.store.robots import list_robots

LEAST_ROWS: Final = 2000  # a question reads fewer as they are
_BATCH_ROWS: Final = 2000
_PAUSE_S: Final = 0.002  # between two short writes, for robots to write theirs
_NEWEST: Final = "SELECT coalesce(max(id), 0) FROM state"


def sum_up(
    recording: Recording,
    progress: Callable[[int, int], object] | None = None,
    *,
    limit_s: float = math.inf,
    called_off: Callable[[], bool] = lambda: False,
) -> str:
    """Put the states that are there now and in no chunk yet into chunks, unless a server does.

    It may end at any moment, also by an exception: the chunks that are made stay, and the next call
    goes on from there.

    Args:
        recording: Of the current schema.
        progress: Called now and then with how many rows are done, and how many there are to do.
        limit_s: Wall seconds after which it stops.
        called_off: Asked between two batches whether to stop.

    Returns:
        How many states are left in no chunk, and why; "" where there are none, or so few that a
        question reads all of them.

    Raises:
        DatabaseError: There is no such recording, or it cannot be read.
    """
    with recording.reader() as connection:
        first, last = watermark(connection), int(connection.execute(_NEWEST).fetchone()[0])
        holder = holder_of(connection, "maintainer") or ""
        is_frozen = isinstance(connection, FrozenConnection)
    if last - first < LEAST_ROWS:
        return ""
    if is_frozen:
        return _left(last - first, "the file cannot be written from here")
    if holder.startswith("server "):
        return _left(last - first, "the server that maintains the recording makes them")
    until_s, mark, why = time.monotonic() + limit_s, first, ""
    try:
        with recording.writer() as connection, _checkpoints(recording):
            live = any(robot.live for robot in list_robots(connection, time.time()))
            while not why and mark <= last:
                pause_s = _PAUSE_S if live else 0.0
                done = make_chunks(connection, _BATCH_ROWS, pause_s).done
                mark = watermark(connection)
                if progress is not None:
                    progress(min(mark, last) - first, last - first)
                if done:
                    return ""
                if called_off() or time.monotonic() > until_s:
                    why = "ask again to continue"
    except DatabaseError as error:
        why = str(error)
    return _left(last - mark, why) if last - mark >= LEAST_ROWS else ""


@contextmanager
def _checkpoints(recording: Recording) -> Generator[None]:
    """With a maintainer that keeps the database's log short meanwhile."""
    if not isinstance(recording.database, Path):
        yield
        return
    maintainer = Maintainer(recording.database, "question")  # idle while a bridge is it
    maintainer.start()
    try:
        yield
    finally:
        maintainer.stop()


def _left(rows: int, why: str) -> str:
    return f"the newest {rows} rows are in no chunk yet: {why}"
