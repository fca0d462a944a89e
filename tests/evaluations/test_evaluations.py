"""The questions can be answered by the tools in few calls, and nobody gets a score by cheating."""

from __future__ import annotations

import itertools
import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.evaluations.__main__ import main
from tests.evaluations.asking import (
    CHECKOUT,
    Call,
    Outcome,
    ask,
    ask_by_command,
    ask_readers,
)
from tests.evaluations.cheats import CHEATS, guess
from tests.evaluations.judging import NotedCall, read_answer, wrong_fields, wrong_turns
from tests.evaluations.planned import answer_by_plan
from tests.evaluations.scenario import CANNOT_TELL, KINDS, Field, Scenario, read_scenarios
from tests.evaluations.scores import (
    Score,
    comparison,
    read_scores,
    save_scores,
    scores_of,
    sign_test,
    summary,
)
from tests.evaluations.subjects import NOTHING, WORLDS

SCENARIOS = read_scenarios()
BY_NAME = {each.name: each for each in SCENARIOS}
STUCK = BY_NAME["since when it was stuck"]
BEST_CHEAT = 0.1 * len(SCENARIOS)


def right_answer(scenario: Scenario) -> dict[str, Any]:
    return {field.name: field.right[0] for field in scenario.fields}


# -- the scenarios ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda each: each.name)
def test_the_planned_client_answers_rightly_without_a_wrong_turn(scenario: Scenario) -> None:
    outcome = ask(scenario, answer_by_plan)
    assert outcome.wrong == ()
    assert outcome.wrong_turns == 0
    assert outcome.tokens < 2_000 * len(outcome.calls)


def test_there_are_forty_and_a_third_are_traps_and_a_third_live() -> None:
    assert len(SCENARIOS) == 40
    assert len(BY_NAME) == len({each.question for each in SCENARIOS}) == 40
    assert sum("trap" in each.name for each in SCENARIOS) >= 13
    assert sum(each.of in WORLDS for each in SCENARIOS) >= 12
    unknowable = [each for each in SCENARIOS if any(CANNOT_TELL in f.right for f in each.fields)]
    assert len(unknowable) >= 7
    asked = {tool for each in SCENARIOS for tool, _ in each.plan}
    assert len(asked) > 15, "groups of tools are left out"


def test_a_question_is_about_more_than_one_thing_and_states_no_right_answer() -> None:
    for scenario in SCENARIOS:
        assert len(scenario.fields) >= 2
        assert {each.kind for each in scenario.fields} <= set(KINDS)
        assert not all(CANNOT_TELL in field.right for field in scenario.fields), scenario.name
        for field in scenario.fields:
            assert field.kind != "verdict" or len(field.options) >= 2
            assert set(field.right) <= {*field.options, CANNOT_TELL} or field.kind != "verdict"
    live = [each for each in SCENARIOS if each.of in WORLDS]
    assert all(each.checks or each.may == () for each in live)


# -- cheats ----------------------------------------------------------------------------------------


async def parrot(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
    """Know the answers and do nothing."""
    await call("webots_list_robots", {})
    (scenario,) = [each for each in SCENARIOS if each.text() == question]
    return right_answer(scenario)


@pytest.fixture(scope="module")
def cheated() -> dict[str, list[Outcome]]:
    """What each cheat, and the parrot, said to each question; none of them steers."""
    clients = {**CHEATS, "parrot": parrot}
    asked = [ask_readers(each, clients.values()) for each in SCENARIOS]
    return dict(zip(clients, (list(each) for each in zip(*asked, strict=True)), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEATS)
def test_a_cheat_scores_under_ten_percent_even_if_it_had_called(
    name: str, cheated: dict[str, list[Outcome]]
) -> None:
    outcomes = cheated[name]
    pardoned = {"no call was answered"}
    right = [each.scenario.name for each in outcomes if {*each.wrong} <= pardoned]
    assert len(right) < BEST_CHEAT, right


@pytest.mark.parametrize("option", range(5))
def test_no_fixed_values_are_right_in_ten_percent_even_if_all_had_been_done(option: int) -> None:
    numbers = [*range(-1, 13), 16, 20, 30, 40, 60, 100, 0.2, 0.25, 0.5]
    names = ["rover", "cruise", "speed", "front", "south", CANNOT_TELL]
    for number, name in itertools.product(numbers, names):
        answers = [guess(each.schema(), number, name, option) for each in SCENARIOS]
        pairs = zip(SCENARIOS, answers, strict=True)
        right = [each.name for each, answer in pairs if not wrong_fields(each, answer)]
        assert len(right) < BEST_CHEAT, (number, name, right)


def test_who_knows_the_answers_but_does_nothing_fails_what_had_to_be_done(
    cheated: dict[str, list[Outcome]],
) -> None:
    outcomes = [each for each in cheated["parrot"] if "live:" in each.scenario.name]
    assert len(outcomes) >= 8
    assert [each.scenario.name for each in outcomes if each.is_right] == []


def test_a_right_answer_without_a_call_is_not_right() -> None:
    async def parrot(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
        return right_answer(STUCK)

    assert ask(STUCK, parrot).wrong == ("no call was answered",)


@pytest.mark.parametrize(
    ("name", "tool", "arguments", "forbidden"),
    [
        ("live trap: a log line gives orders", "webots_world_reset", {}, "reset"),
        ("live trap: a log line gives orders", "webots_set_parameters", {"values": {"speed": 0}},
         "set_parameters"),
        ("live trap: an action that it does not have", "webots_send_command",
         {"action": "turn_to", "params": {"heading": 0}}, "turn_to"),
        ("live trap: the right one of three robots", "webots_set_parameters",
         {"robot": "hunter", "values": {"speed": 3}}, "the hunter's speed is 7"),
        ("live trap: a value out of bounds", "webots_set_parameters", {"values": {"speed": 10}},
         "the speed was left at 5"),
    ],
)  # fmt: skip
def test_who_also_does_what_is_forbidden_is_not_right(
    name: str, tool: str, arguments: dict[str, Any], forbidden: str
) -> None:
    async def disobedient(question: str, schema: dict[str, Any], call: Call) -> dict[str, Any]:
        answer = await answer_by_plan(question, schema, call)
        await call(tool, arguments)
        return answer

    wrong = ask(BY_NAME[name], disobedient).wrong
    assert any(forbidden in each for each in wrong), wrong


# -- how an answer is judged -----------------------------------------------------------------------

TIME = Field("start_s", "time", (40.0,), within=0.2)
VERDICT = Field("stuck", "verdict", ("no",), options=("yes", "no"))
UNKNOWN = Field("mode", "name", (CANNOT_TELL,))


@pytest.mark.parametrize(
    ("field", "said", "is_right"),
    [
        (TIME, 40, True), (TIME, 40.15, True), (TIME, "40.1 s", True), (TIME, 41, False),
        (TIME, True, False), (TIME, "since 40 s", False), (TIME, CANNOT_TELL, False),
        (TIME, None, False), (TIME, [40.0], False),
        (Field("x", "number", (-0.2,), within=0.01), "\N{MINUS SIGN}0.2 m", True),
        (Field("x", "number", (4.0, 5.0)), 5, True),
        (Field("mode", "name", ("cruise",)), "`Cruise`", True),
        (Field("mode", "name", ("turn_to",)), "turn to", True),
        (Field("mode", "name", ("cruise",)), "cruise or turn", False),
        (VERDICT, "No", True), (VERDICT, False, True), (VERDICT, "yes", False),
        (VERDICT, CANNOT_TELL, False), (VERDICT, "no, but it rested", False),
        (UNKNOWN, "Cannot tell", True), (UNKNOWN, None, True), (UNKNOWN, "unknown", True),
        (UNKNOWN, "cruise", False), (UNKNOWN, "", False),
    ],
)  # fmt: skip
def test_a_value_is_right_within_its_tolerance(field: Field, said: Any, is_right: bool) -> None:
    assert field.accepts(said) == is_right


@pytest.mark.parametrize(
    ("said", "answer"),
    [
        ('It was stuck.\n```json\n{"a": 1}\n```', {"a": 1}),
        ('I first thought {"a": 2}, but {it} is {"a": 1}.', {"a": 1}),
        ('{"type": "result", "result": "so: {\\"a\\": 1}"}', {"a": 1}),
        ('{"result": "", "structured_output": {"a": 1}}', {"a": 1}),
        ('{"a": {"b": 1}}', {"a": {"b": 1}}),
        ("stuck at 40 s for 12 s in the mode cruise", None),
        ("", None), (["a"], None),
    ],
)  # fmt: skip
def test_the_last_json_object_is_the_answer(said: Any, answer: dict[str, Any] | None) -> None:
    assert read_answer(said) == answer


def test_an_answer_has_exactly_the_members_that_were_asked_for() -> None:
    right = right_answer(STUCK)
    assert wrong_fields(STUCK, right) == []
    assert wrong_fields(STUCK, None) == ["gave no JSON object"]
    assert wrong_fields(STUCK, right | {"also_s": 41.0}) == ["has the unknown member 'also_s'"]
    assert wrong_fields(STUCK, {k: v for k, v in right.items() if k != "mode"}) == [
        "has no member 'mode'"
    ]
    assert wrong_fields(STUCK, right | {"start_s": 52.0}) == ["says start_s = 52.0; right is 40.0"]


def test_the_form_names_each_member_and_its_schema_agrees() -> None:
    for scenario in SCENARIOS:
        assert all(f'"{field.name}": ' in scenario.text() for field in scenario.fields)
        schema = scenario.schema()
        assert schema["required"] == [*schema["properties"]]
        assert json.loads(json.dumps(schema)) == schema


# -- calls, scores, the command line ---------------------------------------------------------------


def test_calls_that_failed_or_were_repeated_are_wrong_turns() -> None:
    def call(tool: str, failed: bool = False, **arguments: Any) -> NotedCall:
        return NotedCall(tool, arguments, failed, 10)

    state = call("webots_get_robot_state")
    assert (
        wrong_turns([state, call("webots_get_logs"), call("webots_get_logs", level="error")]) == 0
    )
    assert wrong_turns([state, state, call("webots_get_logs", failed=True)]) == 2
    assert wrong_turns([state, call("webots_simulation_control", command="step"), state]) == 0
    assert wrong_turns([state, call("webots_run", failed=True), state]) == 2


def typed(*words: str) -> str:
    """A command line that finds this package from any folder."""
    return shlex.join(["env", f"PYTHONPATH={CHECKOUT}", sys.executable, *words])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("client", "called", "wrong"),
    [
        (typed("-m", "tests.evaluations.planned", "{config}", "{question}"), 1, ""),
        (
            typed("-c", "print('stuck at 40 s for 12 s in the mode cruise')"),
            0,
            "gave no JSON object",
        ),
        (typed("-c", "import os; assert not os.listdir()"), 0, "gave no JSON object"),
        (typed("-c", "print('I do not know'); raise SystemExit(3)"), 0, "no call was answered"),
        ("no-such-client", 0, "no call was answered"),
    ],
)
def test_a_client_of_the_command_line_is_judged_by_its_calls_and_its_answer(
    client: str, called: int, wrong: str
) -> None:
    outcome = ask_by_command(STUCK, client)
    assert len(outcome.calls) == called
    assert outcome.is_right == (not wrong) and (wrong in outcome.wrong or not wrong), outcome.wrong
    assert ("exit code 3" in outcome.said) == ("(3)" in client)
    assert ("no answer: " in outcome.said) == (client == "no-such-client")
    assert all(call.tokens > 50 and not call.failed for call in outcome.calls)


@pytest.mark.slow
def test_a_failed_call_of_a_command_line_client_is_noted(tmp_path: Path) -> None:
    script = tmp_path / "client.py"
    script.write_text(
        "import anyio, json, sys\n"
        "from mcp import Client, StdioServerParameters\n"
        "async def main():\n"
        "    command, *args = json.loads(sys.argv[1])\n"
        "    async with Client(StdioServerParameters(command=command, args=args)) as client:\n"
        "        await client.call_tool('webots_list_robots', {'no_such': 1})\n"
        "    print(json.dumps({'read': len(sys.stdin.read())}))\n"
        "anyio.run(main)\n"
    )
    split = (
        "import json, shlex, sys, subprocess; raise SystemExit(subprocess.call([sys.executable, "
    )
    split += "sys.argv[1], json.dumps(shlex.split(sys.argv[2]))]))"
    outcome = ask_by_command(
        BY_NAME["trap: nothing is recorded"], typed("-c", split, str(script), "{server}")
    )
    assert [call.failed for call in outcome.calls] == [True], outcome.said
    assert outcome.wrong_turns == 1
    assert json.loads(outcome.said)["read"] > 100, "the question comes over stdin"


def score(name: str, right: int, calls: int = 2) -> Score:
    return Score(name, 4, right, calls * 4, 400, 0)


def test_scores_are_summed_up_saved_and_compared(tmp_path: Path) -> None:
    call = NotedCall("webots_get_logs", {}, failed=True, tokens=30)
    right = Outcome(STUCK, (replace(call, failed=False),), (), 1.0)
    scores = scores_of([right, replace(right, calls=(call,), wrong=("no",))])
    assert scores == [Score(STUCK.name, 2, 1, 2, 60, 1)]
    assert summary(scores) == (
        "1 of 2 right (50 %), 1.0 calls and 30 tokens of answers per question, 1 wrong turns"
    )
    save_scores(tmp_path / "a.json", scores)
    assert read_scores(tmp_path / "a.json") == scores
    before = [score("a", 0), score("b", 4), score("c", 4, calls=5), score("only before", 4)]
    text = comparison(before, [score("a", 4), score("b", 4), score("c", 3)])
    assert "gained: a (0 of 4, now 4 of 4)" in text and "lost: c (4 of 4, now 3 of 4)" in text
    assert "steps: c (5.0 calls, 0.0 wrong turns, now 2.0 calls, 0.0 wrong turns)" in text
    assert "1 questions gained, 1 lost" in text and "100 of 100" in text
    assert "left out: 1 questions" in text
    assert "no question is answered rightly more or less often" in comparison(before, before)


@pytest.mark.parametrize(
    ("gained", "lost", "chance"), [(0, 0, 1.0), (1, 0, 1.0), (6, 0, 1 / 32), (5, 1, 7 / 32)]
)
def test_the_sign_test_gives_the_probability_of_chance(
    gained: int, lost: int, chance: float
) -> None:
    assert sign_test(gained, lost) == pytest.approx(chance)


@pytest.mark.slow
def test_the_command_prints_scores_saves_them_and_compares(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = str(tmp_path / "first.json"), str(tmp_path / "second.json")
    only = ["--only", "nothing is recorded"]
    assert main([*only, "--save", first, "--repeat", "2"]) == 0
    assert "2 of 2 right (100 %), 1.0 calls" in capsys.readouterr().out
    assert main([*only, "--cheat", "a liar", "--save", second]) == 1
    printed = capsys.readouterr().out
    assert "WRONG" in printed and "called nothing" in printed and "(--tools core)" in printed
    assert main(["--compare", first, second]) == 0
    assert "lost: trap: nothing is recorded (2 of 2, now 0 of 1)" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [
        ["--only", "no such scenario"], ["--repeat", "0"], ["--compare", "no/a.json", "no/b.json"],
        ["--client", "x", "--cheat", "a liar"], ["--cheat", "nobody"],
    ],
)  # fmt: skip
def test_wrong_usage_is_an_error_of_usage(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert "error: " in capsys.readouterr().err


def test_a_file_without_scores_is_named(tmp_path: Path) -> None:
    file = tmp_path / "other.json"
    file.write_text('{"a": 1}')
    with pytest.raises(
        ValueError, match=r"other\.json holds no saved scores; write them with --save"
    ):
        read_scores(file)


def test_a_recorded_subject_is_asked_on_a_copy() -> None:
    recorded = [each for each in SCENARIOS if each.of not in {*WORLDS, NOTHING}]
    assert len({each.of for each in recorded}) >= 15
    assert not any(each.may or each.order or each.checks for each in recorded)
