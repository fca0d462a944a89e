"""Protect the streams of a command: no content of a recording can control a terminal.

Names, texts and log lines come from controllers and from other people's recordings. Control
characters, and those that change the direction of writing, are written as JSON escapes, so that
JSON keeps its meaning. Progress appears on stderr: in one line on a terminal, elsewhere every few
seconds.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import select
import sys
import threading
import time
from collections.abc import Callable, Generator
from typing import Any, Final, TextIO, cast

from webots_mcp.signals.naming import spelled_out

_PLAIN_INTERVAL_S: Final = 3.0  # between two lines where a line cannot be rewritten
_BAR_CELLS: Final = 20


class _SpelledOut:
    """A text stream that escapes control characters for another one."""

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
    """A binary stream for a text stream; invalid UTF-8 is replaced."""

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
    """Escape control characters in everything printed to stdout or stderr in this context."""
    out, err = (cast("TextIO", _SpelledOut(stream)) for stream in (sys.stdout, sys.stderr))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield


def binary_stdout() -> Any:
    """Return a stream that writes data unchanged; on a terminal, control characters are escaped."""
    return _Bytes(sys.stdout) if sys.stdout.isatty() else sys.stdout.buffer


def wait(seconds: float) -> None:
    """Wait before the next poll, or end if the reader of a pipe has closed it (`tail | head`).

    Raises:
        BrokenPipeError: The reader has closed the pipe; printing would only report that with a
            line.
    """
    try:
        output = sys.stdout.fileno()
        watch = select.poll()  # not available on Windows
    except (AttributeError, OSError):
        return time.sleep(seconds)
    watch.register(output, 0)
    if watch.poll(seconds * 1000):
        raise BrokenPipeError


def write_styled(stream: TextIO, line: str) -> None:
    """Write a line with colours whose parts are already escaped."""
    raw = stream.stream if isinstance(stream, _SpelledOut) and "\x1b[" in line else stream
    print(line, file=raw)


def rewrite(stream: TextIO, text: str = "") -> None:
    """Replace the current line on a terminal; elsewhere do nothing."""
    if stream.isatty():
        raw = stream.stream if isinstance(stream, _SpelledOut) else stream
        raw.write(f"\r{spelled_out(text)}\x1b[K")
        raw.flush()


def progress_bar(done: int, of: int) -> str:
    """Return a bar for a terminal, with a space behind it."""
    full = min(_BAR_CELLS, _BAR_CELLS * done // max(of, 1))
    return f"[{'#' * full}{'.' * (_BAR_CELLS - full)}] "


@contextlib.contextmanager
def shown_progress(doing: str) -> Generator[Callable[[int, int], None]]:
    """Provide a function to call with the amount done and the total.

    It writes to stderr, because stdout may hold the data: on a terminal one line, which disappears
    at the end; elsewhere a line every 3 s, so that short work stays silent.
    """
    is_terminal = sys.stderr.isatty()
    next_s = 0.0 if is_terminal else time.monotonic() + _PLAIN_INTERVAL_S

    def show(done: int, of: int) -> None:
        nonlocal next_s
        if time.monotonic() < next_s:
            return
        text = (
            f"{doing}: {progress_bar(done, of) if is_terminal else ''}{100 * done // max(of, 1)} %"
        )
        if is_terminal:
            next_s = time.monotonic() + 0.1
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
def shown_activity(doing: str) -> Generator[None]:
    """Show on stderr for how long work of unknown length has been running.

    On a terminal it is one line after the first second, which disappears at the end; elsewhere a
    line every 3 s, so that short work stays silent.
    """
    ended = threading.Event()
    stream, is_terminal = sys.stderr, sys.stderr.isatty()
    started_s = time.monotonic()

    def show() -> None:
        while not ended.wait(1.0 if is_terminal else _PLAIN_INTERVAL_S):
            text = f"{doing}: {time.monotonic() - started_s:.0f} s"
            with contextlib.suppress(OSError, ValueError):  # the reader has closed the pipe
                if is_terminal:
                    rewrite(stream, text)
                else:
                    print(f"webots-mcp: {text}", file=stream, flush=True)

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        rewrite(stream)


@contextlib.contextmanager
def line_of_progress() -> Generator[None]:
    """Give `show_progress` a line in this context, which disappears at the end."""
    try:
        yield
    finally:
        rewrite(sys.stderr)


async def show_progress(progress: float, total: float | None, text: str) -> None:
    """Rewrite one line on a terminal; do nothing in a pipe."""
    rewrite(sys.stderr, text)
