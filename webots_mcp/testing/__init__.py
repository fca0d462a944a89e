"""Testing a controller: what it records, and simulations that stop where a test wants them to.

The pytest plugin (`webots_mcp.pytest_plugin`) offers these as fixtures; they need no pytest.
"""

from webots_mcp.testing.commands import RecordedCommand
from webots_mcp.testing.factories import RobotFactory, SimulationFactory
from webots_mcp.testing.recording import Recording
from webots_mcp.testing.rehearsal import Rehearsal
from webots_mcp.testing.signals import RecordedSignal
from webots_mcp.testing.simulation import RecordedSimulation

__all__ = [
    "RecordedCommand",
    "RecordedSignal",
    "RecordedSimulation",
    "Recording",
    "Rehearsal",
    "RobotFactory",
    "SimulationFactory",
]
