"""What ends a `run` before its goal, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.running.conftest import STEP_S, Rounds, let_go_when_paused


@pytest.mark.parametrize("by", ["pause", "resume", "fast", "step", "reset"])
def test_what_steers_the_loop_interrupts_it_and_it_says_how_far_it_came(
    rounds: Rounds, recording: Recording, by: str
) -> None:
    rounds.drive(2)
    sent = recording.send("run", until="n > 1000", for_s=100)
    rounds.drive(1)
    let_go_when_paused(rounds)
    rounds.drive(10)
    interrupting = recording.send(by)
    rounds.drive(3)
    status, result, error = recording.fate(sent)
    assert (status, error) == ("done", None)
    assert result["ended"] == "interrupted"
    assert result["why"] == f"interrupted by command {interrupting} ({by})"
    assert result["advanced_s"] == pytest.approx(11 * STEP_S)
    again = recording.send("run", for_s=STEP_S, then="go_on")
    rounds.drive(4)
    assert recording.fate(again)[0] == "done"


def test_a_breakpoint_that_pauses_interrupts_it(rounds: Rounds, recording: Recording) -> None:
    number = rounds.bridge.breakpoint("n == 8")
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", until="n > 1000", then="go_on")
    rounds.drive(12)
    _, result, error = recording.fate(sent)
    assert (error, result["ended"]) == (None, "interrupted")
    assert f"breakpoint {number}: n == 8" in result["why"]
    assert paused == [pytest.approx(8 * STEP_S)] == [pytest.approx(result["sim_time_s"])]


def test_a_reset_by_a_person_ends_it(rounds: Rounds, recording: Recording) -> None:
    rounds.drive(1)
    run_id = rounds.bridge.run_id
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", until="n > 1000")
    rounds.drive(10)
    rounds.robot.simulationReset()
    rounds.drive(5)
    _, result, error = recording.fate(sent)
    assert error is None
    assert (result["ended"], result["why"]) == ("run ended", "the world was reset")
    assert result["run_id"] == run_id
    assert result["sim_time_s"] == pytest.approx(11 * STEP_S)
    assert len(paused) == 1, "and then the simulation stands, as it was asked"
    assert paused[0] <= 2 * STEP_S


def test_a_quit_ends_it(rounds: Rounds, recording: Recording) -> None:
    sent = recording.send("run", until="n > 1000")
    rounds.drive(10)
    rounds.robot.simulation.quit()
    rounds.drive(5)
    rounds.bridge.close()
    _, result, error = recording.fate(sent)
    assert error is None
    assert result["ended"] == "run ended"
    assert result["sim_time_s"] == pytest.approx(10 * STEP_S)


def test_a_condition_that_cannot_be_asked_ends_it_as_it_was_told_to_end(
    rounds: Rounds, recording: Recording
) -> None:
    paused = let_go_when_paused(rounds)
    sent = recording.send("run", until="n < 'a'")
    rounds.drive(5)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and "n < 'a'" in error
    assert len(paused) == 1


def test_a_cancelled_one_ends_as_it_was_told_to_end(rounds: Rounds, recording: Recording) -> None:
    sent = recording.send("run", until="n > 1000")
    rounds.drive(10)
    other = recording.send("cancel_run", command_id=sent + 1000)
    rounds.drive(2)
    assert recording.fate(other)[1] == {"was_under_way": False}
    assert recording.fate(sent)[0] == "claimed"
    paused = let_go_when_paused(rounds)
    cancel = recording.send("cancel_run", command_id=sent)
    rounds.drive(3)
    assert recording.fate(cancel)[1] == {"was_under_way": True}
    _, result, error = recording.fate(sent)
    assert (error, result["ended"], result["why"]) == (None, "interrupted", "it was cancelled")
    assert len(paused) == 1


def test_two_at_once_are_refused_and_the_first_goes_on(
    rounds: Rounds, recording: Recording
) -> None:
    first = recording.send("run", until="n == 20", then="go_on")
    second = recording.send("run", until="n == 5", reset=True)
    rounds.drive(10)
    status, _, error = recording.fate(second)
    assert status == "failed"
    assert error is not None and f"command {first} (run) is still running" in error
    rounds.drive(20)
    assert recording.fate(first)[1]["values"] == {"n": 20}
    assert recording.rows("SELECT count(*) FROM run") == [1]


@pytest.mark.parametrize("refused", ["step", "load_world", "quit"])
def test_a_command_that_is_refused_interrupts_nothing(
    rounds: Rounds, recording: Recording, refused: str
) -> None:
    sent = recording.send("run", until="n == 20", then="go_on")
    other = recording.send(refused, steps=0, world="/nowhere.wbt", status=-1)
    rounds.drive(22)
    assert recording.fate(other)[0] == "failed"
    assert recording.fate(sent)[1]["ended"] == "condition held"


@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({}, "give until"),
        ({"until": "n <"}, "condition 'n <'"),
        ({"until": 3}, "until must be a condition"),
        ({"for_s": 0}, "above 0"),
        ({"for_s": float("1e9")}, "at most 1000000"),
        ({"for_s": True}, "for_s must be simulated seconds"),
        ({"for_s": "20"}, "for_s must be simulated seconds"),
        ({"for_s": 1, "pace": "slow"}, "pace must be one of null, 'fast', 'real_time', not 'slow'"),
        ({"for_s": 1, "then": "stop"}, "then must be one of 'pause', 'go_on', 'as_before'"),
        ({"for_s": 1, "reset": "yes"}, "reset must be one of False, True"),
        ({"for_s": 1, "parameters": [1]}, "parameters must be an object"),
        ({"for_s": 1, "parameters": {"kp": 1}}, "kp"),
        ({"for_s": 1, "parameters": {"gain": 11}}, "up to 10"),
        ({"for_s": 1, "parameters": {"gain": 5, "kp": 1}, "reset": True}, "kp"),
    ],
)
def test_what_makes_no_sense_is_refused_and_nothing_is_done(
    rounds: Rounds, recording: Recording, params: dict[str, Any], told: str
) -> None:
    gain = rounds.bridge.parameter("gain", 2.0, low=0, high=10)
    rounds.drive(3)
    before = rounds.robot.simulationGetMode()
    sent = recording.send("run", 10, **({"pace": "real_time"} | params))
    rounds.drive(3)
    status, _, error = recording.fate(sent)
    assert status == "failed"
    assert error is not None and told in error
    assert rounds.robot.simulationGetMode() == before
    assert gain.value == 2.0
    assert recording.rows("SELECT count(*) FROM run") == [1]
    rounds.robot.simulationReset()
    rounds.drive(3)
    assert gain.value == 2.0
