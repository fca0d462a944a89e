"""The loop that runs a simulation: serves controllers, keeps time, starts and ends processes."""

from __future__ import annotations

import hmac
import secrets
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from controller.wire import Message

from webots_mcp.standin.controller_answers import answer, description, step_over
from webots_mcp.standin.controller_socket import Connection
from webots_mcp.standin.controllers import Controller
from webots_mcp.standin.simulator import Mode, Simulator
from webots_mcp.standin.standin_errors import StandInError, WorldError
from webots_mcp.standin.world import load_world

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
