"""What the buttons and inputs of a tab do: the way that the tools' own commands go."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from webots_mcp.errors import WebotsMCPError
from webots_mcp.parameter import Value
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.questions.send_command import set_parameters
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import Attempt
from webots_mcp.store.recording import Recording
from webots_mcp.webots.orders import Order

ORDERS: Final[tuple[Order, ...]] = ("pause", "resume", "step", "reset")
_WAIT_S: Final = 10.0


class Told(NamedTuple):
    """What came of an order, in words, and whether it was done."""

    text: str
    is_done: bool = False


async def steer(recording: Recording, robot: str, order: Order) -> Told:
    """Give an order to the simulation of a robot, and say what came of it."""
    params = {"steps": 1} if order == "step" else {}
    dispatcher = Dispatcher(recording, _silent)
    attempt = Attempt(recording, dispatcher, robot, _WAIT_S, order, params)
    return await _told(order, attempt.steer())


async def tune(recording: Recording, robot: str, name: str, value: Value) -> Told:
    """Set one parameter of a robot's controller, and say what came of it."""
    setting = set_parameters(recording, _silent, {name: value}, robot=robot, timeout_s=_WAIT_S)
    return await _told(f"{name} = {value!r}", setting)


async def _told(what: str, asked: Any) -> Told:
    try:
        answer: CommandAnswer = await asked
    except WebotsMCPError as error:
        return Told(f"{what}: {error}")
    if answer.outcome == "done":
        return Told(f"{what}: done", is_done=True)
    why = answer.error or answer.hint or "no answer in time"
    return Told(f"{what}: not done ({answer.outcome}): {why}")


async def _silent(waited_s: float, of_s: float | None, text: str) -> None:
    """The page says that it waits by the button itself."""
