"""The files of MCP clients: our entry comes in, is mended, and everything else stays."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.requirements import checkout
from webots_mcp.setup import FileChange, apply
from webots_mcp.setup.client_entries import (
    Client,
    claude_desktop,
    clients_of,
    plan_entry,
    server_command,
    server_hindrance,
)

LINE = [sys.executable, "-m", "webots_mcp", "serve", "--data-dir", "/p/mcp_data"]


@pytest.fixture
def client(tmp_path: Path) -> Client:
    return clients_of(tmp_path)[0]


def plan(client: Client, held: dict[str, Any] | str) -> tuple[FileChange, str | None]:
    client.file.write_text(held if isinstance(held, str) else json.dumps(held))
    return plan_entry(client, "webots", LINE)


def entry_after(client: Client, entry: dict[str, Any]) -> dict[str, Any]:
    change = plan(client, {"mcpServers": {"webots": entry}})[0]
    return json.loads(change.after)["mcpServers"]["webots"]


def test_each_client_gets_a_full_path_in_its_own_form(tmp_path: Path) -> None:
    line = server_command(tmp_path / "mcp_data")
    for client, servers in zip(
        clients_of(tmp_path), ("mcpServers", "mcpServers", "servers"), strict=True
    ):
        apply(plan_entry(client, "webots", line)[0])
        entry = json.loads(client.file.read_text())[servers]["webots"]
        assert Path(entry["command"]).is_absolute()
        assert Path(entry["command"]).is_file()
        assert entry["args"][-3:] == ["serve", "--data-dir", str(tmp_path / "mcp_data")]
        assert not plan_entry(client, "webots", line)[0].is_needed


@pytest.mark.parametrize("held", ["", " \n", "\ufeff{}"])
def test_an_empty_file_is_taken_for_an_empty_object(client: Client, held: str) -> None:
    after = plan(client, held)[0].after.decode()
    assert json.loads(after.removeprefix("\ufeff"))["mcpServers"]["webots"]["command"] == LINE[0]
    assert after.startswith("\ufeff") == held.startswith("\ufeff")


@pytest.mark.parametrize("command", ["webots-mcp", "/gone/webots-mcp", r"C:\gone\webots-mcp.exe"])
def test_an_entry_that_cannot_be_started_is_mended_and_keeps_its_options(
    client: Client, command: str
) -> None:
    entry = {"command": command, "args": ["serve", "--read-only"], "env": {"A": "b"}}
    assert entry_after(client, entry) == {
        "command": LINE[0], "args": [*LINE[1:], "--read-only"], "env": {"A": "b"},
    }  # fmt: skip


def test_its_own_data_folder_is_among_them(client: Client) -> None:
    entry = {"command": "webots-mcp", "args": ["serve", "--data-dir", "/mine"]}
    assert entry_after(client, entry)["args"] == [*LINE[1:4], "--data-dir", "/mine"]


def test_an_entry_that_can_be_started_is_kept_and_said(client: Client) -> None:
    args = ["-m", "webots_mcp", "serve", "--read-only"]
    held = {"mcpServers": {"webots": {"command": sys.executable, "args": args}}}
    entry = plan(client, held)
    assert not entry[0].is_needed
    assert "kept" in (entry[1] or "")
    assert "--read-only" in (entry[1] or "")


def test_a_server_of_another_kind_is_not_replaced(client: Client) -> None:
    held = {"mcpServers": {"webots": {"command": "npx", "args": ["webots"]}}}
    with pytest.raises(InvalidInputError, match="--name"):
        plan(client, held)
    assert json.loads(client.file.read_text()) == held


@pytest.mark.parametrize("held", ['{"mcpServers": {', '{"mcpServers": []}', "[]"])
def test_a_file_that_is_not_understood_is_refused_by_name(client: Client, held: str) -> None:
    with pytest.raises(InvalidInputError, match=r"\.mcp\.json is left as it is"):
        plan(client, held)


def test_a_file_in_another_encoding_is_refused(client: Client) -> None:
    client.file.write_bytes('{"a": "ü"}'.encode("latin-1"))
    with pytest.raises(InvalidInputError, match="left as it is"):
        plan_entry(client, "webots", LINE)


def test_a_symbolic_link_is_followed_and_stays(client: Client, tmp_path: Path) -> None:
    real = tmp_path / "elsewhere" / "servers.json"
    real.parent.mkdir()
    real.write_text('{"a": 1}')
    real.chmod(0o640)
    client.file.symlink_to(real)
    apply(plan_entry(client, "webots", LINE)[0])
    assert client.file.is_symlink()
    assert json.loads(real.read_text())["mcpServers"]
    assert real.stat().st_mode & 0o777 == 0o640
    assert [file.name for file in real.parent.iterdir()] == ["servers.json"]


def test_a_folder_that_links_to_nothing_makes_none_elsewhere(tmp_path: Path) -> None:
    cursor = clients_of(tmp_path)[1]
    cursor.file.parent.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="link to nothing"):
        plan_entry(cursor, "webots", LINE)


def test_the_same_server_by_another_name_is_not_told_twice(client: Client) -> None:
    entry = plan(client, {"mcpServers": {"mine": {"command": LINE[0], "args": LINE[1:]}}})
    assert not entry[0].is_needed
    assert "'mine'" in (entry[1] or "")


def test_a_file_that_changed_meanwhile_is_not_overwritten(client: Client) -> None:
    change = plan(client, {})[0]
    client.file.write_text('{"new": 1}')
    with pytest.raises(CommandRefusedError, match="changed meanwhile"):
        apply(change)
    assert client.file.read_text() == '{"new": 1}'


@pytest.mark.parametrize(
    ("platform", "folder"),
    [("darwin", "home/Library/Application Support/Claude"), ("linux", "home/.config/Claude"),
     ("win32", "roaming/Claude")],
)  # fmt: skip
def test_claude_desktop_has_its_file_where_that_system_keeps_it(
    platform: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "roaming"))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    assert claude_desktop(platform).file == tmp_path / folder / "claude_desktop_config.json"


def test_a_server_that_lacks_its_packages_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert server_hindrance() is None
    monkeypatch.setitem(sys.modules, "mcp", None)
    assert f"pip install '{checkout()}'" in (server_hindrance() or "")
    monkeypatch.undo()
    monkeypatch.setattr(sys, "prefix", "/home/me/.cache/uv/archive-v0/Ab1")
    assert f"uv tool install {checkout()}" in (server_hindrance() or "")
