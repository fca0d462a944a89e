"""The legend below a picture, in as many rows as it needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

Entry = tuple[Any, str]  # what matplotlib draws, and its text

_SYMBOL_PX: Final = 46  # with the space around it
_LETTER_PX: Final = 6


def paint_legend(figure: Any, entries: Sequence[Entry]) -> None:
    """Row by row, in the order given."""
    if not entries:
        return
    needed_px = sum(_SYMBOL_PX + _LETTER_PX * len(text) for _, text in entries)
    rows = math.ceil(needed_px / (figure.get_figwidth() * figure.dpi))
    columns = math.ceil(len(entries) / rows)
    # matplotlib fills column by column
    filled = [entry for column in range(columns) for entry in entries[column::columns]]
    handles, labels = zip(*filled, strict=True)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)
