"""Rows that will never be written: counted, said, and told in the database."""

from __future__ import annotations

import json

from webots_mcp.bridge.trouble import Trouble


class Drops:
    """How many rows were dropped, and which of them the database does not know of yet."""

    def __init__(self, trouble: Trouble) -> None:
        self._trouble = trouble
        self._because = ""
        self.rows = 0
        self.untold = 0

    def count(self, rows: int, why: str) -> None:
        """Count rows as dropped; in strict mode that raises."""
        self.rows += rows
        self.untold += rows
        self._because = why
        self._trouble.complain(f"dropped: {why}", f"rows are being dropped: {why}")

    def describe(self) -> str:
        """What an event tells of those that were not told yet."""
        return json.dumps({"rows": self.untold, "why": self._because})
