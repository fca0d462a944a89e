"""Three recordings answer every question as it was accepted, and warn of nothing untrue."""

from __future__ import annotations

from functools import cache
from typing import Any, cast, get_args

import pytest

from tests.golden.asking import ACTIONS, NEEDS_A_SIMULATION, TOOLS, Answers, ask_all
from tests.golden.recordings import RECORDINGS
from tests.golden.stored import difference, drawn
from tests.golden.text import Portable
from webots_mcp.extras.plugin_registry import export_formats
from webots_mcp.plotting import PlotKind
from webots_mcp.questions import all_questions

HEADER = {
    "robot", "run_id", "sim_time_s", "age_s", "status", "why", "quoted", "hint", "notes",
}  # fmt: skip
FACTS = {"run", "command", "log", "change", "bridge_event", "kept_stretch"}
"""Kinds of events that say what happened, and not that something is wrong."""


@cache
def asked(name: str) -> tuple[Answers, dict[str, str]]:
    """The answers about a recording, and the same as portable text."""
    recording = RECORDINGS[name]
    with drawn(recording) as folder:
        answers, portable = ask_all(recording, folder), Portable(recording, folder)
        return answers, {question: portable.text(each) for question, each in answers.items()}


def answers_to(question: str) -> list[Any]:
    return [asked(name)[0][question] for name in RECORDINGS]


def is_answered(answer: Any) -> bool:
    """Whether it says more than of which robot and run it is, or why there is nothing to say."""
    answers = cast("list[Any]", answer) if isinstance(answer, list) else [answer]
    return any(
        bool(cast("dict[str, Any]", each).keys() - HEADER)
        for each in answers
        if isinstance(each, dict)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_every_answer_is_the_accepted_one(name: str) -> None:
    found = difference(name, asked(name)[1])
    assert not found, f"{found}\n(after reading each: python -m tests.golden --accept {name})"


def test_every_declared_question_is_asked() -> None:
    tools = {tool for tool, _ in (TOOLS | ACTIONS).values()}
    assert tools == {each.name for each in all_questions()}


@pytest.mark.parametrize("question", sorted(TOOLS.keys() - {*NEEDS_A_SIMULATION, "diagnosis"}))
def test_what_a_recording_can_answer_one_of_the_three_answers(question: str) -> None:
    assert any(is_answered(answer) for answer in answers_to(question))


def test_every_view_has_rows_in_one_of_the_three() -> None:
    views = [question for question in asked("drive")[0] if question.startswith("view ")]
    assert views
    assert [view for view in views if not any(each["rows"] for each in answers_to(view))] == []


def test_every_kind_of_plot_and_every_format_of_export_is_asked() -> None:
    plots = {f"plot of {'the ' * (kind == 'trajectory')}{kind}" for kind in get_args(PlotKind)}
    formats = {f"export as {each.name}" for each in export_formats()}
    own = {"export as csv", "export as jsonl", "export as bundle", "export of trials"}
    expected = {*plots, "plot of trials", *formats, *own, "report"}
    refused = {each for each in expected if all(isinstance(a, str) for a in answers_to(each))}
    assert refused == set()


@pytest.mark.parametrize("name", [name for name, each in RECORDINGS.items() if each.is_healthy])
def test_no_answer_about_a_healthy_recording_warns(name: str) -> None:
    answers, texts = asked(name)
    outcomes = {row[1] for row in answers["check"]["checks"]["rows"] if row[0] != "keeps pace"}
    assert outcomes <= {"not applicable", "not looked at"}
    assert set(answers["events"]["verdicts"]["found"]) <= FACTS
    assert [
        question for question, text in texts.items() if '"warn' in text or '"fail"' in text
    ] == []
