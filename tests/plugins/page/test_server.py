"""The server of the page, asked without a browser."""

from __future__ import annotations

import http.client
import json
import socket
import sqlite3
import struct
from collections.abc import Callable
from contextlib import ExitStack, closing
from http.client import HTTPMessage
from pathlib import Path

import pytest

from tests.plugins.page.conftest import Server
from tests.waiting import wait_for
from webots_mcp.cli import main
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.plugins.page.page_server import LIMITS


def answer(server: Server, path: str, **headers: str) -> tuple[int, str]:
    """What is answered to a request; a path that begins with / is not below the page's own."""
    status, text, _ = answer_and_headers(server, path, **headers)
    return status, text


def answer_and_headers(server: Server, path: str, **headers: str) -> tuple[int, str, HTTPMessage]:
    path = path if path.startswith("/") else server.path + path
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers=named)
    response = connection.getresponse()
    status = response.status
    text = response.read().decode()
    connection.close()
    return status, text, response.headers


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1:{}", "localhost:{}"])
def test_the_page_is_for_this_computer(told: Server, host: str) -> None:
    status, text = answer(told, "", Host=host.format(told.port))
    assert status == 200
    assert "webots-mcp" in text


@pytest.mark.slow
def test_each_ended_run_is_listed_with_the_outcome_of_its_check_in_words(told: Server) -> None:
    def outcomes() -> dict[int, str]:
        status, text = answer(told, "look?robot=rover")
        assert status == 200
        runs = json.loads(text)["runs"]
        assert all(run["title"].endswith(run["outcome"]) for run in runs)
        return {run["id"]: run["outcome"] for run in runs}

    shown = wait_for(outcomes, lambda found: "not checked" not in found.values())
    where = ["--data-dir", str(told.data_dir)]
    checked = {number: main(["check", str(number), *where]) for number in shown}
    assert set(checked.values()) == {0, 1}
    assert {number: ("passed", "failed")[code] for number, code in checked.items()} == shown


@pytest.mark.parametrize("path", ["", "page.js", "look", "draw", "runs"])
def test_a_request_for_another_host_is_refused(told: Server, path: str) -> None:
    status, text = answer(told, path, Host=f"robots.example:{told.port}")
    assert status == 403
    assert "127.0.0.1 and localhost only" in text


@pytest.mark.parametrize(
    "headers",
    [
        {"Content-Type": "application/json", "Origin": "http://robots.example"},
        {"Content-Type": "application/json"},
        {"Content-Type": "text/plain", "Origin": "own"},
    ],
)
def test_a_page_of_another_site_cannot_steer(steering: Server, headers: dict[str, str]) -> None:
    headers = {name: each.replace("own", f"http://127.0.0.1:{steering.port}")
               for name, each in headers.items()}  # fmt: skip
    status, text = post(steering, headers)
    assert (status, text) == (403, "Orders are taken from the page itself only.\n")


def test_a_page_that_only_shows_takes_no_order(told: Server) -> None:
    own = f"http://127.0.0.1:{told.port}"
    assert post(told, {"Content-Type": "application/json", "Origin": own})[0] == 403


@pytest.fixture(scope="module")
def steering(serve: Callable[..., Server], tmp_path_factory: pytest.TempPathFactory) -> Server:
    return serve(tmp_path_factory.mktemp("steering"))


def post(server: Server, headers: dict[str, str]) -> tuple[int, str]:
    """What an order is answered."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    with closing(connection):
        connection.request("POST", f"{server.path}steer?robot=x", b'{"order": "pause"}', headers)
        response = connection.getresponse()
        return response.status, response.read().decode()


@pytest.mark.parametrize("path", ["/", "/page.js", "/look", "/x/"])
def test_without_the_key_of_the_printed_address_nothing_is_shown(told: Server, path: str) -> None:
    status, text = answer(told, path)
    assert status == 403
    assert "open the address that 'webots-mcp view' prints" in text
    assert told.path.strip("/") not in text


@pytest.mark.slow
def test_the_address_stays_until_there_is_another_token(
    serve: Callable[..., Server], tmp_path: Path
) -> None:
    """It is made from the token, and does not show it."""
    first, second = serve(tmp_path), serve(tmp_path)
    assert first.path == second.path
    assert len(first.path.strip("/")) == 32
    shown = second.run("token")
    assert shown not in first.path
    assert answer(first, "")[0] == 200
    assert second.run("token", "--new") != shown
    assert answer(first, "")[0] == 403
    assert serve(tmp_path).path != first.path


def test_no_other_page_can_hold_it_or_is_told_its_address(told: Server) -> None:
    for path in ("", "page.js", "look", "/"):
        _, _, headers = answer_and_headers(told, path)
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.slow
def test_only_so_many_tabs_are_open_at_once(serve: Callable[..., Server], tmp_path: Path) -> None:
    server = serve(tmp_path, "--read-only")
    answers = [answer(server, f"look?tab={tab}") for tab in range(LIMITS.tabs + 1)]
    assert [status for status, _ in answers] == [200] * LIMITS.tabs + [503]
    assert f"{LIMITS.tabs} tabs of this page are open" in answers[-1][1]
    assert answer(server, "look?tab=0")[0] == 200


def test_a_port_that_is_taken_is_said(
    told: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--no-browser", "--data-dir", str(tmp_path)]
    assert main(["view", "--port", str(told.port), *options]) == 2
    assert f"port {told.port} of 127.0.0.1 cannot be listened on" in capsys.readouterr().err
    assert main(["view", "--port", "70000", *options]) == 2
    assert "Must be <= 65535" in capsys.readouterr().err


@pytest.mark.slow
def test_ctrl_c_ends_it_in_a_sentence(serve: Callable[..., Server], tmp_path: Path) -> None:
    assert serve(tmp_path).stop() == "webots-mcp: ended by SIGTERM\n"


@pytest.mark.slow
def test_what_strangers_send_leaves_nothing_on_the_terminal(
    serve: Callable[..., Server], tmp_path: Path
) -> None:
    """And a token that is none any more is told, not raised."""
    server = serve(tmp_path)
    for said in (b"GET http://[x/ HTTP/1.1\r\nHost: localhost\r\n\r\n", b"GET / HT"):
        with closing(socket.create_connection(("127.0.0.1", server.port), 20)) as stranger:
            stranger.sendall(said)
            stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    (tmp_path / ".webots-mcp" / "token").write_text("short", "ascii")
    status, text = answer(server, "")
    assert (status, "webots-mcp token" in text) == (503, True)
    assert server.stop() == "webots-mcp: ended by SIGTERM\n"


@pytest.mark.slow
def test_a_recording_that_is_refused_is_not_served(
    serve: Callable[..., Server], tmp_path: Path
) -> None:
    with closing(sqlite3.connect(tmp_path / DATABASE_NAME)) as other, other:
        other.execute("CREATE TABLE tune (name TEXT)")
    with pytest.raises(AssertionError, match="belongs to another application"):
        serve(tmp_path)


@pytest.mark.parametrize(
    ("length", "status"),
    [("x", 400), ("-5", 400), ("+5", 400), ("1_0", 400), ("", 400), ("5, 5", 400), ("9" * 30, 413)],
)
def test_a_length_that_is_no_number_or_too_large_is_bad_input(
    steering: Server, length: str, status: int
) -> None:
    own = f"Origin: http://127.0.0.1:{steering.port}\r\nContent-Type: application/json\r\n"
    said = f"POST {steering.path}steer HTTP/1.1\r\nHost: localhost\r\n{own}"
    assert raw(steering, f"{said}Content-Length: {length}\r\n\r\n{{}}") == status
    twice = "Content-Length: 2\r\nContent-Length: 3\r\n\r\n{}"
    assert raw(steering, said + twice) == 400
    assert raw(steering, f"{said}Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n") == 400
    assert answer(steering, "")[0] == 200


@pytest.mark.parametrize("body", ["", "[]", "{", "[" * 90_000])
def test_an_order_that_is_no_object_is_bad_input(steering: Server, body: str) -> None:
    own = f"Origin: http://127.0.0.1:{steering.port}\r\nContent-Type: application/json\r\n"
    said = f"POST {steering.path}steer HTTP/1.1\r\nHost: localhost\r\n{own}"
    assert raw(steering, f"{said}Content-Length: {len(body)}\r\n\r\n{body}") == 400


@pytest.mark.parametrize("host", ["127.0.0.1:{}@evil", "localhost:{}.evil", "localhost:", "[::1"])
def test_what_only_begins_like_this_computer_is_another_host(told: Server, host: str) -> None:
    assert answer(told, "", Host=host.format(told.port))[0] == 403


@pytest.mark.slow
def test_a_request_that_comes_byte_by_byte_is_not_waited_for(
    serve: Callable[..., Server], story: Path
) -> None:
    server = serve(story, "--read-only", request_s=0.5)
    with closing(socket.create_connection(("127.0.0.1", server.port), 0.1)) as slow:
        while True:  # until the server has closed it, though a byte came each 0.1 s
            try:
                slow.sendall(b"G")
                if not slow.recv(1):
                    break
            except TimeoutError:
                continue
            except OSError:
                break
    assert answer(server, "")[0] == 200


@pytest.mark.slow
def test_of_many_idle_connections_the_idlest_are_closed(told: Server) -> None:
    with ExitStack() as stack:
        address, more = ("127.0.0.1", told.port), 20
        connections = [
            stack.enter_context(closing(socket.create_connection(address, 60)))
            for _ in range(LIMITS.connections + more)
        ]
        assert answer(told, "")[0] == 200
        for closed in connections[:more]:
            assert closed.recv(1) == b""
        connections[-1].sendall(f"GET {told.path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        assert connections[-1].recv(12) == b"HTTP/1.1 200"


def raw(server: Server, said: str) -> int:
    """The status of the answer to what http.client would not send."""
    with closing(socket.create_connection(("127.0.0.1", server.port), 60)) as connection:
        connection.sendall(said.encode())
        return int(connection.makefile("rb").readline().split()[1])


@pytest.mark.parametrize("order", [{}, {"order": "quit"}, {"name": "speed"}, {"value": 1}])
def test_an_incomplete_order_is_answered_with_what_an_order_needs(
    steering: Server, order: dict[str, object]
) -> None:
    with closing(http.client.HTTPConnection("127.0.0.1", steering.port)) as connection:
        headers = {
            "Content-Type": "application/json",
            "Origin": f"http://127.0.0.1:{steering.port}",
        }
        body = json.dumps(order).encode()
        connection.request("POST", f"{steering.path}steer?robot=x", body, headers)
        assert "give order, one of pause" in connection.getresponse().read().decode()
