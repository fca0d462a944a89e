"""Seeing and setting the parameters of a controller over MCP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.server.conftest import Connect, Driver, ask, fail

pytestmark = pytest.mark.anyio


class TunableDriver(Driver):
    """The driver, with three parameters."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        declare = self.bridge.parameter
        self.kp = declare("kp", 2.0, low=0, high=10, doc="steering gain", unit="1/s")
        self.laps = declare("laps", 3, low=1)
        self.gait = declare("gait", "trot", choices=["trot", "walk"])


@pytest.fixture
def tunable(file: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(file)
    driving.start()
    yield driving
    driving.stop()


def table(answer: dict[str, Any]) -> list[dict[str, Any]]:
    columns = answer["parameters"]["columns"]
    return [dict(zip(columns, row, strict=True)) for row in answer["parameters"]["rows"]]


@pytest.mark.usefixtures("tunable")
async def test_the_parameters_are_shown_with_all_that_one_has_to_know(connect: Connect) -> None:
    async with connect() as client:
        answer = await ask(client, "webots_get_parameters")
        kp, laps, gait = table(answer)
        assert answer["total"] == 3
        assert kp == {
            "name": "kp", "value": 2.0, "unit": "1/s", "default": 2.0, "low": 0.0, "high": 10.0,
            "choices": None, "since_s": 0.0, "set_by": "code", "doc": "steering gain",
        }  # fmt: skip
        assert (laps["value"], laps["low"]) == (3, 1)
        assert (gait["value"], gait["choices"]) == ("trot", ["trot", "walk"])
        named = await ask(client, "webots_get_parameters", names=["k*", "laps"])
        assert [each["name"] for each in table(named)] == ["kp", "laps"]
        said = await fail(client, "webots_get_parameters", names=["kpp"])
        assert "No parameter 'kpp'. The nearest of 3 that the controller declares: kp" in said


async def test_several_are_set_at_once_and_the_answer_says_since_when(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        answer = await ask(client, "webots_set_parameters", values={"kp": 3, "gait": "walk"})
        assert answer["outcome"] == "done"
        assert answer["result"]["values"] == {
            "kp": {"old": 2.0, "new": 3.0},
            "gait": {"old": "trot", "new": "walk"},
        }
        assert (tunable.kp.value, tunable.gait.value) == (3.0, "walk")
        since_s = answer["result"]["since_sim_time_s"]
        kp, _, gait = table(await ask(client, "webots_get_parameters"))
        assert kp["since_s"] == gait["since_s"] == pytest.approx(since_s, abs=1e-3)
        assert (kp["set_by"], kp["command_id"]) == ("command", answer["command_id"])


async def test_values_for_the_next_reset_are_shown_as_such_and_come_with_it(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        answer = await ask(client, "webots_set_parameters", values={"laps": 5}, when="reset")
        assert answer["result"] == {
            "values": {"laps": {"now": 3, "next": 5}},
            "since": "the next reset",
        }
        _, laps, _ = table(await ask(client, "webots_get_parameters"))
        assert (laps["value"], laps["next"]) == (3, 5)
        await ask(client, "webots_world_reset")
        assert tunable.laps.value == 5
        _, laps, _ = table(await ask(client, "webots_get_parameters"))
        assert (laps["value"], laps.get("next")) == (5, None)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"kp": 11}, "'kp' must be a number from 0 up to 10, not 11"),
        ({"kp": True}, "'kp' must be a number from 0 up to 10, not True (bool)"),
        ({"laps": 1.5}, "'laps' must be a whole number"),
        ({"gait": "fly"}, "one of 'trot', 'walk', not 'fly'"),
        ({"kp": 3, "gain": 1}, "No parameter 'gain'"),
        ({}, "values"),
    ],
)
async def test_what_cannot_be_set_is_refused_before_anything_is_sent(
    connect: Connect, tunable: TunableDriver, values: dict[str, Any], said: str
) -> None:
    async with connect() as client:
        assert said in await fail(client, "webots_set_parameters", values=values)
        listed = await ask(client, "webots_list_commands")
        assert "commands" not in listed
    assert tunable.kp.value == 2.0
