"""A request to steer the simulation: sent to a controller, waited for, tried by other routes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from webots_mcp.contract import HEARTBEAT_LATE_S
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.recording import Recording

CLAIMING_S: Final = HEARTBEAT_LATE_S + 0.5  # a loop that has just stopped is detected within it
UNCLAIMED: Final = ("cancelled", "expired")
LEAST_S: Final = 0.1  # that each route gets


@dataclass
class Request:
    """One request, by all routes.

    Attributes:
        robot: The robot whose simulation to steer; None where there is only one.
        timeout_s: The wall time for all routes together, in seconds.
        failed_routes: Why each route did not work, by its name.
    """

    recording: Recording
    dispatcher: Dispatcher
    robot: str | None
    timeout_s: float
    failed_routes: dict[str, str] = field(default_factory=dict[str, str], init=False)
    started_s: float = field(default_factory=time.monotonic, init=False)

    async def _sent(
        self, robot: str | None, action: str, params: Mapping[str, Any], claiming_s: float
    ) -> CommandAnswer:
        """The outcome of a command, which the controller must claim within `claiming_s`."""
        answer = await self.dispatcher.ask(
            robot, action, self._left_s, params, claiming_s=claiming_s
        )
        answer.waited_s = self._waited_s
        return answer

    def _header(self, robot: str) -> dict[str, Any]:
        with self.recording.view(robot) as view:
            return view.header()

    def _failed_routes(self) -> str:
        return "; ".join(f"{route}: {why}" for route, why in self.failed_routes.items())

    @property
    def _waited_s(self) -> float:
        return round(time.monotonic() - self.started_s, 3)

    @property
    def _left_s(self) -> float:
        return max(self.timeout_s - (time.monotonic() - self.started_s), LEAST_S)
