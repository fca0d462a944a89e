"""The view that a client with MCP Apps gets: who gets it, and what it draws in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client
from mcp.client.extension import advertise
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID
from mcp.types import CallToolResult, TextResourceContents

from tests.browsing import chromium
from tests.recordings.rows import Recorded
from tests.server.conftest import pictures_of, text_of
from tests.tool_list import counts_of
from webots_mcp.server.mcp_app_view import SHOWN_TOOLS, VIEW_URI, view_html
from webots_mcp.server.mcp_server import create_server

__all__ = ["chromium"]
APPS = advertise(EXTENSION_ID, {"mimeTypes": [APP_MIME_TYPE]})
OTHER_TYPES = advertise(EXTENSION_ID, {"mimeTypes": ["text/plain"]})
HOSTILE = "<img src=x onerror='window.hacked=1'>"


def client_of(file: Path, *extensions: Any, mode: Any = "auto", **options: Any) -> Client:
    return Client(create_server(file, file.parent, **options), mode=mode, extensions=extensions)


def record(recorded: Recorded, robot: str = "rover") -> None:
    rover = recorded.robot(robot)
    for step in range(200):
        rover.state(step * 0.1, {"pose": [step * 0.01, 0.0], "speed": step % 7, HOSTILE: step})
    rover.end_run("finished")


@pytest.mark.anyio
@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_a_client_that_shows_views_finds_one_in_its_lists(
    file: Path, recorded: Recorded, mode: str
) -> None:
    record(recorded)
    async with client_of(file, APPS, mode=mode, tools="all") as client:
        tools = (await client.list_tools()).tools
        named = {tool.name: tool.meta for tool in tools if tool.meta}
        assert named == {name: {"ui": {"resourceUri": VIEW_URI}} for name in SHOWN_TOOLS}
        listed = (await client.list_resources()).resources
        assert VIEW_URI in [each.uri for each in listed]
        (page,) = (await client.read_resource(VIEW_URI)).contents
        drawn = await client.call_tool("webots_plot", {})
    assert isinstance(page, TextResourceContents)
    assert page.mime_type == APP_MIME_TYPE
    assert page.meta == {"ui": {"csp": {}, "prefersBorder": True}}
    assert len(pictures_of(drawn)) == 1 and json.loads(text_of(drawn))["shows"]


@pytest.mark.anyio
@pytest.mark.parametrize("extensions", [(), (OTHER_TYPES,)])
@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_to_all_other_clients_tools_resources_and_answers_are_as_without_it(
    file: Path, recorded: Recorded, mode: str, extensions: Any
) -> None:
    record(recorded)
    async with client_of(file, *extensions, mode=mode, tools="all") as client:
        assert [tool.meta for tool in (await client.list_tools()).tools if tool.meta] == []
        listed = (await client.list_resources()).resources
        assert [each.uri for each in listed] == ["webots://schema"]
        drawn = await client.call_tool("webots_plot", {})
    assert len(pictures_of(drawn)) == 1 and json.loads(text_of(drawn))["shows"]


@pytest.mark.anyio
async def test_with_the_view_the_list_of_tools_is_as_short_as_it_has_to_be(file: Path) -> None:
    async with client_of(file, APPS) as client:
        counted = counts_of((await client.list_tools()).tools)
    assert counted.tools <= 34
    assert counted.tokens <= 9_000


def test_the_page_allows_its_own_script_alone_and_names_no_other_place() -> None:
    page = view_html()
    (policy,) = re.findall(r'Content-Security-Policy" content="(.+?)"', page)
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy and "*" not in policy
    assert re.findall(r"https?://|\bsrc=|\bhref=|\{\{|innerHTML|\beval\b", page) == []


# -- in a browser ----------------------------------------------------------------------------------

HOST_PAGE = """<!doctype html><meta charset="utf-8"><body style="margin:0"><script>
const host = { got: [], capabilities: {}, context: {}, calls: [] };
function open_view(html, width) {
  const frame = document.createElement("iframe");
  frame.setAttribute("sandbox", "allow-scripts");
  Object.assign(frame.style, { width: `${width}px`, height: "700px", border: 0 });
  frame.srcdoc = html;
  host.frame = document.body.appendChild(frame);
}
function send(message) {
  host.frame.contentWindow.postMessage({ jsonrpc: "2.0", ...message }, "*");
}
addEventListener("message", async ({ data, source }) => {
  if (source !== host.frame.contentWindow) return;
  host.got.push(data);
  if (data.method === "ui/initialize") {
    send({ id: data.id, result: {
      protocolVersion: "2026-01-26", hostInfo: { name: "test", version: "1" },
      hostCapabilities: host.capabilities, hostContext: host.context } });
  } else if (["tools/call", "resources/read"].includes(data.method)) {
    try {
      const answer = await serve(data.method, JSON.stringify(data.params));
      send({ id: data.id, result: JSON.parse(answer) });
    } catch (error) {
      send({ id: data.id, error: { code: -32000, message: String(error.message) } });
    }
  }
});
</script>"""


class Host:
    """A page that holds the view as an MCP host does, and passes its requests to a server."""

    def __init__(
        self, page: Any, make_server: Callable[[], Any], capabilities: dict[str, Any], width: int
    ) -> None:
        self.page, self._make_server = page, make_server
        self.wrong: list[str] = []
        self.asked: list[str] = []
        page.set_default_timeout(90_000)
        page.on("pageerror", self._note_error)
        page.on("console", self._note_line)
        page.on("request", self._note_request)
        page.expose_function("serve", self._serve)
        page.set_content(HOST_PAGE)
        page.evaluate("value => host.capabilities = value", capabilities)
        page.evaluate("([html, width]) => open_view(html, width)", [view_html(), width])
        self.wait_for("ui/notifications/initialized")
        self.view = page.frames[1]

    def _note_error(self, error: Any) -> None:
        self.wrong.append(str(error))

    def _note_line(self, line: Any) -> None:
        if line.type == "error":
            self.wrong.append(line.text)

    def _note_request(self, request: Any) -> None:
        self.asked.append(request.url)

    def wait_for(self, method: str) -> dict[str, Any]:
        """Wait for a message of the view; returns its parameters."""
        find = "method => host.got.find(each => each.method === method)"
        return self.page.wait_for_function(find, arg=method).json_value()["params"]

    def send(self, method: str, params: Any) -> None:
        self.page.evaluate("message => send(message)", {"method": method, "params": params})

    def show(self, tool: str, arguments: dict[str, Any]) -> CallToolResult:
        """Call a tool, and send the view what was asked and answered."""
        self.send("ui/notifications/tool-input", {"arguments": arguments})
        result = self.call(tool, arguments)
        self.send("ui/notifications/tool-result", dumped(result))
        return result

    def call(self, tool: str, arguments: dict[str, Any]) -> CallToolResult:
        async def asked() -> CallToolResult:
            async with Client(self._make_server(), extensions=[APPS]) as client:
                return await client.call_tool(tool, arguments)

        return in_a_thread(asked)

    def _serve(self, method: str, params: str) -> str:
        wanted = json.loads(params)
        if method == "tools/call":
            return json.dumps(dumped(self.call(wanted["name"], wanted["arguments"])))

        async def read() -> Any:
            async with Client(self._make_server(), extensions=[APPS]) as client:
                return await client.read_resource(wanted["uri"])

        return json.dumps(dumped(in_a_thread(read)))

    def text(self, selector: str) -> str:
        return self.view.locator(selector).inner_text()


def dumped(result: Any) -> Any:
    return result.model_dump(mode="json", by_alias=True, exclude_none=True)


def in_a_thread(asked: Any) -> Any:
    """The driver of the browser has the event loop of this thread."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(anyio.run, asked).result()


@pytest.fixture(scope="module")
def make_server(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Any]:
    """Servers of a run whose names are markup."""
    file = tmp_path_factory.mktemp("view") / "webots.db"
    recording = Recorded(file)
    record(recording, f"rover {HOSTILE}")
    recording.close()
    return lambda: create_server(file, file.parent)


@pytest.fixture
def open_host(chromium: Any, make_server: Callable[[], Any]) -> Iterator[Any]:
    contexts: list[Any] = []

    def start(capabilities: dict[str, Any], width: int = 700, **options: Any) -> Host:
        contexts.append(chromium.new_context(**options))
        return Host(contexts[-1].new_page(), make_server, capabilities, width)

    yield start
    for context in contexts:
        context.close()


IS_TALL = """() => host.got.some(
    each => each.method === "ui/notifications/size-changed" && each.params.height > 300)"""
TOOLS = {"serverTools": {}}
BOTH = {"serverTools": {}, "serverResources": {}}


@pytest.mark.slow
def test_a_host_sees_the_picture_with_its_caption_and_facts_and_zooms(open_host: Any) -> None:
    host = open_host({})
    begun = host.page.evaluate("host.got[0]")
    assert begun["method"] == "ui/initialize"
    assert begun["params"]["protocolVersion"] == "2026-01-26"
    caption = json.loads(text_of(host.show("webots_plot", {})))
    picture = host.view.locator("#frame img")
    picture.wait_for()
    assert host.text("#summary") == caption["shows"]
    assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") > 300
    host.view.locator("#facts summary").click()
    assert caption["robot"] in host.text("#facts") and HOSTILE in caption["robot"]
    before = picture.bounding_box()["width"]
    host.view.locator("#closer").click()
    assert picture.bounding_box()["width"] == pytest.approx(1.5 * before, rel=0.01)
    host.view.locator("#whole").click()
    assert picture.bounding_box()["width"] == pytest.approx(before, rel=0.01)
    assert host.view.locator("#request").is_hidden(), "this host calls no tools"
    host.page.wait_for_function(IS_TALL)
    assert host.view.evaluate("window.hacked") is None
    assert [url for url in host.asked if not url.startswith(("data:", "about:"))] == []
    assert host.wrong == []


@pytest.mark.slow
def test_a_person_asks_for_other_signals_and_another_range_through_the_host(open_host: Any) -> None:
    host = open_host(TOOLS)
    host.show("webots_plot", {"signals": ["pose.0"], "width_px": 640})
    first = host.view.locator("#frame img").get_attribute("src")
    assert host.view.locator("[name=signals]").input_value() == "pose.0"
    host.view.locator("[name=signals]").fill("speed")
    host.view.locator("[name=start_s]").fill("x")
    host.view.locator("#draw").click()
    assert host.text("#summary") == "x is not a number of seconds."
    host.view.locator("[name=start_s]").fill("5")
    host.view.locator("[name=end_s]").fill("9,5")
    host.view.locator("[name=end_s]").press("Enter")
    host.view.wait_for_function(
        "src => document.querySelector('#frame img').src !== src", arg=first
    )
    asked = host.wait_for("tools/call")
    wanted = {"signals": ["speed"], "start_s": 5, "end_s": 9.5, "width_px": 640, "kind": "signals"}
    assert asked["name"] == "webots_plot"
    assert wanted.items() <= asked["arguments"].items() and asked["arguments"]["run_id"] == 1
    assert "speed" in host.text("#summary")
    host.view.locator("[name=signals]").fill("nothing_like_it")
    host.view.locator("#draw").click()
    host.view.wait_for_function("() => document.querySelector('#summary').className === 'error'")
    assert "nothing_like_it" in host.text("#summary")
    assert host.wrong == []


@pytest.mark.slow
def test_the_checks_of_a_run_come_with_its_events_and_plot(open_host: Any) -> None:
    host = open_host(BOTH)
    answer = host.show("webots_check_run", {}).structured_content
    assert answer is not None
    host.view.locator("#frame img").wait_for()
    assert host.text("#summary") == answer["summary"]
    assert "Events" in host.text("#events")
    named = " ".join([*(answer.get("passed") or ()), host.text("#checks")])
    assert all(name in host.text("#checks") for name in answer.get("passed") or ()), named
    assert host.view.evaluate("window.hacked") is None
    assert host.wrong == []


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_it_fits_a_narrow_window_in_light_and_dark(open_host: Any, theme: str) -> None:
    other = "dark" if theme == "light" else "light"
    host = open_host(BOTH, width=390, color_scheme=other)
    grounds = "() => ['backgroundColor', 'color'].map(n => getComputedStyle(document.body)[n])"
    host.send("ui/notifications/host-context-changed", {"theme": theme})
    host.view.wait_for_function(
        "theme => document.documentElement.dataset.theme === theme", arg=theme
    )
    ground, ink = (sum(map(int, re.findall(r"\d+", c)[:3])) for c in host.view.evaluate(grounds))
    assert (ground > ink) == (theme == "light") and abs(ground - ink) > 400
    for tool in ("webots_check_run", "webots_plot"):
        host.show(tool, {})
        host.view.locator("#frame img").wait_for()
        assert host.view.evaluate("document.documentElement.scrollWidth") <= 390
    variables = {"--color-text-primary": "rgb(1, 2, 3)", "background": "url(https://a.example)"}
    host.send("ui/notifications/host-context-changed", {"styles": {"variables": variables}})
    host.view.wait_for_function("() => getComputedStyle(document.body).color === 'rgb(1, 2, 3)'")
    assert [url for url in host.asked if not url.startswith(("data:", "about:"))] == []


@pytest.mark.slow
def test_it_answers_the_host_and_listens_to_nobody_else(open_host: Any) -> None:
    host = open_host({})
    for number, method in enumerate(("ping", "ui/resource-teardown", "ui/unknown"), 700):
        host.page.evaluate("message => send(message)", {"id": number, "method": method})
        find = "id => host.got.find(each => each.id === id)"
        answer = host.page.wait_for_function(find, arg=number).json_value()
        assert ("error" in answer) == (method == "ui/unknown")
    fake = {
        "jsonrpc": "2.0",
        "method": "ui/notifications/tool-cancelled",
        "params": {"reason": "x"},
    }
    host.view.evaluate("message => window.postMessage(message, '*')", fake)
    host.send("ui/notifications/tool-cancelled", {"reason": "by the person"})
    host.view.wait_for_function(
        "() => document.querySelector('#summary').textContent.includes('by the person')"
    )
