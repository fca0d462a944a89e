"""A stand-in for Webots: a small, deterministic simulator for tests and first steps.

It is not Webots and does not try to be. It has a flat arena with upright boxes, cylinders and
balls, robots on driven wheels, and sixteen kinds of devices. It reproduces how Webots treats
controllers: processes, blocking, pause, reset, reload, and what each call returns or refuses.

It simplifies the physics: robots collide as discs; a Solid with Physics is pushed along without
turning or rolling on; rays are level; there is no noise and no torque, and nothing falls. Nodes of
unknown types are left out of a world with a warning. Functions that the stand-in's `controller`
package lacks raise an error. 'webots-mcp help standin' lists what there is.

Controllers run unchanged: `from controller import Robot` finds the stand-in's `controller` package
in their processes. Importing this package makes that package importable in this process as well.
Only plugins and `webots_mcp.testing` import the stand-in.

- `Simulation` runs a world with its controllers as real processes.
- `InProcessRobot` and `InProcessSupervisor` are robots for unit tests, without any process.
"""

from __future__ import annotations

from webots_mcp.standin.controller_path import LIBRARY  # first: the others import `controller`
from webots_mcp.standin.in_process import InProcessRobot, InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.simulator import Mode
from webots_mcp.standin.stand_in_simulation import StandInSimulation as Simulation
from webots_mcp.standin.standin_errors import RequestAfterEndError as ControllerEndedError
from webots_mcp.standin.standin_errors import StandInError, WorldError, WouldBlockError

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
