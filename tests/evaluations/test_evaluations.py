"""Each question can be answered by the tools, in few calls; and a client is judged by its words."""

from __future__ import annotations

import shlex
import sys

import pytest

from tests.evaluations.asking import ask_by_command, ask_by_plan
from tests.evaluations.scenario import Fact, Scenario, read_scenarios

SCENARIOS = read_scenarios()
RECORDED = next(each for each in SCENARIOS if each.of == "story")


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda each: each.name)
def test_the_calls_of_the_plan_give_every_fact(scenario: Scenario) -> None:
    outcome = ask_by_plan(scenario)
    assert outcome.is_right, outcome.lacking
    assert outcome.tokens is not None and outcome.tokens < 2_000 * len(outcome.called)


def test_there_are_twenty_and_none_is_like_another() -> None:
    assert len(SCENARIOS) >= 20
    assert len({each.question for each in SCENARIOS}) == len(SCENARIOS)
    assert len({each.of for each in SCENARIOS}) > 8
    assert all(each.facts and len(each.plan) <= each.calls for each in SCENARIOS)
    asked = {tool for each in SCENARIOS for tool, _ in each.plan}
    assert len(asked) > 15, "groups of tools are left out"


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda each: each.name)
def test_who_repeats_the_question_and_hedges_is_not_right(scenario: Scenario) -> None:
    hedged = (
        f"{scenario.question} I looked at run 1 of the rover and am not sure; it is no problem."
    )
    assert not all(fact.is_said(hedged) for fact in scenario.facts)


@pytest.mark.parametrize(
    ("name", "right", "wrong"),
    [
        ("how fast the battery falls", "It falls by 0.001 V/s, to 12.48 V.",
         "It rises by 0.001 V/s, to 12.48 V."),
        ("how a run ended", "Run 1: reset. Run 2 crashed; run 3 finished.",
         "Run 1 finished normally, run 2 by a reset, run 3 crashed."),
        ("seconds without rows", "From 12 s on, for 3 s.", "At 3 s, for 12 s."),
        ("how it spent its time", "26.7 s in cruise, 3.0 s in turn_right. The way is drawn.",
         "It turned for 26.7 s and cruised for 3 s, as the plot shows."),
        ("what was deleted", "80 rows are still there, 5,131 were deleted.",
         "5131 rows are there and 80 were deleted."),
        ("which speed is best", "8: 3 rad/s gets 0.59 m, 8 rad/s 1.34 m, four times each.",
         "3 rad/s: 8 gets 0.59 m, 3 gets 1.34 m."),
        ("until it turns, and a look", "At 4.88 s, x \N{MINUS SIGN}0.22 m; one sees a wall.",
         "At 4.88 s, x 0.22 m; one sees a wall."),
    ],
)  # fmt: skip
def test_who_mixes_up_which_is_which_is_not_right(name: str, right: str, wrong: str) -> None:
    (facts,) = [each.facts for each in SCENARIOS if each.name == name]
    assert [each for each in facts if not each.is_said(right)] == []
    assert not all(each.is_said(wrong) for each in facts)


def typed(*words: str) -> str:
    return shlex.join([sys.executable, *words])


@pytest.mark.parametrize(
    ("client", "called", "is_right"),
    [
        (typed("-m", "tests.evaluations.planned", "{config}", "{question}"), 1, True),
        (typed("-c", "print('stuck at 40 s for 12 s in the mode cruise')"), 0, False),
        (typed("-c", "print('I do not know'); raise SystemExit(3)"), 0, False),
        ("no-such-client", 0, False),
    ],
)
def test_a_client_of_the_command_line_is_judged_by_its_calls_and_its_words(
    client: str, called: int, is_right: bool
) -> None:
    outcome = ask_by_command(RECORDED, client)
    assert (len(outcome.called), outcome.is_right) == (called, is_right), outcome.said
    assert ("exit code 3" in outcome.said) == ("(3)" in client)
    assert ("no answer: " in outcome.said) == (client == "no-such-client")


@pytest.mark.parametrize(
    ("fact", "text", "holds"),
    [
        (Fact("a", 40.0, 0.2), "It was stuck from 40 s on.", True),
        (Fact("a", 40.0, 0.2), "It was stuck at 41 s of 140.", False),
        (Fact("a", 1.34), "8 rad/s: 1.34 m", True),
        (Fact("a", -0.224, 0.01), "x = -0,22 m", True),
        (Fact("a", "cruise"), "in mode `Cruise`", True),
        (Fact("a", 7, says="more runs"), "That takes more runs.", True),
        (Fact("a", 7, says="more runs"), "7 of 7", False),
    ],
)
def test_a_text_holds_a_number_or_words(fact: Fact, text: str, holds: bool) -> None:
    assert fact.is_said(text) == holds
