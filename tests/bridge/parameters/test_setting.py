"""Parameters are set from outside and by the controller, and recorded with each run."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.bridge.conftest import Recording, eager
from tests.bridge.parameters.conftest import VALUES, ask
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge.parameters import MOST_CHANGES
from webots_mcp.signals.parameter import LARGEST_INT
from webots_mcp.standin import InProcessSupervisor

Drive = Callable[[int], None]


def test_a_command_sets_several_at_once_and_each_is_recorded_with_its_time(
    bridge: MCPBridge, recording: Recording, drive: Drive
) -> None:
    kp, gait = bridge.parameter("kp", 2.0), bridge.parameter("gait", "trot")
    drive(3)
    sent = recording.send("set_parameters", values={"kp": 3, "gait": "walk"})
    bridge.publish({"x": 1})
    assert kp.value == 2.0  # not before get_command()
    drive(1)
    assert (kp.value, gait.value) == (3.0, "walk")
    assert recording.fate(sent)[:2] == (
        "done",
        {
            "values": {"kp": {"old": 2.0, "new": 3.0}, "gait": {"old": "trot", "new": "walk"}},
            "since_sim_time_s": pytest.approx(0.064),
            "run_id": 1,
        },
    )
    assert recording.rows(VALUES)[2:] == [
        (1, "kp", "3.0", 0, "command", sent),
        (1, "gait", '"walk"', 0, "command", sent),
    ]
    changed_s = recording.rows("SELECT sim_time_s FROM parameter_value WHERE set_by = 'command'")
    assert changed_s == [pytest.approx(0.064)] * 2


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"kp": 11}, "'kp' must be a number from 0 up to 10, not 11 (int)"),
        ({"kp": -0.001}, "must be a number from 0 up to 10, not -0.001"),
        ({"kp": "3"}, "must be a number from 0 up to 10, not '3' (str)"),
        ({"kp": True}, "not True (bool)"),
        ({"kp": None}, "not None"),
        ({"kp": [1]}, "not [1] (list)"),
        ({"kp": 10**400}, "(int)"),
        ({"n": 1.5}, "'n' must be a whole number of at most 53 bits, not 1.5"),
        ({"n": LARGEST_INT + 1}, "not 9007199254740993"),
        ({"n": False}, "not False (bool)"),
        ({"on": 1}, "'on' must be true or false, not 1 (int)"),
        ({"gait": "fly"}, "'gait' must be one of 'trot', 'walk', not 'fly'"),
        ({"gait": 1}, "not 1 (int)"),
        ({"kpp": 1.0}, "No parameter 'kpp'. The nearest of 4 that the controller declares:"),
        ({}, "give values"),
        ([1], "give values"),
    ],
)
def test_a_wrong_value_fails_the_command_and_none_is_set(
    bridge: MCPBridge, recording: Recording, values: Any, said: str
) -> None:
    kp, n = bridge.parameter("kp", 2.0, low=0, high=10), bridge.parameter("n", 3)
    on = bridge.parameter("on", True)
    gait = bridge.parameter("gait", "trot", choices=("trot", "walk"))
    given = {"n": 4, **values} if isinstance(values, dict) and values else values
    status, _, error = ask(recording, bridge, values=given)
    assert status == "failed"
    assert error is not None and said in error
    assert (kp.value, n.value, on.value, gait.value) == (2.0, 3, True, "trot")
    assert recording.rows("SELECT count(*) FROM parameter_value") == [4]


@pytest.mark.parametrize("text", ['{"values": {"kp": NaN}}', '{"values": {"kp": Infinity}}'])
def test_a_command_that_brings_no_finite_number_fails(
    bridge: MCPBridge, recording: Recording, text: str
) -> None:
    kp = bridge.parameter("kp", 2.0)
    connection_params = json.loads(text)
    assert ask(recording, bridge, **connection_params)[0] == "failed"
    assert kp.value == 2.0


def test_a_whole_number_may_come_as_a_float(bridge: MCPBridge, recording: Recording) -> None:
    n = bridge.parameter("n", 3)
    ask(recording, bridge, values={"n": 4.0})
    assert (type(n.value), n.value) == (int, 4)


def test_a_value_that_stays_the_same_is_no_change(bridge: MCPBridge, recording: Recording) -> None:
    bridge.parameter("kp", 2.0)
    status, result, _ = ask(recording, bridge, values={"kp": 2})
    assert (status, result["values"]) == ("done", {"kp": {"old": 2.0, "new": 2.0}})
    assert recording.rows("SELECT count(*) FROM parameter_value") == [1]


def test_it_is_set_while_the_simulation_is_paused(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, drive: Drive
) -> None:
    kp = bridge.parameter("kp", 2.0)
    drive(2)
    sent = [recording.send("pause"), recording.send("set_parameters", values={"kp": 4.0})]
    sent.append(recording.send("resume"))
    drive(2)
    assert [recording.fate(each)[0] for each in sent] == ["done"] * 3
    paused_s = recording.fate(sent[0])[1]["sim_time_s"]
    assert recording.fate(sent[1])[1]["since_sim_time_s"] == paused_s
    assert kp.value == 4.0


def test_changes_of_one_run_are_so_many_at_most(
    lenient: MCPBridge, recording: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    kp = lenient.parameter("kp", 0)
    lenient._session.parameters._changes = MOST_CHANGES - 1  # pyright: ignore[reportPrivateUsage]
    kp.set(1)
    lenient.get_command()
    kp.set(2)
    lenient.get_command()
    assert kp.value == 1
    assert "changes of parameters are recorded in one run" in capfd.readouterr().err


def test_values_that_wait_for_the_reset_come_with_it_and_stay(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, drive: Drive
) -> None:
    kp, ki = bridge.parameter("kp", 2.0), bridge.parameter("ki", 0.5)
    drive(2)
    status, result, _ = ask(recording, bridge, values={"kp": 3.0}, when="reset")
    assert (status, result) == (
        "done",
        {"values": {"kp": {"now": 2.0, "next": 3.0}}, "since": "the next reset"},
    )
    ask(recording, bridge, values={"kp": 5.0, "ki": 1.0}, when="reset", by="trial")
    assert recording.rows("SELECT next_value FROM parameter ORDER BY id") == ["5.0", "1.0"]
    assert (kp.value, ki.value) == (2.0, 0.5)
    robot.simulationReset()
    drive(2)
    assert (kp.value, ki.value) == (5.0, 1.0)
    ask(recording, bridge, values={"ki": 2.0})
    robot.simulationReset()
    drive(2)
    assert (kp.value, ki.value) == (5.0, 2.0)
    assert recording.rows("SELECT next_value FROM parameter ORDER BY id") == [None, None]
    assert recording.rows(VALUES)[2:] == [
        (2, "kp", "5.0", 0, "trial", 2),
        (2, "ki", "1.0", 0, "trial", 2),
        (2, "ki", "2.0", 0, "command", 3),
        (3, "kp", "5.0", 0, "trial", 2),
        (3, "ki", "2.0", 0, "command", 3),
    ]
    assert recording.rows(
        "SELECT sim_time_s FROM parameter_value WHERE run_id = 2 ORDER BY id"
    ) == [pytest.approx(time_s) for time_s in (0.016, 0.016, 0.032)]


def test_a_reset_finds_the_new_values_when_its_callbacks_run(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording, drive: Drive
) -> None:
    kp = bridge.parameter("kp", 2.0)
    seen: list[float] = []
    bridge.on_reload(lambda: seen.append(kp.value))
    drive(3)
    ask(recording, bridge, values={"kp": 3.0}, when="reset")
    robot.simulationReset()
    drive(1)
    assert seen == [3.0]


def test_a_wrong_value_for_the_next_reset_is_refused_at_once(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.parameter("kp", 2.0, high=10)
    assert ask(recording, bridge, values={"kp": 11}, when="reset")[0] == "failed"
    assert ask(recording, bridge, values={"kp": 1}, when="later")[0] == "failed"
    assert recording.rows("SELECT next_value FROM parameter") == [None]


def test_a_new_process_begins_with_the_code_again(
    database: MemoryDatabase, recording: Recording
) -> None:
    with MCPBridge(InProcessSupervisor("rover"), database=database) as bridge:
        bridge.parameter("kp", 2.0)
        bridge.parameter("gone", 1.0)
        ask(recording, bridge, values={"kp": 3.0})
        ask(recording, bridge, values={"kp": 4.0}, when="reset")
    with MCPBridge(InProcessSupervisor("rover"), database=database) as bridge:
        assert bridge.parameter("kp", 2.5).value == 2.5
    sql = "SELECT name, session_id, default_value, next_value FROM parameter ORDER BY id"
    assert recording.rows(sql) == [("kp", 2, "2.5", None), ("gone", 1, "1.0", None)]


def test_the_controllers_own_code_sets_with_the_next_get_command(
    bridge: MCPBridge, recording: Recording
) -> None:
    kp = bridge.parameter("kp", 2.0)
    kp.set(3)
    bridge.publish({"x": 1})
    assert kp.value == 2.0
    bridge.get_command()
    assert (type(kp.value), kp.value) == (float, 3.0)
    assert recording.rows(VALUES)[-1] == (1, "kp", "3.0", 0, "code", None)


def test_a_wrong_value_of_the_code_is_warned_of_once_and_the_loop_goes_on(
    lenient: MCPBridge, capfd: pytest.CaptureFixture[str]
) -> None:
    kp = lenient.parameter("kp", 2.0, high=5)
    for wrong in (7, 8):
        kp.set(wrong)
        lenient.get_command()
    assert kp.value == 2.0
    assert capfd.readouterr().err.count("Parameter.set failed") == 1
    assert lenient.stats().failures == 2


def test_a_handler_sets_at_once_and_is_told_what_is_wrong(
    bridge: MCPBridge, recording: Recording
) -> None:
    kp = bridge.parameter("kp", 2.0, high=5)

    def tune(command: dict[str, Any]) -> float:
        kp.set(command["kp"])
        return kp.value

    bridge.register_command("tune", tune)
    good, bad = recording.send("tune", kp=4), recording.send("tune", kp=6)
    eager(bridge)
    eager(bridge)
    assert recording.fate(good)[:2] == ("done", 4.0)
    status, _, error = recording.fate(bad)
    assert (status, kp.value) == ("failed", 4.0)
    assert error is not None and "up to 5, not 6" in error
