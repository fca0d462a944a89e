"""Robots for unit tests, whose simulation runs within the test's process."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

from controller.robot import Robot, Supervisor
from controller.simulator_link import Message

from webots_mcp.contract import bundled
from webots_mcp.standin.base_simulation import BaseSimulation, ControllerEndpoint
from webots_mcp.standin.controller_answers import description
from webots_mcp.standin.simulator import Mode
from webots_mcp.standin.simulator import SimulatedRobot as SimulatedRobot
from webots_mcp.standin.standin_errors import (
    RequestAfterEndError,
    StandInError,
    WorldError,
    WouldBlockError,
)

DEFAULT_WORLD: Final = bundled("examples") / "worlds" / "arena.wbt"
"""A 4 m x 4 m arena with a few obstacles and one two-wheeled robot, "rover"."""


_LONGEST_STEP_MS: Final = 1 << 31


class InProcessSimulation(BaseSimulation):
    """A simulation whose time passes only inside the `step` calls of robots in this process.

    There is no thread and no pacing. Several robots may share a simulation. Each has its own clock:
    for a robot that is behind, the requested time has passed already. Stepping robots in turn
    therefore keeps them together, and none waits for another. After a reset or a reload, a new
    robot object can replace one that was ended.
    """

    def __init__(self, world: str | Path = DEFAULT_WORLD, *, pause_timeout_s: float = 0.0) -> None:
        """Load a world, running fast.

        Args:
            world: A .wbt file.
            pause_timeout_s: How long `step` in a paused simulation waits for another thread to
                resume it before it raises `WouldBlockError`, in seconds of wall time.

        Raises:
            WorldError: The world cannot be used.
        """
        self.console: list[str] = []
        """Lines that Webots would show in its console."""
        self._pause_timeout_s = pause_timeout_s
        self._changed = threading.Condition(threading.RLock())
        self._links: list[_LocalLink] = []
        super().__init__(world, Mode.FAST, self.console.append)

    @property
    def _endpoints(self) -> Sequence[_LocalLink]:
        return self._links

    def _obey(self, function: Callable[[], None]) -> None:
        with self._changed:
            function()
            self._changed.notify_all()

    def _step_once(self) -> None:
        self.simulator.mode = Mode.PAUSE
        self._advance()

    def _end(self, endpoints: Sequence[ControllerEndpoint]) -> None:
        for endpoint in endpoints:
            endpoint.is_ending = True
            if endpoint.robot.remaining_ms is not None:
                endpoint.tell_to_quit()
        self._links = [link for link in self._links if not link.is_ending]
        self._changed.notify_all()

    # Controllers ---------------------------------------------------------------------------------

    def connect(self, name: str | None) -> _LocalLink:
        """Connect a robot object to a robot of the world."""
        with self._changed:
            robot = self._found(name)
            if any(link.robot is robot for link in self._links):
                raise StandInError(f"robot {robot.name!r} has a controller already")
            link = _LocalLink(self, robot)
            self._links.append(link)
            return link

    def _found(self, name: str | None) -> SimulatedRobot:
        robots = self.simulator.robots
        if not robots:
            raise WorldError(self.simulator.no_robot())
        if name is not None and len(robots) == 1 and not self.simulator.left_out_robots(name):
            robots[0].node.fields["name"] = name
        return robots[0] if name is None else self.simulator.robot(name)

    def take(self, link: _LocalLink, message: Message) -> None:
        """Answer a controller's request, unless time has to pass first."""
        with self._changed:
            self._serve(link, message)
            self._carry_out_wanted()

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
        """Disconnect a controller that has finished."""
        with self._changed:
            if link in self._links:
                self._links.remove(link)
                link.robot.forget_controller()


class _LocalLink(ControllerEndpoint):
    """Both ends of the connection of an in-process robot."""

    def __init__(self, simulation: InProcessSimulation, robot: SimulatedRobot) -> None:
        self.robot = robot
        self.description: dict[str, Any] = description(simulation.simulator, robot)
        self.replies: deque[Message] = deque()
        self._simulation = simulation
        robot.forget_controller()

    def reply(self, message: Message) -> None:
        self.replies.append(message)

    def send(self, message: Message) -> None:
        if message[0] == "step" and message[1] > _LONGEST_STEP_MS:
            raise WouldBlockError(
                "a negative time step asks for 2**32 ms: step() would never return"
            )
        self._simulation.take(self, message)

    def receive(self) -> Message:
        if not self.replies:
            self._simulation.wait(self)
        return self.replies.popleft()

    def exit(self) -> NoReturn:
        raise RequestAfterEndError(
            "step() has returned -1: a controller process would end here, without a word. "
            "Leave the loop when step() returns -1 and make no further request"
        )

    def close(self) -> None:
        self._simulation.leave(self)


class InProcessRobot(Robot):
    """A `controller.Robot` for unit tests, in a simulation within this process.

    Subclass it like `Robot`; a test may have any number of them. It differs from a controller
    process in two ways: where `step` would wait for ever in a paused simulation it raises
    `WouldBlockError`, and where a request after the end would end the process it raises
    `ControllerEndedError`.
    """

    def __init__(
        self,
        name: str | None = None,
        *,
        world: str | Path | InProcessSimulation = DEFAULT_WORLD,
    ) -> None:
        """Connect to a robot of a world.

        Args:
            name: The robot's name; None for the first robot. The only robot of a world takes any
                name.
            world: A .wbt file to load, or a simulation to share with other robots.

        Raises:
            WorldError: The world cannot be used or has no such robot.
            StandInError: Another object controls the robot.
        """
        shared = isinstance(world, InProcessSimulation)
        self.simulation = world if shared else InProcessSimulation(world)
        """The simulation, with its buttons and the true state of its robots."""
        self._wanted_name = name
        super().__init__()

    def _connect(self) -> _LocalLink:
        return self.simulation.connect(self._wanted_name)


class InProcessSupervisor(InProcessRobot, Supervisor):
    """A `controller.Supervisor` for unit tests; see `InProcessRobot`.

    As in Webots, the world decides whether it has a supervisor's rights.
    """
