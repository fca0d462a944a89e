"""The structured answer of a tool as text: what an assistant reads as JSON, for a person."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, cast

from webots_mcp.cli.tables import printable, table_lines, text_of

_WIDTH: Final = 100
_ROWS: Final = 6
_LONGEST_CELL: Final = 48
_INDENT: Final = "  "
_HEAD: Final = {
    "robot": "{}",
    "run_id": "run {}",
    "sim_time_s": "at {} s",
    "status": "{}",
    "age_s": "{} s old",
}


def answer_lines(answer: Mapping[str, Any]) -> Iterator[str]:
    """Whom and when the answer is about in one line, then part by part what it says.

    Long tables are shown by their first rows, and say how many more there are.
    """
    head = [text.format(text_of(answer[name])) for name, text in _HEAD.items() if name in answer]
    if head:
        yield ", ".join(head)
    rest = {name: each for name, each in answer.items() if name not in _HEAD and each is not None}
    yield from _member_lines(rest)


def _member_lines(members: Mapping[str, Any]) -> Iterator[str]:
    """Short members stand together in a paragraph, each other one on lines of its own."""
    short = list[str]()
    for name, value in members.items():
        line = "" if _has_members(value) else f"{name} {_whole_text(value)}"
        if 0 < len(line) <= _LONGEST_CELL:
            short.append(line)
            continue
        yield from _paragraph(short)
        short = []
        yield from _paragraph([line]) if line else _part_lines(name, value)
    yield from _paragraph(short)


def _part_lines(name: str, value: Any) -> Iterator[str]:
    for part in cast("list[dict[str, Any]]", value if isinstance(value, list) else [value]):
        line = f"{name}: " + ", ".join(f"{each} {_whole_text(part[each])}" for each in part)
        if len(line) <= _WIDTH and not any(map(_has_members, part.values())):
            yield line
            continue
        yield f"{name}:"
        inner = _table_lines(part) if {"columns", "rows"} <= part.keys() else _member_lines(part)
        yield from (_INDENT + line for line in inner)


def _table_lines(table: Mapping[str, Any]) -> Iterator[str]:
    rows = table["rows"]
    yield from table_lines(table["columns"], rows[:_ROWS], _LONGEST_CELL)
    if len(rows) > _ROWS:
        yield f"... and {len(rows) - _ROWS} more"


def _paragraph(texts: Iterable[str]) -> list[str]:
    return textwrap.wrap(", ".join(texts), _WIDTH, subsequent_indent=_INDENT)


def _whole_text(value: Any) -> str:
    """Where `text_of` would cut a long text."""
    return printable(value) if isinstance(value, str) else text_of(value)


def _has_members(value: Any) -> bool:
    """Whether it is an object, or a list of such."""
    each = cast("list[Any]", value)[:1] if isinstance(value, list) else [value]
    return any(isinstance(one, dict) for one in each)
