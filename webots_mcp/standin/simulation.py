"""A running simulation with real controller processes, and the loop that runs it."""

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
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from controller.session import ADDRESS_FILE, Message

from webots_mcp.standin.controller_answers import answer, description, step_over
from webots_mcp.standin.controller_path import LIBRARY
from webots_mcp.standin.controllers import Address, Connection, Controller, Launch, controllers_of
from webots_mcp.standin.simulator import Mode, Robot, Simulator
from webots_mcp.standin.vrml import StandInError, WorldError
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

    @property
    def failure(self) -> int | None:
        """The exit status of the first controller that ended with an error by itself.

        128 and its number for a signal; None if there is none.
        """
        return self._launch.failure

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


_PATIENCE_S: Final = 1.0
"""How long Webots waits for a controller to ask for something, and then for it to exit."""
_MAX_LAG_S: Final = 0.1
"""Real time that is lost is caught up with at most so much."""


class Runner:
    """Runs a simulation in the thread that calls `run`; other threads use `call`."""

    def __init__(
        self,
        simulator: Simulator,
        controllers_for: Callable[[Simulator, list[Controller]], list[Controller]],
        notify: Callable[[], None],
    ) -> None:
        self.simulator = simulator
        self.controllers = controllers_for(simulator, [])
        self.token = secrets.token_hex(16)
        self.exit_status: int | None = None
        self._controllers_for = controllers_for
        self._notify = notify
        self._admitted: dict[Connection, Controller] = {}
        self._calls: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._steps_asked = 0
        self._due_s = 0.0
        self._ending: list[Controller] = []
        self._over = False
        self._selector: selectors.BaseSelector
        self._bell_rope: socket.socket

    def open(self) -> int:
        """Open the door for controllers; returns its port."""
        self._selector = selectors.DefaultSelector()
        door = socket.create_server(("127.0.0.1", 0))
        bell, self._bell_rope = socket.socketpair()
        self._selector.register(door, selectors.EVENT_READ, self._welcome)
        self._selector.register(bell, selectors.EVENT_READ, _hush)
        return door.getsockname()[1]

    # From other threads --------------------------------------------------------------------------

    def call(self, function: Callable[[], Any]) -> Any:
        """Have the loop call a function between two physics steps; returns what it returns.

        Raises:
            StandInError: The simulation has ended.
        """
        future: Future[Any] = Future()
        self._calls.append((function, future))
        self.wake()
        if self._over:
            self._cancel_calls()
        try:
            return future.result()
        except CancelledError:
            raise StandInError("the simulation has ended") from None

    def wake(self) -> None:
        """Let the loop look around, if it waits."""
        with suppress(OSError):
            self._bell_rope.send(b"!")

    # The loop ------------------------------------------------------------------------------------

    def run(self) -> None:
        """Run until the simulation is quit."""
        try:
            if self.simulator.mode is not Mode.PAUSE:
                self._start_controllers()
            while self.exit_status is None:
                self._listen(self._patience_s())
                self._answer_calls()
                self._carry_out_wanted()
                if self._may_advance():
                    self._advance()
        finally:
            self._shut_down()

    def _patience_s(self) -> float | None:
        if not self._wants_to_advance() or self._held_up():
            return None
        if self.simulator.mode is Mode.FAST or self._steps_asked:
            return 0.0
        return max(self._due_s - time.monotonic(), 0.0)

    def _wants_to_advance(self) -> bool:
        return self.simulator.mode is not Mode.PAUSE or self._steps_asked > 0

    def _held_up(self) -> bool:
        return any(controller.holds_up for controller in self.controllers)

    def _may_advance(self) -> bool:
        return self.exit_status is None and self._patience_s() == 0.0

    def _advance(self) -> None:
        now_s, step_s = time.monotonic(), self.simulator.world.basic_time_step_ms / 1000.0
        # A step that came early, as all do in fast mode, is no reason to wait longer for the next.
        self._due_s = max(min(self._due_s, now_s) + step_s, now_s - _MAX_LAG_S)
        done = self.simulator.advance()
        for controller in self.controllers:
            if controller.robot in done and controller.connection:
                controller.connection.send(step_over(self.simulator, controller.robot))
        if self._steps_asked:
            self._steps_asked -= 1
        self._carry_out_wanted()
        self._notify()

    def _listen(self, timeout_s: float | None) -> None:
        for key, _ in self._selector.select(timeout_s):
            key.data(key.fileobj)

    def _listen_until(self, condition: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + _PATIENCE_S
        while not condition() and (left_s := deadline_s - time.monotonic()) > 0.0:
            self._listen(left_s)

    def _answer_calls(self) -> None:
        while self._calls:
            function, future = self._calls.popleft()
            try:
                future.set_result(function())
            except Exception as error:  # noqa: BLE001 - it is the caller's
                future.set_exception(error)

    # Controllers ---------------------------------------------------------------------------------

    def _welcome(self, door: socket.socket) -> None:
        connection = Connection(door.accept()[0])
        self._selector.register(
            connection.stream, selectors.EVENT_READ, partial(self._hear, connection)
        )

    def _hear(self, connection: Connection, _: socket.socket) -> None:
        messages = connection.receive()
        if messages is None:
            self._forget(connection)
            return
        for message in messages:
            if controller := self._admitted.get(connection):
                self._serve(connection, controller, message)
            else:
                self._admit(connection, message)

    def _admit(self, connection: Connection, message: Message) -> None:
        _, token, name = message
        controller = next((c for c in self.controllers if c.name == name), None)
        if not hmac.compare_digest(token, self.token):
            connection.send(("refused", "the token is that of another simulation"))
        elif controller is None:
            connection.send(("refused", self.simulator.no_robot(name)))
        elif controller.connection is not None:
            connection.send(("refused", f"robot {name!r} has a controller already"))
        else:
            controller.connection, self._admitted[connection] = connection, controller
            controller.robot.forget_controller()
            connection.send(("welcome", description(self.simulator, controller.robot)))
            self._notify()

    def _serve(self, connection: Connection, controller: Controller, message: Message) -> None:
        if controller in self._ending:
            controller.tell_to_quit()
            return
        reply = answer(self.simulator, controller.robot, message)
        if reply:
            connection.send(reply)
        if message[0] == "ask":
            self._notify()

    def _forget(self, connection: Connection) -> None:
        self._selector.unregister(connection.stream)
        connection.stream.close()
        if controller := self._admitted.pop(connection, None):
            controller.connection, controller.has_left = None, True
            controller.robot.forget_controller()
            self._notify()

    def _start_controllers(self) -> None:
        for controller in self.controllers:
            controller.start()

    def _end(self, controllers: list[Controller]) -> None:
        """As Webots does it: a second to ask, a second to exit, then by force."""
        self._ending = controllers
        for controller in controllers:
            if controller.robot.remaining_ms is not None:
                controller.tell_to_quit()
        self._listen_until(lambda: not any(c.has_to_be_told for c in controllers))
        for controller in controllers:
            controller.tell_to_quit()
        self._listen_until(lambda: not any(c.is_leaving for c in controllers))
        for controller in controllers:
            controller.end()
            if connection := controller.connection:
                self._forget(connection)
        self._ending = []

    # A person's hands, to be used through `call` -------------------------------------------------

    def set_mode(self, mode: Mode) -> None:
        """Pause or run."""
        self.simulator.mode = mode
        self._after_mode_change()

    def step(self) -> None:
        """Make one basic time step and pause."""
        self.simulator.mode = Mode.PAUSE
        self._steps_asked += 1
        self._after_mode_change()

    def reset(self) -> None:
        """Reset the world and start all controllers again."""
        self._end(self.controllers)
        self.simulator.reset()
        self._start_controllers()
        self._notify()

    def load(self, path: Path) -> None:
        """Read a world and start its controllers; a bad world is named and the old one stays."""
        self._end(self.controllers)
        try:
            world = load_world(path)
            self.simulator = Simulator(world, self.simulator.mode, self.simulator.log)
            self.controllers = self._controllers_for(self.simulator, self.controllers)
        except WorldError as error:
            self.simulator.log(f"ERROR: {error}; the world stays as it was")
            self.simulator.reset()
        if self.simulator.mode is not Mode.PAUSE:
            self._start_controllers()
        self._notify()

    def quit(self, status: int) -> None:
        """End the simulation."""
        self.exit_status = status

    def _after_mode_change(self) -> None:
        self._due_s = time.monotonic()
        for controller in self.controllers:  # a world loaded in pause starts them only now
            if self._wants_to_advance() and not controller.was_started:
                controller.start()
        self._notify()

    def _carry_out_wanted(self) -> None:
        wanted, self.simulator.wanted = self.simulator.wanted, None
        if wanted is None:
            return
        if wanted.action == "quit":
            self.quit(wanted.status)
        elif wanted.action == "restart":
            self._restart(next(c for c in self.controllers if c.name == wanted.robot))
        else:
            self.load(Path(wanted.path) if wanted.path else self.simulator.world.path)

    def _restart(self, controller: Controller) -> None:
        self._end([controller])
        controller.start()

    def _shut_down(self) -> None:
        self.exit_status = self.exit_status or 0
        self._end(self.controllers)
        for key in [*self._selector.get_map().values()]:
            cast("socket.socket", key.fileobj).close()
        self._selector.close()
        self._over = True
        self._bell_rope.close()
        self._cancel_calls()
        self._notify()

    def _cancel_calls(self) -> None:
        with suppress(IndexError):  # both threads may get here at once
            while self._calls:
                self._calls.popleft()[1].cancel()


def _hush(bell: socket.socket) -> None:
    bell.recv(1024)
