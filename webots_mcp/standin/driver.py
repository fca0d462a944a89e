"""What lets a world run: a person's hands on it, and what its controllers ask to be done to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from controller.session import Message

from webots_mcp.standin.controller_answers import answer, step_over
from webots_mcp.standin.simulator import Mode, Robot, Simulator
from webots_mcp.standin.vrml import WorldError
from webots_mcp.standin.world import load_world


class Seat(ABC):
    """Where the controller of a robot is reached, in this process or in another one."""

    robot: Robot
    is_ending = False
    """Whether the next thing it asks for is answered by the end."""
    was_told = False
    """Whether it knows that it has to quit."""

    @abstractmethod
    def reply(self, message: Message) -> None:
        """Send an answer."""

    def tell_to_quit(self) -> None:
        """Send the one answer after which `step` returns -1."""
        if not self.was_told:
            self.was_told = True
            self.robot.remaining_ms = None
            self.reply(("quit",))


class Driver(ABC):
    """A world in motion and those who control its robots.

    The methods named after buttons are a person's hands on Webots' window: they return once the
    simulation has obeyed.
    """

    def __init__(self, world: str | Path, mode: Mode, log: Callable[[str], None]) -> None:
        self.simulator = Simulator(load_world(world), mode, log)
        self.exit_status: int | None = None
        """The status given to `simulationQuit`; None while the simulation is there."""

    @property
    def time_s(self) -> float:
        """Simulated time in seconds."""
        return self.simulator.time_s

    @property
    def mode(self) -> Mode:
        """How the simulation runs."""
        return self.simulator.mode

    def robot(self, name: str) -> Robot:
        """What is really the case with a robot: its `position`, `yaw_rad`, `collisions`, ...

        Raises:
            WorldError: The world has no robot with this name.
        """
        return self.simulator.robot(name)

    # A person's hands ----------------------------------------------------------------------------

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

    # What differs with where the controllers are -------------------------------------------------

    @property
    @abstractmethod
    def _seats(self) -> Sequence[Seat]: ...

    @abstractmethod
    def _obey(self, function: Callable[[], None]) -> None:
        """Do what a person wants, between two physics steps."""

    @abstractmethod
    def _step_once(self) -> None: ...

    @abstractmethod
    def _end(self, seats: Sequence[Seat]) -> None: ...

    def _start(self, seats: Sequence[Seat]) -> None:  # noqa: B027 - in one process there is none
        """Start controllers that have been ended."""

    def _enter_world(self) -> None:  # noqa: B027
        """Have controllers for the robots of a world that was loaded."""

    # Between two physics steps -------------------------------------------------------------------

    def _set_mode(self, mode: Mode) -> None:
        self.simulator.mode = mode

    def _reset(self) -> None:
        self._end(self._seats)
        self.simulator.reset()
        self._start(self._seats)

    def _load(self, path: Path) -> None:
        """Read a world; a bad one is named and the old one stays."""
        self._end(self._seats)
        try:
            self.simulator = Simulator(load_world(path), self.mode, self.simulator.log)
        except WorldError as error:
            self.simulator.log(f"ERROR: {error}; the world stays as it was")
            self.simulator.reset()
        self._enter_world()

    def _quit(self, status: int) -> None:
        self.exit_status = status
        self._end(self._seats)

    def _serve(self, seat: Seat, message: Message) -> None:
        """Answer a controller, unless the answer has to wait for a physics step."""
        if seat.is_ending:
            seat.tell_to_quit()
        elif reply := answer(self.simulator, seat.robot, message):
            seat.reply(reply)

    def _advance(self) -> None:
        """Make one physics step and answer those who have waited for it."""
        done = self.simulator.advance()
        for seat in self._seats:
            if seat.robot in done:
                seat.reply(step_over(self.simulator, seat.robot))
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
