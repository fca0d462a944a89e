"""The pages name what is there, all of it and nothing else, and lead to each other."""

from __future__ import annotations

import inspect
import json
import re
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import pytest

import webots_mcp
from webots_mcp import MCPBridge, MemoryDatabase, testing
from webots_mcp.answers.budget import ANSWER_TOKENS, LARGE_ANSWER_TOKENS
from webots_mcp.bridge.backlog import MAX_WAITING_BYTES, MAX_WAITING_ROWS
from webots_mcp.bridge.devices import MOST_OBJECTS
from webots_mcp.bridge.lidar_summary import SECTORS
from webots_mcp.bridge.printed_lines import MOST_LINES_PER_S
from webots_mcp.cli import described, names
from webots_mcp.contract import BUILT_IN_ACTIONS, KEEP_AFTER_S
from webots_mcp.database.connection import OLDEST_SQLITE
from webots_mcp.database.schema import SCHEMA_FILE
from webots_mcp.judging.checks.check_run import CHECKS
from webots_mcp.judging.detection.event_kinds import kind_names
from webots_mcp.questions import all_questions
from webots_mcp.questions.arguments import MAX_WAIT_S
from webots_mcp.server.mcp_server import create_server
from webots_mcp.setup.client_entries import claude_desktop, clients_of, is_ours

CHECKOUT = Path(__file__).parents[2]
DOCS = CHECKOUT / "docs"
INSTALLED = Path(webots_mcp.__file__).parents[1]
PAGES = sorted([CHECKOUT / "README.md", CHECKOUT / "CHANGELOG.md", CHECKOUT / "CONTRIBUTING.md",
                CHECKOUT / "SECURITY.md",
                *DOCS.glob("*.md"), *CHECKOUT.glob("examples/*/README.md"),
                CHECKOUT / "tests" / "evaluations" / "README.md"])  # fmt: skip
WORDS = {2.0: "two", 8: "eight"}


def page(name: str) -> str:
    return (DOCS / name).read_text("utf-8")


def test_the_page_of_the_tools_names_and_counts_every_tool_and_no_other() -> None:
    tiers = {each.name: each.tier for each in all_questions()}
    text = page("tools.md")
    assert set(re.findall(r"\bwebots_[a-z_]+\b", text)) == set(tiers)
    shown: dict[str, str] = {}
    for tools, listed in re.findall(r"^- (`webots_.*?`) \(([a-z, ]+)\)", text, re.MULTILINE):
        named, lists = re.findall(r"webots_\w+", tools), listed.split(", ")
        shown |= zip(named, lists if len(lists) > 1 else lists * len(named), strict=True)
    assert shown == tiers
    count = Counter(tiers.values())
    default = count["core"] + count["default"]
    assert f"lists {default} of the {len(tiers)} tools" in text
    assert f"lists {count['core']} in about" in text


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
        ("bridge.md", f"(up to {MOST_LINES_PER_S} lines a second of each;"),
        ("bridge.md", f"No tool call waits longer than {MAX_WAIT_S} s"),
        ("bridge.md", f"the nearest distance in each of {WORDS[SECTORS]} sectors"),
        ("bridge.md", f"their number and the nearest {WORDS[MOST_OBJECTS]}"),
        ("bridge.md", f"keeps the last seconds, and the next {WORDS[KEEP_AFTER_S]}"),
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
    names = re.findall(r"`([A-Z]\w+|assert_\w+)`", page("python.md"))
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


def test_the_page_of_events_has_each_kind_and_what_a_check_makes_of_it() -> None:
    text = page("events.md")
    headings = " ".join(re.findall(r"(?m)^## (.+)$", text)).replace(",", " ").split()
    facts = text[text.index("## What was recorded") :]
    told = {*headings, *re.findall(r"`(\w+)`", facts)}
    assert set(kind_names()) <= told
    judged = [check for check in CHECKS if check.kinds and set(check.kinds) & set(headings)]
    assert [each.name for each in judged if f'"{each.name}"' not in text] == []


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


README = (CHECKOUT / "README.md").read_text("utf-8")


def test_it_installs_from_what_exists() -> None:
    lines = re.findall(r"(?:pip|uv tool) install ([^#`\n]*)|uvx --from (\S+)", README)
    sources = {(installed or run).split()[-1] for installed, run in lines}
    assert sources == {"."}
    assert "not on the package index yet" in README


def test_what_it_installs_by_default_has_the_page_and_reports() -> None:
    wanted = (CHECKOUT / "pyproject.toml").read_text("utf-8")
    default = wanted.partition("\ndependencies = [")[2].partition("\n]")[0]
    assert (
        "pip install .            # the bridge, the server, the command line, the live page"
        in README
    )
    assert {"resvg-py", "jinja2"} <= set(re.findall(r'"([\w-]+)', default))


def test_no_advice_names_a_package_index_on_which_anybody_may_register_the_name() -> None:
    """Neither docs nor messages: what is installed by a name is not ours until it is published."""
    by_name = re.compile(
        r"\bwebots-mcp\[|webots-mcp==|\buvx webots-mcp|"
        r"\b(pip|pipx|uv tool) install\b[^`#]*\bwebots-mcp\b"
    )
    files = [
        CHECKOUT / "README.md",
        *CHECKOUT.glob("docs/**/*.md"),
        *CHECKOUT.glob("examples/**/*.md"),
    ]
    files += CHECKOUT.glob("webots_mcp/**/*.py")
    found = [
        f"{file.relative_to(CHECKOUT)}: {line.strip()}"
        for file in files
        for line in file.read_text("utf-8").splitlines()
        if by_name.search(line)
    ]
    assert found == []


def test_it_is_short() -> None:
    assert len(README.split()) <= 900


FIRST_STEPS = (DOCS / "first-steps.md").read_text("utf-8")
CLIENTS = (DOCS / "clients.md").read_text("utf-8")


def _blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", [FIRST_STEPS, CLIENTS])
def test_the_commands_and_their_options_are_there(page: str) -> None:
    options = {
        name: set(re.findall(r"-[\w-]+", " ".join(command.arguments)))
        for name, command in described().items()
    }
    lines = re.findall(r"webots-mcp ([a-z]+\b[^`\n|)]*)", page)
    assert len(lines) >= 4
    for line in lines:
        name, *words = line.split()
        used = {re.sub(r"[^\w-].*", "", word) for word in words if word.startswith("--")}
        assert used <= options[name], line


def test_each_client_that_init_tells_has_its_part_with_its_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("APPDATA", "%APPDATA%")
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    parts = dict(re.findall(r"^## (.+)\n((?:(?!^## ).*\n)*)", CLIENTS, re.MULTILINE))
    for client in clients_of(Path("/project")):
        assert client.file.relative_to("/project").as_posix() in parts[client.name]
    for platform in ("linux", "darwin", "win32"):
        file = claude_desktop(platform).file.as_posix().replace(Path.home().as_posix(), "~")
        file = file.replace("/", "\\") if platform == "win32" else file
        assert f"`{file}`" in parts["Claude Desktop"]


def test_what_clients_are_told_is_an_entry_of_ours() -> None:
    blocks = [json.loads(text) for text in _blocks(CLIENTS, "json")]
    members = {"mcpServers", *(client.servers for client in clients_of(Path("/project")))}
    assert {member for block in blocks for member in block} == members
    entries: list[Any] = [entry for block in blocks for each in block.values()
                          for entry in each.values()]  # fmt: skip
    assert all(is_ours(entry) for entry in entries)


def test_the_prompts_that_are_named_are_there() -> None:
    with closing(MemoryDatabase()) as memory:
        server = create_server(memory, memory.data_dir)
        prompts = {prompt.name for prompt in anyio.run(server.list_prompts)}
    assert set(re.findall(r"`([a-z]+_[a-z_]+)`", CLIENTS)) - {"mcp_data"} == prompts
