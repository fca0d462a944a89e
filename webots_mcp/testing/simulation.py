"""A simulation with real controller processes that stops where a test wants it to stop."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Final, TypeVar

from webots_mcp.connection import connect
from webots_mcp.contract import (
    DATA_DIR_VARIABLE,
    DATABASE_NAME,
    PARAMETERS_VARIABLE,
    THROTTLE_VARIABLE,
)
from webots_mcp.errors import WebotsMCPError
from webots_mcp.parameter import Value
from webots_mcp.pauses import PAUSED
from webots_mcp.schema import require_current
from webots_mcp.standin import Mode, Simulation, StandInError
from webots_mcp.standin.controllers import Controller
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.store.robots import resolve_robot
from webots_mcp.testing.recording import Recording

_CONSOLE_LINES: Final = 30
T = TypeVar("T")


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
        parameters: Mapping[str, Value] | None = None,
        console: Callable[[str], object] | None = None,
    ) -> None:
        """Load a world; nothing runs before `start` or `with`.

        Args:
            world: A .wbt file.
            data_dir: Where bridges that are told nothing else record.
            controllers: Controller files by robot name, instead of those that the world names.
            environment: Variables for the controllers, on top of those of this process.
            parameters: Start values of the controllers' parameters; others begin as in the code.
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
                **({PARAMETERS_VARIABLE: json.dumps(dict(parameters))} if parameters else {}),
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
            TimeoutError: It took too long; the text names the controllers that hang, and ends
                with the console.
            StandInError: The simulation has been quit.
        """
        __tracebackhide__ = True
        self._seen_s, self._ends_in_s = self.time_s, duration_s
        self.fast()
        self.wait_for(self._is_at_rest, timeout_s)
        for controller in self._runner.controllers:
            if controller.exit_code:
                raise AssertionError(
                    f"the controller of {controller.name!r} ended with status "
                    f"{controller.exit_code}; the console says:\n{self._last_lines()}"
                )

    def wait_for(self, condition: Callable[[], T], timeout_s: float = 10.0) -> T:
        """As of `Simulation`; the message begins with the controllers that hang."""
        __tracebackhide__ = True
        try:
            return super().wait_for(condition, timeout_s)
        except TimeoutError as error:
            hanging = [why for each in self._runner.controllers if (why := self._why_hung(each))]
            raise TimeoutError("\n".join([*hanging, str(error)])) from None

    def _why_hung(self, controller: Controller) -> str | None:
        """Why the simulation waits for this controller; None if it does not."""
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
        return self.mode is Mode.PAUSE and not any(map(self._why_hung, self._runner.controllers))

    def _is_held(self, name: str) -> bool:
        """Whether a bridge holds the controller's loop: it asks for no step until it is resumed."""
        try:
            with closing(connect(self.recording.database, "reader")) as connection:
                require_current(connection)
                session = resolve_robot(connection, name, time.time()).session
        except WebotsMCPError:  # nothing was recorded yet
            return False
        return session is not None and session.hold == PAUSED

    def _last_lines(self) -> str:
        return "\n".join(self.console[-_CONSOLE_LINES:])
