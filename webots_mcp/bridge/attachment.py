"""What each step of an attached robot does in addition: publish the devices and serve commands.

A round of the controller's loop lies between two steps. The devices' values are published when a
step ends, so that they are recorded whatever the controller does next. Commands are served when the
next step begins, as a call of `get_command()` at the end of the loop would: by then the controller
has computed its reaction to the last step. Where the controller publishes by itself, the bridge
does not publish a second time: the devices' values become part of the controller's own row.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from webots_mcp.bridge.command_queue import ClaimedCommand
from webots_mcp.bridge.controller_session import Session
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.gate import QUIT, Step

_WHAT: Final = "the attached step"


class Attachment:
    """Listens to the steps of a robot, from `begin` to `end`. Nothing raises into a step.

    Args:
        session: Publishes states.
        serve: Serves the pending commands, as `get_command()` does.
        errors: Receives each failure.
    """

    def __init__(
        self, session: Session, serve: Callable[[], ClaimedCommand | None], errors: ErrorReport
    ) -> None:
        self._session = session
        self._serve = serve
        self._errors = errors
        self._throttle = session.context.throttle
        self._pause = session.context.pause
        self._clock = session.context.clock
        self._calls = self._throttle.calls  # of publish, up to the end of the last step
        self._left_to_controller = False  # the controller published in the last round
        self._last_served: ClaimedCommand | None = None

    def begin(self) -> None:
        """Listen to each step from now on."""
        self._session.control.handlers.loop_polls = False
        self._clock.stepped_s = self._session.context.simulation.time_s
        self._pause.listen_to_steps(self)

    def end(self) -> None:
        """Listen to no more steps."""
        self._session.control.handlers.loop_polls = True
        self._pause.listen_to_steps(None)

    def take_command(self) -> ClaimedCommand | None:
        """The command that was served last, for a loop that also calls `get_command()`."""
        self._session.control.handlers.loop_polls = True
        command, self._last_served = self._last_served, None
        if self._clock.sim_time_s > self._clock.stepped_s:
            self.look_for_unseen()
        return command

    def look_for_unseen(self) -> None:
        """Warn once where simulation time advanced by steps that the bridge did not see."""
        self._session.look_for_unseen(self._clock.stepped_s)

    def before(self, step: Step) -> None:
        """The controller's round is over: publish its state if it did not, and serve commands."""
        if step.finishes or self._pause.in_user_code:
            return
        try:
            self.publish_missing()
            self._last_served = self._serve() or self._last_served
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def after(self, step: Step, answer: int) -> None:
        """A step has ended, or Webots asks the controller to quit."""
        try:
            if answer == QUIT:
                self._session.end()
            elif step.ends:
                self._publish_round()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def publish_missing(self) -> None:
        """Publish the devices where the controller published a round ago, but not in this one."""
        over = self._session.context.simulation.over
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
            self._session.publisher.publish_devices({}, include_time=True)
        finally:
            self._calls = self._throttle.calls
