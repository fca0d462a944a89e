"""How much of a recording is kept: the one place that states it."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.transactions import transaction

# A run that a person named, described or marked is not retention's to judge.
# Trials are labelled by the hundred without anybody's having judged them: their scores stay.
KEPT: Final = (
    "(keep <> 0 OR coalesce(note, '') <> '' "
    "OR (coalesce(label, '') <> '' AND label NOT GLOB 'trial [0-9]* of set [0-9]*: *'))"
)
_MARK: Final = "UPDATE run SET keep = ? WHERE id = ?"


@dataclass(frozen=True)
class Limit:
    """How much of one kind is kept; None is not a limit. What is oldest goes first.

    Attributes:
        size_bytes: So much on the disk, with the free room on the pages and the indexes. Of
            pictures their files.
        rows: So many rows; of chunks so many states that they stand for.
        age_s: So long after they were written, in wall time.
        spared_rows: So many of the newest rows, of all runs together, do not go because of their
            age: runs of abandoned work do not all vanish. Size and rows always hold.
    """

    size_bytes: int | None = None
    rows: int | None = None
    age_s: float | None = None
    spared_rows: int = 10_000

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not 0 <= value < math.inf:
                raise InvalidInputError(f"{field.name}={value} must be 0 or more, and finite")

    @property
    def limits(self) -> bool:
        """Whether it states any limit."""
        return (self.size_bytes, self.rows, self.age_s) != (None, None, None)

    def is_exceeded(
        self, *, size_bytes: float, rows: float, age_s: float = 0, times: float = 1
    ) -> bool:
        """Whether one of these is more than so many times its limit."""
        found = ((size_bytes, self.size_bytes), (rows, self.rows), (age_s, self.age_s))
        return any(limit is not None and value > times * limit for value, limit in found)


@dataclass(frozen=True)
class Retention:
    """The limits of each kind of row.

    They hold for the whole database, over all robots: rows go in the order in which they were
    recorded, whatever their run, about a thousand of a run at once. Runs with a label (but that of
    a trial), a note or `keep` lose nothing and do not count.

    Attributes:
        state: The full rows. They go only after their values were put into chunks.
        chunk: The values of each signal, compressed, of about 1,024 states at once. They go only
            after those states, and with them what their run still says of that time.
        log: Log lines.
        event: Events; its age also holds for finished commands.
        image: Pictures, with their files.
        outlive: When this many times the limits of `state` was recorded after a run, or it ended
            that many times their age ago (and as many states as an age spares were recorded since),
            all that is left of it goes, and with the last run of that time the commands. 0 keeps
            runs for ever.
        kept_state: Rows of kept stretches: those that the throttle dropped, and those that went
            from `state`. A stretch that loses a row is none any more.
        unshipped: What is beyond these limits stays until it is shipped to a pool; of more than
            this size the oldest goes all the same.
    """

    state: Limit = Limit(size_bytes=1_000_000_000, spared_rows=50_000)
    chunk: Limit = Limit(size_bytes=1_000_000_000)
    log: Limit = Limit(size_bytes=100_000_000)
    event: Limit = Limit(size_bytes=100_000_000)
    image: Limit = Limit(size_bytes=1_000_000_000, spared_rows=50)
    outlive: float = 10.0
    kept_state: Limit = Limit(size_bytes=100_000_000)
    unshipped: Limit = Limit(size_bytes=0)

    def __post_init__(self) -> None:
        if not (self.outlive == 0 or 1 <= self.outlive < math.inf):
            raise InvalidInputError(f"outlive={self.outlive} must be 1 or more, or 0 for ever")
        waiting = self.unshipped
        if waiting.size_bytes is None or (waiting.rows, waiting.age_s) != (None, None):
            raise InvalidInputError(
                "rows that wait to be shipped are kept up to a size, so that an unreachable pool "
                "does not fill the disk: --keep-until-shipped 2GB"
            )


DEFAULT: Final = Retention()


def mark_kept(connection: sqlite3.Connection, run_ids: Sequence[int], *, keep: bool = True) -> None:
    """Let retention keep these runs for good, or no longer; all of them or, on an error, none.

    Raises:
        UnknownRunError: There is no such run.
    """
    with transaction(connection):
        for run_id in run_ids:
            fetch_run(connection, run_id)
        connection.executemany(_MARK, [(int(keep), run_id) for run_id in run_ids])
