"""What each step of an attached robot does besides: publish what the devices say, serve commands.

A round of the controller's loop lies between two steps. What the devices say is published when a
step ends, so that it is recorded whatever the controller does next. Commands are served when the
next step begins, as a call of `get_command()` at the end of the loop would: the controller has had
its say by then. One that publishes by itself is left to it, and the same row has what the devices
say.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from webots_mcp.bridge.commands import ClaimedCommand
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.gate import QUIT, Step
from webots_mcp.bridge.session import Session

_WHAT: Final = "the attached step"


class Attachment:
    """Goes along with the steps of a robot, from `begin` to `end`. Nothing raises into them.

    Args:
        session: What publishes, and where commands are looked for.
        serve: Serves the commands that wait, as `get_command()` does.
        errors: Told of what failed.
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
        self._left_to_controller = False
        self._unlooked: ClaimedCommand | None = None

    def begin(self) -> None:
        """From now on each step is gone along with."""
        self._session.control.handlers.loop_looks = False
        self._clock.stepped_s = self._session.context.simulation.time_s
        self._pause.go_along(self)

    def end(self) -> None:
        """No step is, from now on."""
        self._session.control.handlers.loop_looks = True
        self._pause.go_along(None)

    def take_command(self) -> ClaimedCommand | None:
        """The command that was served last, for a loop that asks for it by itself."""
        self._session.control.handlers.loop_looks = True
        command, self._unlooked = self._unlooked, None
        if self._clock.sim_time_s > self._clock.stepped_s:
            self.look_for_unseen()
        return command

    def look_for_unseen(self) -> None:
        """Say it once where time went on by steps that did not come by here."""
        self._session.look_for_unseen(self._clock.stepped_s)

    def before(self, step: Step) -> None:
        """The controller's round is over: publish what it did not, and serve commands."""
        if step.finishes or self._pause.in_user_code:
            return
        try:
            self.publish_missing()
            self._unlooked = self._serve() or self._unlooked
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def after(self, step: Step, answer: int) -> None:
        """Time has passed, or Webots wants the controller to end."""
        try:
            if answer == QUIT:
                self._session.end()
            elif step.ends:
                self._publish_round()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def publish_missing(self) -> None:
        """The controller published in the round before and did not in this one."""
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
