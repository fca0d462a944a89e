"""How many rows were written, and how many were dropped."""

from __future__ import annotations

import json

from webots_mcp.bridge.error_report import ErrorReport


class RowCounts:
    """Counts what was written and what was dropped; drops are warned of and recorded as an event.

    Attributes:
        written: Rows that the database took.
        dropped: Rows that will never be in it.
        untold: Of those, the ones that the database does not know of yet.
    """

    def __init__(self, errors: ErrorReport) -> None:
        self._errors = errors
        self._why = ""
        self._confirmed = 0
        self.written = 0
        self.dropped = 0
        self.untold = 0

    def drop(self, rows: int, why: str) -> None:
        """Count rows as dropped; in strict mode that raises."""
        self.dropped += rows
        self.untold += rows
        self._why = why
        self._errors.warn(f"dropped: {why}", f"rows are being dropped: {why}")

    def confirm(self) -> None:
        """The files were seen in their place: what was written to them is there."""
        self._confirmed = self.written

    def drop_unconfirmed(self, why: str) -> None:
        """The files are gone, and with them what was written since they were last seen."""
        rows, self.written = self.written - self._confirmed, self._confirmed
        if rows:
            self.drop(rows, why)

    def tell(self) -> str:
        """What an event says of the dropped rows that the database does not know of yet."""
        rows, self.untold = self.untold, 0
        return json.dumps({"rows": rows, "why": self._why})
