"""The first sentence of an answer says what its members say, and no more."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.answers.answer_models import (
    Answer,
    AnswerTable,
    BreakpointAnswer,
    CheckAnswer,
    CommandsAnswer,
    ComparisonAnswer,
    EventsAnswer,
    KindVerdicts,
    LogsAnswer,
    RunAnswer,
    RunsAnswer,
    RunTrendTables,
    StateAnswer,
    TrendsAnswer,
    TrialsAnswer,
)
from webots_mcp.answers.event_tables import verdicts_of
from webots_mcp.answers.summaries import MOST_WORDS, summary_of, verdict_of_kinds
from webots_mcp.judging.detection.event_kinds import kind_names
from webots_mcp.judging.verdicts import AS_STUCK, JudgedInterval, SearchCoverage
from webots_mcp.questions import all_questions

_KINDS = st.sampled_from(kind_names())


def events(**verdicts: object) -> str:
    return summary_of(EventsAnswer(verdicts=KindVerdicts.model_validate(verdicts))) or ""


def test_a_kind_that_was_not_searched_is_never_called_not_found() -> None:
    said = events(not_found="jump", not_searched={"stuck, fall": "no command is recorded"})
    assert said == "Not found: jump; cannot tell: fall, stuck."


def test_what_was_found_comes_with_its_number_and_its_first_time_the_worst_first() -> None:
    table = AnswerTable(columns=["kind", "start_s"], rows=[["flat", 0.0], ["stuck", 40.0]])
    verdicts = KindVerdicts(found={"flat": 2, "stuck": 1, "run": 2})
    said = summary_of(EventsAnswer(events=table, verdicts=verdicts))
    assert said == "Found stuck once at 40 s, flat 2 times from 0 s on."


@given(
    found=st.dictionaries(_KINDS, st.integers(1, 9_999)),
    absent=st.lists(_KINDS, unique=True),
    unsearched=st.lists(_KINDS, unique=True),
)
def test_no_verdict_is_called_by_another_ones_name(
    found: dict[str, int], absent: list[str], unsearched: list[str]
) -> None:
    absent = [kind for kind in absent if kind not in found]
    said = events(
        found=found or None,
        not_found=", ".join(absent) or None,
        not_searched=dict.fromkeys(unsearched, "why") or None,
    )
    parts = dict(part.split(": ", 1) for part in said.rstrip(".").split("; ") if ": " in part)
    named = {name.lower(): text.replace(" ...", "") for name, text in parts.items()}
    for kind in _kinds_of(named.get("not found", "")):
        assert kind in absent
    for kind in _kinds_of(named.get("cannot tell", "")):
        assert kind in unsearched and kind not in found and kind not in absent
    assert len(said.split()) <= MOST_WORDS + 1


def _kinds_of(text: str) -> list[str]:
    return [kind for kind in text.split(" and ")[0].split(", ") if kind in kind_names()]


def test_the_checks_are_counted_by_their_outcome() -> None:
    rows = [["wheels grip", "warn"], ["stays upright", "not judged"], ["goal", "not applicable"]]
    table = AnswerTable(columns=["check", "outcome"], rows=rows)
    said = summary_of(CheckAnswer(checks=table, passed=["keeps pace"]))
    assert said == (
        "Of the checks 1 warned (wheels grip), 1 could not be judged (stays upright), 1 passed, "
        "1 not applicable."
    )


def test_an_undecided_comparison_does_not_say_that_nothing_differs() -> None:
    groups = AnswerTable(columns=["name"], rows=[["before"], ["after"]])
    measures = AnswerTable(
        columns=["name", "different"], rows=[["distance_m", None], ["speed", False], ["goal", True]]
    )
    said = summary_of(ComparisonAnswer(groups=groups, measures=measures))
    assert said == "Different: goal; 1 equal within what matters; 1 cannot be decided."
    measures.rows = [["distance_m", None]]
    said = summary_of(ComparisonAnswer(groups=groups, measures=measures))
    assert said == "No figure is known to differ; 1 cannot be decided."


@pytest.mark.parametrize(
    ("unlike", "rows", "said"),
    [
        (None, [], "Identical in 500 compared rows of 3 signals, up to 8 s."),
        (
            None,
            [["speed", 1.5], ["pose.0", 1.516]],
            "The runs differ in speed from 1.5 s on, and are identical before.",
        ),
        (
            {"git_commit": ["a", "b"], "began_by": ["start", "reset"]},
            [["speed", 0.016], ["pose.0", 0.016]],
            "The runs were started differently (git_commit). The runs differ in speed, pose.0 from "
            "the first compared row on.",
        ),
    ],
)
def test_a_first_difference_begins_with_where_it_is(
    unlike: dict[str, list[str]] | None, rows: list[list[object]], said: str
) -> None:
    compared = {"row_count": 500, "signal_count": 3, "start_s": 0.016, "end_s": 8.0}
    answer = ComparisonAnswer(verdict="", different_before=unlike, compared=compared)
    answer.diverging = AnswerTable(columns=["signal", "start_s"], rows=rows)
    assert summary_of(answer) == said
    answer.compared = {"row_count": 0, "signal_count": 0}
    assert "Cannot tell" in (summary_of(answer) or "")


def test_too_few_runs_do_not_hide_the_largest_differences() -> None:
    groups = AnswerTable(columns=["name", "runs"], rows=[["before", [1, 2]], ["after", [3]]])
    measures = AnswerTable(
        columns=["name", "median", "range", "runs_wanted"],
        rows=[
            ["distance_m", [5.98, 8.97], None, 7],
            ["duration_s", [74.9, 59.9], [[29.9, 119.9], [59.9, 59.9]], None],
        ],
    )
    differences = AnswerTable(columns=["signal", "mean"], rows=[["commanded_m_s", [0.1, 0.3]]])
    said = summary_of(ComparisonAnswer(groups=groups, measures=measures, differences=differences))
    assert said == (
        "Largest differences, not certain: commanded_m_s 0.1 -> 0.3, distance_m 5.98 -> 8.97; "
        "too few runs (2 and 1): 7 of each would do."
    )


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (StateAnswer(status="never seen"), "Nothing is recorded here yet."),
        (
            StateAnswer(robot="rover", status="running", sim_time_s=3.2, age_s=0.21, state={}),
            "rover is running at 3.2 s (data 0.2 s old).",
        ),
        (
            StateAnswer(robot="rover", status="paused", sim_time_s=3.2, state={"mode": "dig"}),
            "rover is paused at 3.2 s, mode 'dig'.",
        ),
        (
            BreakpointAnswer(breakpoint_id=2, condition="x > 1", action="pause", armed=None),
            "Breakpoint 2 is stored, not yet confirmed: pause when x > 1.",
        ),
        (
            RunAnswer(action="run", stopped="condition held", state_at_s=4.5),
            "The run stopped at 4.5 s: condition held.",
        ),
        (
            RunAnswer(command_id=3, action="run", outcome="claimed"),
            "run (command 3): still under way.",
        ),
        (
            LogsAnswer(
                lines=AnswerTable(columns=["level", "message"], rows=[["error", "drop all"]]),
                total=7,
            ),
            "1 of 7 log lines; 1 error.",
        ),
    ],
)
def test_a_summary_says_what_is_known_and_repeats_no_recorded_line(
    answer: Answer, said: str
) -> None:
    assert summary_of(answer) == said


def test_every_answer_has_a_summary_as_its_first_member() -> None:
    for each in all_questions():
        if each.answer is not None:
            assert next(iter(each.answer.model_fields)) == "summary", each.name
            assert summary_of(each.answer(status="never seen")), each.name


@given(
    asked=st.lists(_KINDS, unique=True),
    counts=st.dictionaries(_KINDS, st.integers(1, 9)),
    searched=st.sets(_KINDS),
    lacking=st.sets(_KINDS),
    near=st.dictionaries(_KINDS, st.sampled_from(["something near", AS_STUCK])),
)
def test_each_kind_that_was_asked_for_has_exactly_one_verdict(
    asked: list[str],
    counts: dict[str, int],
    searched: set[str],
    lacking: set[str],
    near: dict[str, str],
) -> None:
    coverage = SearchCoverage()
    for kind in asked:
        is_searched = kind in searched or kind in counts
        if is_searched:
            coverage.of(kind).intervals.append(JudgedInterval(1, 0.0, 1.0))
            coverage.note_nearest(kind, 0.5, near.get(kind, ""))
        if kind in lacking or not is_searched:
            coverage.not_searched(kind, "nothing is known of it", "nor of its like")
    shown = verdicts_of(coverage.verdicts(asked, counts))
    made = verdict_of_kinds(shown)
    assert sorted(made) == sorted(asked)
    for kind in asked:
        if kind in counts:
            assert made[kind] == "found"
        elif kind not in searched:
            assert made[kind] == "cannot tell"
        elif kind in lacking:
            assert made[kind] == "none in the searched part"
        else:
            assert made[kind] == (AS_STUCK if near.get(kind) == AS_STUCK else "not found")


def test_what_began_before_the_range_is_said_to_go_on() -> None:
    table = AnswerTable(columns=["kind", "start_s"], rows=[["stuck", 40.0], ["jump", 46.0]])
    verdicts = KindVerdicts(found={"stuck": 1, "jump": 1})
    said = summary_of(EventsAnswer(events=table, verdicts=verdicts, start_s=45.0))
    assert said == "Already going on at 45 s: stuck since 40 s; found jump once at 46 s."


def test_beginnings_and_ends_are_counted_by_run_and_errors_come_first() -> None:
    rows: list[list[Any]] = [
        ["run", 1, "", {"what": "began"}], ["run", 1, "", {"what": "ended"}],
        ["run", 2, "", {"what": "began"}], ["log", 2, "error", {}], ["log", 2, "warning", {}],
        ["command", 2, "grasp", {"status": "failed"}],
    ]  # fmt: skip
    table = AnswerTable(columns=["kind", "run_id", "name", "details"], rows=rows)
    verdicts = KindVerdicts(found={"run": 3, "log": 2, "command": 1})
    said = summary_of(EventsAnswer(events=table, verdicts=verdicts))
    assert said == "Noted 1 log error, 1 failed command and 2 more."
    runs = AnswerTable(columns=["kind", "run_id"], rows=[["run", 1], ["run", 1], ["run", 2]])
    said = summary_of(EventsAnswer(events=runs, verdicts=KindVerdicts(found={"run": 3})))
    assert said == "Noted 2 runs that began or ended."


def test_checks_that_are_not_shown_are_counted_and_expectations_come_first() -> None:
    table = AnswerTable(columns=["check", "outcome"], rows=[["sensors live", "fail"]])
    counts = {"fail": 3, "pass": 4, "not applicable": 5}
    answer = CheckAnswer(checks=table, passed=["a"], counts=counts, expected={"x > 1": "fail: no"})
    assert summary_of(answer) == (
        "x > 1 did not hold. Of the checks 3 failed (sensors live and 2 more), 4 passed, "
        "5 not applicable."
    )


def test_a_condition_that_never_held_is_named_with_the_nearest_value() -> None:
    nearest = "'x > 50' was true in none of 9 rows; nearest: x 12.8 at 4 s"
    verdicts = KindVerdicts(nearest={"condition": nearest})
    assert summary_of(EventsAnswer(verdicts=verdicts)) == f"{nearest}."


def test_trends_begin_with_the_mode_and_runs_with_what_ended_badly() -> None:
    states = AnswerTable(
        columns=["signal", "changes", "last", "since_s"], rows=[["mode", 3, "cruise", 95.0]]
    )
    run = RunTrendTables(run_id=1, start_s=0.0, end_s=119.9, row_count=9, states=states)
    assert summary_of(TrendsAnswer(runs=[run])) == (
        "0 to 119.9 s of run 1: mode changed 3 times, 'cruise' since 95 s."
    )
    runs = AnswerTable(
        columns=["run_id", "ended_by", "duration_s", "notable"],
        rows=[[2, "finished", 9.0, None], [1, "crashed", 3.0, {"log error": 1}]],
    )
    assert summary_of(RunsAnswer(runs=runs, total=2)) == (
        "2 runs; newest: run 2 finished after 9 s; run 1 crashed (1 log error)."
    )


def test_trials_name_the_best_parameters_and_those_that_failed() -> None:
    ranked = AnswerTable(
        columns=["gain", "grip", "score", "failed"],
        rows=[[8.0, "firm", 0.66, None], [8.0, "loose", None, 1]],
    )
    answer = TrialsAnswer(trial_set=1, state="done", trials=2, over=2, failed=1, ranked=ranked)
    assert summary_of(answer) == (
        "Trial set 1: 2 of 2 trials are over, done; best: gain 8.0, grip firm, score 0.66 "
        "(not confirmed); 1 failed (gain 8.0, grip loose)."
    )


def test_the_newest_command_comes_with_its_run_and_a_dead_controller_with_no_actions() -> None:
    commands = AnswerTable(
        columns=["action", "outcome", "run_id", "sim_time_s"], rows=[["blink", "done", 1, 8.0]]
    )
    answer = CommandsAnswer(robot="rover", status="stopped 9 s ago", commands=commands)
    assert summary_of(answer) == (
        "What rover can do is unknown while no controller runs; newest command: blink (run 1, "
        "8 s), done."
    )
