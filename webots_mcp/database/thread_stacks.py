"""Shows where a silent loop is: stacks of a controller's threads, in a file next to the database.

The bridge lets `faulthandler` write them if the loop gives no sign of life for longer than a limit.
The first line of the file is a JSON object: the run, the thread, and which files are libraries. The
rest is what `faulthandler` wrote, if anything; the time of the file is when. The file stays locked
while its process lives.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import os
import re
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

VERSION: Final = "webots_mcp_stacks"
FORMAT: Final = 1
LOGGER: Final = "stacks"  # of the log rows
SIGNAL: Final = getattr(signal, "SIGRTMAX", 5) - 5  # 0, none, but on Linux
STEPPING: Final = ("step", "stepBegin", "stepEnd")  # methods in which a controller waits for Webots
# Patterns are texts, which `re` compiles when they are needed: rarely in a controller.
_THREAD: Final = (
    r"(?m)^(?:Current thread|Thread) 0x([0-9a-f]+)[^\n]*\(most recent call first\):"
    r"\n((?:  .*\n?)*)"
)
_CALL: Final = r'(?m)^  File "(.*)", line (\S+) in (.*)$'
# Folders whose files are no controller's own: this package's, and Python's.
LIBRARIES: Final = (f"{Path(__file__).parents[1]}{os.sep}", f"{Path(os.__file__).parent}{os.sep}")
INSTALLED: Final = (
    r"[/\\](?:site|dist)-packages[/\\]|[/\\]lib[/\\]controller[/\\]python[/\\]|^<frozen "
)
_DEBUGGER: Final = r"(?:[/\\]|^)(?:bdb|pdb)\.py$|[/\\](?:pydevd|debugpy|_pydev)"
# The errors that a file of unknown origin may raise.
_STRANGE: Final = (OSError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError)


class StackLimits(NamedTuple):
    """Limits of what is read from a file of stacks.

    Attributes:
        early_share: Share of the limit of silence, because the clock of files is coarse.
        untouched_s: Age from which the maintainer's thread counts as stuck; normally it touches the
            file once a second.
        file_bytes: Size up to which a file is read.
        text_characters: Length at which the text in a log row is cut.
        callers: Callers that a place names.
        name_characters: Length at which a name is cut.
    """

    early_share: float = 0.9
    untouched_s: float = 3.0
    file_bytes: int = 200_000
    text_characters: int = 4000
    callers: int = 3
    name_characters: int = 60


_LIMITS: Final = StackLimits()


class Call(NamedTuple):
    """A function that was being executed: its file, line and name."""

    file: str
    line: str
    function: str

    def __str__(self) -> str:
        name = re.split(r"[/\\]", self.file)[-1]
        place = f"{_cut(name)}:{self.line}"
        return place if self.function == "<module>" else f"{place}, {_cut(self.function)}()"

    @property
    def as_caller(self) -> str:
        """Its name in a list of callers."""
        return str(self) if self.function == "<module>" else f"{_cut(self.function)}()"


class Stacks(NamedTuple):
    """The stacks of a silent controller.

    Attributes:
        wall_time_s: When they were written, in Unix time.
        run: UUID of the run.
        limit_s: How long the loop may be silent.
        calls: The calls of the loop's thread, the innermost first; never empty.
        own: Those calls that are the controller's own code, neither the bridge's nor a library's.
        is_hang: Whether that code, or what it called, keeps the loop from its step. Otherwise the
            loop waits for Webots in a step, or for a person: in a debugger, for a key or a click.
        is_in_step: Whether the loop waits for Webots.
        text: The stacks of all threads, as `faulthandler` wrote them.
    """

    wall_time_s: float
    run: str
    limit_s: float
    calls: list[Call]
    own: list[Call]
    is_hang: bool
    is_in_step: bool
    text: str

    def began_after(self, last_seen_wall_time_s: float) -> bool:
        """Return whether the loop had been silent for the limit since that sign of life."""
        return self.wall_time_s - last_seen_wall_time_s >= _LIMITS.early_share * self.limit_s

    @property
    def place(self) -> str:
        """Where the loop was, the controller's own code first."""
        place, *callers = self.own or self.calls
        names = " and ".join(call.as_caller for call in callers[: _LIMITS.callers])
        text = f"{place}, called from {names}" if names else f"{place}"
        return text if place is self.calls[0] else f"{text}; there in {self.calls[0]}"

    def log_values(self, sim_time_s: float | None) -> dict[str, float | str | None]:
        """Return the values of the log row, which its time identifies."""
        shown = self.text[: _LIMITS.text_characters]
        text = f"silent for more than {self.limit_s:g} s in {self.place}\n{shown}"
        return {"sim_time": sim_time_s, "wall_time": self.wall_time_s, "message": text}


def stacks_path(database: Path, session_uuid: str) -> Path:
    """Return the file in which the stacks of a session's process are written."""
    return Path(f"{database}-stacks-{session_uuid}.txt")


def read_stacks(file: BinaryIO) -> Stacks | None:
    """Read the stacks in a file; None if there are none, or it cannot be read."""
    file.seek(0)
    head, _, rest = file.read(_LIMITS.file_bytes).partition(b"\n")
    text = rest.decode("utf-8", "replace")
    try:
        about = json.loads(head)
        run, limit_s = str(about["run"]), float(about["limit_s"])
        threads = {int(thread, 16): calls for thread, calls in re.findall(_THREAD, text)}
        calls = [Call(*call) for call in re.findall(_CALL, threads[about["thread"]])]
        steps, libraries = (tuple(map(str, about[name])) for name in ("step_files", "libraries"))
        run.encode()
    except _STRANGE:
        return None
    if not calls or about.get(VERSION) != FORMAT:
        return None
    waits = [call for call in calls if call.function in STEPPING and call.file in steps]
    own = [call for call in calls if call not in waits and not is_library(call.file, libraries)]
    inner = calls[: calls.index(own[0])] if own else calls
    is_in_step = any(call in waits for call in inner)
    # of Webots' Robot: it waits for a key or a click
    is_held = any(
        re.search(_DEBUGGER, call.file) or call.function == "waitForUserInputEvent"
        for call in calls
    )
    hangs = not (is_in_step or is_held)
    written_s = os.fstat(file.fileno()).st_mtime
    return Stacks(written_s, run, limit_s, calls, own, hangs, is_in_step, text)


def is_library(file: str, libraries: tuple[str, ...] = LIBRARIES) -> bool:
    """Return whether a file belongs to Python, Webots, this package or an installed one."""
    return file.startswith(libraries) or re.search(INSTALLED, file) is not None


def stacks_at(path: Path) -> Stacks | None:
    """Read the stacks of a process; None if there are none."""
    with suppress(*_STRANGE), path.open("rb") as file:
        return read_stacks(file)
    return None


def needs_signal(path: Path, silent_s: float) -> bool:
    """Return whether only `SIGNAL` makes a process write the stacks of its silent loop.

    That is the case if the loop is silent for the limit, nothing is written, and no thread has
    touched the file: C code holds the interpreter's lock. The signal may end a system call of that
    code early, such as a `sleep`, so there must be no other way.

    Args:
        path: The file of the process.
        silent_s: For how long its loop has given no sign of life.
    """
    with suppress(*_STRANGE), path.open("rb") as file:
        about, untouched_s = (
            json.loads(file.readline()),
            time.time() - os.fstat(file.fileno()).st_mtime,
        )
        is_written, limit_s = bool(file.read(1)), float(about["limit_s"])
        is_stuck = not is_written and untouched_s > limit_s + _LIMITS.untouched_s
        return bool(SIGNAL) and about["signal"] == SIGNAL and is_stuck and silent_s >= limit_s
    return False


def _cut(name: str) -> str:
    return (
        name if len(name) <= _LIMITS.name_characters else f"{name[: _LIMITS.name_characters - 1]}…"
    )
