"""The tables of a report, cut to a number of bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Final, NamedTuple

_ROW_BYTES: Final = 32  # Markup of a row.
_SHORT: Final = 24  # Characters of cells in a column that is not wrapped.
_CELL_BYTES: Final = 24  # Markup of a cell.


class GridRow(NamedTuple):
    """The texts of a row, and its mark: `warning`, `error` or nothing."""

    cells: Sequence[str]
    mark: str = ""

    @property
    def size_bytes(self) -> int:
        """Return about the bytes that the row takes in the report."""
        texts = sum(len(escape(cell).encode("utf-8", "replace")) for cell in self.cells)
        return _ROW_BYTES + _CELL_BYTES * len(self.cells) + texts


@dataclass(frozen=True)
class Grid:
    """A table.

    Attributes:
        columns: Names of the columns, with units in brackets.
        notes: Notes below the table.
        left_out: Number of rows that are not shown.
        or_more: Whether there may be more rows, which were not counted.
    """

    columns: Sequence[str]
    rows: Sequence[GridRow]
    notes: Sequence[str] = field(default=())
    left_out: int = 0
    or_more: bool = False

    @property
    def missing(self) -> str:
        """Return the number of rows that are not shown, in words."""
        return f"{self.left_out:,}" + (" or more" if self.or_more else "")

    @property
    def classes(self) -> list[str]:
        """Return the CSS class of each column: numbers are aligned, short texts not wrapped."""
        return [
            self._class_of([row.cells[i] for row in self.rows]) for i in range(len(self.columns))
        ]

    def within(self, budget_bytes: float, *, newest: bool = False) -> Grid:
        """Return as many of the first or the newest rows as fit, without empty columns."""
        rows = list(reversed(self.rows)) if newest else list(self.rows)
        kept: list[GridRow] = []
        for row in rows:
            budget_bytes -= row.size_bytes
            if budget_bytes < 0:
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
        rows = [GridRow([row.cells[i] for i in kept], row.mark) for row in self.rows]
        return replace(self, columns=[self.columns[i] for i in kept], rows=rows)


def _is_number(text: str) -> bool:
    try:
        float(text or "0")
    except ValueError:
        return False
    return True
