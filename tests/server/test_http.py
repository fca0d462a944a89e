"""The server over HTTP: a real process, real clients, and those that nobody has invited."""

from __future__ import annotations

import http.client
import json
import os
import re
import socket
import sqlite3
import ssl
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, closing
from pathlib import Path
from typing import Any, Literal

import anyio
import httpx2
import pytest
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

from tests.exploring import attempts
from tests.server.conftest import Driver, ask, fail
from tests.waiting import until, wait_for
from webots_mcp.cli import main
from webots_mcp.server.access_token import access_token, new_token, token_file
from webots_mcp.server.endpoint import Endpoint
from webots_mcp.server.http_server import guarded_app
from webots_mcp.server.mcp_server import create_server

pytestmark = pytest.mark.anyio
Mode = Literal["auto", "legacy"]
_JSON = {"Content-Type": "application/json", "Accept": "application/json, text/event-stream"}
_INITIALIZE = {
    "protocolVersion": "2025-11-25",
    "capabilities": {},
    "clientInfo": {"name": "raw", "version": "1"},
}
_SERVE = """
from webots_mcp.server import http_limits
from webots_mcp.cli import main
http_limits.HEADERS_S, http_limits.BODY_S = {}
raise SystemExit(main())
"""
_LOAD = attempts(40, exploring=900)  # calls of each of two clients; 40 have all kinds of them
_AT_ONCE = 10


class Http:
    """`webots-mcp serve --http` on a data folder."""

    def __init__(
        self, data_dir: Path, *options: str, at: str = "0", limits_s: tuple[float, float] = (10, 60)
    ) -> None:
        where = ["--http", at, "--data-dir", str(data_dir), *options]
        self.data_dir = data_dir
        self.process = subprocess.Popen(
            [sys.executable, "-c", _SERVE.format(limits_s), "serve", *where],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        said = self.process.stdout.readline()
        found = re.search(r"https?://\S+:(\d+)/mcp", said)
        assert found, self.process.communicate(timeout=30)
        self.url, self.port = found[0], int(found[1])
        self.token = token_file().read_text("ascii").strip()

    @asynccontextmanager
    async def client(self, mode: Mode = "auto", **options: Any) -> AsyncGenerator[Client]:
        headers = {"Authorization": f"Bearer {self.token}"}
        carrier = httpx2.AsyncClient(headers=headers, timeout=100)
        async with carrier:
            transport = streamable_http_client(self.url, http_client=carrier)
            async with Client(transport, mode=mode, **options) as client:
                yield client

    def post(
        self, method: str, params: Any = None, request_id: int | None = 1, /, **headers: str
    ) -> http.client.HTTPConnection:
        """Send a message; the connection that it is answered on."""
        message: dict[str, Any] = {"jsonrpc": "2.0", "method": method, "params": params or {}}
        message |= {} if request_id is None else {"id": request_id}
        named = {"Authorization": f"Bearer {self.token}"} | {
            name.replace("_", "-"): value for name, value in headers.items()
        }
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request("POST", "/mcp", json.dumps(message), _JSON | named)
        return connection

    def status(self, method: str = "initialize", params: Any = None, **headers: str) -> int:
        with closing(self.post(method, params or _INITIALIZE, **headers)) as connection:
            return connection.getresponse().status

    def session(self) -> str:
        """Open one, as a client of 2025 does."""
        with closing(self.post("initialize", _INITIALIZE)) as connection:
            session = connection.getresponse().headers["mcp-session-id"]
        notified = self.post("notifications/initialized", None, None, Mcp_Session_Id=session)
        notified.getresponse().read()
        notified.close()
        return session

    def stop(self) -> str:
        self.process.terminate()
        return self.process.communicate(timeout=30)[1]


@pytest.fixture(autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of a user who has no token yet."""
    folder = tmp_path_factory.mktemp("home")
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(folder))
    return folder


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Http]]:
    running: list[Http] = []

    def start(*options: str, at: str = "0", headers_s: float = 10, body_s: float = 60) -> Http:
        running.append(Http(tmp_path, *options, at=at, limits_s=(headers_s, body_s)))
        return running[-1]

    yield start
    for each in running:
        if each.process.poll() is None:
            each.stop()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Http]:
    """A server for several tests, with a token of its own: a start takes 2 s of processor time."""
    with pytest.MonkeyPatch.context() as here:
        for name in ("HOME", "USERPROFILE"):
            here.setenv(name, str(tmp_path_factory.mktemp("home")))
        server = Http(tmp_path_factory.mktemp("shared"))
    yield server
    assert "Traceback" not in server.stop()


@pytest.fixture
def shared_driver(shared: Http) -> Iterator[Driver]:
    driving = Driver(shared.data_dir / "webots.db")
    driving.start()
    yield driving
    driving.stop()


@pytest.mark.slow
async def test_nobody_gets_in_without_the_token_or_from_elsewhere(
    serve: Callable[..., Http],
) -> None:
    server = serve()
    wrong = server.token[::-1]
    for given in (
        "",
        "Bearer",
        f"Bearer {wrong}",
        f"Basic {server.token}",
        server.token,
        "Bearer ",
    ):
        assert server.status(Authorization=given) == 401, given
    assert server.status("tools/list", Authorization=f"Bearer {wrong}", Mcp_Session_Id="x") == 401
    assert server.status(Host=f"robots.example:{server.port}") == 421
    for host in ("127.0.0.1:{}@evil", "127.0.0.1:{}.evil", "localhost:", "localhost:{}/x", "[::1"):
        assert server.status(Host=host.format(server.port)) == 421, host
    for origin in ("http://127.0.0.1:{}@evil", "http://localhost:x", "https://localhost:{}"):
        assert server.status(Origin=origin.format(server.port)) == 403, origin
    assert server.status(Host=f"localhost:{server.port}", Origin="http://localhost:1") == 200
    assert server.status(Host=f"LOCALHOST:{server.port}", Origin="http://LocalHost:1") == 200
    assert server.status(Origin="http://robots.example") == 403
    assert server.status(Origin="null") == 403
    modern = {"Mcp_Protocol_Version": "2026-07-28", "Mcp_Method": "tools/list"}
    assert server.status("tools/list", Host="robots.example", **modern) == 421
    assert server.status(Origin=f"http://localhost:{server.port}") == 200
    assert server.status() == 200

    new_token()
    assert server.status() == 401
    server.token = token_file().read_text("ascii").strip()
    assert server.status() == 200
    token_file().chmod(0o644)
    assert server.status() == (200 if os.name == "nt" else 503)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_what_a_client_asks_that_goes_away_is_stopped(
    shared: Http, shared_driver: Driver, mode: Mode
) -> None:
    """It is cut off in the middle of a run, of which the controller is told; some count from 0."""
    server = shared

    def commands() -> list[tuple[str, str]]:
        with closing(sqlite3.connect(server.data_dir / "webots.db")) as connection:
            query = "SELECT action, status FROM command ORDER BY id"
            return connection.execute(query).fetchall()

    before = len(commands())

    def runs() -> list[tuple[str, str]]:
        return commands()[before:]

    call = {"name": "webots_run", "arguments": {"for_s": 10_000, "timeout_wall_s": 90}}
    if mode == "legacy":
        asked = server.post("tools/call", call, 0, Mcp_Session_Id=server.session())
    else:
        prefix = "io.modelcontextprotocol/"
        meta = {f"{prefix}protocolVersion": "2026-07-28", f"{prefix}clientCapabilities": {}}
        modern = {"Mcp_Protocol_Version": "2026-07-28", "Mcp_Method": "tools/call"}
        params = call | {"_meta": meta}
        asked = server.post("tools/call", params, Mcp_Name="webots_run", **modern)

    wait_for(runs, lambda found: found == [("run", "claimed")])
    asked.close()
    ended = wait_for(runs, lambda found: all(status == "done" for _, status in found[:1]))
    assert [action for action, _ in ended] == ["run", "cancel_run"]


@pytest.mark.slow
async def test_over_http_there_are_the_same_tools_with_the_same_options(
    serve: Callable[..., Http], tmp_path: Path
) -> None:
    options = ["--read-only", "--tools", "core", "--output-schemas"]
    file = tmp_path / "webots.db"
    plain = create_server(file, tmp_path, read_only=True, tools="core", output_schemas=True)
    async with Client(plain) as one, serve(*options).client() as other:
        assert await one.list_tools() == await other.list_tools()
        assert await one.list_prompts() == await other.list_prompts()
        assert one.instructions == other.instructions


async def test_however_many_clients_there_are_one_maintains_the_recording(file: Path) -> None:
    server = create_server(file, file.parent)
    carrier = httpx2.AsyncClient(transport=httpx2.ASGITransport(server.streamable_http_app()))
    ours, before = Counter[str](), {*threading.enumerate()}  # of bridges of other tests
    async with carrier, server.session_manager.run(), AsyncExitStack() as stack:
        for _ in range(5):
            transport = streamable_http_client("http://localhost:8000/mcp", http_client=carrier)
            client = await stack.enter_async_context(Client(transport, mode="legacy"))
            await client.call_tool("webots_list_robots", {})
        begun = {*threading.enumerate()} - before
        ours = Counter(each.name for each in begun if "webots-mcp" in each.name)
    assert ours == {"webots-mcp maintainer": 1, "webots-mcp consoles": 1}


@pytest.mark.slow
async def test_it_ends_at_once_while_clients_wait(
    serve: Callable[..., Http], driver: Driver
) -> None:
    server = serve()
    call = {"name": "webots_run", "arguments": {"for_s": 10_000, "timeout_wall_s": 90}}
    asked = server.post("tools/call", call, 7, Mcp_Session_Id=server.session())
    said = server.stop()
    assert server.process.returncode == 143
    assert said.splitlines()[-1] == "webots-mcp: ended by SIGTERM"
    asked.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--http 0.0.0.0:0", "ssh -N -L 0:127.0.0.1:0"),
        ("--http robots.lab:8000 --allow-host robots.lab", "--tls-cert FILE"),
        ("--http 8000 --tls-cert x.pem", "belong together"),
        ("--http 0 --tls-cert x.pem --tls-key y.pem", "cannot be used"),
        ("--http http://x", "is not [HOST:]PORT"),
        ("--http 70000", "is not [HOST:]PORT"),
        ("--allow-host robots.lab", "apply only to --http"),
    ],
)
async def test_what_would_be_open_to_others_is_refused(
    options: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", *options.split(), "--data-dir", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


async def test_the_token_is_its_owners_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["token"]) == 0
    first = capsys.readouterr().out
    assert main(["token", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["token"], told["file"]) == (first.strip(), str(token_file()))
    assert os.name == "nt" or token_file().stat().st_mode & 0o777 == 0o600
    assert main(["token", "--new"]) == 0
    assert capsys.readouterr().out != first
    for text in ("short", f"{first.strip()}\nand another", ""):
        token_file().write_text(text, "ascii")
        assert main(["token"]) == 2
        assert "holds no token" in capsys.readouterr().err
    assert main(["token", "--new"]) == 0
    if hasattr(os, "geteuid") and os.geteuid() == 0:  # who else reads what belongs to others
        os.chown(token_file(), 12_345, -1)
        assert main(["token"]) == 2
        assert "other users may read" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="others have one address of loopback")
async def test_each_address_of_this_computer_that_it_serves_is_answered(
    serve: Callable[..., Http],
) -> None:
    server = serve(at="127.0.0.2:0")
    asked = httpx2.AsyncClient(headers=_JSON | {"Authorization": f"Bearer {server.token}"})
    async with asked:
        body = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": _INITIALIZE}
        assert (await asked.post(server.url, json=body)).status_code == 200


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="openssl is not everywhere")
async def test_from_the_network_it_is_reached_by_tls_and_by_an_allowed_name(
    serve: Callable[..., Http], tmp_path: Path
) -> None:
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    made = ["-nodes", "-days", "2", "-subj", "/CN=x", "-addext", "subjectAltName=IP:127.0.0.1"]
    files = ["-keyout", str(key), "-out", str(certificate)]
    line = ["openssl", "req", "-x509", "-newkey", "rsa:2048", *made, *files]
    subprocess.run(line, check=True, capture_output=True)
    options = ["--tls-cert", str(certificate), "--tls-key", str(key)]
    server = serve(*options, "--allow-host", "Robots.Lab", at="0.0.0.0:0")
    headers = {"Authorization": f"Bearer {server.token}", **_JSON}
    body = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": _INITIALIZE}
    context = ssl.create_default_context(cafile=str(certificate))
    found: list[int] = []
    client = httpx2.AsyncClient(verify=context)
    async with client:
        for host in ("robots.lab", f"robots.lab:{server.port}", "127.0.0.1", "elsewhere.lab"):
            address = f"https://127.0.0.1:{server.port}/mcp"
            answer = await client.post(address, headers=headers | {"Host": host}, json=body)
            found.append(answer.status_code)
    assert found == [200, 200, 200, 421]


@pytest.mark.slow
async def test_two_clients_under_load_lose_nothing_and_nobody_else_gets_in(
    shared: Http, shared_driver: Driver
) -> None:
    """Of all calls some are cancelled and some cut off, while strangers knock.

    What was answered belongs to its question; a command ran as often as it is recorded as done;
    none is left open; none is a stranger's.
    """
    server, driver = shared, shared_driver
    ran, answered, came = Counter[int](), set[int](), Counter[str]()
    plain = driver.set_speed

    def counting(command: dict[str, Any]) -> dict[str, float]:
        ran[int(command["speed"])] += 1
        return plain(command)

    driver.bridge.register_command("count", counting)

    def sent(number: int) -> dict[str, Any]:
        return {"action": "count", "params": {"speed": number}, "timeout_wall_s": 60}

    async def call(client: Client, session: str, number: int) -> None:
        kind = number % 10
        if kind == 0:  # cut off, at whatever stage it is
            params = {"name": "webots_send_command", "arguments": sent(number)}
            asked = server.post("tools/call", params, number, Mcp_Session_Id=session)
            asked.close()
            came["cut off"] += 1
        elif kind == 1:
            with anyio.move_on_after(number % 7 * 0.004):
                await ask(client, "webots_send_command", **sent(number))
                answered.add(number)
            came["cancelled"] += number not in answered
        elif kind in (2, 3, 4, 5):
            told = await ask(client, "webots_send_command", **sent(number))
            assert told["result"] == {"speed": number}
            answered.add(number)
        elif kind == 6:
            stranger = {"name": "webots_send_command", "arguments": sent(-number)}
            headers = (
                {"Authorization": "Bearer " + "x" * 43},
                {"Host": "robots.example"},
                {"Origin": "http://robots.example"},
                {"Authorization": ""},
            )[number // 10 % 4]
            status = server.status("tools/call", stranger, Mcp_Session_Id=session, **headers)
            assert status in (401, 403, 421)
            came["refused"] += 1
        else:
            told = await fail(client, "webots_get_robot_state", robot=f"robot {number}")
            assert f"'robot {number}'" in told
            answered.add(number)

    async def load(mode: Mode, first: int) -> None:
        session = server.session()
        async with server.client(mode) as client:
            for start in range(first, first + _LOAD, _AT_ONCE):
                async with anyio.create_task_group() as tasks:
                    for number in range(start, start + _AT_ONCE):
                        tasks.start_soon(call, client, session, number)

    driver.bridge.get_command()
    async with anyio.create_task_group() as both:
        both.start_soon(load, "auto", 1_000)
        both.start_soon(load, "legacy", 2_000)

    def commands() -> dict[int, str]:
        with closing(sqlite3.connect(driver.bridge.database)) as connection:  # type: ignore[arg-type]
            rows = connection.execute("SELECT params, status FROM command WHERE action = 'count'")
            return {json.loads(params)["speed"]: status for params, status in rows}

    ends = {"done", "cancelled", "expired"}
    recorded = await until(commands, lambda found: set(found.values()) <= ends)
    assert len(answered) + sum(came.values()) == 2 * _LOAD
    assert came["cut off"] == came["refused"] == 2 * _LOAD / 10
    done = {number for number, status in recorded.items() if status == "done"}
    assert ran == Counter(done)
    assert {number for number in answered if number % 10 <= 5} <= done
    assert min(recorded) >= 1_000


async def test_a_client_that_goes_away_while_it_speaks_is_no_defect(shared: Http) -> None:
    server = shared
    session, deep = server.session(), "[" * 100_000
    for headers in ({"Mcp_Session_Id": session}, {"Mcp_Protocol_Version": "2026-07-28"}):
        for said in ("{", deep):
            named = {name.replace("_", "-"): value for name, value in headers.items()}
            named |= _JSON | {"Authorization": f"Bearer {server.token}", "Content-Length": "999999"}
            with closing(http.client.HTTPConnection("127.0.0.1", server.port)) as connection:
                connection.request("POST", "/mcp", said, named)
    assert server.status() == 200  # and at the end it has printed no traceback


async def test_at_the_limit_of_sessions_the_one_that_is_idle_for_longest_ends(
    tmp_path: Path, home: Path
) -> None:
    server = create_server(tmp_path / "webots.db", tmp_path)
    app = guarded_app(server, Endpoint("127.0.0.1", 80), most_sessions=3)
    headers = {"Authorization": f"Bearer {access_token()}", **_JSON}
    body = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": _INITIALIZE}
    ping = {"jsonrpc": "2.0", "id": 2, "method": "ping"}
    client = httpx2.AsyncClient(
        transport=httpx2.ASGITransport(app), base_url="http://127.0.0.1", headers=headers
    )
    async with server.session_manager.run(), client:

        async def opened() -> str:
            answer = await client.post("/mcp", json=body)
            assert answer.status_code == 200
            return answer.headers["mcp-session-id"]

        async def status(session: str) -> int:
            answer = await client.post("/mcp", json=ping, headers={"mcp-session-id": session})
            return answer.status_code

        first, second, third = [await opened() for _ in range(3)]
        assert await status(first) == 200
        fourth = await opened()
        states = {each: await status(each) for each in (first, second, third, fourth)}
        assert states == {first: 200, second: 404, third: 200, fourth: 200}
        for _ in range(30):  # clients that nobody ends
            newest = await opened()
            assert await status(newest) == 200


@pytest.mark.slow
async def test_a_request_that_does_not_arrive_in_time_ends(serve: Callable[..., Http]) -> None:
    server = serve(headers_s=0.5, body_s=0.5)
    request = (
        f"POST /mcp HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {server.token}\r\n"
        "Content-Length: 100\r\n\r\n{"
    )
    for said, answered in (
        ("", b""),
        ("POST /mcp HTTP/1.1\r\nHost: local", b"HTTP/1.1 408 "),  # within its headers
        (request, b"HTTP/1.1 408 "),  # within its body
    ):
        with closing(socket.create_connection(("127.0.0.1", server.port), 60)) as stranger:
            stranger.sendall(said.encode())
            answer = stranger.recv(100)  # until the server ends it
        assert answer[:13] == answered
    assert server.status() == 200
    assert "Traceback" not in server.stop()
