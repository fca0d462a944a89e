"""What a command writes, which a terminal may show: nothing of a recording that it would obey.

It is shown how far long work has come; where stderr is no terminal, by a line every few seconds.

Names, texts and log lines come from controllers and from recordings of others. Whatever a command
prints goes through one stream, in which control characters and such as turn the direction of
writing are spelled out; as JSON escapes, so that JSON stays the same data.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import json
import math
import os
import re
import select
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from types import FrameType
from typing import Any, Final, NamedTuple, TextIO, TypeAlias, cast

from webots_mcp.signals.naming import spelled_out

_INTERVAL_S: Final = 0.1  # between two states of the line of progress
_PLAIN_INTERVAL_S: Final = 3.0  # between two lines where no line can be rewritten
_GRACE_S: Final = 0.5  # for giving back the lease and for commands that nobody waits for any more
_LONGEST_END_S: Final = 2.5  # of a command that cleans up; then it ends as it is
_WORDS: Final = {signal.SIGINT: "ended by Ctrl-C", signal.SIGTERM: "ended by SIGTERM"}
_UNQUOTED: Final = r"(?<![\w'\".-])"  # a quoted name is somebody's data
_NOT_ON: Final = r"(?![\w'\"])"
_OTHERS: Final = {  # by tool: those that are answered by a command of another name or function
    "get_full_state": "tail", "get_robot_state": "tail", "monitor": "tail",
    "breakpoint": "breakpoint", "list_commands breakpoints": "breakpoint",
    "list_commands parameters": "parameters", "set_parameters": "parameters",
    "list_commands outcome": "wait", "list_runs trials": "trials", "run_trials": "trials",
    "plot": "plot", "report": "report",
    "simulation_control": "send", "world_reset": "send reset",
}  # fmt: skip
_FOR_A_CLIENT: Final = {  # what only one who asks by MCP can do, and what a person does
    "start the server with --data-dir or --database": "give --data-dir or --database",
    "the resource webots://schema": "'.schema' in the sqlite3 shell",
}
_TOOL: Final = re.compile(
    r"webots_(?P<tool>\w+)(?:\(what=.(?P<what>\w+).(?:, \w+=(?P<id>\d+))?\))?"
)
_CODE: Final = re.compile(r"(\b(?:bridge\.\w+|MCPBridge)\([^()]*\))")  # of a controller
_PARAGRAPH: Final = 100  # characters of a line of text, where the terminal has more
_SHORT: Final = 48
_INDENT: Final = "  "
_ENDLESS: Final = 100_000
_GAP: Final = 2  # between columns
_LONGEST_WORD: Final = 24  # that no column folds, such as a time
_HEAD: Final = {
    "robot": "{}",
    "run_id": "run {}",
    "sim_time_s": "at {} s",
    "status": "{}",
    "age_s": "{} s old",
}
_TIMES: Final = ("sim_time_s", "since_s")  # lists of them
_CALLED_ALIKE: Final = ("numbers", "signals")  # what they hold has names of its own
_AS_READ: Final = "result"  # rows of a database, where null is a value; or of a command
_OF_TABLE: Final = ("columns", "rows", "in_every_row")
_NOTES: Final = ("why", "storage", "position_by", "notes", "hint", "left_out")


class _SpelledOut:
    """A text stream to another one."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(spelled_out(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class _Bytes(io.RawIOBase):
    """A binary stream to a text stream; what is no UTF-8 is replaced."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._stream.write(self._decoder.decode(bytes(data)))
        return len(data)


@contextlib.contextmanager
def spelling_out() -> Generator[None]:
    """Inside, whatever is printed to stdout or stderr is spelled out."""
    out, err = (cast("TextIO", _SpelledOut(stream)) for stream in (sys.stdout, sys.stderr))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield


def binary_stdout() -> Any:
    """Where data is written as it is; on a terminal it is spelled out as all else."""
    return _Bytes(sys.stdout) if sys.stdout.isatty() else sys.stdout.buffer


def wait(seconds: float) -> None:
    """Wait for the next look, or end where nobody reads a pipe any more (`tail | head`).

    Raises:
        BrokenPipeError: The reader is gone; printing would tell only when there is a line.
    """
    try:
        output = sys.stdout.fileno()
        watch = select.poll()  # not on Windows
    except (AttributeError, OSError):
        return time.sleep(seconds)
    watch.register(output, 0)
    if watch.poll(seconds * 1000):
        raise BrokenPipeError


def rewrite(stream: TextIO, text: str = "") -> None:
    """Put a text in the place of the line that stands there, on a terminal; elsewhere nothing."""
    if stream.isatty():
        raw = stream.stream if isinstance(stream, _SpelledOut) else stream
        raw.write(f"\r{spelled_out(text)}\x1b[K")
        raw.flush()


@contextlib.contextmanager
def shown_progress(doing: str) -> Generator[Callable[[int, int], None]]:
    """A function to call with how much is done and how much there is.

    It writes to stderr, because stdout may be the data: on a terminal one line, which vanishes at
    the end; elsewhere a line every 3 s, so that short work stays silent.
    """
    is_terminal = sys.stderr.isatty()
    next_s = 0.0 if is_terminal else time.monotonic() + _PLAIN_INTERVAL_S

    def show(done: int, of: int) -> None:
        nonlocal next_s
        if time.monotonic() < next_s:
            return
        text = f"{doing}: {100 * done // max(of, 1)} %"
        if is_terminal:
            next_s = time.monotonic() + _INTERVAL_S
            rewrite(sys.stderr, text)
        else:
            next_s = time.monotonic() + _PLAIN_INTERVAL_S
            print(f"webots-mcp: {text}", file=sys.stderr, flush=True)

    if not is_terminal:
        yield show
        return
    try:
        yield show
    finally:
        rewrite(sys.stderr)


@contextlib.contextmanager
def line_of_progress() -> Generator[None]:
    """Inside, `show_progress` has a line, which vanishes at the end."""
    try:
        yield
    finally:
        rewrite(sys.stderr)


async def show_progress(progress: float, total: float | None, text: str) -> None:
    """On a terminal one line that changes; in a pipe nothing, as for all commands."""
    rewrite(sys.stderr, text)


# -- how a command ends before it is done: by Ctrl-C or by SIGTERM --

Handler: TypeAlias = Callable[[int, "FrameType | None"], None]


@contextlib.contextmanager
def ending_by_signals(*, is_process: bool) -> Generator[None]:
    """Let SIGTERM clean up as Ctrl-C does: by a KeyboardInterrupt, which carries the signal.

    A process that SIGTERM has not ended after 2.5 s, because a thread of it still works, ends at
    once: the database rolls back what was being written.

    Args:
        is_process: The command is all that the process does, to the exit of the interpreter, which
            waits for threads.

    Before Python 3.11 anyio's own handling of Ctrl-C ends with a CancelledError.
    """
    as_well = (signal.SIGINT,) if sys.version_info < (3, 11) else ()
    late: list[threading.Timer] = []

    def end(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM and not late:
            late.append(threading.Timer(_LONGEST_END_S, _exit, [number]))
            late[0].daemon = True
            late[0].start()
        _interrupt(number, frame)

    try:
        with _handling(end, signal.SIGTERM, *as_well):
            yield
    finally:
        for timer in late * (not is_process):
            timer.cancel()


@contextlib.contextmanager
def ending_by_event(stopping: threading.Event) -> Generator[None]:
    """Let a signal only set an event, and end the command when what watches it is over.

    This is for work in threads: two exceptions out of handlers break the locks that they meet. A
    second signal ends the process at once.
    """
    came: list[int] = []

    def end(number: int, _: FrameType | None) -> None:
        if came:
            _exit(number)
        came.append(number)
        threading.Thread(target=stopping.set).start()  # whoever holds its lock was interrupted here

    try:
        with _handling(end, *_WORDS):
            yield
    finally:
        if came:
            raise KeyboardInterrupt(came[0])


@contextlib.contextmanager
def ending_in_time() -> Generator[None]:
    """End the process at a signal, after half a second at most, whatever its threads wait for.

    One that reads from a terminal waits for the next line, which nobody will type.
    """
    import logging  # only here: most commands do without it

    def end(number: int, frame: FrameType | None) -> None:
        # A task that the interrupt meets in the middle is no defect that anybody has to read of.
        logging.getLogger("asyncio").disabled = True
        late = threading.Timer(_GRACE_S, _exit, [number])
        late.daemon = True
        late.start()
        _interrupt(number, frame)

    with _handling(end, *_WORDS):
        try:
            yield
        except KeyboardInterrupt as interrupt:
            _exit(*interrupt.args)


@contextlib.contextmanager
def _handling(handler: Handler, *numbers: int) -> Generator[None]:
    """Handle signals; not in a thread that does not get them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [(number, signal.signal(number, handler)) for number in numbers]
    try:
        yield
    finally:
        for number, handled in before:
            signal.signal(number, handled)


def ended_by(interrupt: KeyboardInterrupt) -> tuple[int, str]:
    """The exit code of a process that a signal has ended, and a word about it."""
    number = signal.Signals(interrupt.args[0] if interrupt.args else signal.SIGINT)
    return 128 + number, _WORDS[number]


def _interrupt(number: int, _: FrameType | None) -> None:
    raise KeyboardInterrupt(number)


def _exit(number: int) -> None:
    code, word = ended_by(KeyboardInterrupt(number))
    with contextlib.suppress(OSError):
        print(f"webots-mcp: {word}", file=sys.stderr, flush=True)
    os._exit(code)


# -- texts in the words of the command line: `last_s=-3` is `--last -3` there --
#
# The questions call their arguments as the MCP tools do. Of the command that runs it is known by
# which option each is typed. Hints that name a tool name the command that answers the same.

_running: ContextVar[tuple[Typed, ...]] = ContextVar("running", default=())


def speak_of(arguments: Iterable[Typed]) -> None:
    """Let `as_typed` speak of these arguments: those of the command that runs."""
    _running.set(tuple(arguments))


def running() -> tuple[Typed, ...]:
    """The arguments of the command that runs."""
    return _running.get()


class Typed(NamedTuple):
    """An argument, as a person types it.

    Attributes:
        turned_off: Of a flag, the option that turns it off; empty where there is none.
    """

    name: str
    typed: str
    value_name: str
    turned_off: str = ""


def value_name(option: str) -> str:
    """The word for an option's value, as help shows it."""
    return option.lstrip("-").replace("-", "_").upper()


def as_typed(text: str) -> str:
    """The text with a person's options instead of the names of arguments.

    A name that is a common word (`since`) is meant only where a value follows it, or where it is
    joined to another one ("since and until").
    """
    parts = _CODE.split(text)
    parts[::2] = map(_text_as_typed, parts[::2])
    return "".join(parts)


def _text_as_typed(text: str) -> str:
    for of_a_client, of_a_person in _FOR_A_CLIENT.items():
        text = text.replace(of_a_client, of_a_person)
    text = _TOOL.sub(_command_for, text)
    typed = {each.name: each.typed for each in _running.get()}
    for each in _running.get():
        shown = f"{each.typed} {each.value_name}" if each.typed.startswith("-") else each.typed
        text = re.sub(rf"{_UNQUOTED}{each.name}=(\[['.]+\]|\.\.\.)", shown, text)
        text = re.sub(rf"{_UNQUOTED}{each.name}=true\b", each.typed, text)
        text = re.sub(rf"{_UNQUOTED}{each.name}=false\b", each.turned_off or each.typed, text)
        text = re.sub(rf"{_UNQUOTED}{each.name}=", f"{each.typed} ", text)
        if "_" in each.name:
            text = re.sub(rf"{_UNQUOTED}{each.name}{_NOT_ON}", each.typed, text)
    words = "|".join(name for name in typed if "_" not in name)
    if not words:
        return text
    for form in (
        rf"(?<=\bwith )(?:this )?({words}){_NOT_ON}",
        rf"(?<=\bsee )({words}){_NOT_ON}",
        rf"{_UNQUOTED}({words})(?= for more)",
    ):
        text = re.sub(form, lambda found: typed[found[1]], text)
    joined = rf"{_UNQUOTED}({words}) (and|or) ({words}){_NOT_ON}"
    return re.sub(joined, lambda found: f"{typed[found[1]]} {found[2]} {typed[found[3]]}", text)


def commands_by_tool() -> dict[str, str]:
    """The command that answers what a tool does, by the tool's name without `webots_`."""
    from webots_mcp.cli.commands import COMMANDS

    return {each.name.removeprefix("webots_"): name for name, each in COMMANDS.items()} | _OTHERS


def _command_for(found: re.Match[str]) -> str:
    """The command that answers what a tool does; the tool itself where there is none."""
    tool, what, number = found["tool"], found["what"], found["id"]
    command = commands_by_tool().get(f"{tool} {what}" if what else tool)
    whole = f"{command} {number}" if number else command
    return f"'webots-mcp {whole}'" if command else found[0]


# -- answers as text --
#
# Tables fit the terminal, by folding their cells; in a pipe each row is one line. Notes are wrapped
# and never cut.


def print_answer(answer: Mapping[str, Any]) -> None:
    """Print an answer on stdout, its notes last."""
    for line in answer_lines(answer, width=terminal_width(sys.stdout)):
        print(line)


def answer_lines(
    answer: Mapping[str, Any], *, width: int = _PARAGRAPH, most_rows: int | None = None
) -> Iterator[str]:
    """Whom and when the answer is about in one line, then part by part what it says.

    Args:
        answer: As JSON knows it.
        width: Of the lines, characters.
        most_rows: Of tables; it is said how many more there are. None for all.
    """
    layout = _Layout(width, most_rows, is_of_command="outcome" in answer)
    head = [text.format(text_of(answer[name])) for name, text in _HEAD.items() if name in answer]
    if head:
        yield from textwrap.wrap(", ".join(head), width, subsequent_indent=_INDENT)
    apart = (*_HEAD, *_NOTES)
    yield from layout.members({k: v for k, v in answer.items() if k not in apart})
    for name in _NOTES:
        value = answer.get(name)
        texts = cast("list[str]", value if isinstance(value, list) else [value] if value else [])
        for text in texts:
            yield from note_lines(f"left out: {text}" if name == "left_out" else text, width)


def note_lines(text: str, width: int = _PARAGRAPH) -> list[str]:
    """What there is to know about an answer, whole."""
    lines = textwrap.wrap(
        f"note: {printable(as_typed(text))}", min(width, _PARAGRAPH), subsequent_indent=_INDENT
    )
    return lines if width < _ENDLESS else [" ".join(map(str.strip, lines))]


def print_notes(notes: Iterable[str], file: TextIO | None = None) -> None:
    """What there is to know about an answer, below it; on stdout, or in that file."""
    for note in notes:
        for line in note_lines(note, terminal_width(file or sys.stdout)):
            print(line, file=file)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print rows under their column names; columns that are empty throughout are left out."""
    for line in table_lines(columns, rows, terminal_width(sys.stdout)):
        print(line)


def table_lines(
    columns: Sequence[str], rows: Sequence[Sequence[Any]], width: int = _ENDLESS
) -> Iterator[str]:
    """The lines of a table that is no wider than so many characters; what is longer is folded.

    Where not even the longest words of its columns fit beside each other, each row is a paragraph.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    kept = [i for i in range(len(columns)) if any(row[i] is not None for row in rows)]
    headers = {index: printable(columns[index]) for index in kept}
    words = {i: [word for row in rows for word in text_of(row[i]).split()] for i in kept}
    if sum(_longest([headers[i], *words[i]]) + _GAP for i in kept) > width:
        headers = {index: header.replace("_", "_\n") for index, header in headers.items()}
    least = {i: _longest([*headers[i].split(), *words[i]]) for i in kept}
    full = {i: max(len(headers[i]), *(len(text_of(row[i])) for row in rows), 1) for i in kept}
    if sum(least.values()) + _GAP * len(kept) > width:
        return (line for row in rows for line in _row_in_words(columns, row, width))
    widths = _shared_out(width - _GAP * len(kept), least, full)
    table = Table(box=None, pad_edge=False, padding=(0, _GAP, 0, 0), show_edge=False)
    for index in kept:
        numbers = all(isinstance(row[index], (int, float, type(None))) for row in rows)
        table.add_column(
            Text(headers[index]),
            justify="right" if numbers else "left",
            overflow="fold",
            width=widths[index],
        )
    for row in rows:
        table.add_row(*(Text(text_of(row[index])) for index in kept))
    wide = sum(widths.values()) + _GAP * len(kept)
    console = Console(width=wide, color_system=None, highlight=False, markup=False, emoji=False)
    with console.capture() as captured:
        console.print(table)
    return (line.rstrip() for line in captured.get().splitlines())


def _row_in_words(columns: Sequence[str], row: Sequence[Any], width: int) -> list[str]:
    """A row as a paragraph that names its columns."""
    named = (
        f"{printable(column)} {text_of(value)}"
        for column, value in zip(columns, row, strict=True)
        if value is not None
    )
    return textwrap.wrap(
        ", ".join(named),
        width,
        subsequent_indent=_INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _shared_out(room: int, least: Mapping[int, int], full: Mapping[int, int]) -> dict[int, int]:
    """The width of each column: what its words need, and what is left for those that want more.

    Those that want little more come first.
    """
    widths = dict(least)
    spare = max(room - sum(least.values()), 0)
    wanting = sorted(full, key=lambda index: full[index] - least[index])
    for number, index in enumerate(wanting):
        more = min(full[index] - least[index], spare // (len(wanting) - number))
        widths[index] += max(more, 0)
        spare -= max(more, 0)
    return widths


def _longest(words: Iterable[str]) -> int:
    return min(max(map(len, words), default=1), _LONGEST_WORD)


def text_of(value: Any) -> str:
    """A value in one line; what a terminal would obey is spelled out instead."""
    if value is None:
        return ""
    if isinstance(value, float):
        return _number_text(value)
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value).items()
        return printable(", ".join(f"{name} {text_of(member)}" for name, member in members))
    return printable(value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))


def printable(text: str) -> str:
    """A text in one line, with what a terminal would obey spelled out."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return spelled_out(line)


def id_ranges(numbers: Sequence[int]) -> str | None:
    """Numbers as a person lists them: 1 to 7, 9."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1][1:] = [number]
        else:
            parts.append([number])
    return ", ".join(" to ".join(map(str, part)) for part in parts) or None


def clock_text(wall_time_s: float) -> str:
    """A wall time in local time."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(wall_time_s))


def print_json(found: Any) -> None:
    """Print an answer for programs; what is no JSON as its text."""
    print(json.dumps(found, ensure_ascii=False, default=str))


def terminal_width(stream: TextIO) -> int:
    """The characters of a line; no limit where nobody looks at it."""
    return shutil.get_terminal_size().columns if stream.isatty() else _ENDLESS


def _number_text(value: float) -> str:
    """4 significant digits, but never coarser than a thousandth."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:.3f}".rstrip("0").rstrip(".") if abs(value) >= 1 else f"{value:.4g}"


class _Layout:
    """How the parts of an answer stand below each other."""

    def __init__(self, width: int, most_rows: int | None, *, is_of_command: bool) -> None:
        self._width = width
        self._paragraph = min(width, _PARAGRAPH)
        self._most_rows = most_rows
        self._is_of_command = is_of_command

    def members(self, members: Mapping[str, Any]) -> Iterator[str]:
        """Short members stand together in a paragraph, each other one on lines of its own."""
        short = list[str]()
        for name, value in members.items():
            line = "" if _has_members(value) else f"{name} {text_of(value)}"
            if 0 < len(line) <= _SHORT:
                short.append(line)
                continue
            yield from self._wrapped(short)
            short = []
            yield from self._wrapped([line]) if line else self._part(name, value)
        yield from self._wrapped(short)

    def _series(self, part: Mapping[str, Any]) -> Iterator[str]:
        """Lists that belong to a list of times are columns; what is left stands below them."""
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
            if name == _AS_READ and "rows" in part and not self._is_of_command:
                part = part | {
                    "rows": [["NULL" if v is None else v for v in row] for row in part["rows"]]
                }
            yield from (_INDENT + line for line in self._inside(part))

    def _inside(self, part: Mapping[str, Any]) -> Iterator[str]:
        if {"columns", "rows"} <= part.keys():
            return self._table_with_rest(part)
        if any(isinstance(part.get(name), list) for name in _TIMES):
            return self._series(part)
        return self.members(part)

    def _table_with_rest(self, part: Mapping[str, Any]) -> Iterator[str]:
        yield from self._table(part)
        yield from self.members({k: v for k, v in part.items() if k not in _OF_TABLE})

    def _table(self, table: Mapping[str, Any]) -> Iterator[str]:
        rows = table["rows"]
        shared = table.get("in_every_row")
        if shared:
            yield from self._wrapped(f"{name} {text_of(value)}" for name, value in shared.items())
        yield from table_lines(
            table["columns"], rows[: self._most_rows], self._width - len(_INDENT)
        )
        if self._most_rows is not None and len(rows) > self._most_rows:
            yield f"... and {len(rows) - self._most_rows} more"

    def _wrapped(self, texts: Iterable[str]) -> list[str]:
        return textwrap.wrap(", ".join(texts), self._paragraph, subsequent_indent=_INDENT)


def _without_lists(
    part: Mapping[str, Any], length: int, path: tuple[str, ...], columns: dict[str, list[Any]]
) -> dict[str, Any]:
    """The part without lists of that length, which become columns; without what is empty then."""
    rest: dict[str, Any] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            members = cast("dict[str, Any]", value)
            is_series = any(isinstance(members.get(each), list) for each in _TIMES)
            inner = (*path, *([] if name in _CALLED_ALIKE else [name]))
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
    """Whether it is an object, or a list of such."""
    each = cast("list[Any]", value)[:1] if isinstance(value, list) else [value]
    return any(isinstance(one, dict) for one in each)
