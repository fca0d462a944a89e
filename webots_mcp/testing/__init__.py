"""Testing a controller: what it records, and simulations that stop where a test wants them to.

The pytest plugin (`webots_mcp.pytest_plugin`) offers these as fixtures; they need no pytest.
"""

from webots_mcp.testing.recorded_signal import RecordedSignal
from webots_mcp.testing.recorded_simulation import (
    RecordedSimulation,
    Rehearsal,
    RobotFactory,
    SimulationFactory,
)
from webots_mcp.testing.robot_recording import RecordedCommand, RobotRecording

__all__ = [
    "RecordedCommand",
    "RecordedSignal",
    "RecordedSimulation",
    "Rehearsal",
    "RobotFactory",
    "RobotRecording",
    "SimulationFactory",
]
