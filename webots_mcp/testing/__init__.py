"""Testing a controller: what it records, and simulations that stop where a test wants them to.

The pytest plugin offers these as fixtures; they need no pytest. Only tests import this package. It
may import the stand-in, the judgements and everything below. Its names are imported when first
asked for, since each pytest run loads the plugin.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from webots_mcp.testing.recording import (
        RecordedCommand,
        RecordedSignal,
        RobotRecording,
    )
    from webots_mcp.testing.simulation import (
        RecordedSimulation,
        Rehearsal,
        RobotFactory,
        SimulationFactory,
    )

__all__ = [
    "RecordedCommand",
    "RecordedSignal",
    "RecordedSimulation",
    "Rehearsal",
    "RobotFactory",
    "RobotRecording",
    "SimulationFactory",
]

_OF_SIMULATION = ("RecordedSimulation", "Rehearsal", "RobotFactory", "SimulationFactory")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = f"{__name__}.{'simulation' if name in _OF_SIMULATION else 'recording'}"
    globals()[name] = value = getattr(import_module(module), name)
    return value
