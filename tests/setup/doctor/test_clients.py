"""The files in which clients look for servers."""

from __future__ import annotations

import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from tests.setup.doctor.conftest import Look

SERVE = ["-m", "webots_mcp", "serve"]


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


@pytest.mark.parametrize(
    ("command", "arguments", "verdict", "seen"),
    [
        ("still-nothing-of-ours", [], "warning", "names webots-mcp"),
        ("/nowhere/webots-mcp", ["serve"], "wrong", "no program '/nowhere/webots-mcp'"),
        (sys.executable, [*SERVE, "--data-dir", "/another"], "warning", "serves /another"),
        (sys.executable, [*SERVE, "--data-dir={}"], "ok", "starts"),
        (sys.executable, [*SERVE, "--database={}/webots.db"], "ok", "starts"),
    ],
)
def test_a_server_is_well_where_it_is_there_and_serves_this_recording(
    look: Look, tmp_path: Path, command: str, arguments: list[str], verdict: str, seen: str
) -> None:
    entry = {"command": command, "args": [each.format(tmp_path) for each in arguments]}
    servers = {"webots": entry, "other": {"command": "nothing-of-ours"}}
    (tmp_path / ".mcp.json").write_text(json.dumps({"mcpServers": servers}), "utf-8")
    found = look("Clients")
    assert (found.verdict, seen in found.seen) == (verdict, True), found


@pytest.mark.parametrize(
    ("status", "verdict", "seen"),
    [
        (401, "ok", "a server asks for the token"),
        (404, "wrong", "asks for no token (404)"),
        (None, "wrong", "nothing answers"),
    ],
)
def test_a_server_over_http_is_well_where_it_asks_for_the_token_which_is_not_sent(
    look: Look, tmp_path: Path, status: int | None, verdict: str, seen: str
) -> None:
    given: list[str | None] = []

    class Answering(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            given.append(self.headers["Authorization"])
            self.send_error(status or 500)

    with HTTPServer(("127.0.0.1", 0), Answering) as server:
        url = f"http://127.0.0.1:{server.server_port}/mcp"
        headers = {"Authorization": "Bearer ${WEBOTS_MCP_TOKEN}"}
        entry = {"type": "http", "url": url, "headers": headers}
        (tmp_path / ".mcp.json").write_text(json.dumps({"mcpServers": {"w": entry}}), "utf-8")
        if status is None:
            server.server_close()
        else:
            threading.Thread(target=server.handle_request).start()
        found = look("Clients")
    assert (found.verdict, seen in found.seen) == (verdict, True), found
    assert not any(given)
