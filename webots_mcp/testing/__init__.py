"""Testing a controller by what it records, in simulations that a test starts and stops.

The pytest plugin offers these classes as fixtures; they need no pytest. Only tests import this
package. It may import the stand-in, `judging` and everything below. Its names are imported on first
use, since each pytest run loads the plugin.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from webots_mcp.testing.recorded_command import RecordedCommand
    from webots_mcp.testing.recorded_signal import RecordedSignal
    from webots_mcp.testing.recorded_simulation import (
        RecordedSimulation,
        Rehearsal,
        RobotFactory,
        SimulationFactory,
    )
    from webots_mcp.testing.robot_recording import RobotRecording
    from webots_mcp.testing.same_commands import assert_same_commands

__all__ = [
    "RecordedCommand",
    "RecordedSignal",
    "RecordedSimulation",
    "Rehearsal",
    "RobotFactory",
    "RobotRecording",
    "SimulationFactory",
    "assert_same_commands",
]

_MODULES = {
    "RecordedCommand": "recorded_command", "RecordedSignal": "recorded_signal",
    "RobotRecording": "robot_recording", "assert_same_commands": "same_commands",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{_MODULES.get(name, 'recorded_simulation')}")
    globals()[name] = value = getattr(module, name)
    return value
