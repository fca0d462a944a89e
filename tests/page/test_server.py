"""The server of the page, asked without a browser."""

from __future__ import annotations

import http.client
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.page.conftest import Server
from webots_mcp.cli import main

UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


def answer(server: Server, path: str, **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers=named)
    response = connection.getresponse()
    status = response.status
    text = "" if status == 101 else response.read().decode()
    connection.close()
    return status, text


@pytest.mark.parametrize("host", ["127.0.0.1:{}", "localhost:{}"])
def test_the_page_is_for_this_computer(told: Server, host: str) -> None:
    status, text = answer(told, "/", Host=host.format(told.port))
    assert status == 200
    assert "webots-mcp" in text
    assert "cdn.bokeh.org" not in text


@pytest.mark.parametrize("path", ["/", "/static/js/bokeh.min.js", "/ws", "/metadata"])
def test_a_request_for_another_host_is_refused(told: Server, path: str) -> None:
    status, text = answer(told, path, Host=f"robots.example:{told.port}")
    assert status == 403
    assert "127.0.0.1 and localhost only" in text


def test_a_page_of_another_site_gets_no_websocket(told: Server) -> None:
    headers = {**UPGRADE, "Host": f"127.0.0.1:{told.port}", "Origin": "http://robots.example"}
    status, _ = answer(told, "/ws", **headers)
    assert status == 403


def test_a_port_that_is_taken_is_said(
    told: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--no-browser", "--data-dir", str(tmp_path)]
    assert main(["view", "--port", str(told.port), *options]) == 2
    assert f"port {told.port} of 127.0.0.1 cannot be listened on" in capsys.readouterr().err
    assert main(["view", "--port", "70000", *options]) == 2
    assert "the last port is 65535" in capsys.readouterr().err


def test_ctrl_c_ends_it_in_a_sentence(serve: Callable[..., Server], tmp_path: Path) -> None:
    assert serve(tmp_path).stop() == "webots-mcp: ended by SIGTERM\n"
