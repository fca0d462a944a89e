"""Tables of a report: texts in rows, as many as have room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Final, NamedTuple

_ROW_BYTES: Final = 32  # of marks around a row
_SHORT: Final = 24  # characters
_CELL_BYTES: Final = 24  # of marks around a cell


class Row(NamedTuple):
    """Texts, and a mark that shows in the page: `warning`, `error` or nothing."""

    cells: Sequence[str]
    mark: str = ""

    @property
    def size_bytes(self) -> int:
        """About what the row takes in the page."""
        texts = sum(len(escape(cell).encode("utf-8", "replace")) for cell in self.cells)
        return _ROW_BYTES + _CELL_BYTES * len(self.cells) + texts


@dataclass(frozen=True)
class Grid:
    """A table.

    Attributes:
        columns: Their names; a unit stands in brackets.
        notes: What is said below it.
        left_out: How many rows are not shown for want of room.
        or_more: There may be more than these, which nobody counted.
    """

    columns: Sequence[str]
    rows: Sequence[Row]
    notes: Sequence[str] = field(default=())
    left_out: int = 0
    or_more: bool = False

    @property
    def missing(self) -> str:
        """How many rows are not shown, in words."""
        return f"{self.left_out:,}" + (" or more" if self.or_more else "")

    @property
    def classes(self) -> list[str]:
        """How each column is set: digits below each other, short texts in one line."""
        return [
            self._class_of([row.cells[i] for row in self.rows]) for i in range(len(self.columns))
        ]

    def within(self, room_bytes: float, *, newest: bool = False) -> Grid:
        """As many of the first rows, or of the newest, as have room; empty columns are dropped."""
        rows = list(reversed(self.rows)) if newest else list(self.rows)
        kept: list[Row] = []
        for row in rows:
            room_bytes -= row.size_bytes
            if room_bytes < 0:
                break
            kept.append(row)
        left_out = self.left_out + len(rows) - len(kept)
        shown = replace(self, rows=kept[::-1] if newest else kept, left_out=left_out)
        return shown._without_empty_columns()

    def _class_of(self, cells: Sequence[str]) -> str:
        if all(map(_is_number, cells)):
            return "number"
        return "short" if max(map(len, cells)) <= _SHORT else ""

    def _without_empty_columns(self) -> Grid:
        kept = [i for i in range(len(self.columns)) if any(row.cells[i] for row in self.rows)]
        rows = [Row([row.cells[i] for i in kept], row.mark) for row in self.rows]
        return replace(self, columns=[self.columns[i] for i in kept], rows=rows)


def _is_number(text: str) -> bool:
    try:
        float(text or "0")
    except ValueError:
        return False
    return True
