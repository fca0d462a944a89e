"""Answers as a person reads them in a terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Any, Final, TextIO, cast

from webots_mcp.cli.rendering import clock_text as clock_text
from webots_mcp.cli.rendering import id_ranges as id_ranges
from webots_mcp.cli.wording import as_typed

if TYPE_CHECKING:
    from webots_mcp.store.questions.sql import Result

_LONGEST_CELL: Final = 110
_RIGHT: Final = (int, float)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows under their column names; columns that are empty throughout are left out."""
    for line in table_lines(columns, rows):
        print(line)


def table_lines(
    columns: Sequence[str], rows: Sequence[Sequence[Any]], longest_cell: int = _LONGEST_CELL
) -> Iterator[str]:
    """The lines of a table; no cell is longer than so many characters."""
    kept = [index for index in range(len(columns)) if any(row[index] is not None for row in rows)]
    cells = [[columns[index] for index in kept]]
    cells += [[_shortened(text_of(row[index]), longest_cell) for index in kept] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    right = [all(isinstance(row[i], (*_RIGHT, type(None))) for row in rows) for i in kept]
    for line in cells:
        fields = zip(line, widths, right, strict=True)
        padded = (cell.rjust(width) if r else cell.ljust(width) for cell, width, r in fields)
        yield "  ".join(padded).rstrip()


def text_of(value: Any) -> str:
    """A value in one line; what a terminal would obey is spelled out instead."""
    if value is None:
        return ""
    if isinstance(value, float):
        return _number_text(value)
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value).items()
        return _one_line(", ".join(f"{name} {text_of(member)}" for name, member in members))
    return _one_line(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))


def printable(text: str) -> str:
    """A text in one line, with what a terminal would obey spelled out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _one_line(text: str) -> str:
    return _shortened(printable(text), _LONGEST_CELL)


def _shortened(line: str, longest: int) -> str:
    return line if len(line) <= longest else f"{line[: longest - 1]}…"


def _number_text(value: float) -> str:
    """4 significant digits, but never coarser than a thousandth."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:.3f}".rstrip("0").rstrip(".") if abs(value) >= 1 else f"{value:.4g}"


def print_notes(notes: Sequence[str], file: TextIO | None = None) -> None:
    """What there is to know about an answer, below it; on stdout, or in that file."""
    for note in notes:
        print(f"note: {text_of(as_typed(note))}", file=file)


def print_result(found: Result, *, as_json: bool) -> None:
    """Print what a SELECT has answered."""
    if as_json:
        return print_json(found)
    rows = [["NULL" if cell is None else cell for cell in row] for row in found.rows]
    print_table(found.columns, rows)
    cut = f"{found.shortened} long values are cut" if found.shortened else None
    print_notes([note for note in (found.truncated, cut, None if rows else "no row") if note])


def print_json(found: Any) -> None:
    """Print the answer of a question, a dataclass, as one object."""
    assert is_dataclass(found)
    assert not isinstance(found, type)
    print(json.dumps(_with_names(asdict(found)), ensure_ascii=False))


def _with_names(value: Any) -> Any:
    """The fields of named tuples by their names; JSON by itself knows them as lists."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {name: _with_names(each) for name, each in cast("dict[Any, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [_with_names(each) for each in cast("Sequence[Any]", value)]
    return value
