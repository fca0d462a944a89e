"""Trials from the shell, with real simulators and controllers."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.steering.trials.conftest import Run, command, rows, wait_for_trial

Plan = Callable[[str], Path]


@pytest.mark.slow
def test_sets_are_tried_scored_ranked_and_their_runs_kept(
    project: Path, plan: Plan, run: Run
) -> None:
    plan('score = "last(x)"\nfor_s = 2\nrepeats = 2\n[grid]\nspeed = [1.0, 2.0, 3.0]')

    answer = json.loads(run("--jobs", "2", "--json", "--plot", str(project / "a.png")).stdout)

    assert (project / "a.png").read_bytes().startswith(b"\x89PNG")
    best, next_, crashed = answer["sets"]
    assert [each["parameters"]["speed"] for each in answer["sets"]] == [2.0, 1.0, 3.0]
    assert best["scores"] == [pytest.approx(4.0, abs=0.05)] * 2
    assert next_["score"]["mean"] == pytest.approx(2.0, abs=0.05)
    assert len(crashed["failures"]) == 2
    assert "did not reach its end, only 0.3" in crashed["failures"][0]
    assert answer["better"] is None, "the others crashed, or agree"
    assert "repeat each 4 times" in answer["verdict"]
    assert answer["notes"][0].startswith("repeats of speed 2.0: 2 runs: equal to the last digit in")
    runs = rows(
        project,
        "SELECT t.number, r.label, p.value, t.ended_by, t.ended_sim_time_s, t.pid FROM trial t "
        "JOIN run r ON r.id = t.run_id JOIN parameter_value p ON p.run_id = r.id ORDER BY t.number",
    )
    assert runs[0] == (1, "trial 1 of set 1: speed 1.0", "1.0", "for_s", 2.0, None)
    assert [value for _, _, value, *_ in runs] == ["1.0", "2.0", "3.0"] * 2
    assert list((project / "data" / "trials").iterdir()) == []


@pytest.mark.slow
def test_a_trial_ends_at_the_very_state_in_which_the_condition_holds(
    project: Path, plan: Plan, run: Run
) -> None:
    plan('score = "duration"\nuntil = "x > 1"\nbest = "lowest"\n[[parameters]]\nspeed = 2.0')

    answer = json.loads(run("--json").stdout)

    (only,) = answer["sets"]
    assert only["scores"] == [pytest.approx(0.512)]
    assert rows(project, "SELECT DISTINCT ended_by FROM trial") == [("until",)]


@pytest.mark.slow
def test_a_finished_plan_is_only_shown_and_again_begins_anew(
    project: Path, plan: Plan, run: Run
) -> None:
    plan('score = "max(x)"\nfor_s = 0.5\n[grid]\nspeed = [1.0]')

    first, shown, again = run(), run(), run("--again")

    assert first.stdout == shown.stdout
    assert "1 of 1 trials were done before" in shown.stderr
    assert "one parameter set: there is nothing to compare" in shown.stdout
    assert "trial set 2" in again.stdout
    assert rows(project, "SELECT count(*) FROM run") == [(2,)]


@pytest.mark.slow
def test_what_no_trial_can_have_ends_all_of_them_with_a_sentence(plan: Plan, run: Run) -> None:
    plan('score = "last(x)"\nfor_s = 0.2\n[grid]\nsped = [1.0, 2.0]')
    refused = run()
    assert refused.returncode == 2
    assert "The controller declares no parameter 'sped'. It declares speed" in refused.stderr

    plan('score = "1 + last(y)"\nfor_s = 0.2\n[grid]\nspeed = [1.0, 2.0]')
    refused = run()
    assert refused.returncode == 2
    assert "score '1 + last(y)', column 10: no signal 'y' is recorded" in refused.stderr


def test_a_value_that_was_not_taken_is_a_failure_and_not_a_score(plan: Plan, run: Run) -> None:
    plan('score = "last(x)"\nfor_s = 0.2\n[grid]\nspeed = [11.0]')

    answer = json.loads(run("--json").stdout)

    assert answer["sets"][0]["scores"] == []
    assert "speed=11.0 was not taken (from 0.0 to 10.0)" in answer["sets"][0]["failures"][0]


@pytest.mark.slow
def test_two_cannot_work_on_one_set(project: Path, plan: Plan, run: Run) -> None:
    plan('score = "last(x)"\nuntil = "x > 1e6"\n[grid]\nspeed = [1.0, 2.0]')
    assert "no database" in run("--so-far").stderr
    process = subprocess.Popen(command(project, "--jobs", "2"), stderr=subprocess.DEVNULL)
    try:
        wait_for_trial(project, 2, process)
        refused = run()
        so_far = run("--so-far")
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)

    assert refused.returncode == 2
    assert f"Process {process.pid} on " in refused.stderr
    assert (so_far.returncode, so_far.stderr) == (0, "")
    assert "trial set 1, no run was recorded" in so_far.stdout


@pytest.mark.slow
def test_what_is_over_so_far_is_ranked_and_who_leads_is_told(
    project: Path, plan: Plan, run: Run
) -> None:
    plan('score = "last(x)"\nfor_s = 0.2\n[grid]\nspeed = [1.0, 0.5]')
    whole = run()
    assert "best so far: speed 1, mean 0.19" in whole.stderr

    assert run("--so-far").stdout == whole.stdout

    plan('score = "last(x)"\nfor_s = 0.3\n[grid]\nspeed = [1.0]')
    assert "No trials of " in run("--so-far").stderr


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('score = "last(x)"\n[grid]\nspeed = [1.0]', "Give for_s, until or both"),
        ('for_s = 1\n[grid]\nspeed = [1.0]', "score is missing"),
        ('score = "last(x)"\nfor_s = 1', "give a .grid., as in speed"),
        ('score = "last(x)"\nfor_s = 1\n[grid]\nspeed = 1.0', "must be a list of values"),
        ('score = "last(x"\nfor_s = 1\n[grid]\nspeed = [1.0]', "column 5: '(' was never closed"),
        ('score = "x"\nfor_s = 1\n[grid]\nspeed = [1.0]', "a signal has a value in each state"),
        ('score = "last(x)"\nfor_s = -1\n[grid]\nspeed = [1.0]', "for_s=-1 must be a number"),
        ('score = "last(x)"\nfor_s = "1"\n[grid]\nspeed = [1.0]', "for_s='1' is a str"),
        ('score = "last(x)"\nfors = 1\n[grid]\nspeed = [1.0]', "Unknown key 'fors'"),
        ('score = "last(x)"\nfor_s = 1\n[grid]\nspeed = [1.0, 1.0]', "To repeat them, use repeats"),
        ('score = "last(x)"\nfor_s = 1\nbest = "most"\n[grid]\nspeed = [1]', "highest, lowest"),
        ("score = ", "is not valid TOML"),
    ],
)  # fmt: skip
def test_a_plan_that_is_none_is_refused_before_anything_is_written(
    project: Path, plan: Plan, refused: Callable[..., str], text: str, said: str
) -> None:
    plan(text)

    assert said.replace(".grid.", "[grid]") in refused()
    assert not (project / "data").exists()
