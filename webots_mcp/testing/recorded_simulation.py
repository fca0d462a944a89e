"""Robots and simulations for tests, in the test's own process or with real controller processes.

The fixtures of the pytest plugin are a `RobotFactory` and a `SimulationFactory`.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar, overload

from webots_mcp.contract import (
    DATA_DIR_VARIABLE,
    DATABASE_NAME,
    PARAMETERS_VARIABLE,
    THROTTLE_VARIABLE,
)
from webots_mcp.database.connection import connect
from webots_mcp.database.pause_states import PAUSED
from webots_mcp.database.schema import require_current
from webots_mcp.errors import WebotsMCPError
from webots_mcp.signals.parameter import Value as ParameterValue
from webots_mcp.standin import (
    InProcessRobot,
    InProcessSimulation,
    InProcessSupervisor,
    Mode,
    Simulation,
    StandInError,
    WouldBlockError,
)
from webots_mcp.standin.controllers import Controller
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.store.robots import resolve_robot
from webots_mcp.testing.robot_recording import RobotRecording

if TYPE_CHECKING:
    from controller.simulator_link import Message

HOLD_LIMIT_S: Final = 2.0
"""How long a pause may hold a loop that nobody can resume, in wall time."""
_CONSOLE_LINES: Final = 30
T = TypeVar("T")
World = str | Path | InProcessSimulation


class Rehearsal(InProcessSimulation):
    """An `InProcessSimulation` that ends by itself, so that a whole control loop can be tested.

    After `duration_s` of simulated time, `step` returns -1, as when a person closes Webots. A pause
    that nothing in the process can end raises an error.
    """

    def __init__(self, world: str | Path = DEFAULT_WORLD, *, duration_s: float = math.inf) -> None:
        """Load a world, running fast.

        Args:
            world: A .wbt file.
            duration_s: Simulated time after which it ends.

        Raises:
            WorldError: The world cannot be used.
        """
        super().__init__(world)
        self._duration_s = duration_s
        self._held_since_s: float | None = None

    def take(self, link: Any, message: Message) -> None:
        """Answer a controller's request, unless time has to pass first.

        Raises:
            WouldBlockError: The loop calls `step`, and a pause has held it for 2 s of wall time.
                Other requests are answered, so that the end of the test can resume.
        """
        if self.mode is not Mode.PAUSE or message[:2] == ("ask", "simulation_set_mode"):
            self._held_since_s = None
        elif self._held_since_s is None:
            self._held_since_s = time.monotonic()
        elif message[0] == "step" and time.monotonic() - self._held_since_s > HOLD_LIMIT_S:
            raise WouldBlockError(
                f"the simulation is paused and nobody resumed it for {HOLD_LIMIT_S:g} s: send "
                "'resume' before get_command() takes the 'pause', or run the controller as a "
                "process with webots_simulation"
            )
        super().take(link, message)

    def _advance(self) -> None:
        super()._advance()
        if self.time_s >= self._duration_s and self.exit_status is None:
            self.quit()


class RecordedSimulation(Simulation):
    """A `Simulation` whose controllers record into a folder of the test.

    It begins paused, before the first step. `run_for` runs it as fast as possible and pauses it
    after exactly that much simulated time, so that the recording does not depend on the speed of
    the machine. Other methods are buttons of the window, as in `Simulation`.
    """

    def __init__(
        self,
        world: str | Path = DEFAULT_WORLD,
        *,
        data_dir: Path,
        controllers: Mapping[str, str | Path] | None = None,
        environment: Mapping[str, str] | None = None,
        parameters: Mapping[str, ParameterValue] | None = None,
        console: Callable[[str], object] | None = None,
    ) -> None:
        """Load a world; nothing runs before `start` or `with`.

        Args:
            world: A .wbt file.
            data_dir: Folder that bridges record in by default.
            controllers: Controller files by robot name, instead of those that the world names.
            environment: Variables for the controllers, on top of those of this process.
            parameters: Start values of the controllers' parameters, instead of those in the code.
            console: Called with each line of Webots' console.

        Raises:
            WorldError: The world cannot be used.
            StandInError: The world has no such robot, or a controller file is missing.
        """
        self._ends_in_s = 0.0
        self._seen_s = 0.0
        super().__init__(
            world,
            mode="pause",
            console=console,
            controllers=controllers,
            environment={
                DATA_DIR_VARIABLE: str(data_dir),
                THROTTLE_VARIABLE: "1",
                **({PARAMETERS_VARIABLE: json.dumps(dict(parameters))} if parameters else {}),
                **(environment or {}),
            },
        )
        for name, file in (controllers or {}).items():
            self.controller(name)
            if not Path(file).is_file():
                raise StandInError(f"the controller of {name!r} is missing: {Path(file).resolve()}")
        self.recording = RobotRecording(data_dir / DATABASE_NAME)
        """The recording of the controllers; use `recording.robot(name)` if there are several."""

    def run_for(self, duration_s: float, timeout_s: float = 60.0) -> None:
        """Run for that much simulated time, then pause.

        It returns earlier if a controller or another thread pauses or quits the simulation. By
        then, every controller has published what belongs to the last step.

        Args:
            duration_s: Simulated time, rounded up to a multiple of the basic time step.
            timeout_s: Maximum time to wait, in seconds of wall time.

        Raises:
            AssertionError: A controller ended with an error. The text ends with the console.
            TimeoutError: It took too long. The text names the controllers that hang, and ends
                with the console.
            StandInError: The simulation has been quit.
        """
        self._seen_s, self._ends_in_s = self.time_s, duration_s
        self.fast()
        self.wait_for(self._is_at_rest, timeout_s)
        for controller in self.controllers:
            if controller.exit_code:
                raise AssertionError(
                    f"the controller of {controller.name!r} ended with status "
                    f"{controller.exit_code}; the console says:\n{self._last_lines()}"
                )

    def wait_for(self, condition: Callable[[], T], timeout_s: float = 10.0) -> T:
        """Wait until a condition holds; the error begins with the controllers that hang."""
        try:
            return super().wait_for(condition, timeout_s)
        except TimeoutError as error:
            hanging = [why for each in self.controllers if (why := self._why_hung(each))]
            raise TimeoutError("\n".join([*hanging, str(error)])) from None

    def _why_hung(self, controller: Controller) -> str | None:
        """Return why the simulation waits for this controller; None if it does not."""
        if controller.holds_up and not self._is_held(controller.name):
            connected = controller.connection is not None
            what = "does not come to its next step()" if connected else "has made no Robot() yet"
        elif controller.has_left and controller.is_running:
            what = "has let go of its robot, but its process does not end"
        else:
            return None
        which = "an extern program" if controller.file is None else f"{controller.file}"
        return (
            f"the controller of {controller.name!r} ({which}, process {controller.pid}) {what}; "
            f"simulated time stands at {self.time_s:g} s"
        )

    def _notice(self) -> None:
        """Pause at the end of `run_for`. Called in the simulation's thread after each step."""
        now_s = self.time_s
        passed_s = (
            now_s - self._seen_s if now_s >= self._seen_s else now_s
        )  # A smaller time means a reset.
        self._seen_s = now_s
        if self._ends_in_s > 0.0:
            self._ends_in_s = round(self._ends_in_s - passed_s, 9)
            if self._ends_in_s <= 0.0:
                self._set_mode(Mode.PAUSE)
        super()._notice()

    def _is_at_rest(self) -> bool:
        if not self.is_running:
            return True
        return self.mode is Mode.PAUSE and not any(map(self._why_hung, self.controllers))

    def _is_held(self, name: str) -> bool:
        """Return whether a bridge holds the controller's loop until it is resumed."""
        try:
            with closing(connect(self.recording.database, "reader")) as connection:
                require_current(connection)
                session = resolve_robot(connection, name, time.time()).session
        except WebotsMCPError:  # Nothing was recorded yet.
            return False
        return session is not None and session.pause_state == PAUSED

    def _last_lines(self) -> str:
        return "\n".join(self.console[-_CONSOLE_LINES:])


class RobotFactory:
    """Makes robots of the stand-in within the test's process."""

    def __init__(self, root: Path | None = None) -> None:
        """Find worlds with relative paths in `root`; None for the current folder."""
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
        """Make a robot of a world.

        Args:
            name: The robot's name; None for the first.
            world: A .wbt file, relative to `root` or absolute; or the `simulation` of another robot
                to share its world.
            supervisor: Whether its class is `Supervisor` rather than `Robot`.
            duration_s: Simulated time after which `step` returns -1. It has no effect on a shared
                world.

        Raises:
            WorldError: The world cannot be used or has no such robot.
            StandInError: Another object controls the robot.
        """
        if not isinstance(world, InProcessSimulation):
            world = Rehearsal(self._root / world, duration_s=duration_s)
        kind = InProcessSupervisor if supervisor else InProcessRobot
        return kind(name, world=world)


class SimulationFactory:
    """Starts simulations whose controllers record into folders of the test."""

    def __init__(
        self,
        folder: Path,
        root: Path | None = None,
        on_start: Callable[[RecordedSimulation], object] = lambda _: None,
    ) -> None:
        """Start nothing yet.

        Args:
            folder: Folder for the data folder of each simulation.
            root: Folder of worlds and controllers with relative paths; None for the current one.
            on_start: Called with each simulation that was started.
        """
        self._folder = folder
        self._root = root or Path()
        self._on_start = on_start
        self._started: list[RecordedSimulation] = []

    @property
    def databases(self) -> list[Path]:
        """Return the databases that the simulations have recorded in."""
        asked = (each.recording.database for each in self._started)
        return [each for each in asked if isinstance(each, Path) and each.is_file()]

    def __call__(
        self,
        world: str | Path = DEFAULT_WORLD,
        *,
        data_dir: Path | None = None,
        controllers: Mapping[str, str | Path] | None = None,
        environment: Mapping[str, str] | None = None,
        parameters: Mapping[str, ParameterValue] | None = None,
        console: Callable[[str], object] | None = None,
    ) -> RecordedSimulation:
        """Start a simulation, paused before its first step; see `RecordedSimulation`."""
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
        """End all simulations that were started."""
        for simulation in self._started:
            simulation.close()
