"""What the buttons and inputs of the page do: the way that the tools' own commands go."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import anyio

from webots_mcp.errors import WebotsMCPError
from webots_mcp.parameter import Value
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.questions.send_command import set_parameters
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import Attempt
from webots_mcp.store.recording import Recording
from webots_mcp.webots.orders import Order

_WAIT_S: Final = 10.0


def steer(recording: Recording, robot: str, order: Order) -> dict[str, Any]:
    """Give an order to the simulation of a robot; answers in words what came of it."""
    params = {"steps": 1} if order == "step" else {}
    dispatcher = Dispatcher(recording, _silent)
    attempt = Attempt(recording, dispatcher, robot, _WAIT_S, order, params)
    return _told(order, attempt.steer)


def tune(recording: Recording, robot: str, name: str, value: Value) -> dict[str, Any]:
    """Set one parameter of a robot's controller, and say what came of it."""
    setting = partial(
        set_parameters, recording, _silent, {name: value}, robot=robot, timeout_s=_WAIT_S
    )
    return _told(f"{name} = {value!r}", setting)


def _told(what: str, ask: Any) -> dict[str, Any]:
    try:
        answer: CommandAnswer = anyio.run(ask)
    except WebotsMCPError as error:
        return {"text": f"{what}: {error}", "is_done": False}
    if answer.outcome == "done":
        return {"text": f"{what}: done", "is_done": True}
    why = answer.error or answer.hint or "no answer in time"
    return {"text": f"{what}: not done ({answer.outcome}): {why}", "is_done": False}


async def _silent(waited_s: float, of_s: float | None, text: str) -> None:
    """The page says that it waits by the button itself."""
