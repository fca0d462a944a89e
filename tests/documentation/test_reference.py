"""What the site adds to the pages from the code has all of it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import get_args

import anyio
import pytest

from docs import reference
from webots_mcp import MemoryDatabase
from webots_mcp.answers.answer_models import AnswerTable
from webots_mcp.answers.columns import COLUMNS
from webots_mcp.answers.event_tables import EVENT_COLUMNS
from webots_mcp.answers.summaries import TRIAL_FIGURES
from webots_mcp.answers.trend_tables import STATE_COLUMNS, TREND_COLUMNS
from webots_mcp.cli import described, names
from webots_mcp.database.schema import SCHEMA_FILE
from webots_mcp.judging.divergence import PartedSignal
from webots_mcp.questions.describe_signals import MEANING_COLUMNS
from webots_mcp.questions.inspect_controller import INSPECTION_COLUMNS
from webots_mcp.questions.list_and_compare_runs import (
    CHECK_COLUMNS,
    DIFFERENCE_COLUMNS,
    GROUP_COLUMNS,
    MEASURE_COLUMNS,
    PARTED_COLUMNS,
    RUN_COLUMNS,
)
from webots_mcp.questions.list_robots import (
    BODY_COLUMNS,
    PLACE_COLUMNS,
    RECORDER_COLUMNS,
    ROBOT_COLUMNS,
)
from webots_mcp.questions.query_history import SIGNAL_COLUMNS
from webots_mcp.questions.send_command import COMMAND_COLUMNS
from webots_mcp.questions.set_breakpoints import BREAKPOINT_COLUMNS
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.run_parameters import COLUMNS as COLUMNS_OF_PARAMETERS


def parts(text: str) -> dict[str, str]:
    """By heading what stands below it."""
    return dict(re.findall(r"(?ms)^### (\S+).*?\n(.*?)(?=^### |\Z)", text))


def test_each_tool_has_its_parameters_with_their_meaning() -> None:
    memory = MemoryDatabase()
    try:
        tools = anyio.run(create_server(memory, memory.data_dir).list_tools)
    finally:
        memory.close()
    shown = parts(reference.tools())
    assert shown.keys() == {tool.name for tool in tools}
    for tool in tools:
        rows = re.findall(r"(?m)^- `(\w+)` \(.+?\): (.*)$", shown[tool.name])
        assert dict(rows).keys() == tool.input_schema["properties"].keys()
        assert all(meaning for _, meaning in rows), tool.name


@pytest.mark.slow
def test_each_command_has_its_options() -> None:
    shown = parts(reference.commands())
    assert sorted(shown) == names()
    for name, command in described().items():
        for typed in command.arguments:
            assert f"- `{typed}`: " in shown[name], name


def test_each_table_and_view_has_its_columns_and_every_comment_of_the_schema() -> None:
    shown = parts(reference.tables())
    schema = SCHEMA_FILE.read_text("utf-8")
    made = re.findall(r"(?ms)^CREATE (TABLE|VIEW) (\w+)(.*?);$", schema)
    assert shown.keys() == {name for _, name, _ in made} - {"alembic_version"}
    for kind, name, text in made:
        comments = re.findall(r"/\* ?(.*?) ?\*/", text)
        for comment in comments if kind == "TABLE" else comments[:1]:
            assert reference.escaped(comment) in shown[name], name


def test_each_field_of_each_answer_has_a_meaning() -> None:
    shown = parts(reference.fields())
    models = reference.answer_models()
    assert shown.keys() == {model.__name__ for model in models}
    for model in models:
        inherited = {
            name for base in model.__mro__[1:] for name in getattr(base, "model_fields", ())
        }
        rows = re.findall(r"(?m)^\| `(\w+)` \| .+ \| (.*) \|$", shown[model.__name__])
        assert dict(rows).keys() == model.model_fields.keys() - inherited
        assert all(meaning.endswith(".") for _, meaning in rows), model.__name__


def test_the_fields_of_plugins_are_there_too() -> None:
    assert "size_bytes" in parts(reference.fields())["ReportAnswer"]


def test_each_table_of_an_answer_has_its_columns_with_their_meaning() -> None:
    tables = {
        f"{model.__name__}.{name}"
        for model in reference.answer_models()
        for name, field in model.model_fields.items()
        if AnswerTable in get_args(field.annotation)
    }
    assert tables == COLUMNS.keys()
    shown = parts(reference.fields())
    for field, columns in COLUMNS.items():
        assert all(meaning.endswith(".") for meaning in columns.values()), field
        model, _, name = field.partition(".")
        assert f"Columns of `{name}`:" in shown[model]
        first = next(each for each, others in COLUMNS.items() if others is columns)
        for column in columns if first == field else ():
            assert f"| `{column}` |" in shown[model], (field, column)


@pytest.mark.parametrize(
    ("field", "filled"),
    [
        ("RobotsAnswer.robots", (*ROBOT_COLUMNS, *RECORDER_COLUMNS)),
        ("WorldAnswer.in_world", (*BODY_COLUMNS, *PLACE_COLUMNS)),
        ("ParametersAnswer.parameters", COLUMNS_OF_PARAMETERS),
        ("CommandsAnswer.commands", COMMAND_COLUMNS),
        ("BreakpointsAnswer.breakpoints", BREAKPOINT_COLUMNS),
        ("InspectionAnswer.inspections", INSPECTION_COLUMNS),
        ("SignalsAnswer.signals", SIGNAL_COLUMNS),
        ("SignalMeaningsAnswer.signals", MEANING_COLUMNS),
        ("RunTrendTables.numbers", TREND_COLUMNS),
        ("RunTrendTables.states", STATE_COLUMNS),
        ("EventsAnswer.events", (*EVENT_COLUMNS, "@SIGNAL")),
        ("CheckAnswer.checks", CHECK_COLUMNS),
        ("TrialsAnswer.ranked", ("PARAMETER", *TRIAL_FIGURES)),
        ("RunsAnswer.runs", RUN_COLUMNS),
        ("ComparisonAnswer.diverging", PARTED_COLUMNS),
        ("ComparisonAnswer.groups", GROUP_COLUMNS),
        ("ComparisonAnswer.measures", MEASURE_COLUMNS),
        ("ComparisonAnswer.differences", DIFFERENCE_COLUMNS),
    ],
)
def test_the_columns_that_are_described_are_those_that_are_filled(
    field: str, filled: Sequence[str]
) -> None:
    assert list(COLUMNS[field]) == list(filled)
    assert PARTED_COLUMNS[3:] == PartedSignal._fields[3:-1]


@pytest.mark.parametrize(
    ("text", "markdown"),
    [
        ("a < b and `a < b`, 2 * 3", "a \\< b and `a < b`, 2 \\* 3"),
        (
            "So:\n\n  webots-mcp run 'x < 1'\n\nThat.",
            "So:\n\n```sh\nwebots-mcp run 'x < 1'\n```\n\nThat.",
        ),
    ],
)
def test_docstrings_are_shown_as_they_are_meant(text: str, markdown: str) -> None:
    assert reference.as_markdown(text) == markdown


def test_the_navigation_has_the_pages_of_each_list() -> None:
    index = "# A\n\n## One\n\n- [b](b.md): c\n- [d](../d.md)\n\n## Two\n\n- [e](e.md), f\n"
    trees = re.findall(r":caption: ([^\n]+)\n\n(.*?)\n```", reference.navigation(index), re.DOTALL)
    assert trees == [("One", "b.md\n../d.md"), ("Two", "e.md")]


def test_each_tool_and_each_command_is_on_one_page() -> None:
    for folder, everything in (
        ("tools", reference.tools()),
        ("command-line", reference.commands()),
    ):
        pages = [parts(added("")) for page, added in reference.ADDED.items()
                 if page.startswith(f"docs/{folder}/")]  # fmt: skip
        named = [name for page in pages for name in page]
        assert all(pages)
        assert sorted(named) == sorted(parts(everything))


def test_each_page_that_is_generated_is_there_and_its_parent_links_to_it() -> None:
    for folder in ("tools", "command-line"):
        files = {file.stem for file in (reference.DOCS / folder).glob("*.md")}
        assert {f"docs/{folder}/{name}" for name in files} == {
            page for page in reference.ADDED if page.startswith(f"docs/{folder}/")
        }
        links = re.findall(
            rf"\]\({folder}/(\w+)\.md\)", (reference.DOCS / f"{folder}.md").read_text()
        )
        assert set(links) == files
