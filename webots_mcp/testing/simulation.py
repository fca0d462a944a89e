"""A simulation with real controller processes that stops where a test wants it to stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Final

from webots_mcp.connection import connect
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, THROTTLE_VARIABLE
from webots_mcp.errors import WebotsMCPError
from webots_mcp.schema import require_current
from webots_mcp.standin import Mode, Simulation, StandInError
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.store.robots import resolve_robot
from webots_mcp.testing.recording import Recording

_CONSOLE_LINES: Final = 30


class RecordedSimulation(Simulation):
    """A `Simulation` whose controllers record into a folder of the test's.

    It begins paused, before the first step. `run_for` lets it run as fast as it can and pauses it
    after exactly that much simulated time: what is recorded until then does not depend on how fast
    the machine is. Its other methods are a person's hands, as of `Simulation`.
    """

    def __init__(
        self,
        world: str | Path = DEFAULT_WORLD,
        *,
        data_dir: Path,
        controllers: Mapping[str, str | Path] | None = None,
        environment: Mapping[str, str] | None = None,
        console: Callable[[str], object] | None = None,
    ) -> None:
        """Load a world; nothing runs before `start` or `with`.

        Args:
            world: A .wbt file.
            data_dir: Where bridges that are told nothing else record.
            controllers: Controller files by robot name, instead of those that the world names.
            environment: Variables for the controllers, on top of those of this process.
            console: Is called with each line of Webots' console.

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
                **(environment or {}),
            },
        )
        for name, file in (controllers or {}).items():
            self.controller(name)
            if not Path(file).is_file():
                raise StandInError(f"the controller of {name!r} is missing: {Path(file).resolve()}")
        self.recording = Recording(data_dir / DATABASE_NAME)
        """What the controllers recorded; `recording.robot(name)` where there are several."""

    def run_for(self, duration_s: float, timeout_s: float = 60.0) -> None:
        """Run for that much simulated time, then pause.

        It returns earlier where somebody else pauses or quits the simulation.

        When it returns, every controller has published what belongs to the last step.

        Args:
            duration_s: Simulated time, rounded up to a multiple of the basic time step.
            timeout_s: The longest time to wait, in seconds of wall time.

        Raises:
            AssertionError: A controller ended with an error; the text ends with the console.
            TimeoutError: It took too long; the text ends with the console.
            StandInError: The simulation has been quit.
        """
        self._seen_s, self._ends_in_s = self.time_s, duration_s
        self.fast()
        self.wait_for(self._is_at_rest, timeout_s)
        for controller in self._runner.controllers:
            if controller.exit_code:
                raise AssertionError(
                    f"the controller of {controller.name!r} ended with status "
                    f"{controller.exit_code}; the console says:\n{self._last_lines()}"
                )

    def _notice(self) -> None:
        """Called in the simulation's thread after each physics step."""
        now_s = self.time_s
        passed_s = now_s - self._seen_s if now_s >= self._seen_s else now_s  # less: a reset
        self._seen_s = now_s
        if self._ends_in_s > 0.0:
            self._ends_in_s = round(self._ends_in_s - passed_s, 9)
            if self._ends_in_s <= 0.0:
                self._runner.set_mode(Mode.PAUSE)
        super()._notice()

    def _is_at_rest(self) -> bool:
        if not self.is_running:
            return True
        return self.mode is Mode.PAUSE and not any(
            (each.holds_up and not self._is_held(each.name)) or (each.has_left and each.is_running)
            for each in self._runner.controllers
        )

    def _is_held(self, name: str) -> bool:
        """Whether a bridge holds the controller's loop: it asks for no step until it is resumed."""
        try:
            with closing(connect(self.recording.database, "reader")) as connection:
                require_current(connection)
                session = resolve_robot(connection, name, time.time()).session
        except WebotsMCPError:  # nothing was recorded yet
            return False
        return session is not None and session.hold == "paused"

    def _last_lines(self) -> str:
        return "\n".join(self.console[-_CONSOLE_LINES:])
