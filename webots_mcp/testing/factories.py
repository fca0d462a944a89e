"""What makes robots and simulations for a test; the fixtures of the pytest plugin are these."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, overload

from webots_mcp.parameter import Value
from webots_mcp.standin import InProcessRobot, InProcessSimulation, InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.testing.rehearsal import Rehearsal
from webots_mcp.testing.simulation import RecordedSimulation

World = str | Path | InProcessSimulation


class RobotFactory:
    """Makes robots of the stand-in, without a process."""

    def __init__(self, root: Path | None = None) -> None:
        """Worlds that are named by a relative path lie in `root`; None for the current folder."""
        self._root = root or Path()

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
            world: A .wbt file, by its path in `root` or an absolute one; or the `simulation` of
                another robot to share its world.
            supervisor: Whether it is of the class `Supervisor`, else `Robot`.
            duration_s: Of a world that is loaded for it: after so much simulated time its `step`
                returns -1.

        Raises:
            WorldError: The world cannot be used or has no such robot.
            StandInError: Another object controls the robot.
        """
        if not isinstance(world, InProcessSimulation):
            world = Rehearsal(self._root / world, duration_s=duration_s)
        kind = InProcessSupervisor if supervisor else InProcessRobot
        return kind(name, world=world)


class SimulationFactory:
    """Starts simulations whose controllers record into folders of the test's."""

    def __init__(
        self,
        folder: Path,
        root: Path | None = None,
        on_start: Callable[[RecordedSimulation], object] = lambda _: None,
    ) -> None:
        """Nothing is started yet.

        Args:
            folder: Each simulation gets a data folder of its own in it.
            root: Where worlds and controllers lie that are named by a relative path; None for the
                current folder.
            on_start: Is called with each simulation that was started.
        """
        self._folder = folder
        self._root = root or Path()
        self._on_start = on_start
        self._started: list[RecordedSimulation] = []

    @property
    def databases(self) -> list[Path]:
        """Those in which the simulations have recorded."""
        asked = (each.recording.database for each in self._started)
        return [each for each in asked if isinstance(each, Path) and each.is_file()]

    def __call__(
        self,
        world: str | Path = DEFAULT_WORLD,
        *,
        data_dir: Path | None = None,
        controllers: Mapping[str, str | Path] | None = None,
        environment: Mapping[str, str] | None = None,
        parameters: Mapping[str, Value] | None = None,
        console: Callable[[str], object] | None = None,
    ) -> RecordedSimulation:
        """A simulation that is paused before its first step; arguments and errors as there."""
        files = {name: self._root / file for name, file in (controllers or {}).items()}
        simulation = RecordedSimulation(
            self._root / world,
            data_dir=data_dir or self._folder / f"mcp_data_{len(self._started) + 1}",
            controllers=files,
            environment=environment,
            parameters=parameters,
            console=console,
        )
        self._started.append(simulation)
        simulation.start()
        self._on_start(simulation)
        return simulation

    def close(self) -> None:
        """End all that were started."""
        for simulation in self._started:
            simulation.close()
