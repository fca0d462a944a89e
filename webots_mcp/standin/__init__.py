"""A stand-in for Webots: a small, deterministic simulator for tests and first steps.

It is not Webots and does not try to be: a flat arena with upright boxes, cylinders and balls,
robots on driven wheels, sixteen kinds of devices. What it does reproduce is how Webots treats
controllers: processes, blocking, pause, reset, reload, and what each call returns or refuses.

Simpler than in Webots: robots are discs where they touch something; what has Physics is pushed
along without turning or rolling on; rays are level; there is no noise, no torque, nothing falls.
Nodes of a world that are not known here are left out with a warning, functions of the package that
are not there fail with a sentence; docs/standin.md lists what there is.

Controllers run unchanged: `from controller import Robot` finds the stand-in's `controller` package
in their processes. Importing this package makes it importable here as well.

- `Simulation` runs a world with its controllers as real processes.
- `InProcessRobot` and `InProcessSupervisor` are robots for unit tests, without any process.
"""

from __future__ import annotations

from webots_mcp.standin.controller_path import LIBRARY  # first: the others import `controller`
from webots_mcp.standin.in_process import InProcessRobot, InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.simulation import StandInSimulation as Simulation
from webots_mcp.standin.simulator import Mode
from webots_mcp.standin.vrml import RequestAfterEndError as ControllerEndedError
from webots_mcp.standin.vrml import StandInError, WorldError, WouldBlockError

__all__ = [
    "LIBRARY",
    "ControllerEndedError",
    "InProcessRobot",
    "InProcessSimulation",
    "InProcessSupervisor",
    "Mode",
    "Simulation",
    "StandInError",
    "WorldError",
    "WouldBlockError",
]
