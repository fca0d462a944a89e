"""What can go wrong with the stand-in, as one small tree of exceptions.

StandInError
├── WorldError            the world file cannot be used; names the line
├── WouldBlockError       the call would wait for ever: the simulation is paused
└── ControllerEndedError  the API was used after `step` had returned -1
"""

from __future__ import annotations


class StandInError(Exception):
    """Anything the stand-in refuses to do."""


class WorldError(StandInError):
    """A world file that the stand-in cannot use."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message if line is None else f"line {line}: {message}")
        self.line = line


class WouldBlockError(StandInError):
    """An in-process `step` that would never return, because the simulation is paused."""


class ControllerEndedError(StandInError):
    """The API was used after `step` had returned -1.

    A controller process would end here without a word (C `exit`); in process that would end the
    whole test run, hence an exception.
    """
