"""What the buttons and inputs of the page do: the same commands as those of the tools."""

from __future__ import annotations

import re
import threading
import time
from functools import partial
from typing import Any, Final

import anyio

from webots_mcp.answers.answer_models import CommandAnswer
from webots_mcp.contract import VERSION
from webots_mcp.errors import WebotsMCPError
from webots_mcp.questions.controller_parameters import set_parameters
from webots_mcp.signals.naming import spelled_out
from webots_mcp.signals.parameter import Value
from webots_mcp.simulator.orders import Order
from webots_mcp.simulator.own_webots import own_webots
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import Attempt
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import OpenRequest, Requester

_WAIT_S: Final = 10.0
"""How long to wait for the answer of a controller."""
_SEARCH_EVERY_S: Final = 3.0
"""How long the result of a search for Webots is used, which reads the list of all processes."""
_SHORT_CHARACTERS: Final = 120
"""Characters of the line that reports a refusal; the details are shown on demand."""
_BY_PAGE: Final = Requester("webots-mcp view", VERSION, "page")


class WebotsSearch:
    """Finds out whether a Webots of a recording runs, and remembers it for some seconds."""

    def __init__(self, recording: RecordingAccess) -> None:
        self._recording = recording
        self._lock = threading.Lock()
        self._is_found, self._until_s = False, 0.0

    def is_found(self) -> bool:
        """Return whether a Webots of the recording runs on this machine.

        Raises:
            DatabaseError: The recording cannot be read.
        """
        with self._lock:
            if time.monotonic() >= self._until_s:
                self._is_found = bool(own_webots(self._recording))
                self._until_s = time.monotonic() + _SEARCH_EVERY_S
            return self._is_found


def why_not_steerable(robot: str, search: WebotsSearch, *, is_live: bool) -> str:
    """Return why nobody would carry out an order for a robot; empty if somebody can."""
    if is_live or search.is_found():
        return ""
    return (
        f"The controller of {robot} is not running, and no Webots of this project runs on this "
        "computer. Start the simulation to use these buttons."
    )


def steer(recording: RecordingAccess, robot: str, order: Order) -> dict[str, Any]:
    """Send an order to the simulation of a robot; return the outcome in words."""
    params = {"steps": 1} if order == "step" else {}
    dispatcher = Dispatcher(recording, _silent)
    attempt = Attempt(recording, dispatcher, robot, _WAIT_S, order, params)
    asked = {"command": order, "robot": robot}
    request = OpenRequest(recording, _BY_PAGE, ["webots_simulation_control"], asked)
    return _carry_out(order, attempt.steer, request)


def tune(recording: RecordingAccess, robot: str, name: str, value: Value) -> dict[str, Any]:
    """Set one parameter of a robot's controller; return the outcome in words."""
    setting = partial(
        set_parameters, recording, _silent, {name: value}, robot=robot, timeout_s=_WAIT_S
    )
    asked = {"values": {name: value}, "robot": robot}
    request = OpenRequest(recording, _BY_PAGE, ["webots_set_parameters"], asked)
    return _carry_out(f"{name} = {value!r}", setting, request)


def _carry_out(what: str, ask: Any, request: OpenRequest) -> dict[str, Any]:
    try:
        with request:
            answer: CommandAnswer = anyio.run(ask)
            request.outcome = answer.outcome or ""
    except WebotsMCPError as error:
        return _refusal(what, str(error))
    if answer.outcome == "done":
        return {"text": f"{what}: done", "details": "", "is_done": True}
    why = answer.error or answer.hint or "no answer in time"
    return _refusal(f"{what}: not done ({answer.outcome})", why)


def _refusal(what: str, why: str) -> dict[str, Any]:
    """Return the first sentence of a reason in one short line, and all of it as details."""
    why = spelled_out(why)
    first = re.split(r"[.;]\s|\n", why, maxsplit=1)[0]
    if len(first) > _SHORT_CHARACTERS:
        first = first[:_SHORT_CHARACTERS].rsplit(" ", 1)[0] + " …"
    details = "" if first == why.rstrip(".") else why
    return {"text": f"{what}: {first}", "details": details, "is_done": False}


async def _silent(waited_s: float, of_s: float | None, text: str) -> None:
    """Report no progress: the button of the page shows that it waits."""
