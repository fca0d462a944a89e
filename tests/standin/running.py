"""What tests with controller processes have in common."""

from __future__ import annotations

from pathlib import Path

from webots_mcp.standin import Simulation

LOOP = """
while robot.step(16) != -1:
    pass
print("ended")
"""
"""The end of most controllers."""


def fast(world: Path) -> Simulation:
    """A simulation as fast as it can be."""
    return Simulation(world, mode="fast")


def has_line(simulation: Simulation, text: str) -> bool:
    """Whether a line of the console has this text in it."""
    return any(text in line for line in simulation.console)
