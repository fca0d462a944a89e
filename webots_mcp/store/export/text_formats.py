"""Rows as CSV and as JSON lines."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any, BinaryIO, Final

from webots_mcp.store.export.export_rows import Table, as_text

_SPELLED: Final = ("bool", "text", "numbers")
_FORMULAS: Final = ("=", "+", "-", "@", "\t", "\r")
_encode: Final = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode


def write_csv(source: Table, sink: BinaryIO, *, safe_cells: bool = False) -> None:
    r"""One line per row under a line of column names; UTF-8, lines end as in RFC 4180.

    What a row lacks, or is null, is empty; flags are `true` and `false`; what was not finite is
    `nan`, `inf` or `-inf`; a long array is its JSON text; a NUL character is `\0`, because many
    readers of CSV end there.

    A spreadsheet runs a text that begins with =, +, - or @ as a formula. With `safe_cells` such a
    text (also a name) gets an apostrophe before it; numbers are left as they are.
    """
    spell = _harmless if safe_cells else _without_nul
    columns = source.columns()
    names = [column.name for column in columns]
    # The writer itself turns numbers into text, and null into nothing.
    spelled = [i for i, column in enumerate(columns, len(source.head)) if column.kind in _SPELLED]
    text = io.TextIOWrapper(sink, "utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(map(spell, (*(column.name for column in source.head), *names)))
    for row in source.rows(pass_number=2):
        cells: list[object] = [*row.head, *map(row.values.get, names)]
        for i in spelled:
            value = cells[i]
            cells[i] = (spell if isinstance(value, str) else _without_nul)(as_text(value))
        writer.writerow(cells)
    text.detach()


def _without_nul(text: str | None) -> str | None:
    return text.replace("\0", "\\0") if text else text


def _harmless(text: str | None) -> str | None:
    plain = _without_nul(text)
    return f"'{plain}" if plain and plain.startswith(_FORMULAS) else plain


def write_json_lines(source: Table, sink: BinaryIO) -> None:
    """One JSON object per row and line: what it holds by dotted name, null where it is not finite.

    `replaced`, where a row has it, names the path of every value that JSON cannot hold, and what
    it was.
    """
    head = [column.name for column in source.head]
    for row in source.rows():
        line: dict[str, Any] = dict(zip(head, row.head, strict=True)) | row.values
        if row.replaced:
            line["replaced"] = row.replaced
        sink.write(_line(line))


def json_text(value: dict[str, Any]) -> str:
    """Strict JSON: null where a number is not finite."""
    try:
        return _encode(value)
    except ValueError:
        return _encode(_finite(value))


def _line(line: dict[str, Any]) -> bytes:
    return f"{json_text(line)}\n".encode()


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return [_finite(item) for item in value] if isinstance(value, list) else value  # pyright: ignore[reportUnknownVariableType]
