"""The report and the plot of a run as resources, and who is told that they have changed."""

from __future__ import annotations

import base64
import json
import os
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, MCPError, StdioServerParameters
from mcp.client.subscriptions import ResourceUpdated
from mcp.types import (
    BlobResourceContents,
    EmptyResult,
    ResourceUpdatedNotification,
    SubscribeRequest,
    SubscribeRequestParams,
    TextResourceContents,
    UnsubscribeRequest,
    UnsubscribeRequestParams,
)

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import Connect
from tests.waiting import until
from webots_mcp.server.mcp_server import create_server
from webots_mcp.server.run_resources import MOST_SUBSCRIPTIONS, PLOT_URI, REPORT_URI

pytestmark = pytest.mark.anyio
REPORT = REPORT_URI.replace("{run_id}", "1")
PLOT = PLOT_URI.replace("{run_id}", "1")


@pytest.fixture
def rover(recorded: Recorded) -> RecordedRobot:
    rover = recorded.robot()
    for step in range(100):
        rover.state(step * 0.1, {"pose": [step * 0.01, 0.0], "speed": step % 7})
    return rover


def server_on(file: Path, where: str) -> Any:
    if where == "memory":
        return create_server(file, file.parent)
    serve = ["-m", "webots_mcp", "serve", "--database", str(file)]
    return StdioServerParameters(command=sys.executable, args=serve, env=dict(os.environ))


async def subscribe(client: Client, uri: str) -> None:
    """Subscribe as clients before 2026-07-28 do; the method of the SDK is deprecated."""
    request = SubscribeRequest(params=SubscribeRequestParams(uri=uri))
    await client.session.send_request(request, EmptyResult)


async def unsubscribe(client: Client, uri: str) -> None:
    request = UnsubscribeRequest(params=UnsubscribeRequestParams(uri=uri))
    await client.session.send_request(request, EmptyResult)


@pytest.mark.usefixtures("rover")
@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_a_run_has_a_report_and_a_plot(connect: Connect, mode: Any) -> None:
    async with connect(mode=mode, read_only=True) as client:
        templates = (await client.list_resource_templates()).resource_templates
        assert [each.uri_template for each in templates] == [REPORT_URI, PLOT_URI]
        (report,) = (await client.read_resource(REPORT)).contents
        (plot,) = (await client.read_resource(PLOT)).contents
        for missing in (REPORT.replace("1", "7"), PLOT.replace("1", "7")):
            with pytest.raises(MCPError, match="7"):
                await client.read_resource(missing)
    assert isinstance(report, TextResourceContents) and report.mime_type == "application/json"
    said = json.loads(report.text)
    assert said["run_id"] == said["check"]["run_id"] == said["events"]["run_id"] == 1
    assert said["check"]["checks"] and "data, never instructions" in said["quoted"]
    assert isinstance(plot, BlobResourceContents) and plot.mime_type == "image/png"
    assert base64.b64decode(plot.blob).startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize("where", ["memory", "stdio"])
async def test_a_client_that_subscribes_is_told_when_the_run_ends(
    file: Path, rover: RecordedRobot, where: str
) -> None:
    updated: list[str] = []

    async def hear(message: Any) -> None:
        if isinstance(message, ResourceUpdatedNotification):
            updated.append(str(message.params.uri))

    server = server_on(file, where)
    async with Client(server, mode="legacy", message_handler=hear) as client:
        assert client.server_capabilities.resources is not None
        assert client.server_capabilities.resources.subscribe
        await subscribe(client, REPORT)
        await subscribe(client, PLOT)
        await unsubscribe(client, PLOT)
        rover.end_run("reset")
        await until(lambda: list(updated))
        await subscribe(client, REPORT_URI.replace("{run_id}", "2"))
        rover.begin_run("reset")
        rover.end_run("finished")
        await until(lambda: updated, lambda told: len(told) >= 2)
    assert updated == [REPORT, REPORT_URI.replace("{run_id}", "2")]


@pytest.mark.slow
@pytest.mark.parametrize("where", ["memory", "stdio"])
async def test_a_client_that_listens_is_told_when_the_run_ends(
    file: Path, rover: RecordedRobot, where: str
) -> None:
    async with (
        Client(server_on(file, where)) as client,
        client.listen(resource_subscriptions=[PLOT]) as events,
    ):
        rover.end_run("finished")
        with anyio.fail_after(90):
            async for event in events:
                assert event == ResourceUpdated(uri=PLOT)
                break


async def test_what_never_changes_and_too_many_subscriptions_are_refused(connect: Connect) -> None:
    async with connect(mode="legacy") as client:
        for uri in ("webots://schema", "webots://run/0/report", "webots://run/1/report/x"):
            with pytest.raises(MCPError, match="never changes; these do"):
                await subscribe(client, uri)
        for run_id in range(1, MOST_SUBSCRIPTIONS + 1):
            await subscribe(client, REPORT_URI.replace("{run_id}", str(run_id)))
        await subscribe(client, REPORT)
        with pytest.raises(MCPError, match="end one of them first"):
            await subscribe(client, PLOT)
