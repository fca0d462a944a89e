"""The errors that are about a recording, a question to it, or a command.

Arguments of a wrong type or value are Python's TypeError and ValueError; the stand-in has a tree
of its own.

    WebotsMCPError
    ├── DatabaseError               the file, not the question, is the problem
    │   ├── NoDatabaseError         nothing has been recorded there yet
    │   ├── ForeignDatabaseError    the file is not a recording of this package
    │   ├── ForkedProcessError      a parent process has the file open
    │   ├── MalformedRowError       a row holds a value that no bridge has written
    │   ├── SessionGoneError        the session that is being recorded was deleted
    │   ├── SchemaTooNewError       a newer webots-mcp wrote it
    │   └── SchemaTooOldError       an older webots-mcp wrote it
    ├── PoolError                   the store of many recordings is the problem
    │   ├── PoolUnavailableError    it is away, restarts or is full: worth trying again
    │   └── PoolBusyError           another ships the same recording
    ├── InvalidInputError           the question is the problem; the text says how to ask
    │   ├── UnknownRobotError
    │   ├── AmbiguousRobotError
    │   ├── UnknownRunError
    │   ├── UnknownSignalError
    │   ├── UnknownActionError
    │   ├── InvalidConditionError
    │   └── InvalidRangeError
    ├── NothingRecordedError        the question is fine, the recording has no answer yet
    ├── NotAllowedError             the project's file does not allow it: which line does not
    │   └── ConsentRequiredError    it does if the person agrees, who was not asked
    ├── LeaseLostError              another process does by now what this one did
    ├── ConditionFailedError        a condition met values that it cannot be asked of
    └── CommandRefusedError         the simulation or the robot cannot do what was asked
        └── InterruptedCommandError something else ended it before it was done
            └── ControllerEndedError

Each message names the value that was wrong and the next step to take.

A condition that stops no work is not an error: `warn` writes it as a line on stderr.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from types import MappingProxyType


class WebotsMCPError(Exception):
    """Root of the errors about recordings, questions and commands.

    Attributes:
        left_out: The rows that no bridge has written and that were not looked at; for want of them
            something may be missing.
    """

    left_out: tuple[str, ...] = ()


class DatabaseError(WebotsMCPError):
    """The database file cannot be used as it is."""


class NoDatabaseError(DatabaseError):
    """There is no database yet: no controller has recorded there."""


class ForeignDatabaseError(DatabaseError):
    """The file is no SQLite database, or belongs to another application."""


class ForkedProcessError(DatabaseError):
    """SQLite cannot open the file in this process, because of the one that forked it."""


class MalformedRowError(DatabaseError):
    """A row holds a value that cannot be read; the file is whole."""


class SessionGoneError(DatabaseError):
    """The row of a session that still records, or whose rows still wait, was deleted."""


class SchemaTooNewError(DatabaseError):
    """The database was written by a newer version of this package."""


class SchemaTooOldError(DatabaseError):
    """The database was written by an older version of this package."""


class PoolError(WebotsMCPError):
    """A pool cannot be used as it is."""


class PoolUnavailableError(PoolError):
    """A pool does not answer, restarts or has no room: the same may succeed later."""


class PoolBusyError(PoolError):
    """Another process ships the same recording to the same pool just now."""


class InvalidInputError(WebotsMCPError):
    """An argument is out of bounds, or contradicts another."""


class UnknownRobotError(InvalidInputError):
    """No robot of that name has been recorded."""


class AmbiguousRobotError(InvalidInputError):
    """Several robots are possible and none was named."""


class UnknownRunError(InvalidInputError):
    """No run of that id has been recorded."""


class UnknownSignalError(InvalidInputError):
    """No signal of that name has been recorded."""


class UnknownActionError(InvalidInputError):
    """The robot's controller has registered no such action."""


class InvalidConditionError(InvalidInputError):
    """A condition is not in the language; the text says where, and what would be."""


class InvalidRangeError(InvalidInputError):
    """A time range is empty, reversed or contradictory."""


class NothingRecordedError(WebotsMCPError):
    """The question is fine, but nothing has been recorded that answers it."""


class NotAllowedError(WebotsMCPError):
    """A rule of the project's `webots-mcp.toml` forbids it, or that file is invalid.

    Attributes:
        rule: The file, the line, and what stands there.
    """

    def __init__(self, text: str, rule: str) -> None:
        super().__init__(text)
        self.rule = rule


class ConsentRequiredError(NotAllowedError):
    """A rule of the project's `webots-mcp.toml` allows it only if the person agrees.

    Attributes:
        request_id: The row of the request, if it has one.
    """

    request_id: int | None = None


class LeaseLostError(WebotsMCPError):
    """Another process took a job over from this one, which had been stopped for too long."""


class ConditionFailedError(WebotsMCPError):
    """A condition met values that it cannot be asked of: is a text less than a number?"""


class CommandRefusedError(WebotsMCPError):
    """The simulation or the robot cannot do what a command asked for.

    Attributes:
        answer: What became of the command, where one was sent.
    """

    answer: Mapping[str, object] = MappingProxyType({})


class InterruptedCommandError(CommandRefusedError):
    """Something ended a command that was under way; the text says what."""


class ControllerEndedError(InterruptedCommandError):
    """The controller, or its bridge, ended while a command was under way."""


def warn(text: str) -> None:
    """Write a line for the person who runs the controller or the server.

    A stderr that is full, closed or (under pythonw) not there costs the line, nothing else.
    """
    if sys.stderr is None:  # pyright: ignore[reportUnnecessaryComparison]
        return
    try:
        print(f"webots-mcp: {text}", file=sys.stderr, flush=True)  # noqa: T201
    except (OSError, ValueError):
        return
