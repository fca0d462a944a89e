"""A running simulation with real controller processes."""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar

from controller.wire import ADDRESS_FILE

from webots_mcp.standin.controller_path import LIBRARY
from webots_mcp.standin.controllers import Address, Controller, Launch, controllers_of
from webots_mcp.standin.runner import Runner
from webots_mcp.standin.simulator import Mode, Robot, Simulator
from webots_mcp.standin.standin_errors import StandInError
from webots_mcp.standin.world import load_world

_MODES: Final = {"pause": Mode.PAUSE, "realtime": Mode.REAL_TIME, "fast": Mode.FAST}
_NOTICE_S: Final = 0.002
_RECHECK_S: Final = 0.05
_CONSOLE_LINES: Final = 10_000

T = TypeVar("T")


class Simulation:
    """A world that runs in a background thread, its controllers as processes of their own.

    Use it in a `with` statement; leaving it ends all controllers. The methods named after buttons
    are a person's hands on Webots' window: they return once the simulation has obeyed.
    """

    def __init__(
        self,
        world: str | Path,
        *,
        mode: str = "realtime",
        console: Callable[[str], object] | None = None,
        environment: Mapping[str, str] | None = None,
        controllers: Mapping[str, str | Path] | None = None,
        python: str = sys.executable,
    ) -> None:
        """Load a world; nothing runs before `start` or `with`.

        Args:
            world: A .wbt file, best in a project: `worlds/x.wbt` next to `controllers/`.
            mode: `pause`, `realtime` or `fast`, as for Webots' `--mode`. A world that is loaded
                in pause starts its controllers with the first step.
            console: Is called with each line of Webots' console, from one thread at a time.
            environment: Variables for the controllers, on top of those of this process.
            controllers: Controller files by robot name, instead of those that the world names.
            python: The interpreter of the controllers.

        Raises:
            WorldError: The world cannot be used, or has no robot that `controllers` names.
            StandInError: There is no such mode.
        """
        if mode not in _MODES:
            raise StandInError(f"mode has to be one of {', '.join(_MODES)}, not {mode!r}")
        self._console = console
        self._lines: deque[str] = deque(maxlen=_CONSOLE_LINES)
        self._printing = threading.Lock()
        self._changed = threading.Condition()
        self._noticed_s = 0.0
        self._folder = Path(tempfile.mkdtemp(prefix="webots-standin-"))
        self._clean_up = weakref.finalize(self, shutil.rmtree, self._folder, True)
        overrides = {name: Path(file) for name, file in (controllers or {}).items()}
        self._launch = Launch(
            LIBRARY, python, environment or {}, overrides, self._print, self._exited
        )
        simulator = Simulator(load_world(world), _MODES[mode], self._print)
        for name in overrides:
            simulator.robot(name)  # refuses a name that the world does not have
        self._runner = Runner(
            simulator,
            lambda simulator, before: controllers_of(simulator, self._launch, before),
            self._notice,
        )
        self._thread = threading.Thread(target=self._runner.run, name="simulation", daemon=True)

    # Life ----------------------------------------------------------------------------------------

    def start(self) -> Simulation:
        """Start the controllers and, unless it is to be paused, time."""
        port, token = self._runner.open(), self._runner.token
        folder = self._folder / str(port)  # it is this user's alone
        folder.mkdir()
        (folder / ADDRESS_FILE).write_text(f"{port} {token}", encoding="utf-8")
        self._launch.address = Address(port, token, folder)
        self._thread.start()
        return self

    def close(self) -> None:
        """Quits, if that has not happened yet, and waits until all processes are gone."""
        if self._thread.is_alive():
            with suppress(StandInError):  # it was quit otherwise meanwhile
                self.quit()
        if self._thread.ident is not None:
            self._thread.join()
        self._clean_up()

    def __enter__(self) -> Simulation:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_running(self) -> bool:
        """Whether the simulation has not been quit."""
        return self._runner.exit_status is None

    @property
    def exit_status(self) -> int | None:
        """The status given to `simulationQuit`; None while it runs."""
        return self._runner.exit_status

    # What is the case ----------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Simulated time in seconds."""
        return self._runner.simulator.time_s

    @property
    def mode(self) -> Mode:
        """How the simulation runs."""
        return self._runner.simulator.mode

    @property
    def labels(self) -> dict[int, str]:
        """The texts of `setLabel` by number."""
        return {number: label.text for number, label in self._runner.simulator.labels.items()}

    @property
    def console(self) -> list[str]:
        """The last lines of the console: `[robot] text` from controllers, others from Webots."""
        with self._printing:
            return [*self._lines]

    def robot(self, name: str) -> Robot:
        """What is really the case with a robot: its `position`, `yaw_rad`, `collisions`, ...

        Raises:
            WorldError: The world has no robot with this name.
        """
        return self._runner.simulator.robot(name)

    def controller(self, name: str) -> Controller:
        """A robot's controller: its `pid`, `exit_code`, `starts`, `kill()`, ...

        Raises:
            StandInError: The world has no robot with this name.
        """
        for controller in self._runner.controllers:
            if controller.name == name:
                return controller
        raise StandInError(f"no robot {name!r} in {self._runner.simulator.world.path.name}")

    def environment_of(self, name: str) -> dict[str, str]:
        """The environment that makes a program of yours the controller of an <extern> robot.

        Raises:
            StandInError: There is no such robot, or the simulation has not started.
        """
        controller = self.controller(name)
        return controller.launch.environment_of(controller.robot)

    def wait_for(self, condition: Callable[[], T], timeout_s: float = 10.0) -> T:
        """Wait until something is the case; looks whenever something has happened.

        Args:
            condition: Is called in this thread until its value is true.
            timeout_s: The longest time to wait, in seconds of wall time.

        Returns:
            The true value.

        Raises:
            TimeoutError: It was not the case in time; the message ends with the console.
        """
        deadline_s = time.monotonic() + timeout_s
        while not (value := condition()):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                tail = "\n".join(self.console[-20:])
                raise TimeoutError(f"not the case after {timeout_s} s; the console says:\n{tail}")
            with self._changed:
                self._changed.wait(min(left_s, _RECHECK_S))
        return value

    # A person's hands ----------------------------------------------------------------------------

    def pause(self) -> None:
        """Press pause."""
        self._runner.call(lambda: self._runner.set_mode(Mode.PAUSE))

    def resume(self) -> None:
        """Press play: real time."""
        self._runner.call(lambda: self._runner.set_mode(Mode.REAL_TIME))

    def fast(self) -> None:
        """Press fast."""
        self._runner.call(lambda: self._runner.set_mode(Mode.FAST))

    def step(self) -> None:
        """Press step: one basic time step as soon as all controllers have asked, then pause."""
        self._runner.call(self._runner.step)

    def reset(self) -> None:
        """Reset the world and start all controllers again."""
        self._runner.call(self._runner.reset)

    def reload(self) -> None:
        """Read the world from its file again and start all controllers again."""
        self._runner.call(lambda: self._runner.load(self._runner.simulator.world.path))

    def quit(self, status: int = 0) -> None:
        """Close the window."""
        self._runner.call(lambda: self._runner.quit(status))

    # From the simulation's threads ---------------------------------------------------------------

    def _print(self, line: str) -> None:
        with self._printing:
            self._lines.append(line)
            if self._console:
                self._console(line)
        self._tell()

    def _exited(self) -> None:
        self._runner.wake()
        self._tell()

    def _notice(self) -> None:
        now_s = time.monotonic()
        if now_s - self._noticed_s > _NOTICE_S:  # a thread switch for each step would cost too much
            self._noticed_s = now_s
            self._tell()

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()
