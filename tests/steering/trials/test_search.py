"""Searching ranges of parameters with Optuna: its samplers, our trials."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.steering.trials.conftest import Run, command, rows, wait_for_trial
from webots_mcp.questions.run_trials import set_facts
from webots_mcp.steering.trial_plan import ParameterRange, Search, TrialPlan
from webots_mcp.steering.trial_search import next_parameters
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.trial_sets import TrialRecord

Write = Callable[[str], Path]
PARAMETERS = "SELECT parameters FROM trial ORDER BY number"


def a_plan(search: Search = "tpe", **more: Any) -> TrialPlan:
    """Of no world: no simulator is started."""
    ranges: dict[str, Any] = {
        "kp": ParameterRange(0.0, 10.0),
        "gait": ParameterRange(choices=["trot", "walk"]),
    }
    given: dict[str, Any] = {"ranges": ranges, "sets": 40, "seed": 7} | more
    return TrialPlan(score="last(x)", for_s=1.0, search=search, **given)


def tried(plan: TrialPlan, score: Callable[[dict[str, Any]], float]) -> list[TrialRecord]:
    """All trials of a search, one after the other, with the scores that a robot would have got."""
    trials: list[TrialRecord] = []
    while (values := next_parameters(plan, trials)) is not None:
        trials.append(a_trial(len(trials) + 1, values, score(values)))
    return trials


def a_trial(number: int, values: dict[str, Any], score: float | None) -> TrialRecord:
    over = (None, score, "for_s", 1.0, None, None, None, None, None)
    return TrialRecord(number, 1, str(number), number, json.dumps(values), "done", *over)


def hill(values: dict[str, Any]) -> float:
    return -((values["kp"] - 6.5) ** 2) - 5 * (values["gait"] == "walk")


@pytest.mark.parametrize(("best", "sign"), [("highest", 1), ("lowest", -1)])
def test_it_comes_to_the_best_parameters(best: str, sign: int) -> None:
    found = tried(a_plan(best=best), lambda values: sign * hill(values))

    assert len(found) == 40
    top = max(found, key=lambda each: hill(each.values)).values
    assert top["kp"] == pytest.approx(6.5, abs=0.1)
    assert top["gait"] == "trot"
    assert sum(each.values["gait"] == "trot" for each in found[20:]) > 15


def test_each_set_is_tried_as_often_as_the_plan_says() -> None:
    found = tried(a_plan(sets=3, repeats=3), hill)

    assert [each.parameters for each in found] == [
        found[number].parameters for number in (0, 0, 0, 3, 3, 3, 6, 6, 6)
    ]


SEARCH = """
score = "last(x)"
for_s = 0.3
prune = "x > 1.5"
sets = 3
[ranges]
speed = { choices = [1.0, 9.0] }
"""


@pytest.mark.slow
def test_a_search_runs_trials_and_ends_early_what_is_pruned(
    project: Path, plan: Write, run: Run
) -> None:
    plan(SEARCH)

    said = run("--search", "random", "--jobs", "2", "--json")

    best, pruned = json.loads(said.stdout)["sets"]
    assert (best["parameters"], pruned["parameters"]) == ({"speed": 1.0}, {"speed": 9.0})
    assert len(best["scores"]) + pruned["pruned"] == 3
    assert (pruned["scores"], pruned["failures"]) == ([], [])
    assert "speed 9: pruned: 'x > 1.5' held at 0.1" in said.stderr
    assert "speed 1: score 0.288" in said.stderr
    statuses = rows(project, "SELECT DISTINCT status, ended_by, run_id > 0, error FROM trial")
    assert sorted(statuses)[0] == ("done", "for_s", 1, None)
    assert sorted(statuses)[1][:3] == ("pruned", "prune", 1)
    told = set_facts(RecordingAccess(project / "data" / "webots.db", project / "data"), None)
    assert (told["state"], told["trials"], told["pruned"]) == ("done", 3, pruned["pruned"])
    assert told["failed"] is None
    table = run("--search", "random").stdout
    assert "every other parameter set was pruned" in table


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_search_that_was_killed_goes_on_as_if_it_had_not_been(
    project: Path, plan: Write, run: Run
) -> None:
    plan('score = "last(x)"\nfor_s = 0.3\nsets = 4\nseed = 3\n[ranges]\nspeed = { low=1, high=2 }')
    with subprocess.Popen(command(project, "--search", "tpe"), stderr=subprocess.DEVNULL) as killed:
        wait_for_trial(project, 2, killed)
        killed.kill()

    left = set_facts(RecordingAccess(project / "data" / "webots.db", project / "data"), None)
    assert left["state"] == "left"
    assert left["trials"] > left["over"]
    answer = json.loads(run("--search", "tpe", "--json").stdout)
    found = rows(project, PARAMETERS)
    run("--search", "tpe", "--again")

    assert sum(len(each["scores"]) for each in answer["sets"]) == 4
    assert len(found) == 4
    assert rows(project, f"{PARAMETERS.replace('ORDER', 'WHERE trial_set_id = 2 ORDER')}") == found
    assert rows(project, "SELECT count(*), count(DISTINCT uuid) FROM run") == [(8, 8)]


def test_without_optuna_it_names_what_to_install(
    project: Path, plan: Write, run: Run, tmp_path: Path
) -> None:
    plan(SEARCH)
    (tmp_path / "missing").mkdir()
    (tmp_path / "missing" / "optuna.py").write_text("raise ModuleNotFoundError('optuna')")

    refused = run("--search", "tpe", env={**os.environ, "PYTHONPATH": str(tmp_path / "missing")})

    assert refused.returncode == 2
    assert "pip install 'optuna" in refused.stderr
    assert not (project / "data").exists()


@pytest.mark.parametrize(
    ("ranges", "said"),
    [
        ("", "[ranges] names no parameter"),
        ("speed = 3", "[ranges] speed: write { low = 0.5"),
        ("speed = { low = 1 }", "[ranges] speed: it needs low and high, or choices"),
        ("speed = { low = 2, high = 1 }", "low=2 must be less than high=1"),
        ("speed = { low = nan, high = 1 }", "low=nan must be less than high=1"),
        ("speed = { low = 0, high = 1, log = true }", "low=0 must be above 0 with log = true"),
        ("speed = { low = 0, high = 1, step = 0.3 }", "high=1 must be a number of steps=0.3"),
        ("speed = { low = 0, high = 1, step = 0 }", "step=0 must be a number above 0"),
        ("speed = { low = 1, high = 3, step = 2, log = true }", "log and step go together only"),
        ("speed = { low = 1, hight = 3 }", "Unknown key 'hight'. Keys, the nearest first: high"),
        ("speed = { low = '1', high = 3 }", "low='1' is a str"),
        ("speed = { choices = [] }", "choices must be an array"),
        ("speed = { choices = [1, 1] }", "the same choice is given twice"),
        ("speed = { choices = [1], low = 2 }", "choices stand alone"),
    ],
)  # fmt: skip
def test_a_range_that_is_none_is_refused_before_anything_is_written(
    project: Path, plan: Write, refused: Callable[..., str], ranges: str, said: str
) -> None:
    plan(f'score = "last(x)"\nfor_s = 1\nsets = 3\n[ranges]\n{ranges}')

    assert said in refused("--search", "tpe")
    assert not (project / "data").exists()


@pytest.mark.parametrize(
    ("options", "text", "said"),
    [
        ((), "sets = 3\n[ranges]\nspeed = { low = 1, high = 2 }", "--search takes tpe, random"),
        (("--search", "gp"), "sets = 3\n[ranges]\nspeed = { low = 1, high = 2 }", 'from: "tpe"'),
        (("--search", "tpe"), "[ranges]\nspeed = { low = 1, high = 2 }", "sets is missing"),
        (("--search", "tpe"), "sets = 3\n[grid]\nspeed = [1.0]", "--search takes [ranges]"),
        (("--search", "tpe"), "seed = -1\nsets = 3\n[ranges]\nspeed = { low = 1, high = 2 }",
         "seed=-1 must be 0 or more"),
        (("--search", "tpe"), "sets = 20000\n[ranges]\nspeed = { low = 1, high = 2 }",
         "there must be 1 to 10000 trials"),
        (("--search", "tpe"), "prune = 'x <'\nsets = 3\n[ranges]\nspeed = { low = 1, high = 2 }",
         "condition 'x <'"),
        ((), "sets = 3\n[grid]\nspeed = [1.0]", "[ranges], sets and seed are for a search"),
        ((), "[grid]\nspeed = [1.0]\n[ranges]\nspeed = { low = 1, high = 2 }", "and [ranges]"),
    ],
)  # fmt: skip
def test_a_search_that_is_none_is_refused_before_anything_is_written(
    project: Path,
    plan: Write,
    refused: Callable[..., str],
    options: tuple[str, ...],
    text: str,
    said: str,
) -> None:
    plan(f'score = "last(x)"\nfor_s = 1\n{text}')

    assert said in refused(*options)
    assert not (project / "data").exists()


def test_values_keep_to_their_ranges() -> None:
    ranges = {
        "whole": ParameterRange(1, 9, step=2),
        "half": ParameterRange(0.0, 2.0, step=0.5),
        "log": ParameterRange(0.001, 1000.0, log=True),
        "order": ParameterRange(1, 1000, step=1, log=True),
    }

    found = [each.values for each in tried(a_plan("random", ranges=ranges), lambda _: 0.0)]

    assert {each["whole"] for each in found} == {1, 3, 5, 7, 9}
    assert {each["half"] for each in found} == {0.0, 0.5, 1.0, 1.5, 2.0}
    assert 10 < sum(each["log"] < 1 for each in found) < 30
    assert all(isinstance(each["order"], int) for each in found)
