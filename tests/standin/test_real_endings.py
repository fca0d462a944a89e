"""What getters give at the end of the simulation is what those of Webots' own package give."""

from __future__ import annotations

from collections.abc import Iterator
from math import isnan
from pathlib import Path
from typing import Any, NamedTuple, cast

import pytest

from webots_mcp.standin import ControllerEndedError, InProcessSimulation, InProcessSupervisor

HERE = Path(__file__).parent
STEP_MS = 16


class Ending(NamedTuple):
    """A line of the table."""

    before: str
    expression: str
    is_asked_before: bool
    until_the_step: str
    """What it gives when the controller is ended and `step` has not returned -1 yet."""
    after_it: str


def endings() -> Iterator[Ending]:
    for line in (HERE / "real_endings.tsv").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            before, expression, asked, until, after = line.split("\t")
            yield Ending(before, expression, asked == "asked before", until, after)


class Host:
    """A supervisor that has read all its sensors, in a simulation that a person can end."""

    def __init__(self, ending: Ending) -> None:
        self.simulation = InProcessSimulation(HERE / "ending_host.wbt")
        self.robot = InProcessSupervisor("robot", world=self.simulation)
        self.names: dict[str, Any] = {"robot": self.robot}
        self.expression = ending.expression
        for index in range(self.robot.getNumberOfDevices()):
            device = self.robot.getDeviceByIndex(index)
            if hasattr(device, "enable"):
                device.enable(STEP_MS)
        for _ in range(3):
            self.robot.step(STEP_MS)
        if ending.before != "-":
            exec(ending.before, self.names)
        self.answered_before = self.value() if ending.is_asked_before else self
        self.simulation.reload()

    def value(self) -> object:
        try:
            return cast("object", eval(self.expression, self.names))
        except ControllerEndedError:
            return "exits"
        except AttributeError as error:
            return error

    def answer(self) -> str:
        """What it gives now, in the words of the table."""
        value = self.value()
        same = type(value) is type(self.answered_before)
        if same and (value == self.answered_before or hasattr(value, "__dict__")):
            return "as before"
        if isinstance(value, AttributeError):
            return f"EXC AttributeError: {value}"
        if isinstance(value, list):
            numbers = cast("list[float]", value)
            return f"list[{len(numbers)}]" + (
                " of nan" if all(map(isnan, numbers)) else "" if any(numbers) else " of 0"
            )
        if value == "exits":
            return "exits"
        if value is None or isinstance(value, (int, str)):
            return repr(value)
        return type(value).__name__

    def matches(self, expected: str) -> bool:
        answer = self.answer()
        return answer == expected or (expected == "list" and answer.startswith("list["))


@pytest.mark.parametrize("ending", [*endings()], ids=lambda ending: "|".join(ending[:2]))
def test_a_getter_gives_at_the_end_what_it_gives_in_webots(ending: Ending) -> None:
    host = Host(ending)
    if "getPositionSensor" in ending.expression:  # the stand-in knows it without a request
        host.robot.getFromDef("NOBODY")
    assert host.matches(ending.until_the_step)
    assert host.matches(ending.until_the_step)
    assert host.robot.step(STEP_MS) == -1
    assert host.matches(ending.after_it)
    stepped = Host(ending)
    assert stepped.robot.step(STEP_MS) == -1
    assert stepped.matches(ending.after_it)


def test_the_news_of_the_end_may_come_with_another_request() -> None:
    for ending in endings():
        host = Host(ending)
        assert host.robot.getFromDef("NOBODY") is None
        assert host.matches(ending.until_the_step), ending
        assert host.robot.step(STEP_MS) == -1
