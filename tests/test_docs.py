"""The pages name what is there, all of it and nothing else, and lead to each other."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import anyio
import pytest

import webots_mcp
from webots_mcp import MCPBridge, MemoryDatabase, testing
from webots_mcp.bridge.backlog import MAX_WAITING_BYTES, MAX_WAITING_ROWS
from webots_mcp.bridge.capture import MOST_LINES_PER_S
from webots_mcp.bridge.devices import MOST_OBJECTS, SECTORS
from webots_mcp.cli import names
from webots_mcp.connection import OLDEST_SQLITE, SCHEMA_FILE
from webots_mcp.contract import BUILT_IN_ACTIONS, KEEP_AFTER_S
from webots_mcp.questions.budget import ANSWER_TOKENS, LARGE_ANSWER_TOKENS
from webots_mcp.questions.declaring import MAX_WAIT_S
from webots_mcp.server import create_server
from webots_mcp.store.detection.events import kind_names

CHECKOUT = Path(__file__).parents[1]
DOCS = CHECKOUT / "docs"
INSTALLED = Path(webots_mcp.__file__).parents[1]
PAGES = sorted([CHECKOUT / "README.md", CHECKOUT / "CHANGELOG.md", CHECKOUT / "CONTRIBUTING.md",
                *DOCS.glob("*.md"), *CHECKOUT.glob("examples/*/README.md")])  # fmt: skip

WORDS = {2.0: "two", 8: "eight"}


def page(name: str) -> str:
    return (DOCS / name).read_text("utf-8")


def test_the_page_of_the_tools_names_every_tool_and_no_other() -> None:
    memory = MemoryDatabase()
    try:
        server = create_server(memory, memory.data_dir)
        tools = {tool.name for tool in anyio.run(server.list_tools)}
    finally:
        memory.close()
    assert set(re.findall(r"\bwebots_[a-z_]+\b", page("tools.md"))) == tools


def test_the_page_of_the_command_line_names_every_command() -> None:
    for name in names():
        assert re.search(rf"`{name}\b", page("command-line.md")), name


def test_the_page_of_the_bridge_names_every_method() -> None:
    for name, _ in inspect.getmembers(MCPBridge, inspect.isfunction):
        if not name.startswith("_"):
            assert f"bridge.{name}(" in page("bridge.md"), name


def test_the_page_of_the_bridge_names_every_action_that_is_built_in_and_no_other() -> None:
    (listed,) = re.findall(r"actions that are built in [^:]*:([^.]*)\.", page("bridge.md"))
    assert re.findall(r"`(\w+)`", listed) == list(BUILT_IN_ACTIONS)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("bridge.md", f"up to {MAX_WAITING_ROWS:,} rows or {MAX_WAITING_BYTES / 1e6:g} MB"),
        ("bridge.md", f"({MOST_LINES_PER_S} a second of each; what is above is counted)"),
        ("bridge.md", f"No call waits longer than {MAX_WAIT_S} s"),
        ("bridge.md", f"the nearest distance of {WORDS[SECTORS]} sectors"),
        ("bridge.md", f"how many and the nearest {WORDS[MOST_OBJECTS]}"),
        ("bridge.md", f"keeps the last seconds, and {WORDS[KEEP_AFTER_S]} more"),
        ("limits.md", f"No tool waits longer than {MAX_WAIT_S} s"),
        ("limits.md", f"under {ANSWER_TOKENS:,} tokens"),
        ("limits.md", f"up to {LARGE_ANSWER_TOKENS:,}"),
        ("tools.md", f"up to {LARGE_ANSWER_TOKENS:,} tokens"),
        ("limits.md", f"SQLite {OLDEST_SQLITE[0]}.{OLDEST_SQLITE[1]} or newer is needed"),
    ],
)
def test_a_limit_has_the_figure_that_its_page_says(name: str, said: str) -> None:
    assert said in " ".join(page(name).split())


def test_the_page_of_the_bridge_shows_its_defaults() -> None:
    parameters = inspect.signature(MCPBridge).parameters.values()
    plain = [each.replace(annotation=inspect.Parameter.empty) for each in parameters]
    assert f"`MCPBridge{inspect.Signature(plain)}`" in page("bridge.md")


def test_the_page_of_the_interface_names_all_that_may_be_imported() -> None:
    names = re.findall(r"`([A-Z]\w+)`", page("python.md"))
    assert set(names) == {*webots_mcp.__all__, *testing.__all__} - {"__version__"}
    assert len(names) == len(set(names))


def test_the_page_of_the_database_names_tables_and_views_that_there_are() -> None:
    part = page("database.md").partition("## What is in it")[2].partition("\n## ")[0]
    named = set(re.findall(r"`([a-z]+_?[a-z]+)`", part))
    made = set(re.findall(r"(?m)^CREATE (?:TABLE|VIEW) (\w+)", SCHEMA_FILE.read_text()))
    assert named == made - {"alembic_version"}


def test_the_pages_name_only_kinds_of_events_that_there_are() -> None:
    found = [
        re.findall(r"events of the kind `(\w+)`", page(file.name)) for file in DOCS.glob("*.md")
    ]
    named = [kind for kinds in found for kind in kinds]
    assert named
    assert set(named) <= set(kind_names())


def test_the_first_page_leads_to_each_other_once() -> None:
    links = re.findall(r"(?m)^- \[.+?\]\((.+?)\)", page("index.md"))
    assert sorted((DOCS / link).resolve() for link in links) == [
        each for each in PAGES if each != DOCS / "index.md"
    ]


@pytest.mark.parametrize("file", PAGES, ids=lambda file: file.relative_to(CHECKOUT).as_posix())
def test_what_a_page_links_to_is_there(file: Path) -> None:
    text = re.sub(r"(?ms)^```.*?^```", "", file.read_text("utf-8"))
    for target in re.findall(r"\]\(((?!https?:)[^)\s]+)\)", text):
        name, _, part = target.partition("#")
        there = (file.parent / name).resolve() if name else file
        if not there.exists():  # the package may be installed, and lie elsewhere
            there = INSTALLED / there.relative_to(CHECKOUT)
        assert there.exists(), target
        assert not part or part in anchors(there.read_text("utf-8")), target


@pytest.mark.parametrize("file", PAGES, ids=lambda file: file.relative_to(CHECKOUT).as_posix())
def test_no_page_installs_from_the_package_index_what_is_not_there(file: Path) -> None:
    found = re.findall(r"install [^`\n]*\bwebots-mcp\b[^`\n]*", file.read_text("utf-8"))
    assert not found, "once it is published, this test goes"


def anchors(text: str) -> set[str]:
    """Of the headings, as code hosts make them."""
    heads = re.findall(r"(?m)^#+ (.+)$", text)
    return {re.sub(r"[^\w -]", "", head).lower().replace(" ", "-") for head in heads}
