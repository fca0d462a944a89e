"""The action `run`: the loop runs until a condition holds or a time is over, to the very step."""

from __future__ import annotations

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from tests.bridge.running.conftest import STEP_S, Rounds, let_go_when_paused
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

MODES = ("real_time", "fast")


def test_it_pauses_at_the_very_step_at_which_the_condition_holds(
    rounds: Rounds, recording: Recording
) -> None:
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", until="n >= 40", pace="fast")
    rounds.drive(60)
    status, result, error = recording.fate(sent)
    assert (status, error) == ("done", None)
    assert paused == [pytest.approx(40 * STEP_S)]
    assert result["ended"] == "condition held"
    assert result["sim_time_s"] == pytest.approx(40 * STEP_S)
    assert result["values"] == {"n": 40}
    assert result["mode"] == "pause"
    assert 40 in [state["n"] for state in recording.states()], "whatever the throttle"
    notes = recording.rows("SELECT data ->> 'command_id' FROM event WHERE kind = 'pause'")
    assert notes == [sent]


@pytest.mark.parametrize("steps", [100, 99.5, 99.1])
def test_it_pauses_at_the_step_that_reaches_the_time(
    rounds: Rounds, recording: Recording, steps: float
) -> None:
    rounds.drive(3)
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", for_s=steps * STEP_S)
    rounds.drive(150)
    _, result, error = recording.fate(sent)
    assert error is None
    (at_s,) = paused
    began = 4  # it is claimed in the fourth round
    assert at_s == pytest.approx((began + 100) * STEP_S)
    assert result["ended"] == "simulation time reached"
    assert result["advanced_s"] == pytest.approx(100 * STEP_S)
    assert began + 100 in [state["n"] for state in recording.states()]


@pytest.mark.parametrize("publish_each", [2, 9])
def test_the_time_is_exact_where_the_loop_does_not_publish_in_each_round(
    rounds: Rounds, recording: Recording, publish_each: int
) -> None:
    paused = let_go_when_paused(rounds)
    recording.send("run", for_s=50 * STEP_S)
    rounds.drive(80, publish_each)
    assert paused == [pytest.approx(51 * STEP_S)]


def test_a_reset_counts_the_time_from_zero_and_asks_the_first_state_after_it(
    rounds: Rounds, recording: Recording
) -> None:
    rounds.drive(30)
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", until="time < 1", for_s=2.0, reset=True, pace="fast")
    rounds.drive(20)
    _, result, error = recording.fate(sent)
    assert error is None
    assert (result["ended"], result["from_s"]) == ("condition held", 0.0)
    assert result["sim_time_s"] == paused[0] <= 2 * STEP_S
    assert recording.rows("SELECT max(id) FROM run") == [result["run_id"]]

    sent = recording.send("run", for_s=2.0, reset=True)
    rounds.drive(200)
    _, result, error = recording.fate(sent)
    assert error is None
    assert result["sim_time_s"] == pytest.approx(2.0) == result["advanced_s"]
    assert paused[1:] == [pytest.approx(2.0)]


@pytest.mark.parametrize(
    ("then", "mode_before", "mode_after"),
    [
        ("go_on", "real_time", "real_time"),
        ("go_on", "fast", "fast"),
        ("as_before", "real_time", "real_time"),
        ("as_before", "fast", "fast"),
    ],
)
def test_at_the_end_it_goes_on_or_is_as_it_was(
    rounds: Rounds, recording: Recording, then: str, mode_before: str, mode_after: str
) -> None:
    robot = rounds.robot
    robot.simulationSetMode(getattr(robot, f"SIMULATION_MODE_{mode_before.upper()}"))
    sent = recording.send("run", until="n == 10", pace="fast", then=then)
    rounds.drive(12)
    _, result, error = recording.fate(sent)
    assert error is None
    assert (result["ended"], result["mode"]) == ("condition held", mode_after)
    assert result["sim_time_s"] == pytest.approx(10 * STEP_S)
    assert 10 in [state["n"] for state in recording.states()]
    assert recording.rows("SELECT count(*) FROM event WHERE kind = 'pause'") == [0]


@pytest.mark.parametrize("ended_by", ["its goal", "a breakpoint", "pause", "reset", "close"])
@pytest.mark.parametrize("mode_before", ["real_time", "fast"])
def test_the_pace_of_a_run_ends_with_it_however_it_ends(
    rounds: Rounds, recording: Recording, ended_by: str, mode_before: str
) -> None:
    robot = rounds.robot
    modes = {name: getattr(robot, f"SIMULATION_MODE_{name.upper()}") for name in MODES}
    robot.simulationSetMode(modes[mode_before])
    (pace,) = set(MODES) - {mode_before}
    if ended_by == "a breakpoint":
        rounds.bridge.breakpoint("n == 8")
    recording.send("run", until="n >= 20" if ended_by == "its goal" else "n > 1000", pace=pace)
    rounds.drive(7)
    assert robot.simulationGetMode() == modes[pace]
    if ended_by == "close":
        rounds.bridge.close()
        assert robot.simulationGetMode() == modes[mode_before]
        return
    if ended_by in ("pause", "reset"):
        recording.send(ended_by)
    if ended_by != "reset":
        let_go_when_paused(rounds, by="reset")
    rounds.drive(20)
    assert recording.rows("SELECT count(*) FROM run") == [2]
    assert robot.simulationGetMode() == modes[mode_before]
    resumed = recording.send("resume")
    rounds.drive(2)
    _, result, _ = recording.fate(resumed)
    assert ("it ran fast before" in result["why"]) is (mode_before == "fast")


@pytest.mark.parametrize("reset", [False, True])
def test_parameters_are_set_before_it_runs(
    rounds: Rounds, recording: Recording, reset: bool
) -> None:
    gain = rounds.bridge.parameter("gain", 2.0, low=0, high=10)
    rounds.drive(5)
    recording.send("run", for_s=0.2, reset=reset, parameters={"gain": 4}, then="go_on")
    rounds.drive(5)
    assert gain.value == 4.0
    of_run = "run_id = (SELECT max(id) FROM run) ORDER BY since_s, utc"
    assert recording.rows(f"SELECT value FROM robot_parameter WHERE {of_run}")[-1] == 4.0


def test_auto_publish_is_asked_at_every_call(
    robot: InProcessSupervisor, sparse: MCPBridge, recording: Recording
) -> None:
    rounds = Rounds(robot, sparse, recording, "nothing is published")
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", until="n >= 12", for_s=10)
    for n in range(20):
        robot.step(STEP_MS)
        sparse.auto_publish({"n": n})
        eager(sparse)
    assert recording.fate(sent)[1]["values"] == {"n": 12}
    assert paused == [pytest.approx(13 * STEP_S)]
    assert 12 in [state["n"] for state in recording.states()]
