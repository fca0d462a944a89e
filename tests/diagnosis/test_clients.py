"""The files in which clients look for servers."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.diagnosis.conftest import Look


def write(folder: Path, **entry: Any) -> None:
    servers = {"webots": entry, "other": {"command": "nothing-of-ours"}}
    (folder / ".mcp.json").write_text(json.dumps({"mcpServers": servers}), "utf-8")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a user who has no client outside of projects."""
    for name in ("HOME", "APPDATA", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "home"))


def test_without_a_file_it_is_said_how_to_make_one(look: Look) -> None:
    found = look("Clients")
    assert (found.verdict, "webots-mcp init" in (found.fix or "")) == ("warning", True)


@pytest.mark.parametrize("text", ['{"mcpServers": {', "[1]", "\xff"])
def test_a_damaged_file_is_wrong(look: Look, tmp_path: Path, text: str) -> None:
    (tmp_path / ".mcp.json").write_bytes(text.encode("latin-1"))
    found = look("Clients")
    assert found.verdict == "wrong"
    assert ".mcp.json (Claude Code) cannot be read" in found.seen


def test_a_file_with_comments_is_read_as_its_client_reads_it(look: Look, tmp_path: Path) -> None:
    (tmp_path / ".vscode").mkdir()
    entry = {"command": sys.executable, "args": ["-m", "webots_mcp", "serve"]}
    text = f'{{ // mine\n "servers": {{"webots": {json.dumps(entry)},}} }}'
    (tmp_path / ".vscode" / "mcp.json").write_text(text, "utf-8")
    found = look("Clients")
    assert (found.verdict, "VS Code" in found.seen) == ("ok", True)


def test_a_file_of_other_servers_only_is_warned_of(look: Look, tmp_path: Path) -> None:
    write(tmp_path, command="still-nothing-of-ours")
    assert look("Clients").verdict == "warning"


def test_a_program_that_is_not_there_is_wrong(look: Look, tmp_path: Path) -> None:
    write(tmp_path, command="/nowhere/webots-mcp", args=["serve"])
    found = look("Clients")
    assert found.verdict == "wrong"
    assert "no program '/nowhere/webots-mcp'" in found.seen


def test_a_server_of_another_recording_is_warned_of(look: Look, tmp_path: Path) -> None:
    arguments = ["-m", "webots_mcp", "serve", "--data-dir", "/another/mcp_data"]
    write(tmp_path, command=sys.executable, args=arguments)
    found = look("Clients")
    assert (found.verdict, "/another/mcp_data" in found.seen) == ("warning", True)


@pytest.mark.parametrize("option", ["--data-dir={}", "--database={}/webots.db"])
def test_a_server_of_this_recording_is_well(look: Look, tmp_path: Path, option: str) -> None:
    arguments = ["-m", "webots_mcp", "serve", option.format(tmp_path)]
    write(tmp_path, command=sys.executable, args=arguments)
    assert look("Clients").verdict == "ok"
