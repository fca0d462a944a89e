"""The controller's own stack frames: where they are, and three lines of their source.

Frames of Python's library, of installed packages, of Webots and of the bridge are left out.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from stat import S_ISREG
from types import FrameType, TracebackType
from typing import Any, Final, NamedTuple

from webots_mcp.database.secret_names import SecretNames
from webots_mcp.database.thread_stacks import is_library

MOST_FRAMES: Final = 8
_MOST_KNOWN_FILES: Final = 10_000  # of which it is remembered whether they are the controller's own
_EXAMPLES: Final = f"{Path(__file__).parents[2] / 'examples'}{os.sep}"  # of this package: own code
_LINES_AROUND: Final = 1  # before and after the line
_MOST_FILES: Final = 50
_MOST_FILE_BYTES: Final = 1_000_000
_LONGEST_LINE: Final = 160
_LITERAL: Final = r"['\"]|(?<!\w)\d"
_WITH_SECRET: Final = "(left out: it names a secret and may hold its value)"


def _kinds_of_locals() -> tuple[type, ...]:
    """Return the classes of what a function's frame gives: from Python 3.13 on it is no dict."""
    return dict, type(sys._getframe().f_locals)  # pyright: ignore[reportPrivateUsage]


_LOCALS: Final = frozenset(map(id, _kinds_of_locals()))
_TEXT: Final = frozenset((id(str),))


class OwnFrame(NamedTuple):
    """A frame of the controller's own code, and the line that it executes."""

    frame: FrameType
    line: int

    @property
    def variables(self) -> Mapping[str, Any]:
        """Its local variables; none where a class body has a mapping of the user's."""
        names = self.frame.f_locals
        return names if id(type(names)) in _LOCALS and has_text_keys(names) else {}

    @property
    def module_variables(self) -> Mapping[str, Any]:
        """The names of its module."""
        names = self.frame.f_globals
        return names if type(names) is dict and has_text_keys(names) else {}


def has_text_keys(names: Mapping[Any, Any]) -> bool:
    """Return whether all keys are texts: looking up any other may call the user's `__eq__`."""
    return _TEXT.issuperset(map(id, map(type, names)))


def own_frames(frame: FrameType | None, most: int = MOST_FRAMES) -> list[OwnFrame]:
    """Return the controller's own frames, the innermost first, from `frame` outwards."""
    found: list[OwnFrame] = []
    while frame is not None and len(found) < most:
        if is_own(frame.f_code.co_filename):
            found.append(OwnFrame(frame, frame.f_lineno))
        frame = frame.f_back
    return found


def frames_of_error(traceback: TracebackType | None, most: int = MOST_FRAMES) -> list[OwnFrame]:
    """Return the controller's own frames that an exception came through, the innermost first."""
    found = [
        OwnFrame(each.tb_frame, each.tb_lineno)
        for each in _each_of(traceback)
        if is_own(each.tb_frame.f_code.co_filename)
    ]
    return found[-most:][::-1]


def _each_of(traceback: TracebackType | None) -> Iterator[TracebackType]:
    while traceback is not None:
        yield traceback
        traceback = traceback.tb_next


_own_files: dict[str, bool] = {}


def is_own(file: str) -> bool:
    """Return whether a file is the controller's own; each is judged once."""
    known = _own_files.get(file)
    if known is None:
        known = not is_library(file) or file.startswith(_EXAMPLES)
        if len(_own_files) < _MOST_KNOWN_FILES:
            _own_files[file] = known
    return known


class SourceLines:
    """Reads lines of source files, each file once.

    A file that was changed after the controller had started has other lines than the code that
    runs: none of them are given.

    Args:
        started_s: When the controller had started, in Unix time.
        secrets: Names next to which no text or number is shown.
    """

    def __init__(self, started_s: float, secrets: SecretNames) -> None:
        self._started_s = started_s
        self._secrets = secrets
        self._lines: dict[str, list[str]] = {}

    def around(self, own: OwnFrame) -> list[str]:
        """Return the line of a frame with the ones before and after it; empty if not known."""
        lines = self._lines_of(own.frame.f_code.co_filename)
        first = max(own.line - 1 - _LINES_AROUND, 0)
        shown = lines[first : own.line + _LINES_AROUND]
        return [_WITH_SECRET if self._has_secret(line) else line[:_LONGEST_LINE] for line in shown]

    def _has_secret(self, line: str) -> bool:
        """Return whether a line names a secret next to a text or a number, which may be its value.

        The project's patterns are for whole names.
        """
        if re.search(_LITERAL, line) is None:
            return False
        return self._secrets.has(line) or any(map(self._secrets.has, re.findall(r"\w+", line)))

    def _lines_of(self, file: str) -> list[str]:
        lines = self._lines.get(file)
        if lines is None:
            lines = self._read(file)
            if len(self._lines) < _MOST_FILES:
                self._lines[file] = lines
        return lines

    def _read(self, file: str) -> list[str]:
        try:
            path = Path(file)
            about = path.stat()  # reading a pipe would block, or take what is not for the bridge
            if not S_ISREG(about.st_mode) or about.st_size > _MOST_FILE_BYTES:
                return []
            if about.st_mtime > self._started_s:
                return []
            # `splitlines` would also break a line at a form feed, where Python does not.
            return path.read_text("utf-8-sig", "replace").split("\n")
        except (OSError, ValueError):  # a name such as "<string>", or with a null character
            return []
