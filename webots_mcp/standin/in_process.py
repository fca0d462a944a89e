"""Robots for unit tests: the same classes, without a second process and without a socket."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from typing import Any, Final, NoReturn

from controller.robot import Robot, Supervisor
from controller.session import Message

from webots_mcp.contract import bundled
from webots_mcp.standin.controller_answers import answer, description, step_over
from webots_mcp.standin.simulator import Mode, Simulator, Wanted
from webots_mcp.standin.simulator import Robot as SimulatedRobot
from webots_mcp.standin.vrml import ControllerEndedError, StandInError, WorldError, WouldBlockError
from webots_mcp.standin.world import load_world

DEFAULT_WORLD: Final = bundled("examples") / "worlds" / "arena.wbt"
"""A 4 m x 4 m arena with a few obstacles and one two-wheeled robot, "rover"."""

_LONGEST_STEP_MS: Final = 1 << 31


class InProcessSimulation:
    """A world that the robots of this process move themselves, step by step.

    There is no thread and no pacing: time passes while a robot is inside `step`. Several robots
    may share a simulation. Each has its own clock: the one that is behind finds that its time has
    passed already, so stepping them in turn keeps them together, and none waits for another.

    The methods named after buttons are a person's hands on Webots' window.
    """

    def __init__(self, world: str | Path = DEFAULT_WORLD, *, pause_timeout_s: float = 0.0) -> None:
        """Load a world, running fast.

        Args:
            world: A .wbt file.
            pause_timeout_s: How long a `step` in a paused simulation waits for another thread to
                resume it, before it raises `WouldBlockError`; seconds of wall time.

        Raises:
            WorldError: The world cannot be used.
        """
        self.console: list[str] = []
        """What Webots would show in its console."""
        self._pause_timeout_s = pause_timeout_s
        self._changed = threading.Condition(threading.RLock())
        self._links: list[_LocalLink] = []
        self._simulator = Simulator(load_world(world), Mode.FAST, self.console.append)
        self.exit_status: int | None = None
        """The status given to `simulationQuit`; None while the simulation is there."""

    @property
    def time_s(self) -> float:
        """Simulated time in seconds."""
        return self._simulator.time_s

    @property
    def mode(self) -> Mode:
        """How the simulation runs; fast and real time are the same here."""
        return self._simulator.mode

    def robot(self, name: str) -> SimulatedRobot:
        """What is really the case with a robot: its `position`, `yaw_rad`, `collisions`, ...

        Raises:
            WorldError: The world has no robot with this name.
        """
        return self._simulator.robot(name)

    # A person's hands ----------------------------------------------------------------------------

    def pause(self) -> None:
        """Press pause."""
        self._set_mode(Mode.PAUSE)

    def resume(self) -> None:
        """Press play."""
        self._set_mode(Mode.REAL_TIME)

    def fast(self) -> None:
        """Press fast."""
        self._set_mode(Mode.FAST)

    def step(self) -> None:
        """Make one basic time step and pause."""
        with self._changed:
            self._simulator.mode = Mode.PAUSE
            self._advance()
            self._changed.notify_all()

    def reset(self) -> None:
        """Reset the world; controllers are ended, a new robot object may take their place."""
        with self._changed:
            self._end(self._links)
            self._simulator.reset()

    def reload(self) -> None:
        """Read the world from its file; controllers are ended as with `reset`."""
        self._load(self._simulator.world.path)

    def quit(self, status: int = 0) -> None:
        """End the simulation: every `step` returns -1."""
        with self._changed:
            self.exit_status = status
            self._end(self._links)

    def _set_mode(self, mode: Mode) -> None:
        with self._changed:
            self._simulator.mode = mode
            self._changed.notify_all()

    def _load(self, path: Path) -> None:
        with self._changed:
            self._end(self._links)
            self._simulator = Simulator(load_world(path), self.mode, self.console.append)

    def _end(self, links: list[_LocalLink]) -> None:
        for link in links:
            link.quit()
        self._links = [link for link in self._links if link not in links]
        self._changed.notify_all()

    # Controllers ---------------------------------------------------------------------------------

    def connect(self, name: str | None) -> _LocalLink:
        """Connect a robot object to a robot of the world."""
        with self._changed:
            robot = self._found(name)
            if any(link.robot is robot for link in self._links):
                raise StandInError(f"robot {robot.name!r} has a controller already")
            link = _LocalLink(self, self._simulator, robot)
            self._links.append(link)
            return link

    def _found(self, name: str | None) -> SimulatedRobot:
        robots = self._simulator.robots
        if not robots:
            raise WorldError(self._simulator.no_robot())
        if name is not None and len(robots) == 1 and not self._simulator.left_out_robots(name):
            robots[0].node.fields["name"] = name
        return robots[0] if name is None else self._simulator.robot(name)

    def take(self, link: _LocalLink, message: Message) -> None:
        """Take a controller's request, and let time pass as far as it asks for."""
        with self._changed:
            reply = answer(self._simulator, link.robot, message)
            if reply:
                link.replies.append(reply)
            self._carry_out(self._simulator.wanted)

    def wait(self, link: _LocalLink) -> None:
        """Let time pass until the controller has its answer.

        Raises:
            WouldBlockError: The simulation is paused and nothing can resume it.
        """
        with self._changed:
            while not link.replies:
                if self.mode is Mode.PAUSE and not self._changed.wait(self._pause_timeout_s):
                    link.robot.remaining_ms = None
                    raise WouldBlockError(
                        "step() with a time above 0 waits until the simulation is resumed, "
                        "which is paused: call step(0), or resume it from another thread within "
                        "pause_timeout_s"
                    )
                if self.mode is not Mode.PAUSE and not link.replies:
                    self._advance()

    def leave(self, link: _LocalLink) -> None:
        """Forget a controller that is done."""
        with self._changed:
            if link in self._links:
                self._links.remove(link)
                link.robot.forget_controller()

    def _advance(self) -> None:
        waiting = {link.robot.name: link for link in self._links}
        for robot in self._simulator.advance():
            waiting[robot.name].replies.append(step_over(self._simulator, robot))
        self._carry_out(self._simulator.wanted)

    def _carry_out(self, wanted: Wanted | None) -> None:
        if wanted is None:
            return
        self._simulator.wanted = None
        if wanted.action == "quit":
            self.quit(wanted.status)
        elif wanted.action == "restart":
            self._end([link for link in self._links if link.robot.name == wanted.robot])
        else:
            self._load(Path(wanted.path) if wanted.path else self._simulator.world.path)


class _LocalLink:
    """The connection of an in-process robot."""

    def __init__(
        self, simulation: InProcessSimulation, simulator: Simulator, robot: SimulatedRobot
    ) -> None:
        self.simulation = simulation
        self.robot = robot
        self.description: dict[str, Any] = description(simulator, robot)
        self.replies: deque[Message] = deque()
        self._ended = False
        robot.forget_controller()

    def send(self, message: Message) -> None:
        if message[0] == "step" and message[1] > _LONGEST_STEP_MS:
            raise WouldBlockError(
                "a negative time step asks for 2**32 ms: step() would never return"
            )
        if not self._ended:
            self.simulation.take(self, message)
        elif not self.replies:
            self.replies.append(("quit",))

    def receive(self) -> Message:
        if not self.replies:
            self.simulation.wait(self)
        return self.replies.popleft()

    def quit(self) -> None:
        """The next answer, or the one that is waited for, is that the simulation ends."""
        self._ended = True
        if self.robot.remaining_ms is not None:
            self.robot.remaining_ms = None
            self.replies.append(("quit",))

    def exit(self) -> NoReturn:
        raise ControllerEndedError(
            "step() has returned -1: a controller process would end here, without a word. "
            "Leave the loop when step() returns -1 and make no further request"
        )

    def close(self) -> None:
        self.simulation.leave(self)


class InProcessRobot(Robot):
    """A `controller.Robot` for unit tests, in a simulation within this process.

    Subclass it like `Robot`; there may be as many as a test wants. What differs from a controller
    process: `step` in a paused simulation raises `WouldBlockError` where it would wait for ever,
    and a request after `step` has returned -1 raises `ControllerEndedError` where the process
    would end.
    """

    def __init__(
        self,
        name: str | None = None,
        *,
        world: str | Path | InProcessSimulation = DEFAULT_WORLD,
    ) -> None:
        """Connect to a robot of a world.

        Args:
            name: The robot's name; None: the first robot. If the world has one robot only, that
                one takes the name.
            world: A .wbt file to load, or a simulation to share with other robots.

        Raises:
            WorldError: The world cannot be used or has no such robot.
            StandInError: Another object controls the robot.
        """
        shared = isinstance(world, InProcessSimulation)
        self.simulation = world if shared else InProcessSimulation(world)
        """The simulation: a person's hands, and what is really the case."""
        self._wanted_name = name
        super().__init__()

    def _connect(self) -> _LocalLink:
        return self.simulation.connect(self._wanted_name)


class InProcessSupervisor(InProcessRobot, Supervisor):
    """A `controller.Supervisor` for unit tests; see `InProcessRobot`.

    Whether it has a supervisor's rights is the world's business, as in Webots.
    """
