"""Define the observer: a robot that records what it sees of the world, and steers the simulation.

It is a Supervisor with a bridge of its own, so the controllers of the robots that it watches need
no change. It uses the standard library only, because it runs inside a controller.

The loop must neither delay the world nor hang in a pause. `step(n)` of a paused simulation does not
return, so a controller waiting in it cannot resume. A robot without synchronization need not wait:
it calls `step(0)` again and again, which is answered at once. The observer tests whether these
answers carry the current time. If they do not, and in fast mode, where a moment would be long in
simulation time, the loop makes steps like any other.
"""

from __future__ import annotations

import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from typing import Any, Final

from webots_mcp.bridge.custom_data import CustomDataReader, ObserverParts
from webots_mcp.bridge.mcp_bridge import MCPBridge
from webots_mcp.contract import LOOK_AT, MODE_EVENT, OBSERVER, WORLD_EVENT
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.signals.meaning import DeclaredMeaning
from webots_mcp.simulator.observed_bodies import DIGITS, ObservedBodies, ObservedBody

PERIOD_MS: Final = 100  # default simulation time between two rows
LONGEST_PERIOD_MS: Final = 60_000
_GRACE_S: Final = 2.0  # wall time within which a loop that a signal ends has to return


def checked_period(period_ms: int) -> int:
    """Return a period that is within the limits.

    Raises:
        InvalidInputError: If it is not.
    """
    if not 1 <= period_ms <= LONGEST_PERIOD_MS:
        raise InvalidInputError(f"the period is from 1 to {LONGEST_PERIOD_MS} ms, not {period_ms}")
    return period_ms


class StepPace:
    """Makes the rounds of a loop.

    Args:
        robot: The observer's own Supervisor.
        period_ms: The step that it makes where it makes one.
        world_waits: Whether the world waits for the observer's steps.
        moves: Returns whether something in the world has moved since it was last asked.
    """

    def __init__(
        self, robot: Any, period_ms: int, *, world_waits: bool, moves: Callable[[], bool]
    ) -> None:
        self._robot = robot
        self._moves = moves
        self._period_ms = period_ms
        self._may_pump = not world_waits
        self._tells_time: bool | None = None
        self._time_s = float(robot.getTime())
        self._stood_since_s = time.monotonic()

    def go_on(self, *, may_step: bool = True) -> bool:
        """Make one round; return False if Webots wants the controller to end.

        Args:
            may_step: Whether it may make a step, which a command that counts steps forbids.
        """
        if not may_step:
            self._stood_since_s = time.monotonic()
            return self._robot.step(0) != -1
        is_fast = self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_FAST
        if not self._may_pump or self._tells_time is False or is_fast:
            return self._robot.step(self._period_ms) != -1
        if self._tells_time is None and self._has_stood():
            self._stood_since_s = time.monotonic()
            # Where a robot's loop hangs, nothing moves, and a step would wait for it.
            if self._moves():
                return self._try_step()
        answer = self._robot.step(0)
        now_s = float(self._robot.getTime())
        if now_s != self._time_s:
            self._time_s, self._tells_time = now_s, True
        time.sleep(0.01)
        return answer != -1

    def _has_stood(self) -> bool:
        if self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_PAUSE:
            self._stood_since_s = time.monotonic()
        return time.monotonic() - self._stood_since_s > 1.0

    def _try_step(self) -> bool:
        """Make one step; where time advances by more, `step(0)` is no longer trusted to show it."""
        before_s = self._time_s
        answer = self._robot.step(self._period_ms)
        self._time_s = float(self._robot.getTime())
        if self._time_s - before_s > 2 * self._period_ms / 1000:
            self._tells_time = False
        return answer != -1


class ObserverBridge(MCPBridge):
    """The bridge of a robot that only observes others."""

    _kind = OBSERVER

    def record_event(self, kind: str, data: dict[str, object]) -> None:
        """Record what seldom changes: the bodies of the world, and the simulation mode."""
        self._session.journal.event(kind, data)

    def record_meanings(self, known: Sequence[tuple[DeclaredMeaning, str]]) -> None:
        """Record what signals mean, and what says it."""
        self._session.meanings.record_devices(known)

    def count_steps_by_time(self) -> None:
        """Count steps by time, since the world advances between two rounds of this loop."""
        self._session.clock.step_s = self._session.simulation.basic_time_step_s

    @property
    def world_waits(self) -> bool:
        """Whether the world waits for the observer's steps, by its own field."""
        return self._session.simulation.waits_for_robot

    @property
    def steps_world(self) -> bool:
        """Whether a command counts the observer's steps, for which the world waits meanwhile."""
        return self._session.simulation.world_is_waiting

    @property
    def mode_name(self) -> str:
        """The mode in which the simulation is seen to be."""
        return self._session.simulation.mode_name

    def read_custom_data(self) -> CustomDataReader:
        """Return what records the robots that have no bridge of their own."""
        own = self._session
        parts = (own.identity, own.simulation, own.clock, own.recorder, own.journal, own.errors)
        return CustomDataReader(ObserverParts(*parts))

    def failed(self, error: Exception) -> None:
        """Count what could not be seen, and say it once on stderr."""
        self._errors.failed("the observer", error)


def main(arguments: list[str] | None = None) -> None:
    """Run the whole controller; its first argument may be a period in milliseconds."""
    from controller import Supervisor  # type: ignore[import-not-found]

    given = " ".join(sys.argv[1:] if arguments is None else arguments)
    try:
        period_ms = checked_period(int(given)) if given else PERIOD_MS
    except (ValueError, InvalidInputError) as error:
        raise SystemExit(f"give a period of 1 to {LONGEST_PERIOD_MS} ms, not {given!r}") from error
    observe(Supervisor(), period_ms)


def observe(robot: Any, period_ms: int = PERIOD_MS, **options: Any) -> None:
    """Record the world until Webots ends the controller.

    Args:
        robot: A `Supervisor`.
        period_ms: Simulation time between two rows; it is rounded up to whole basic time steps.
        options: As of `MCPBridge`.

    Raises:
        CommandRefusedError: The robot has no supervisor's rights.
    """
    with EndSignals() as signals:
        observer = Observer(robot, period_ms, **options)
        with observer.bridge, closing(observer.custom_data):
            while signals.received is None and observer.go_on():
                pass


class EndSignals:
    """Lets SIGINT, SIGTERM and SIGHUP end the observer's loop between two rounds.

    Webots' library would end the process at once, and a world that waits for the observer's steps
    would wait on. A loop that does not come round, because it is blocked in a step, is ended after
    `_GRACE_S`: a signal's handler runs in no other thread, but the system wakes one.

    Attributes:
        received: The signal; None as long as there was none.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._over = threading.Event()
        self._before: dict[int, Any] = {}
        self._sockets = socket.socketpair()
        self._wakes_before = -1

    def __enter__(self) -> EndSignals:
        if threading.current_thread() is threading.main_thread():
            reader, writer = self._sockets
            writer.setblocking(False)
            names = (name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
            for number in (getattr(signal, name) for name in names):
                self._before[number] = signal.signal(number, self._receive)
                if hasattr(signal, "siginterrupt"):  # Webots' library takes EINTR for an error
                    signal.siginterrupt(number, False)
            self._wakes_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(reader,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._before:
            signal.set_wakeup_fd(self._wakes_before)
            for number, handler in self._before.items():
                signal.signal(number, handler)
        for each in self._sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        if self.received is not None:
            signal.signal(self.received, signal.SIG_DFL)
            signal.raise_signal(self.received)

    def _receive(self, number: int, _: object) -> None:
        self.received = number

    def _watch(self, reader: socket.socket) -> None:
        with suppress(OSError):
            while number := reader.recv(1):
                if number[0] in self._before and not self._over.wait(_GRACE_S):
                    os._exit(128 + number[0])


class Observer:
    """Looks at a world, round by round.

    Raises:
        CommandRefusedError: The robot has no supervisor's rights.
    """

    def __init__(self, robot: Any, period_ms: int = PERIOD_MS, **options: Any) -> None:
        if not robot.getSupervisor():
            raise CommandRefusedError(
                "the observer needs a robot with 'supervisor TRUE': "
                f"{str(robot.getName())!r} is none. 'webots-mcp init --observer WORLD' adds one to "
                "a copy of a world"
            )
        basic_ms = float(robot.getBasicTimeStep())
        self._period_ms = max(int(math.ceil(period_ms / basic_ms) * basic_ms), 1)
        self._robot = robot
        self.bridge = ObserverBridge(robot, throttle_interval=1, keep_last_s=0, **options)
        self.bridge.count_steps_by_time()
        self.world = ObservedBodies(robot, self._period_ms, self._warn)
        self.bridge.record_meanings(self.world.describe_signals())
        self.custom_data = self.bridge.read_custom_data()
        waits = self.bridge.world_waits
        self._pace = StepPace(robot, self._period_ms, world_waits=waits, moves=self._moves)
        self._due_s = -math.inf
        self._mode = -1
        self._record_again_s = math.inf
        self.bridge.register_command(LOOK_AT, self.look_at)

    def go_on(self) -> bool:
        """Make one round; return False if Webots wants the controller to end."""
        if not self._pace.go_on(may_step=not self.bridge.steps_world):
            return False
        try:
            self._observe()
        except Exception as error:  # noqa: BLE001  (it still steers, and tries again later)
            self.bridge.failed(error)
        self.bridge.get_command()
        return True

    def _moves(self) -> bool:
        try:
            return self.world.moves()
        except Exception as error:  # noqa: BLE001  (it still steers, and tries again later)
            self.bridge.failed(error)
            return False

    def _observe(self) -> None:
        """Follow what is in the world, and record where everything is if that is due."""
        sim_time_s = float(self._robot.getTime())
        if self.bridge.detect_reload():
            self.world.begin_run()
            self._due_s = -math.inf
        self._record_news()
        is_due = sim_time_s >= self._due_s
        if is_due and (seen := self.world.read_poses(sim_time_s)):
            self._due_s = sim_time_s + self._period_ms / 1000 - 1e-6
            self.bridge.publish(seen)
        self.custom_data.read_all(
            [body for body in self.world.bodies.values() if body.is_robot], is_due=is_due
        )

    def _record_news(self) -> None:
        """Record the mode and the content of the world if they changed or are old."""
        is_due, mode = time.monotonic() > self._record_again_s, int(self._robot.simulationGetMode())
        if mode != self._mode or is_due:
            self._mode = mode
            self.bridge.record_event(MODE_EVENT, {"mode": self.bridge.mode_name})
        self.world.go_on()
        if self.world.is_new or is_due:
            self._record_again_s = time.monotonic() + 3600.0  # old events are purged
            self.bridge.record_event(WORLD_EVENT, self.world.describe())

    def _warn(self, text: str) -> None:
        self.bridge.log(text, "warning")

    def look_at(self, command: dict[str, Any]) -> dict[str, Any]:
        """Velocity, contact points, centre of mass and static balance of a robot or solid now.

        params: of (its DEF, its name, or its word in the signals world.WORD.x_m).
        """
        body = self.world.find(command["params"].get("of"))
        if body is None:
            there = ", ".join(self.world.bodies) or "nothing yet"
            raise InvalidInputError(f"give params.of: one of {there}")
        return _looked_at(body, self._robot)


def _looked_at(body: ObservedBody, robot: Any) -> dict[str, Any]:
    node = body.scene.node
    velocity = [round(float(value), DIGITS) for value in node.getVelocity()]
    answer: dict[str, Any] = {
        "key": body.key,
        "position_m": [round(float(value), DIGITS) for value in node.getPosition()],
        "velocity_mps": velocity[:3],
        "angular_velocity_radps": velocity[3:],
    }
    return answer | _standing(node, robot)


def _standing(node: Any, robot: Any) -> dict[str, Any]:
    """Contacts, centre of mass and balance of a Solid; a note where Webots has none for it."""
    try:
        contacts = node.getContactPoints(True)
        return {
            "contacts": [_contact(contact, robot) for contact in contacts[:30]],
            "contacts_in_all": len(contacts),
            "contacts_note": (
                "No event or check judges contacts. Webots reports none for bodies that sleep "
                "and for nested robots: an empty list does not show that nothing touches."
            ),
            "center_of_mass_m": [round(float(value), DIGITS) for value in node.getCenterOfMass()],
            "is_balanced": bool(node.getStaticBalance()),
        }
    except (AttributeError, TypeError, ValueError) as error:  # a null pointer is a ValueError
        return {"not_told": f"contact points, centre of mass and balance: {error}"}


def _contact(contact: Any, robot: Any) -> list[Any]:
    """Return where it touches, and with which of its nodes."""
    point = [round(float(value), DIGITS) for value in contact.getPoint()[:3]]
    node = robot.getFromId(contact.getNodeId())
    return [*point, None if node is None else node.getDef() or node.getTypeName()]
