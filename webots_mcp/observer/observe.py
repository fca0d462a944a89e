"""The observer's controller: its loop, and what it answers when it is asked.

The loop must neither hold up the world nor hang in a pause. `step(n)` of a paused simulation does
not return, so a controller waiting in it cannot resume. A robot without synchronization need not
wait: it asks `step(0)`, which is answered at once, again and again. Whether these answers have the
time is tested, not assumed; where it does not, and in fast mode, where a moment would be
long in simulation time, the loop makes steps like any other.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any, Final

from webots_mcp.bridge.mcp_bridge import MCPBridge
from webots_mcp.contract import LOOK_AT, MODE_EVENT, OBSERVER, WORLD_EVENT
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.observer.bodies import ObservedBody, ObservedWorld

PERIOD_MS: Final = 100  # of simulation time between two rows, unless another is asked for
LONGEST_PERIOD_MS: Final = 60_000

_ROUND_S: Final = 0.01  # of wall time
_TRIAL_S: Final = 1.0  # of wall time in which time ought to have moved
_RECORD_AGAIN_S: Final = 3600.0  # of wall time: old events are purged
_MOST_CONTACTS: Final = 30
_DIGITS: Final = 6
_NO_RIGHTS: Final = (
    "the observer needs a robot with 'supervisor TRUE': {!r} is none. 'webots-mcp init --observer "
    "WORLD' adds one to a copy of a world"
)


def checked_period(period_ms: int) -> int:
    """A period that can be kept to.

    Raises:
        InvalidInputError: It cannot.
    """
    if not 1 <= period_ms <= LONGEST_PERIOD_MS:
        raise InvalidInputError(f"the period is from 1 to {LONGEST_PERIOD_MS} ms, not {period_ms}")
    return period_ms


class StepPace:
    """Makes the rounds of a loop.

    Args:
        robot: The observer's own Supervisor.
        period_ms: The step that it makes where it makes one.
    """

    def __init__(self, robot: Any, period_ms: int) -> None:
        self._robot = robot
        self._period_ms = period_ms
        self._may_pump = not robot.getSynchronization()
        self._tells_time: bool | None = None
        self._time_s = float(robot.getTime())
        self._stood_since_s = time.monotonic()

    def go_on(self) -> bool:
        """One round; False where Webots wants the controller to end."""
        if not self._may_pump or self._tells_time is False or self._is_fast():
            return self._robot.step(self._period_ms) != -1
        if self._tells_time is None and self._has_stood():
            return self._try_step()
        answer = self._robot.step(0)
        self._note()
        time.sleep(_ROUND_S)
        return answer != -1

    def _is_fast(self) -> bool:
        return self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_FAST

    def _note(self) -> None:
        now_s = float(self._robot.getTime())
        if now_s != self._time_s:
            self._time_s, self._tells_time = now_s, True

    def _has_stood(self) -> bool:
        if self._robot.simulationGetMode() == self._robot.SIMULATION_MODE_PAUSE:
            self._stood_since_s = time.monotonic()
        return time.monotonic() - self._stood_since_s > _TRIAL_S

    def _try_step(self) -> bool:
        """Make one step; where time advances by more, `step(0)` is no longer trusted to show it."""
        before_s, self._stood_since_s = self._time_s, time.monotonic()
        answer = self._robot.step(self._period_ms)
        self._time_s = float(self._robot.getTime())
        if self._time_s - before_s > 2 * self._period_ms / 1000:
            self._tells_time = False
        return answer != -1


class ObserverBridge(MCPBridge):
    """The bridge of a robot that only looks."""

    _kind = OBSERVER

    def record_world(self, world: dict[str, object]) -> None:
        """Record what there is: an event, as it changes seldom."""
        self._session.journal.event(WORLD_EVENT, world)

    def count_steps_by_time(self) -> None:
        """Count steps by time, since the world advances between two rounds of this loop."""
        self._session.clock.step_s = self._session.simulation.basic_time_step_s

    def record_mode(self) -> None:
        """Record in which mode the simulation is seen to be: an event."""
        mode = self._session.simulation.mode_name
        self._session.journal.event(MODE_EVENT, {"mode": mode})

    def failed(self, error: Exception) -> None:
        """Count what could not be seen, and say it once on stderr."""
        self._errors.failed("the observer", error)


def main(arguments: list[str] | None = None) -> None:
    """The whole controller; its first argument may be a period in milliseconds."""
    from controller import Supervisor  # type: ignore[import-not-found]

    given = sys.argv[1:] if arguments is None else arguments
    observe(Supervisor(), _period(given))


def _period(given: list[str]) -> int:
    if not given:
        return PERIOD_MS
    try:
        return checked_period(int(" ".join(given)))
    except (ValueError, InvalidInputError) as error:
        raise SystemExit(
            f"give a period of 1 to {LONGEST_PERIOD_MS} ms, not {' '.join(given)!r}"
        ) from error


def observe(robot: Any, period_ms: int = PERIOD_MS, **options: Any) -> None:
    """Record the world until Webots ends the controller.

    Args:
        robot: A `Supervisor`.
        period_ms: Simulation time between two rows; it is rounded up to whole basic time steps.
        options: As of `MCPBridge`.

    Raises:
        CommandRefusedError: The robot has no supervisor's rights.
    """
    with Observer(robot, period_ms, **options) as observer:
        while observer.go_on():
            pass


class Observer:
    """Looks at a world, round by round.

    Raises:
        CommandRefusedError: The robot has no supervisor's rights.
    """

    def __init__(self, robot: Any, period_ms: int = PERIOD_MS, **options: Any) -> None:
        if not robot.getSupervisor():
            raise CommandRefusedError(_NO_RIGHTS.format(str(robot.getName())))
        basic_ms = float(robot.getBasicTimeStep())
        self._period_ms = max(int(math.ceil(period_ms / basic_ms) * basic_ms), 1)
        self._robot = robot
        self.bridge = ObserverBridge(robot, throttle_interval=1, keep_last_s=0, **options)
        self.bridge.count_steps_by_time()
        self.world = ObservedWorld(robot, self._period_ms, self._warn)
        self._pace = StepPace(robot, self._period_ms)
        self._due_s = -math.inf
        self._mode = -1
        self._record_again_s = math.inf
        self.bridge.register_command(LOOK_AT, self.look_at)

    def __enter__(self) -> Observer:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        self.bridge.__exit__(kind, error, traceback)

    def go_on(self) -> bool:
        """One round; False where Webots wants the controller to end."""
        if not self._pace.go_on():
            return False
        try:
            self._look()
        except Exception as error:  # noqa: BLE001  (it still steers, and looks again later)
            self.bridge.failed(error)
        self.bridge.get_command()
        return True

    def _look(self) -> None:
        """Look around, and record where everything is if it is time to."""
        sim_time_s = float(self._robot.getTime())
        if self.bridge.detect_reload():
            self.world.begin_run()
            self._due_s = -math.inf
        self._record_news()
        if sim_time_s >= self._due_s and (seen := self.world.look(sim_time_s)):
            self._due_s = sim_time_s + self._period_ms / 1000 - 1e-6
            self.bridge.publish(seen)

    def _record_news(self) -> None:
        """Record the mode and what there is where they are not as before, or long ago."""
        is_due, mode = time.monotonic() > self._record_again_s, int(self._robot.simulationGetMode())
        if mode != self._mode or is_due:
            self._mode = mode
            self.bridge.record_mode()
        self.world.go_on()
        if self.world.is_new or is_due:
            self._record_again_s = time.monotonic() + _RECORD_AGAIN_S
            self.bridge.record_world(self.world.describe())

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
    velocity = [round(float(value), _DIGITS) for value in node.getVelocity()]
    answer: dict[str, Any] = {
        "key": body.key,
        "position_m": [round(float(value), _DIGITS) for value in node.getPosition()],
        "velocity_mps": velocity[:3],
        "angular_velocity_radps": velocity[3:],
    }
    return answer | _standing(node, robot)


def _standing(node: Any, robot: Any) -> dict[str, Any]:
    """Contacts, centre of mass and balance of a Solid; a note where Webots has none for it."""
    try:
        contacts = node.getContactPoints(True)
        return {
            "contacts": [_contact(contact, robot) for contact in contacts[:_MOST_CONTACTS]],
            "contacts_in_all": len(contacts),
            "center_of_mass_m": [round(float(value), _DIGITS) for value in node.getCenterOfMass()],
            "is_balanced": bool(node.getStaticBalance()),
        }
    except (AttributeError, TypeError, ValueError) as error:  # a null pointer is a ValueError
        return {"not_told": f"contact points, centre of mass and balance: {error}"}


def _contact(contact: Any, robot: Any) -> list[Any]:
    """Where it touches, and with which of its nodes."""
    point = [round(float(value), _DIGITS) for value in contact.getPoint()[:3]]
    node = robot.getFromId(contact.getNodeId())
    return [*point, None if node is None else node.getDef() or node.getTypeName()]
