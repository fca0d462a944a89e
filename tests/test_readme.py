"""The README names what is there: all of it, and nothing else."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import anyio

import webots_mcp
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.cli import COMMANDS
from webots_mcp.contract import BUILT_IN_ACTIONS
from webots_mcp.server import create_server

CHECKOUT = Path(__file__).parent.parent
INSTALLED = Path(webots_mcp.__file__).parent.parent
README = (CHECKOUT / "README.md").read_text("utf-8")


def test_it_names_every_tool_and_no_other() -> None:
    memory = MemoryDatabase()
    try:
        server = create_server(memory, memory.data_dir)
        tools = {tool.name for tool in anyio.run(server.list_tools)}
    finally:
        memory.close()
    fixtures = {"webots_mcp", "webots_simulation"}
    assert set(re.findall(r"\bwebots_[a-z_]+\b", README)) - fixtures == tools


def test_it_names_every_command() -> None:
    for command in COMMANDS:
        assert re.search(rf"`(webots-mcp )?{command.name}\b", README), command.name


def test_it_names_every_method_of_the_bridge() -> None:
    for name, _ in inspect.getmembers(MCPBridge, inspect.isfunction):
        if not name.startswith("_"):
            assert f"bridge.{name}(" in README, name


def test_it_names_every_action_that_is_built_in_and_no_other() -> None:
    (listed,) = re.findall(r"actions that are built in [^:]*:([^.]*)\.", README)
    assert re.findall(r"`(\w+)`", listed) == list(BUILT_IN_ACTIONS)


def test_the_files_it_links_to_exist() -> None:
    for target in re.findall(r"\]\(((?!http)[^)#]+)\)", README):
        assert any((folder / target).exists() for folder in (CHECKOUT, INSTALLED)), target


def test_it_installs_from_what_exists() -> None:
    lines = re.findall(r"(?:pip|uv tool) install ([^#`\n]*)|uvx --from (\S+)", README)
    sources = [(installed or run).split()[-1] for installed, run in lines]
    assert sources.count(".") >= 4
    others = set(sources) - {".", "'.[search]'", "/path/to/checkout"}
    assert others <= {"pyarrow"}, "not from a checkout, and no dependency"
    published = re.findall(r"[^.]*\bpackage index\b[^.]*\.[^.]*\.", README)
    assert len(published) == 1
    assert "not on the package index yet" in published[0]
    assert "Once it is published" in published[0]
