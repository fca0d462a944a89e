"""Where a silent loop is: the stacks of a controller's threads, in a file next to the database.

The bridge lets `faulthandler` write them where the loop gives no sign of life for longer than a
limit. The first line of the file is a JSON object: whose stacks they are, and which files are not
the controller's own. What follows is empty, or what `faulthandler` wrote; its time is that of the
file. The file stays locked while its process lives.

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
_BY_PERSON: Final = "waitForUserInputEvent"  # of Webots' Robot: a key or a click is waited for
_EARLY: Final = 0.9  # of the limit: the clock of files is coarse
_UNTOUCHED_S: Final = 3.0  # the maintainer's thread touches the file each second
_MOST_BYTES: Final = 200_000
_MOST_TEXT: Final = 4000
_MOST_CALLERS: Final = 3
_LONGEST_NAME: Final = 60
# What a file that was made by others raises.
_STRANGE: Final = (OSError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError)


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
        """In a list of callers, where its name is enough."""
        return str(self) if self.function == "<module>" else f"{_cut(self.function)}()"


class Stacks(NamedTuple):
    """What was written of a silent controller.

    Attributes:
        wall_time_s: When, Unix time.
        run: UUID of the run.
        limit_s: How long the loop may be silent.
        calls: Of the loop's thread, the innermost first; never empty.
        own: Of them, those of the controller's own code: neither the bridge's nor a library's.
        is_hang: That code, or what it called, keeps the loop from its step; else it waits for
            Webots in a step, or for a person: in a debugger of Python, for a key or a click.
        is_in_step: It waits for Webots.
        text: All threads, as `faulthandler` wrote them.
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
        """Whether the loop had been silent for the limit since that sign of life."""
        return self.wall_time_s - last_seen_wall_time_s >= _EARLY * self.limit_s

    @property
    def place(self) -> str:
        """Where the loop was, the controller's own code first."""
        place, *callers = self.own or self.calls
        names = " and ".join(call.as_caller for call in callers[:_MOST_CALLERS])
        text = f"{place}, called from {names}" if names else f"{place}"
        return text if place is self.calls[0] else f"{text}; there in {self.calls[0]}"

    def log_values(self, sim_time_s: float | None) -> dict[str, float | str | None]:
        """Of the log row, which is known by its time."""
        text = f"silent for more than {self.limit_s:g} s in {self.place}\n{self.text[:_MOST_TEXT]}"
        return {"sim_time": sim_time_s, "wall_time": self.wall_time_s, "message": text}


def stacks_path(database: Path, session_uuid: str) -> Path:
    """Where the stacks of a session's process are written."""
    return Path(f"{database}-stacks-{session_uuid}.txt")


def read_stacks(file: BinaryIO) -> Stacks | None:
    """What a file holds; None where nothing was written, or it cannot be read."""
    file.seek(0)
    head, _, rest = file.read(_MOST_BYTES).partition(b"\n")
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
    is_held = any(re.search(_DEBUGGER, call.file) or call.function == _BY_PERSON for call in calls)
    hangs = not (is_in_step or is_held)
    written_s = os.fstat(file.fileno()).st_mtime
    return Stacks(written_s, run, limit_s, calls, own, hangs, is_in_step, text)


def is_library(file: str, libraries: tuple[str, ...] = LIBRARIES) -> bool:
    """Whether a file is no controller's own, but Python's, Webots', this package's or installed."""
    return file.startswith(libraries) or re.search(INSTALLED, file) is not None


def stacks_at(path: Path) -> Stacks | None:
    """What the file of a process holds; None where nothing was written."""
    with suppress(*_STRANGE), path.open("rb") as file:
        return read_stacks(file)
    return None


def needs_signal(path: Path, silent_s: float) -> bool:
    """Whether only `SIGNAL` makes a process write the stacks of its silent loop.

    So it is where the loop is silent for the limit, nothing is written, and no thread could touch
    the file either: C code keeps the interpreter's lock. The signal ends what that code waits for
    in the system, such as a `sleep`, early; so nothing less is a reason to send it.

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
        is_stuck = not is_written and untouched_s > limit_s + _UNTOUCHED_S
        return bool(SIGNAL) and about["signal"] == SIGNAL and is_stuck and silent_s >= limit_s
    return False


def _cut(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
