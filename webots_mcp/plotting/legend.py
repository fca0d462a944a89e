"""The legend below a picture, in as many rows as it needs, up to a quarter of the height."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

Entry = tuple[Any, str]  # what matplotlib draws, and its text

_SYMBOL_PX: Final = 50  # with the space around it
_LETTER_PX: Final = 7
_ROW_PX: Final = 18
_MOST_HEIGHT: Final = 0.25  # of the picture


def paint_legend(figure: Any, entries: Sequence[Entry]) -> None:
    """Row by row, in the order given; those without room are counted."""
    if not entries:
        return
    columns = _columns(entries, figure.get_figwidth() * figure.dpi)
    room = columns * max(1, int(_MOST_HEIGHT * figure.get_figheight() * figure.dpi / _ROW_PX))
    if len(entries) > room:
        more = len(entries) - room + 1
        entries = [*entries[: room - 1], (_nothing(), f"and {more} more")]
    # matplotlib fills column by column
    filled = [entry for column in range(columns) for entry in entries[column::columns]]
    handles, labels = zip(*filled, strict=True)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def _nothing() -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="")


def _columns(entries: Sequence[Entry], width_px: float) -> int:
    """As many as fit beside each other; each is as wide as its longest text."""
    letters = [len(text) for _, text in entries]
    for columns in range(len(entries), 1, -1):
        longest = sum(max(letters[column::columns]) for column in range(columns))
        if columns * _SYMBOL_PX + longest * _LETTER_PX <= width_px:
            return columns
    return 1
