"""How many rows were written, and how many were dropped."""

from __future__ import annotations

import json

from webots_mcp.bridge.error_report import ErrorReport


class RowCounts:
    """Counts written and dropped rows; drops are warned of and recorded as an event.

    Attributes:
        written: Rows that the database took.
        dropped: Rows that will never be in it.
        unreported: Dropped rows that no event in the database reports yet.
    """

    def __init__(self, errors: ErrorReport) -> None:
        self._errors = errors
        self._why = ""
        self._confirmed = 0
        self.written = 0
        self.dropped = 0
        self.unreported = 0

    def drop(self, rows: int, why: str) -> None:
        """Count rows as dropped, and warn; raises in strict mode."""
        self.dropped += rows
        self.unreported += rows
        self._why = why
        self._errors.warn(f"dropped: {why}", f"rows are being dropped: {why}")

    def confirm(self) -> None:
        """The files still exist, so what was written to them so far is stored."""
        self._confirmed = self.written

    def drop_unconfirmed(self, why: str) -> None:
        """The files are lost: count the rows written since the last `confirm` as dropped."""
        rows, self.written = self.written - self._confirmed, self._confirmed
        if rows:
            self.drop(rows, why)

    def report(self) -> str:
        """The data of the event that reports the unreported drops; none are left afterwards."""
        rows, self.unreported = self.unreported, 0
        return json.dumps({"row_count": rows, "why": self._why})
