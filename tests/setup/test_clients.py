"""The files of MCP clients: our entry comes in, is mended, and everything else stays."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.extras.requirements import checkout
from webots_mcp.setup.client_entries import (
    Client,
    claude_desktop,
    clients_of,
    object_in,
    plan_entry,
    server_command,
    server_hindrance,
)
from webots_mcp.setup.file_change import FileChange, apply

LINE = [sys.executable, "-m", "webots_mcp", "serve", "--data-dir", "/p/mcp_data"]


@pytest.fixture
def client(tmp_path: Path) -> Client:
    return clients_of(tmp_path)[0]


def plan(client: Client, held: dict[str, Any] | str) -> tuple[FileChange, str | None]:
    client.file.write_text(held if isinstance(held, str) else json.dumps(held))
    return plan_entry(client, "webots", LINE)


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


@pytest.mark.parametrize(
    ("command", "options", "kept"),
    [
        ("webots-mcp", ["--read-only"], LINE[1:]),
        ("/gone/webots-mcp", ["--read-only"], LINE[1:]),
        (r"C:\gone\webots-mcp.exe", ["--read-only"], LINE[1:]),
        ("webots-mcp", ["--data-dir", "/mine"], LINE[1:4]),
    ],
)
def test_an_entry_that_cannot_be_started_is_mended_and_keeps_its_options(
    client: Client, command: str, options: list[str], kept: list[str]
) -> None:
    entry = {"command": command, "args": ["serve", *options], "env": {"A": "b"}}
    change, _ = plan(client, {"mcpServers": {"webots": entry}})
    assert json.loads(change.after)["mcpServers"]["webots"] == {
        "command": LINE[0], "args": [*kept, *options], "env": {"A": "b"},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "arguments", "said"),
    [
        ("webots", ["-m", "webots_mcp", "serve", "--read-only"], "kept: .*--read-only"),
        ("mine", LINE[1:], "by the name 'mine'"),
    ],
)
def test_a_server_that_is_there_and_can_be_started_is_left_as_it_is_and_said(
    client: Client, name: str, arguments: list[str], said: str
) -> None:
    change, note = plan(client, {"mcpServers": {name: {"command": LINE[0], "args": arguments}}})
    assert not change.is_needed
    assert re.search(said, note or "")


@pytest.mark.parametrize(
    ("held", "why"),
    [
        (b'{"mcpServers": {"webots": {"command": "npx", "args": ["webots"]}}}', "--name"),
        (b'{"mcpServers": {', "left as it is"),
        (b'{"mcpServers": []}', "left as it is"),
        (b"[]", "left as it is"),
        ('{"a": "ü"}'.encode("latin-1"), "left as it is"),
    ],
)
def test_what_is_not_understood_or_not_ours_is_refused_by_name(
    client: Client, held: bytes, why: str
) -> None:
    client.file.write_bytes(held)
    with pytest.raises(InvalidInputError, match=rf"\.mcp\.json .*{why}"):
        plan_entry(client, "webots", LINE)
    assert client.file.read_bytes() == held


OTHERS = {"inputs": ["ü", 1.5], "mcpServers": {"other": {"url": "http://x//y"}}, "b": None}


@pytest.mark.parametrize("indent", ["  ", "\t", "    "])
def test_the_entry_comes_first_and_all_else_stays_in_its_order(client: Client, indent: str) -> None:
    held = json.dumps(OTHERS, indent=indent, ensure_ascii=False).replace("\n", "\r\n")
    after = plan(client, held)[0].after.decode()
    entry = {"command": LINE[0], "args": LINE[1:]}
    wanted = {**OTHERS, "mcpServers": {"webots": entry, "other": {"url": "http://x//y"}}}
    lines = json.dumps(wanted, indent=indent, ensure_ascii=False).split("\n")
    assert after == "\r\n".join([*lines, ""])


COMMENTED = """// mine
{
    /* about { servers */
    "servers": { "other": {"url": "http://x//y"}, }, // end
}
"""


def test_a_file_with_comments_can_be_read_and_is_not_changed(tmp_path: Path) -> None:
    assert object_in(COMMENTED) == {"servers": {"other": {"url": "http://x//y"}}}
    client = clients_of(tmp_path)[2]
    client.file.parent.mkdir()
    client.file.write_text(COMMENTED)
    with pytest.raises(
        InvalidInputError, match=r"is left as it is.*line 1.*by hand to hold .*serve"
    ):
        plan_entry(client, "webots", LINE)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{\n  "a": 1\n  "b": 2\n}', "line 3, column 3"),
        ("[1]", "no JSON object"),
        ('{"a": 1, "a": 2}', '"a" is there twice'),
        ("[" * 100_000, "too deep"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_place(text: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        object_in(text)


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


def test_a_server_over_http_is_told_with_a_variable_for_its_token(tmp_path: Path) -> None:
    url = "http://127.0.0.1:8000/mcp"
    written = ("${WEBOTS_MCP_TOKEN}", "${env:WEBOTS_MCP_TOKEN}", "${env:WEBOTS_MCP_TOKEN}")
    for client, variable in zip(clients_of(tmp_path), written, strict=True):
        apply(plan_entry(client, "webots", LINE)[0])
        apply(plan_entry(client, "webots", url)[0])  # in place of the one that is started
        headers = {"Authorization": f"Bearer {variable}"}
        entry = json.loads(client.file.read_text())[client.servers]["webots"]
        assert entry == {"type": "http", "url": url, "headers": headers}
        for again in (url, LINE):
            change, note = plan_entry(client, "webots", again)
            assert not change.is_needed
            assert note is None or url in note
    with pytest.raises(InvalidInputError, match="Claude Desktop reads no servers over HTTP"):
        plan_entry(claude_desktop("linux"), "webots", url)
