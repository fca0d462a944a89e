"""Where a silent loop is: the stacks of a controller's threads, in a file next to the database.

The bridge lets `faulthandler` write them where the loop gives no sign of life for longer than a
limit. Its timer is a thread of C that needs no lock of the interpreter, so that it also works where
C code never returns. The first line of the file is a JSON object: whose stacks they are, and which
files are not the controller's own. What follows is empty, or what `faulthandler` wrote; its time is
that of the file. The file stays locked while its process lives.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO, Final, NamedTuple, cast

VERSION: Final = "webots_mcp_stacks"
FORMAT: Final = 1
LOGGER: Final = "stacks"  # of the log rows
STEPPING: Final = ("step", "stepBegin", "stepEnd")  # methods in which a controller waits for Webots
_THREAD: Final = re.compile(
    r"^(?:Current thread|Thread) 0x([0-9a-f]+)[^\n]*\(most recent call first\):\n((?:  .*\n?)*)",
    re.MULTILINE,
)
_FRAME: Final = re.compile(r'^  File "(.*)", line (\S+) in (.*)$', re.MULTILINE)
_INSTALLED: Final = re.compile(r"[/\\](?:site|dist)-packages[/\\]|^<frozen ")
_DEBUGGER: Final = re.compile(r"(?:[/\\]|^)(?:bdb|pdb)\.py$|[/\\](?:pydevd|debugpy|_pydev)")
_EARLY: Final = 0.9  # of the limit: the clock of files is coarse
_MOST_BYTES: Final = 200_000
_MOST_TEXT: Final = 4000
_MOST_CALLERS: Final = 3
_LONGEST_NAME: Final = 60


class Call(NamedTuple):
    """A function that was being executed: its file, line and name."""

    file: str
    line: str
    function: str

    @property
    def file_name(self) -> str:
        """The file without its folders, of whichever system."""
        path = PureWindowsPath(self.file) if "\\" in self.file else PurePosixPath(self.file)
        return _cut(path.name)

    def __str__(self) -> str:
        place = f"{self.file_name}:{self.line}"
        return place if self.function == "<module>" else f"{place}, {_cut(self.function)}()"

    @property
    def as_caller(self) -> str:
        """In a list of callers, where its name is enough."""
        return str(self) if self.function == "<module>" else f"{_cut(self.function)}()"


class Stacks(NamedTuple):
    """What was written of a silent controller.

    Attributes:
        wall_time_s: When, Unix time.
        about: The first line of the file.
        calls: Of the loop's thread, the innermost first; never empty.
        text: All threads, as `faulthandler` wrote them.
    """

    wall_time_s: float
    about: dict[str, Any]
    calls: list[Call]
    text: str

    @property
    def is_in_step(self) -> bool:
        """Whether the loop waits for Webots in the library's step, called by its own code."""
        inner = self.calls[: self.calls.index(own[0])] if (own := self._own) else self.calls
        return any(c.function in STEPPING and c.file in self._named("step_files") for c in inner)

    @property
    def is_in_debugger(self) -> bool:
        """Whether a person has stopped it with a debugger of Python."""
        return any(_DEBUGGER.search(call.file) for call in self.calls)

    @property
    def is_hang(self) -> bool:
        """Whether the controller's own code, or what it called, keeps the loop from its step."""
        return not (self.is_in_step or self.is_in_debugger)

    def began_after(self, last_seen_wall_time_s: float) -> bool:
        """Whether the loop had been silent for the limit since that sign of life."""
        return self.wall_time_s - last_seen_wall_time_s >= _EARLY * self.limit_s

    @property
    def limit_s(self) -> float:
        """How long the loop had been silent when they were written."""
        limit_s = self.about.get("limit_s")
        return float(limit_s) if isinstance(limit_s, (int, float)) else 0.0

    @property
    def place(self) -> str:
        """Where the loop was, the controller's own code first."""
        own = self._own or self.calls
        callers = " and ".join(call.as_caller for call in own[1 : 1 + _MOST_CALLERS])
        text = f"{own[0]}{f', called from {callers}' if callers else ''}"
        return text if own[0] is self.calls[0] else f"{text}; there in {self.calls[0]}"

    @property
    def message(self) -> str:
        """The log row."""
        return f"silent for more than {self.limit_s:g} s in {self.place}\n{self.text[:_MOST_TEXT]}"

    @property
    def _own(self) -> list[Call]:
        """The calls of the controller's own code: neither the bridge's nor a library's."""
        return [call for call in self.calls if self._is_own(call)]

    def _is_own(self, call: Call) -> bool:
        if (call.function in STEPPING and call.file in self._named("step_files")) or (
            _INSTALLED.search(call.file)
        ):
            return False
        return not call.file.startswith(tuple(self._named("libraries")))

    def _named(self, key: str) -> list[str]:
        found = self.about.get(key)
        return [str(e) for e in cast("list[Any]", found)] if isinstance(found, list) else []


def stacks_path(database: Path, session_uuid: str) -> Path:
    """Where the stacks of a session's process are written."""
    return Path(f"{database}-stacks-{session_uuid}.txt")


def stacks_paths(database: Path) -> list[Path]:
    """The files of all sessions of a database, of living ones too."""
    try:
        return sorted(database.parent.glob(f"{database.name}-stacks-*.txt"))
    except OSError:
        return []


def read_stacks(file: BinaryIO) -> Stacks | None:
    """What a file holds; None where nothing was written, or it cannot be read."""
    file.seek(0)
    head, _, rest = file.read(_MOST_BYTES).partition(b"\n")
    try:
        about = json.loads(head)
    except (ValueError, RecursionError):
        return None
    if not isinstance(about, dict) or cast("dict[str, Any]", about).get(VERSION) != FORMAT:
        return None
    about, text = cast("dict[str, Any]", about), rest.decode("utf-8", "replace")
    for thread, calls in _THREAD.findall(text):
        found = [Call(*call) for call in _FRAME.findall(calls)]
        if found and int(thread, 16) == about.get("thread"):
            return Stacks(os.fstat(file.fileno()).st_mtime, about, found, text)
    return None


def stacks_at(path: Path) -> Stacks | None:
    """What the file at that path holds; None where there is none."""
    try:
        with path.open("rb") as file:
            return read_stacks(file)
    except OSError:
        return None


def _cut(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
