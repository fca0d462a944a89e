"""What the bridge adds to each step of an attached robot: it publishes devices and serves commands.

One round of the controller's loop runs from the end of a step to the beginning of the next one. At
the end of a step the devices' values are published, so that they are recorded whatever the
controller does next. Before the next step commands are served, as if the loop called
`get_command()` at its end.

If the controller publishes by itself, the bridge does not publish a second time: the devices'
values become part of the controller's own row.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from webots_mcp.bridge.claimed_commands import ClaimedCommand, Handlers
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.publishing import Publisher
from webots_mcp.bridge.simulation import QUIT, Clock, Simulation, Step
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import UNSEEN

_UNSEEN_S: Final = 1.0  # of simulation time; less may be one step whose end an interrupt hid
_WHAT: Final = "the attached step"


class UnseenSteps:
    """Warns once that the loop makes steps that the bridge does not see."""

    def __init__(self, simulation: Simulation, journal: Journal, errors: ErrorReport) -> None:
        self._simulation = simulation
        self._journal = journal
        self._errors = errors
        self._reported = False

    def check(self, seen_s: float) -> None:
        """Warn if simulation time has advanced beyond the steps that the bridge saw.

        Args:
            seen_s: The newest simulation time at which the bridge saw the loop.
        """
        simulation = self._simulation
        if self._reported or simulation.over:
            return
        unseen_s = simulation.time_s - seen_s
        if unseen_s < _UNSEEN_S or not simulation.waits_for_robot:
            return
        self._reported = True
        text = f"{UNSEEN}; so far it has missed {unseen_s:.1f} s of simulation time"
        self._journal.log("warning", "bridge", text)
        self._errors.warn("unseen", text)


class Attachment:
    """Listens to the steps of a robot, from `begin` to `end`. Nothing raises into a step.

    Args:
        serve: Serves the pending commands, as `get_command()` does.
        end_session: Called when Webots asks the controller to quit.
    """

    def __init__(
        self,
        publisher: Publisher,
        throttle: Throttle,
        simulation: Simulation,
        clock: Clock,
        pause: Pause,
        handlers: Handlers,
        errors: ErrorReport,
        unseen: UnseenSteps,
        serve: Callable[[], ClaimedCommand | None],
        end_session: Callable[[], None],
    ) -> None:
        self._publisher = publisher
        self._simulation = simulation
        self._handlers = handlers
        self._serve = serve
        self._end_session = end_session
        self._errors = errors
        self._unseen = unseen
        self._throttle = throttle
        self._pause = pause
        self._clock = clock
        self._calls = self._throttle.calls  # of publish, up to the end of the last step
        self._left_to_controller = False  # the controller published in the last round
        self._last_served: ClaimedCommand | None = None

    def begin(self) -> None:
        """Listen to each step from now on."""
        self._handlers.loop_polls = False
        self._clock.stepped_s = self._simulation.time_s
        self._pause.listen_to_steps(self)

    def end(self) -> None:
        """Listen to no more steps."""
        self._handlers.loop_polls = True
        self._pause.listen_to_steps(None)

    def take_command(self) -> ClaimedCommand | None:
        """Return the command served last, once: for a loop that also calls `get_command()`."""
        self._handlers.loop_polls = True
        command, self._last_served = self._last_served, None
        if self._clock.sim_time_s > self._clock.stepped_s:
            self.report_unseen()
        return command

    def report_unseen(self) -> None:
        """Warn once if simulation time advanced by steps that the bridge did not see."""
        self._unseen.check(self._clock.stepped_s)

    def before(self, step: Step) -> None:
        """Before a step: publish the state if the controller did not, and serve commands."""
        if step.finishes or self._pause.in_user_code:
            return
        try:
            self.publish_missing()
            self._last_served = self._serve() or self._last_served
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def after(self, step: Step, answer: int) -> None:
        """After a step: publish the devices' values, or end if Webots asks for it."""
        try:
            if answer == QUIT:
                self._end_session()
            elif step.ends:
                self._publish_round()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def publish_missing(self) -> None:
        """Publish the devices if the controller published in the last round but not in this one."""
        over = self._simulation.over
        if self._left_to_controller and self._throttle.calls == self._calls and not over:
            self._publish()

    def _publish_round(self) -> None:
        self._left_to_controller = self._throttle.calls > self._calls
        self._calls = self._throttle.calls
        if not self._left_to_controller:
            self._publish()

    def _publish(self) -> None:
        self._left_to_controller = False
        try:
            self._publisher.publish_devices({}, include_time=True)
        finally:
            self._calls = self._throttle.calls
