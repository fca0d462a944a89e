"""The pages of first steps and of clients name commands, options and files that there are."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import anyio
import pytest

from webots_mcp import MemoryDatabase
from webots_mcp.cli.commands import described
from webots_mcp.server import create_server
from webots_mcp.setup.client_entries import claude_desktop, clients_of, is_ours

DOCS = Path(__file__).parents[1] / "docs"
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
    lines = re.findall(r"webots-mcp ([a-z]+\b[^`\n|]*)", page)
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


def test_the_programs_are_python() -> None:
    for program in _blocks(FIRST_STEPS, "python"):
        ast.parse(program)


def test_the_prompts_that_are_named_are_there() -> None:
    memory = MemoryDatabase()
    try:
        server = create_server(memory, memory.data_dir)
        prompts = {prompt.name for prompt in anyio.run(server.list_prompts)}
    finally:
        memory.close()
    assert set(re.findall(r"`(\w+_\w+)`", CLIENTS)) - {"mcp_data"} == prompts
