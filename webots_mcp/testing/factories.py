"""What makes robots and simulations for a test; the fixtures of the pytest plugin are these."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, overload

from webots_mcp.standin import InProcessRobot, InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.testing.rehearsal import Rehearsal
from webots_mcp.testing.simulation import RecordedSimulation

World = str | Path | InProcessSimulation


class RobotFactory:
    """Makes robots of the stand-in, without a process."""

    @overload
    def __call__(
        self,
        name: str | None = None,
        *,
        world: World = DEFAULT_WORLD,
        supervisor: Literal[True] = True,
        duration_s: float = math.inf,
    ) -> InProcessSupervisor: ...

    @overload
    def __call__(
        self,
        name: str | None = None,
        *,
        world: World = DEFAULT_WORLD,
        supervisor: Literal[False],
        duration_s: float = math.inf,
    ) -> InProcessRobot: ...

    def __call__(
        self,
        name: str | None = None,
        *,
        world: World = DEFAULT_WORLD,
        supervisor: bool = True,
        duration_s: float = math.inf,
    ) -> InProcessRobot:
        """A robot of a world.

        Args:
            name: The robot's name; None for the first.
            world: A .wbt file, or the `simulation` of another robot to share its world.
            supervisor: Whether it is of the class `Supervisor`, else `Robot`.
            duration_s: Of a world that is loaded for it: after so much simulated time its `step`
                returns -1.

        Raises:
            WorldError: The world cannot be used or has no such robot.
            StandInError: Another object controls the robot.
        """
        if not isinstance(world, InProcessSimulation):
            world = Rehearsal(world, duration_s=duration_s)
        kind = InProcessSupervisor if supervisor else InProcessRobot
        return kind(name, world=world)


class SimulationFactory:
    """Starts simulations whose controllers record into folders of the test's."""

    def __init__(self, folder: Path) -> None:
        """Nothing is started yet; each simulation gets a data folder of its own in `folder`."""
        self._folder = folder
        self._started: list[RecordedSimulation] = []

    def __call__(
        self,
        world: str | Path = DEFAULT_WORLD,
        *,
        data_dir: Path | None = None,
        controllers: Mapping[str, str | Path] | None = None,
        environment: Mapping[str, str] | None = None,
        console: Callable[[str], object] | None = None,
    ) -> RecordedSimulation:
        """A simulation that is paused before its first step; arguments and errors as there."""
        simulation = RecordedSimulation(
            world,
            data_dir=data_dir or self._folder / f"mcp_data_{len(self._started) + 1}",
            controllers=controllers,
            environment=environment,
            console=console,
        )
        self._started.append(simulation)
        simulation.start()
        return simulation

    def close(self) -> None:
        """End all that were started."""
        for simulation in self._started:
            simulation.close()
