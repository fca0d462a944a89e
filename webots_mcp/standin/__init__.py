"""A stand-in for Webots: a small, deterministic simulator for tests and first steps.

It is not Webots and does not try to be: a flat arena with upright boxes, cylinders and balls,
robots on two driven wheels, seven kinds of devices. What it does reproduce is how Webots treats
controllers: processes, blocking, pause, reset, reload, and what each call returns or refuses.

Simpler than in Webots: robots are discs where they touch something; what has Physics is pushed
along without turning or rolling on; rays are level; there is no noise, no gravity and no torque;
worlds are made of base nodes, without PROTOs.

Controllers run unchanged: `from controller import Robot` finds the stand-in's `controller` package
in their processes. Importing this package makes it importable here as well.

- `Simulation` runs a world with its controllers as real processes.
- `InProcessRobot` and `InProcessSupervisor` are robots for unit tests, without any process.
"""

import sys
from pathlib import Path

LIBRARY = Path(__file__).parent / "lib"
"""The folder that holds the `controller` package; it belongs in front of PYTHONPATH."""

_loaded = sys.modules.get("controller")
if _loaded is not None and str(LIBRARY) not in str(_loaded.__file__):
    raise ImportError(
        f"another package named controller is loaded, from {_loaded.__file__}: import "
        "webots_mcp.standin before it, or leave Webots' own out of PYTHONPATH"
    )
if str(LIBRARY) not in sys.path:
    sys.path.insert(0, str(LIBRARY))

from webots_mcp.standin.errors import (  # noqa: E402 - needs the path above
    ControllerEndedError,
    StandInError,
    WorldError,
    WouldBlockError,
)
from webots_mcp.standin.in_process import (  # noqa: E402
    InProcessRobot,
    InProcessSimulation,
    InProcessSupervisor,
)
from webots_mcp.standin.simulation import Simulation  # noqa: E402
from webots_mcp.standin.simulator import Mode  # noqa: E402

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
