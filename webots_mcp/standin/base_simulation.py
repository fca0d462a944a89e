"""The base of both kinds of simulation: a world in motion and the controllers of its robots.

`StandInSimulation` runs controllers as processes, `InProcessSimulation` within the test's process.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from controller.simulator_link import Message

from webots_mcp.standin.controller_answers import answer, step_over
from webots_mcp.standin.simulator import Mode, SimulatedRobot, Simulator
from webots_mcp.standin.world import load_world
from webots_mcp.worlds.world_errors import WorldFileError


class ControllerEndpoint(ABC):
    """The connection to the controller of a robot, in this process or in another one."""

    robot: SimulatedRobot
    is_ending = False
    """Whether its next request is answered by the end of the simulation."""
    was_told = False
    """Whether it was ordered to quit."""

    @abstractmethod
    def reply(self, message: Message) -> None:
        """Send an answer."""

    def tell_to_quit(self) -> None:
        """Send the one answer after which `step` returns -1."""
        if not self.was_told:
            self.was_told = True
            self.robot.remaining_ms = None
            self.reply(("quit",))


class BaseSimulation(ABC):
    """A running world and the controllers of its robots.

    The methods named after buttons do what the buttons of Webots' window do, and return once the
    simulation has done it.
    """

    def __init__(self, world: str | Path, mode: Mode, log: Callable[[str], None]) -> None:
        self.simulator = Simulator(load_world(world), mode, log)
        self.exit_status: int | None = None
        """The status given to `simulationQuit`; None while the simulation runs."""

    @property
    def time_s(self) -> float:
        """Return simulated time in seconds."""
        return self.simulator.time_s

    @property
    def mode(self) -> Mode:
        """Return the mode of the simulation."""
        return self.simulator.mode

    def robot(self, name: str) -> SimulatedRobot:
        """Return the true state of a robot: its `position`, `yaw_rad`, `collisions`, ...

        Raises:
            WorldError: The world has no robot with this name.
        """
        return self.simulator.robot(name)

    # Buttons of the window -----------------------------------------------------------------------

    def pause(self) -> None:
        """Press pause."""
        self._obey(partial(self._set_mode, Mode.PAUSE))

    def resume(self) -> None:
        """Press play: real time."""
        self._obey(partial(self._set_mode, Mode.REAL_TIME))

    def fast(self) -> None:
        """Press fast."""
        self._obey(partial(self._set_mode, Mode.FAST))

    def step(self) -> None:
        """Press step: one basic time step, then pause."""
        self._obey(self._step_once)

    def reset(self) -> None:
        """Reset the world; all controllers are ended and start again."""
        self._obey(self._reset)

    def reload(self) -> None:
        """Read the world from its file again; all controllers are ended and start again."""
        self._obey(lambda: self._load(self.simulator.world.path))

    def quit(self, status: int = 0) -> None:
        """Close the window."""
        self._obey(partial(self._quit, status))

    # Depends on where the controllers run --------------------------------------------------------

    @property
    @abstractmethod
    def _endpoints(self) -> Sequence[ControllerEndpoint]: ...

    @abstractmethod
    def _obey(self, function: Callable[[], None]) -> None:
        """Call a function between two physics steps."""

    @abstractmethod
    def _step_once(self) -> None: ...

    @abstractmethod
    def _end(self, endpoints: Sequence[ControllerEndpoint]) -> None: ...

    def _start(self, endpoints: Sequence[ControllerEndpoint]) -> None:  # noqa: B027 - nothing to start within one process
        """Start controllers that have been ended."""

    def _enter_world(self) -> None:  # noqa: B027
        """Prepare controllers for the robots of a world that was loaded."""

    # Between two physics steps -------------------------------------------------------------------

    def _set_mode(self, mode: Mode) -> None:
        self.simulator.mode = mode

    def _reset(self) -> None:
        self._end(self._endpoints)
        self.simulator.reset()
        self._start(self._endpoints)

    def _load(self, path: Path) -> None:
        """Read a world. If it cannot be used, log the reason and keep the current world."""
        self._end(self._endpoints)
        try:
            self.simulator = Simulator(load_world(path), self.mode, self.simulator.log)
        except WorldFileError as error:
            self.simulator.log(f"ERROR: {error}; the world stays as it was")
            self.simulator.reset()
        self._enter_world()

    def _quit(self, status: int) -> None:
        self.exit_status = status
        self._end(self._endpoints)

    def _serve(self, endpoint: ControllerEndpoint, message: Message) -> None:
        """Answer a controller, unless the answer has to wait for a physics step.

        A controller that has to end can still fetch the picture or scan of its last sample, because
        Webots sends those with the step.
        """
        if endpoint.is_ending and message[0] != "fetch":
            endpoint.tell_to_quit()
        elif reply := answer(self.simulator, endpoint.robot, message):
            endpoint.reply(reply)

    def _advance(self) -> None:
        """Make one physics step and answer the controllers that waited for it."""
        done = self.simulator.advance()
        for endpoint in self._endpoints:
            if endpoint.robot in done:
                endpoint.reply(step_over(self.simulator, endpoint.robot))
        self._carry_out_wanted()

    def _carry_out_wanted(self) -> None:
        wanted, self.simulator.wanted = self.simulator.wanted, None
        match wanted:
            case None:
                return
            case int(status):
                self._quit(status)
            case path:
                self._load(Path(path or self.simulator.world.path))
