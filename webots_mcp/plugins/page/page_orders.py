"""What the buttons and inputs of the page do: the same commands as those of the tools."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import anyio

from webots_mcp.answers.answer_models import CommandAnswer
from webots_mcp.contract import VERSION
from webots_mcp.errors import WebotsMCPError
from webots_mcp.questions.controller_parameters import set_parameters
from webots_mcp.signals.parameter import Value
from webots_mcp.simulator.orders import Order
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import Attempt
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import OpenRequest, Requester

_WAIT_S: Final = 10.0
"""How long to wait for the answer of a controller."""
_BY_PAGE: Final = Requester("webots-mcp view", VERSION, "page")


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
        return {"text": f"{what}: {error}", "is_done": False}
    if answer.outcome == "done":
        return {"text": f"{what}: done", "is_done": True}
    why = answer.error or answer.hint or "no answer in time"
    return {"text": f"{what}: not done ({answer.outcome}): {why}", "is_done": False}


async def _silent(waited_s: float, of_s: float | None, text: str) -> None:
    """Report no progress: the button of the page shows that it waits."""
