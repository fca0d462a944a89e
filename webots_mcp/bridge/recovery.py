"""Recovery after a failed write: trying again, starting a new database, or giving up."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Final

from webots_mcp.bridge.backlog import Backlog, Row
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.opening import is_ours, move_aside
from webots_mcp.bridge.row_counts import RowCounts
from webots_mcp.bridge.session_connection import SessionConnection
from webots_mcp.connection import is_busy, is_damage, text_of
from webots_mcp.errors import (
    ForeignDatabaseError,
    ForkedProcessError,
    SchemaTooNewError,
    SchemaTooOldError,
    SessionGoneError,
)

_RETRY_INTERVAL_S: Final = 1.0

# Errors that no later attempt can resolve.
_FOR_GOOD: Final = (
    ForeignDatabaseError, ForkedProcessError, SchemaTooNewError, SchemaTooOldError,
)  # fmt: skip


class Recovery:
    """Opens the database, and opens it again after a failure.

    Attributes:
        off: Why recording has ended for good; None while it has not.
    """

    def __init__(
        self,
        session: SessionConnection,
        backlog: Backlog,
        counts: RowCounts,
        errors: ErrorReport,
        clock: Clock,
    ) -> None:
        self._session = session
        self._backlog = backlog
        self._counts = counts
        self._errors = errors
        self._clock = clock
        self._retry_at_s = 0.0
        self.off: str | None = None

    def open(self, *, patient: bool) -> bool:
        """Open (or create) the database and enter a session; False, with a warning, on failure."""
        if self.off is not None:
            return False
        try:
            self._session.open(patient=patient)
        except _FOR_GOOD as error:
            self._give_up(str(error))
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.why = why = text_of(error)
            self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
            if is_damage(error):
                return self._replace_damaged(why)
            if not is_busy(error):
                self._errors.warn(f"open {type(error).__name__}", f"not recording yet: {why}")
        return self._session.connection is not None

    def is_connected(self) -> bool:
        """Whether a write may be tried now; tries to open a closed database once a second."""
        if self.off is not None or time.monotonic() < self._retry_at_s:
            return False
        return self._session.connection is not None or self.open(patient=False)

    def put_off(self, error: Exception) -> None:
        """Decide how to continue after a failed write: at once, in a second, or in a new file."""
        self._backlog.why = text = text_of(error)
        if is_busy(error):
            return  # another writer has the lock for the moment: the next call tries again
        self._retry_at_s = time.monotonic() + _RETRY_INTERVAL_S
        if is_damage(error):
            self._replace_files(text)
        elif isinstance(error, SessionGoneError) or _misses_rows(text):
            self._start_over(f"the database lost this session ({text})")
        else:
            self._errors.warn(text, f"not recorded yet, trying again each second: {text}")

    def look_after_files(self) -> None:
        """Start over where the files of the open connection were deleted, replaced or truncated."""
        if self._session.connection is None:
            return
        if (fault := self._session.find_fault()) is not None:
            self._start_over(fault)
        else:
            self._counts.confirm()

    def _replace_files(self, why: str) -> None:
        """Rename a damaged database, and begin a new one."""
        database = self._session.database
        assert isinstance(database, Path)
        self._session.close()
        try:
            move_aside(database)
        except OSError as error:
            why = f"{database} is damaged and cannot be renamed: {error}; move it away by hand"
            self._errors.warn("damaged", why)
            return
        self._start_over(f"{database} was damaged ({why}) and moved aside")

    def _start_over(self, why: str) -> None:
        """Continue in a new database, which does not have this session yet."""
        self._session.close()
        self._retry_at_s = 0.0
        run = self._session.run
        before = run.uuid
        run.begin_anew()
        self._backlog.rename_run(before, run.uuid)
        moment = (self._clock.newest_s(run), time.time())
        self._backlog.keep(Row("event", run, (*moment, "storage", None, json.dumps({"why": why}))))
        entries = [each for make in self._session.new_database_entries for each in make()]
        for kind, of_run, values in entries:
            self._backlog.keep(Row(kind, run if of_run else None, values))
        self._counts.drop_unconfirmed(why)
        self._errors.warn("storage", f"{why}; recording continues in a new database")

    def _replace_damaged(self, why: str) -> bool:
        """Move a damaged database aside; a file that is not ours is left alone."""
        if not is_ours(self._session.database, why):
            self._give_up(f"{why}; choose another file")
            return False
        self._replace_files(why)
        return self._retry_at_s == 0 and self.open(patient=False)

    def _give_up(self, why: str) -> None:
        self.off = f"not recording into {self._session.database}: {why}"
        self._errors.warn("off", self.off)
        self._backlog.drop_rows_in_memory(self.off)


def _misses_rows(text: str) -> bool:
    """Whether SQLite's error says that a table, or a row that is referred to, is missing."""
    return "no such table" in text or "FOREIGN KEY" in text
