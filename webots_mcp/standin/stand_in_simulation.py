"""A running simulation whose controllers are real processes, and the loop that runs it."""

from __future__ import annotations

import hmac
import secrets
import selectors
import shutil
import socket
import sys
import tempfile
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Protocol, TypeVar, cast

from controller.simulator_link import ADDRESS_FILE, Message

from webots_mcp.standin.base_simulation import BaseSimulation, ControllerEndpoint
from webots_mcp.standin.controller_answers import description
from webots_mcp.standin.controllers import Controller, ControllerConnection, ControllerLaunch
from webots_mcp.standin.simulator import Mode
from webots_mcp.standin.standin_errors import StandInError

_MODES: Final = {"pause": Mode.PAUSE, "realtime": Mode.REAL_TIME, "fast": Mode.FAST}
_CONSOLE_LINES: Final = 10_000

T = TypeVar("T")


@dataclass(frozen=True)
class SimulationTimes:
    """Times of the simulation's loop, in seconds of wall time.

    Attributes:
        notify_interval_s: Minimum time between two notifications of waiting threads: each costs a
            thread switch.
        recheck_s: Maximum time between two checks of a condition that a thread waits for.
        patience_s: How long Webots waits for a controller to make a request, and then for it to
            exit.
        max_lag_s: Maximum delay behind real time that is caught up.
    """

    notify_interval_s: float = 0.002
    recheck_s: float = 0.05
    patience_s: float = 1.0
    max_lag_s: float = 0.1


_TIMES: Final = SimulationTimes()


class ConsoleRecorder(Protocol):
    """Stores the lines of a simulation's console."""

    def begin(self, port: int) -> None:
        """Begin a simulation that controllers know by this port."""

    def put(self, stream: str, line: str) -> None:
        """Take a line of `stdout` or `stderr`: `[robot] text` from controllers, others from Webots.

        Called from one thread at a time, also before `begin`.
        """


class StandInSimulation(BaseSimulation):
    """A world that runs in a background thread; `webots_mcp.standin.Simulation`.

    Its controllers are processes of their own. Use it in a `with` statement; leaving it ends all
    controllers.
    """

    def __init__(
        self,
        world: str | Path,
        *,
        mode: str = "realtime",
        console: Callable[[str], object] | None = None,
        recorder: ConsoleRecorder | None = None,
        environment: Mapping[str, str] | None = None,
        controllers: Mapping[str, str | Path] | None = None,
        python: str = sys.executable,
    ) -> None:
        """Load a world; nothing runs before `start` or `with`.

        Args:
            world: A .wbt file, best in a project: `worlds/x.wbt` next to `controllers/`.
            mode: `pause`, `realtime` or `fast`, as for Webots' `--mode`. A world that is loaded
                in pause starts its controllers with the first step.
            console: Called with each line of Webots' console, from one thread at a time.
            recorder: Receives the same lines, as Webots sends them to its clients.
            environment: Variables for the controllers, on top of those of this process.
            controllers: Controller files by robot name, instead of those that the world names.
            python: Interpreter that runs the controllers.

        Raises:
            WorldError: The world cannot be used, or lacks a robot that `controllers` names.
            StandInError: The mode is unknown.
        """
        if mode not in _MODES:
            raise StandInError(f"mode has to be one of {', '.join(_MODES)}, not {mode!r}")
        self._console = console
        self._recorder = recorder
        self._lines: deque[str] = deque(maxlen=_CONSOLE_LINES)
        self._printing = threading.Lock()
        self._changed = threading.Condition()
        self._noticed_s = 0.0
        self._folder = Path(tempfile.mkdtemp(prefix="webots-standin-"))
        self._clean_up = weakref.finalize(self, shutil.rmtree, self._folder, True)
        overrides = {name: Path(file) for name, file in (controllers or {}).items()}
        self._launch = ControllerLaunch(
            python, environment or {}, overrides, self._print, self._exited, secrets.token_hex(16)
        )
        self.controllers: list[Controller] = []
        """One for each robot, in the order of the scene tree."""
        super().__init__(world, _MODES[mode], self._print)
        for name in overrides:
            self.robot(name)  # Raises for a name that the world does not have.
        self._find_controllers()
        self._admitted: dict[ControllerConnection, Controller] = {}
        self._calls: deque[tuple[Callable[[], None], Future[None]]] = deque()
        self._steps_asked = 0
        self._due_s = 0.0
        self._over = False
        self._selector = selectors.DefaultSelector()
        self._bell_rope: socket.socket
        self._thread = threading.Thread(target=self._run, name="simulation", daemon=True)

    # Start and end -------------------------------------------------------------------------------

    def start(self, shown_port: int | None = None) -> StandInSimulation:
        """Start the controllers and, unless it is to be paused, time.

        Args:
            shown_port: What the folder for controllers is named after, where another program
                listens for Webots' clients; None: the port for controllers.
        """
        door = socket.create_server(("127.0.0.1", 0))
        bell, self._bell_rope = socket.socketpair()
        self._selector.register(door, selectors.EVENT_READ, self._welcome)
        self._selector.register(bell, selectors.EVENT_READ, _hush)
        self._launch.port = door.getsockname()[1]
        self._launch.folder = self._folder / str(shown_port or self._launch.port)
        if self._recorder:
            self._recorder.begin(int(self._launch.folder.name))
        self._launch.folder.mkdir()  # Only this user can read it.
        address = f"{self._launch.port} {self._launch.token}"
        (self._launch.folder / ADDRESS_FILE).write_text(address, encoding="utf-8")
        self._thread.start()
        return self

    def close(self) -> None:
        """Quit, unless that happened before, and wait until all processes have ended."""
        if self._thread.is_alive():
            with suppress(StandInError):  # A controller may have quit it meanwhile.
                self.quit()
        if self._thread.ident is not None:
            self._thread.join()
        self._clean_up()

    def __enter__(self) -> StandInSimulation:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_running(self) -> bool:
        """Return whether the simulation has not been quit."""
        return self.exit_status is None

    @property
    def can_go_on(self) -> bool:
        """Return whether a controller runs or may still connect, or none was ever started."""
        started = [each for each in self.controllers if each.process is not None]
        return not started or any(each.may_act for each in self.controllers)

    @property
    def failure(self) -> int | None:
        """Return the exit status of the first controller that ended with an error by itself.

        For a signal that is 128 plus its number; None if no controller failed.
        """
        return self._launch.failure

    # State ---------------------------------------------------------------------------------------

    @property
    def console(self) -> list[str]:
        """Return the last lines of the console; lines of controllers begin with `[robot]`."""
        with self._printing:
            return [*self._lines]

    def controller(self, name: str) -> Controller:
        """Return a robot's controller: its `pid`, `exit_code`, `starts`, `kill()`, ...

        Raises:
            WorldError: The world has no robot with this name.
        """
        robot = self.robot(name)
        return next(controller for controller in self.controllers if controller.robot is robot)

    def environment_of(self, name: str) -> dict[str, str]:
        """Return the environment that makes a program of yours the controller of an <extern> robot.

        Raises:
            StandInError: There is no such robot, or the simulation has not started.
        """
        return self.controller(name).environment()

    def wait_for(self, condition: Callable[[], T], timeout_s: float = 10.0) -> T:
        """Wait until a condition holds. It is checked whenever something has happened.

        Args:
            condition: Called in this thread until its value is true.
            timeout_s: Maximum time to wait, in seconds of wall time.

        Returns:
            The true value.

        Raises:
            TimeoutError: The condition did not hold in time; the text ends with the console.
        """
        deadline_s = time.monotonic() + timeout_s
        while not (value := condition()):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                tail = "\n".join(self.console[-20:])
                raise TimeoutError(f"not the case after {timeout_s} s; the console says:\n{tail}")
            with self._changed:
                self._changed.wait(min(left_s, _TIMES.recheck_s))
        return value

    # From other threads --------------------------------------------------------------------------

    def _obey(self, function: Callable[[], None]) -> None:
        """Have the loop call a function between two physics steps.

        Raises:
            StandInError: The simulation has ended.
        """
        future: Future[None] = Future()
        self._calls.append((function, future))
        self._wake()
        if self._over:
            self._cancel_calls()
        try:
            future.result()
        except CancelledError:
            raise StandInError("the simulation has ended") from None

    def _wake(self) -> None:
        """Wake up the loop, if it waits."""
        with suppress(OSError):
            self._bell_rope.send(b"!")

    def _print(self, line: str, stream: str | None = None, /) -> None:
        with self._printing:
            self._lines.append(line)
            if self._console:
                self._console(line)
            if self._recorder:
                own = "stdout" if line.startswith("INFO: ") else "stderr"
                self._recorder.put(stream or own, line)
        self._tell()

    def _exited(self) -> None:
        self._wake()
        self._tell()

    def _notice(self) -> None:
        """Notify threads in `wait_for`; called in the simulation's thread, such as after a step."""
        now_s = time.monotonic()
        if now_s - self._noticed_s > _TIMES.notify_interval_s:
            self._noticed_s = now_s
            self._tell()

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()

    # The loop ------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Run until the simulation is quit."""
        try:
            if self.mode is not Mode.PAUSE:
                self._start(self.controllers)
            while self.exit_status is None:
                self._listen(self._patience_s())
                self._answer_calls()
                self._carry_out_wanted()
                if self.exit_status is None and self._patience_s() == 0.0:
                    self._advance()
        finally:
            self._shut_down()

    def _patience_s(self) -> float | None:
        """Return how long to wait for messages before the next physics step; None for no limit."""
        wants_to_advance = self.mode is not Mode.PAUSE or self._steps_asked
        if not wants_to_advance or any(each.holds_up for each in self.controllers):
            return None
        if self.mode is Mode.FAST or self._steps_asked:
            return 0.0
        return max(self._due_s - time.monotonic(), 0.0)

    def _advance(self) -> None:
        now_s, step_s = time.monotonic(), self.simulator.world.basic_time_step_ms / 1000.0
        # A step that was made early, as in fast mode, must not delay the next one.
        self._due_s = max(min(self._due_s, now_s) + step_s, now_s - _TIMES.max_lag_s)
        self._steps_asked = max(self._steps_asked - 1, 0)
        super()._advance()
        self._notice()

    def _listen(self, timeout_s: float | None) -> None:
        for key, _ in self._selector.select(timeout_s):
            key.data(key.fileobj)

    def _listen_until(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + _TIMES.patience_s
        while not condition() and (left_s := deadline_s - time.monotonic()) > 0.0:
            self._listen(left_s)

    def _answer_calls(self) -> None:
        while self._calls:
            function, future = self._calls.popleft()
            try:
                future.set_result(function())
            except Exception as error:  # noqa: BLE001 - The caller receives it.
                future.set_exception(error)
            self._notice()

    def _shut_down(self) -> None:
        self.exit_status = self.exit_status or 0
        self._end(self.controllers)
        for key in [*self._selector.get_map().values()]:
            cast("socket.socket", key.fileobj).close()
        self._selector.close()
        self._over = True
        self._bell_rope.close()
        self._cancel_calls()
        self._notice()

    def _cancel_calls(self) -> None:
        with suppress(IndexError):  # Both threads may get to this point at once.
            while self._calls:
                self._calls.popleft()[1].cancel()

    # Controllers ---------------------------------------------------------------------------------

    @property
    def _endpoints(self) -> Sequence[Controller]:
        return self.controllers

    def _welcome(self, door: socket.socket) -> None:
        connection = ControllerConnection(door.accept()[0])
        self._selector.register(
            connection.stream, selectors.EVENT_READ, partial(self._hear, connection)
        )

    def _hear(self, connection: ControllerConnection, _: socket.socket) -> None:
        messages = connection.receive()
        if messages is None:
            self._forget(connection)
            return
        for message in messages:
            if controller := self._admitted.get(connection):
                self._serve(controller, message)
                if message[0] == "ask":
                    self._notice()
            else:
                self._admit(connection, message)

    def _admit(self, connection: ControllerConnection, message: Message) -> None:
        _, token, name = message
        controller = next((c for c in self.controllers if c.name == name), None)
        if not hmac.compare_digest(token, self._launch.token):
            connection.send(("refused", "the token is that of another simulation"))
        elif controller is None:
            connection.send(("refused", self.simulator.no_robot(name)))
        elif controller.connection is not None:
            connection.send(("refused", f"robot {name!r} has a controller already"))
        else:
            controller.connection, self._admitted[connection] = connection, controller
            controller.robot.forget_controller()
            connection.send(("welcome", description(self.simulator, controller.robot)))
            self._notice()

    def _forget(self, connection: ControllerConnection) -> None:
        self._selector.unregister(connection.stream)
        connection.stream.close()
        if controller := self._admitted.pop(connection, None):
            controller.connection, controller.has_left = None, True
            controller.robot.forget_controller()
            self._notice()

    def _find_controllers(self) -> None:
        """Make a controller for each robot; reuse controllers of the previous world by name."""
        known = {controller.name: controller for controller in self.controllers}
        self.controllers = [
            known.get(robot.name) or Controller(robot, self._launch)
            for robot in self.simulator.robots
        ]
        for controller, robot in zip(self.controllers, self.simulator.robots, strict=True):
            controller.enter(robot, self.simulator)

    def _start(self, endpoints: Sequence[ControllerEndpoint]) -> None:
        for controller in self.controllers:
            if controller in endpoints:
                controller.start()

    def _end(self, endpoints: Sequence[ControllerEndpoint]) -> None:
        """End controllers as Webots does: a second for a request, one to exit, then by force."""
        controllers = [controller for controller in self.controllers if controller in endpoints]
        for controller in controllers:
            controller.is_ending = True
            if controller.robot.remaining_ms is not None:
                controller.tell_to_quit()
        self._listen_until(lambda: not any(c.awaits_quit for c in controllers))
        for controller in controllers:
            controller.tell_to_quit()
        self._listen_until(lambda: not any(c.is_leaving for c in controllers))
        for controller in controllers:
            controller.end()
            if connection := controller.connection:
                self._forget(connection)
            controller.is_ending = False

    # Modes, steps and worlds ---------------------------------------------------------------------

    def _set_mode(self, mode: Mode) -> None:
        super()._set_mode(mode)
        self._start_late()

    def _step_once(self) -> None:
        """Make one basic time step as soon as all controllers have asked for one."""
        self.simulator.mode = Mode.PAUSE
        self._steps_asked += 1
        self._start_late()

    def _start_late(self) -> None:
        """Start controllers of a world that was loaded in pause, once time is to pass."""
        self._due_s = time.monotonic()
        if self.mode is not Mode.PAUSE or self._steps_asked:
            self._start([each for each in self.controllers if not each.was_started])

    def _enter_world(self) -> None:
        self._find_controllers()
        if self.mode is not Mode.PAUSE:
            self._start(self.controllers)


def _hush(bell: socket.socket) -> None:
    bell.recv(1024)
