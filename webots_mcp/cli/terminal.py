"""Show answers as text in a terminal.

The first line answers. Tables fit the terminal: cells are wrapped, and columns that do not fit are
named below the table, starting with the least important. In a pipe each row is one line and nothing
is left out. Notes are wrapped and never cut. `--verbose` shows every column.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TextIO, cast

from webots_mcp.cli.streams import write_styled
from webots_mcp.cli.wording import as_typed
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.relative_times import age_in_words

_HEAD: Final = {
    "robot": "{}",
    "run_id": "run {}",
    "sim_time_s": "at {} s",
    "status": "{}",
    "age_s": "{} old",
    "newest_wall_time": "recorded {}",
}
_TIMES: Final = ("sim_time_s", "since_s")  # lists of them
_NOTES: Final = ("why", "storage", "position_by", "notes", "hint", "left_out")
# Columns that a narrow table drops first, least important first; then those on the right.
_LESS_IMPORTANT: Final = (
    "sha256", "git_commit", "world", "controller", "route", "database", "began_by", "kind_of",
    "own_ms", "step_wait_ms", "real_time_factor", "took_wall_s", "deviation", "pace", "command_id",
    "actions", "runs", "row_count", "age_s", "more", "set_by", "source", "live", "first_id",
    "arguments", "by", "at_s",
)  # fmt: skip
# Columns that are shown as long as two columns fit.
_MOST_IMPORTANT: Final = frozenset(
    {"outcome", "status", "why", "message", "evidence", "reason", "error", "result", "mode", "tool"}
)
# Columns with coloured words, and the colours of those words.
_COLOURED_COLUMNS: Final = frozenset({"outcome", "status", "level", "ended_by", "verdict"})
_COLOURS: Final[Sequence[tuple[str, frozenset[str]]]] = (
    ("green", frozenset({"done", "pass", "running", "ok", "finished"})),
    ("bold red", frozenset({"fail", "failed", "lost", "error", "critical", "crashed", "wrong"})),
    (
        "yellow",
        frozenset({"warn", "warning", "expired", "cancelled", "pruned", "not judged", "paused"}),
    ),
)


@dataclass(frozen=True)
class TextLayout:
    """The layout of answers, in characters.

    Attributes:
        paragraph: Width of a line of text where the terminal has more.
        short: Length up to which members share a paragraph.
        indent: Indentation of what belongs to the line above.
        endless: Width where nobody reads: no line is folded.
        gap: Gap between columns.
        word: Length up to which no column folds a word, such as a time.
        text: Minimum width of a column of texts.
        cell_lines: Lines of a cell on a terminal; a longer text ends with an ellipsis there.
        seconds_up_to: Age up to which it is shown in seconds, to the hundredth.
    """

    paragraph: int = 100
    short: int = 48
    indent: str = "  "
    endless: int = 100_000
    gap: int = 2
    word: int = 24
    text: int = 16
    cell_lines: int = 4
    seconds_up_to: float = 120.0


_LAYOUT: Final = TextLayout()


class Display(NamedTuple):
    """How answers are shown, as the global options say.

    Attributes:
        verbose: Show every column and every detail.
        colour: Whether colours may be used if stdout is a terminal.
    """

    verbose: bool = False
    colour: bool = True


_USUAL: Final = Display()
_display: ContextVar[Display] = ContextVar("display", default=_USUAL)
_recording_read: ContextVar[str] = ContextVar("recording_read", default="")


def set_display(display: Display) -> None:
    """Show the answers of this command in this way."""
    _display.set(display)


def note_recording(database: object) -> None:
    """Remember which recording the command reads, for an error with `--verbose`."""
    _recording_read.set(str(database))


def recording_read() -> str:
    """Return the database of the recording that the command reads; empty if it reads none."""
    return _recording_read.get()


def is_verbose() -> bool:
    """Return whether every detail was asked for."""
    return _display.get().verbose


def has_colour() -> bool:
    """Return whether stdout is a terminal with colours, and nothing forbids them."""
    if not _display.get().colour or os.environ.get("NO_COLOR") or not sys.stdout.isatty():
        return False
    return os.environ.get("TERM", "") not in ("", "dumb")


def print_answer(answer: Mapping[str, Any]) -> None:
    """Print an answer on stdout, its notes last."""
    colour = has_colour()
    for line in answer_lines(answer, width=terminal_width(sys.stdout), colour=colour):
        write_styled(sys.stdout, line)


def answer_lines(
    answer: Mapping[str, Any],
    *,
    width: int = _LAYOUT.paragraph,
    most_rows: int | None = None,
    colour: bool = False,
) -> Iterator[str]:
    """Yield what an answer says in a sentence, its subject and time, then its parts.

    Args:
        answer: The answer as JSON values.
        width: Maximum characters of a line.
        most_rows: Maximum rows of a table, with a note on how many more exist; None for all.
        colour: Whether lines contain the colour codes of a terminal.
    """
    layout = _Layout(width, most_rows, is_of_command="outcome" in answer, colour=colour)
    if summary := answer.get("summary"):
        for line in textwrap.wrap(printable(str(summary)), width, subsequent_indent=_LAYOUT.indent):
            yield _styled(line, "bold") if colour else line
    if head := _head_of(answer):
        for line in textwrap.wrap(", ".join(head), width, subsequent_indent=_LAYOUT.indent):
            yield _styled(line, "dim") if colour else line
    apart = ("summary", *_HEAD, *_NOTES)
    yield from layout.members({k: v for k, v in answer.items() if k not in apart})
    for name in _NOTES:
        value = answer.get(name)
        texts = cast("list[str]", value if isinstance(value, list) else [value] if value else [])
        for text in texts:
            yield from note_lines(f"left out: {text}" if name == "left_out" else text, width)


def _head_of(answer: Mapping[str, Any]) -> list[str]:
    """Return the members of the header as words.

    An age of hours is worded as in sentences. It is left out if the status contains it.
    """
    head: list[str] = []
    for name, text in _HEAD.items():
        value = answer.get(name)
        if name not in answer or (name == "age_s" and " ago" in str(answer.get("status"))):
            continue
        if name == "age_s" and isinstance(value, (int, float)):
            is_short = value < _LAYOUT.seconds_up_to
            value = f"{text_of(value)} s" if is_short else age_in_words(value)
        head.append(text.format(text_of(value)))
    return head


def _styled(line: str, style: str) -> str:
    """Return a line in a style of rich, with the colour codes of a terminal."""
    from rich.style import Style

    return Style.parse(style).render(line)


def note_lines(text: str, width: int = _LAYOUT.paragraph) -> list[str]:
    """Return all notes about an answer."""
    note = f"note: {printable(as_typed(text))}"
    if width >= _LAYOUT.endless:
        return [" ".join(note.split())]
    return textwrap.wrap(
        note,
        min(width, _LAYOUT.paragraph),
        subsequent_indent=_LAYOUT.indent,
        break_on_hyphens=False,
    )


def print_notes(notes: Iterable[str], file: TextIO | None = None) -> None:
    """Print the notes about an answer below it, on stdout or into a file."""
    for note in notes:
        for line in note_lines(note, terminal_width(file or sys.stdout)):
            print(line, file=file)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows under their column names; empty columns are left out."""
    for line in table_lines(columns, rows, terminal_width(sys.stdout), colour=has_colour()):
        write_styled(sys.stdout, line)


def table_lines(
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    width: int = _LAYOUT.endless,
    *,
    colour: bool = False,
) -> Iterator[str]:
    """Yield the lines of a table of at most `width` characters.

    Longer cells are wrapped. Columns that do not fit are left out and named below the table; with
    `--verbose` each row is instead a paragraph that names every value.
    """
    kept = [i for i in range(len(columns)) if any(row[i] is not None for row in rows)]
    least = {i: _minimum_width(columns[i], [row[i] for row in rows]) for i in kept}
    shown = _fitting_columns(columns, least, width)
    if len(shown) < len(kept) and (is_verbose() or len(shown) < 2):
        yield from (line for row in rows for line in _row_in_words(columns, row, width))
        return
    full = {i: max(len(columns[i]), *(len(text_of(row[i])) for row in rows), 1) for i in shown}
    least = {i: least[i] for i in shown}
    widths = _shared_out(width - _LAYOUT.gap * len(shown), least, full)
    yield from _drawn(columns, rows, widths, is_cut=width < _LAYOUT.endless, colour=colour)
    if omitted := [printable(columns[i]) for i in kept if i not in shown]:
        names = ", ".join(omitted)
        yield from textwrap.wrap(
            f"not shown: {names} (--verbose shows all)", width, subsequent_indent=_LAYOUT.indent
        )


def _minimum_width(header: str, values: Sequence[Any]) -> int:
    """Return the width below which a column cannot be read.

    That is the length of its longest word, or of a few words of a text.
    """
    texts = [text_of(value) for value in values]
    words = [word for text in texts for word in text.split()]
    parts = printable(header).replace("_", "_ ").split()
    of_a_text = min(max(map(len, texts), default=0), _LAYOUT.text)
    return max(_longest([*parts, *words]), of_a_text)


def _fitting_columns(columns: Sequence[str], least: Mapping[int, int], width: int) -> list[int]:
    """Return the columns that fit, without the least important ones."""
    order = {name: place for place, name in enumerate(_LESS_IMPORTANT)}

    def importance(index: int) -> tuple[int, int]:
        name = columns[index]
        if name in order:
            return 0, order[name]
        is_extra = name.startswith("@")  # values of other signals at the time of an event
        return (1 if is_extra else 3 if name in _MOST_IMPORTANT else 2), -index

    shown = sorted(least)
    for index in sorted(least, key=importance):
        if sum(least[i] + _LAYOUT.gap for i in shown) <= width + _LAYOUT.gap:
            break
        shown.remove(index)
    return shown


def _drawn(
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    widths: Mapping[int, int],
    *,
    is_cut: bool,
    colour: bool,
) -> Iterator[str]:
    """Yield the lines of a table with columns of these widths."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, _LAYOUT.gap, 0, 0), show_edge=False)
    if colour:
        table.header_style = "dim"
    for index, width in widths.items():
        numbers = all(isinstance(row[index], (int, float, type(None))) for row in rows)
        header = printable(columns[index])
        table.add_column(
            Text(header if len(header) <= width else header.replace("_", "_\n")),
            justify="right" if numbers else "left",
            overflow="fold",
            width=width,
        )
    for row in rows:
        cells = {index: text_of(row[index]) for index in widths}
        if is_cut and not is_verbose():
            cells = {index: _cut(cell, widths[index]) for index, cell in cells.items()}
        table.add_row(
            *(Text(cell, style=_colour_of(columns[i], cell)) for i, cell in cells.items())
        )
    console = Console(
        width=sum(widths.values()) + _LAYOUT.gap * len(widths),
        force_terminal=colour,
        color_system="standard" if colour else None,
        no_color=not colour,
        highlight=False,
        markup=False,
        emoji=False,
    )
    with console.capture() as captured:
        console.print(table)
    yield from (line.rstrip() for line in captured.get().splitlines())


def _cut(text: str, width: int) -> str:
    """Return a text cut to a few lines of a cell, with an ellipsis if something is left out."""
    most = width * _LAYOUT.cell_lines
    return text if len(text) <= most else textwrap.shorten(text, most - 2, placeholder=" ...")


def _colour_of(column: str, cell: str) -> str:
    if column not in _COLOURED_COLUMNS:
        return ""
    return next((colour for colour, words in _COLOURS if cell in words), "")


def _row_in_words(columns: Sequence[str], row: Sequence[Any], width: int) -> list[str]:
    """Return a row as a paragraph that names its columns."""
    named = (
        f"{printable(column)} {text_of(value)}"
        for column, value in zip(columns, row, strict=True)
        if value is not None
    )
    return textwrap.wrap(
        ", ".join(named),
        width,
        subsequent_indent=_LAYOUT.indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _shared_out(space: int, least: Mapping[int, int], full: Mapping[int, int]) -> dict[int, int]:
    """Return the width of each column: what its words need, and a share of the remaining width.

    Columns that need little more are served first.
    """
    widths = dict(least)
    spare = max(space - sum(least.values()), 0)
    wanting = sorted(full, key=lambda index: full[index] - least[index])
    for number, index in enumerate(wanting):
        more = min(full[index] - least[index], spare // (len(wanting) - number))
        widths[index] += max(more, 0)
        spare -= max(more, 0)
    return widths


def _longest(words: Iterable[str]) -> int:
    return min(max(map(len, words), default=1), _LAYOUT.word)


def text_of(value: Any) -> str:
    """Return a value in one line, with control characters escaped."""
    if value is None:
        return ""
    if isinstance(value, float):
        return _number_text(value)
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value).items()
        return printable(", ".join(f"{name} {text_of(member)}" for name, member in members))
    return printable(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))


def printable(text: str) -> str:
    """Return a text in one line, with control characters escaped."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return spelled_out(line)


def id_ranges(numbers: Sequence[int]) -> str | None:
    """Return numbers as a person lists them: 1 to 7, 9."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1][1:] = [number]
        else:
            parts.append([number])
    return ", ".join(" to ".join(map(str, part)) for part in parts) or None


def runs_named(numbers: Sequence[int]) -> str:
    """Return runs as the subject of a sentence: run 4; runs 1 to 3, 7."""
    return f"{'run' if len(numbers) == 1 else 'runs'} {id_ranges(numbers) or 'none'}"


def clock_text(wall_time_s: float) -> str:
    """Return a wall time in local time."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(wall_time_s))


def print_json(found: Any) -> None:
    """Print an answer as JSON for programs; values that are no JSON become texts."""
    print(json.dumps(found, ensure_ascii=False, default=str))


def terminal_width(stream: TextIO) -> int:
    """Return the characters of a line; no limit if stdout is no terminal."""
    return shutil.get_terminal_size().columns if stream.isatty() else _LAYOUT.endless


def _number_text(value: float) -> str:
    """Return a number with 4 significant digits, but never coarser than a thousandth."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:.3f}".rstrip("0").rstrip(".") if abs(value) >= 1 else f"{value:.4g}"


class _Layout:
    """Lay out the parts of an answer below each other."""

    def __init__(
        self, width: int, most_rows: int | None, *, is_of_command: bool, colour: bool
    ) -> None:
        self._width = width
        self._colour = colour
        self._paragraph = min(width, _LAYOUT.paragraph)
        self._most_rows = most_rows
        self._is_of_command = is_of_command
        self._depth = 0  # how far the lines that are made now will be indented

    def members(self, members: Mapping[str, Any]) -> Iterator[str]:
        """Lay out members: short ones share a paragraph, each other one has lines of its own."""
        short = list[str]()
        for name, value in members.items():
            line = "" if _has_members(value) else f"{name} {text_of(value)}"
            if 0 < len(line) <= _LAYOUT.short:
                short.append(line)
                continue
            yield from self._wrapped(short)
            short = []
            yield from self._wrapped([line]) if line else self._part(name, value)
        yield from self._wrapped(short)

    def _series(self, part: Mapping[str, Any]) -> Iterator[str]:
        """Lay out lists that belong to a list of times as columns, and the rest below them."""
        columns = {name: part[name] for name in _TIMES if isinstance(part.get(name), list)}
        (length,) = {len(each) for each in columns.values()}
        rest = _without_lists(part, length, (), columns)
        rows = [list(row) for row in zip(*columns.values(), strict=True)]
        yield from self._table({"columns": list(columns), "rows": rows})
        yield from self.members(rest)

    def _part(self, name: str, value: Any) -> Iterator[str]:
        for part in cast("list[dict[str, Any]]", value if isinstance(value, list) else [value]):
            line = f"{name}: " + ", ".join(f"{each} {text_of(part[each])}" for each in part)
            is_flat = "columns" not in part and not any(map(_has_members, part.values()))
            if is_flat and len(line) <= self._paragraph:
                yield line
                continue
            yield f"{name}:"
            if name == "verdicts":
                part = _as_typed_texts(part)
            # In database rows, null is a value.
            if name == "result" and "rows" in part and not self._is_of_command:
                part = part | {
                    "rows": [["NULL" if v is None else v for v in row] for row in part["rows"]]
                }
            self._depth += 1
            yield from (_LAYOUT.indent + line for line in self._inside(part))
            self._depth -= 1

    def _inside(self, part: Mapping[str, Any]) -> Iterator[str]:
        if {"columns", "rows"} <= part.keys():
            return self._table_with_rest(part)
        if any(isinstance(part.get(name), list) for name in _TIMES):
            return self._series(part)
        return self.members(part)

    def _table_with_rest(self, part: Mapping[str, Any]) -> Iterator[str]:
        yield from self._table(part)
        yield from self.members(
            {k: v for k, v in part.items() if k not in ("columns", "rows", "in_every_row")}
        )

    def _table(self, table: Mapping[str, Any]) -> Iterator[str]:
        rows = table["rows"]
        shared = table.get("in_every_row")
        if shared:
            yield from self._wrapped(f"{name} {text_of(value)}" for name, value in shared.items())
        yield from table_lines(
            table["columns"],
            rows[: self._most_rows],
            self._width - len(_LAYOUT.indent) * max(1, self._depth),
            colour=self._colour,
        )
        if self._most_rows is not None and len(rows) > self._most_rows:
            yield f"... and {len(rows) - self._most_rows} more"

    def _wrapped(self, texts: Iterable[str]) -> list[str]:
        width = min(self._paragraph, self._width - len(_LAYOUT.indent) * self._depth)
        return textwrap.wrap(", ".join(texts), width, subsequent_indent=_LAYOUT.indent)


def _as_typed_texts(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return texts of webots-mcp itself, such as advice, with commands instead of calls."""
    typed: dict[str, Any] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            typed[name] = _as_typed_texts(cast("dict[str, Any]", value))
        else:
            typed[name] = as_typed(value) if isinstance(value, str) else value
    return typed


def _without_lists(
    part: Mapping[str, Any], length: int, path: tuple[str, ...], columns: dict[str, list[Any]]
) -> dict[str, Any]:
    """Return the part without lists of that length, which become columns."""
    rest: dict[str, Any] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            members = cast("dict[str, Any]", value)
            is_series = any(isinstance(members.get(each), list) for each in _TIMES)
            # Their contents have names of their own.
            inner = (*path, *([] if name in ("numbers", "signals") else [name]))
            left = members if is_series else _without_lists(members, length, inner, columns)
            if left:
                rest[name] = left
        elif isinstance(value, list) and len(cast("list[Any]", value)) == length:
            values = cast("list[Any]", value)
            if not _has_members(values):
                columns[" ".join((*path, name))] = values
                continue
            rest[name] = values
        else:
            rest[name] = value
    return rest


def _has_members(value: Any) -> bool:
    """Return whether a value is an object or a list of objects."""
    each = cast("list[Any]", value)[:1] if isinstance(value, list) else [value]
    return any(isinstance(one, dict) for one in each)
