"""The errors of the stand-in.

StandInError
├── WorldError            the world file cannot be used; the text names the line
├── WouldBlockError       the call would wait for ever, because the simulation is paused
└── RequestAfterEndError  a request was made after `step` had returned -1
"""

from __future__ import annotations

from webots_mcp.worlds.world_errors import WorldFileError


class StandInError(Exception):
    """Base of all errors of the stand-in."""


class WorldError(WorldFileError, StandInError):
    """A world file that the stand-in cannot use."""


class WouldBlockError(StandInError):
    """An in-process `step` that would never return, because the simulation is paused."""


class RequestAfterEndError(StandInError):
    """A request after `step` had returned -1; `webots_mcp.standin.ControllerEndedError`.

    A controller process would end silently here (C `exit`). Within the test's process that would
    end the whole test run, therefore this is an exception.
    """
