"""The legend below a picture, in as many rows as it needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

Entry = tuple[Any, str]  # what matplotlib draws, and its text

_SYMBOL_PX: Final = 50  # with the space around it
_LETTER_PX: Final = 7


def paint_legend(figure: Any, entries: Sequence[Entry]) -> None:
    """Row by row, in the order given."""
    if not entries:
        return
    columns = _columns(entries, figure.get_figwidth() * figure.dpi)
    # matplotlib fills column by column
    filled = [entry for column in range(columns) for entry in entries[column::columns]]
    handles, labels = zip(*filled, strict=True)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def _columns(entries: Sequence[Entry], width_px: float) -> int:
    """As many as fit beside each other; each is as wide as its longest text."""
    letters = [len(text) for _, text in entries]
    for columns in range(len(entries), 1, -1):
        longest = sum(max(letters[column::columns]) for column in range(columns))
        if columns * _SYMBOL_PX + longest * _LETTER_PX <= width_px:
            return columns
    return 1
