"""The first sentence of an answer says what its members say, and no more."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.answers.models import (
    Answer,
    AnswerTable,
    BreakpointAnswer,
    CheckAnswer,
    ComparisonAnswer,
    EventsAnswer,
    KindVerdicts,
    LogsAnswer,
    RunAnswer,
    StateAnswer,
)
from webots_mcp.answers.summaries import MOST_WORDS, summary_of
from webots_mcp.judging.detection.events import kind_names
from webots_mcp.questions import all_questions

_KINDS = st.sampled_from(kind_names())


def events(**verdicts: object) -> str:
    return summary_of(EventsAnswer(verdicts=KindVerdicts.model_validate(verdicts))) or ""


def test_a_kind_that_was_not_searched_is_never_called_not_found() -> None:
    said = events(not_found="jump", not_searched={"stuck, fall": "no command is recorded"})
    assert said == "Not found: jump; cannot tell: stuck, fall."


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
            "rover is running at 3.2 s (data 0.21 s old).",
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
                matching=7,
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
