"""Resources of each run: its report and its plot, and who wants to know when they change.

They change when the run ends. Clients of protocols before 2026-07-28 subscribe to a resource, later
ones listen; both receive only the address, and read it again.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

from anyio import CapacityLimiter, to_thread
from mcp import MCPError
from mcp.server.connection import Connection
from mcp.server.context import CallNext, HandlerResult, ServerRequestContext
from mcp.server.mcpserver import Context, MCPServer
from mcp.server.mcpserver.exceptions import ResourceError, ResourceNotFoundError
from mcp.server.subscriptions import InMemorySubscriptionBus, ResourceUpdated
from mcp.types import (
    INVALID_PARAMS,
    EmptyResult,
    SubscribeRequestParams,
    UnsubscribeRequestParams,
)

from webots_mcp.answers.shortening import compact_json
from webots_mcp.errors import NothingRecordedError, UnknownRunError, WebotsMCPError
from webots_mcp.server.connected_clients import ConnectedClients, connection_of, requester_of
from webots_mcp.server.notable_events import IS_DATA, News
from webots_mcp.server.push_updates import UpdateWatch
from webots_mcp.server.tool_list import listed_tools
from webots_mcp.store.recording import RecordingAccess

if TYPE_CHECKING:
    from webots_mcp.questions.declaration import Reply

REPORT_URI: Final = "webots://run/{run_id}/report"
PLOT_URI: Final = "webots://run/{run_id}/plot"
MOST_SUBSCRIPTIONS: Final = 100  # of one client
MOST_UPDATES: Final = 50  # runs that ended within half a second; older ones are left out
_AT_ONCE: Final = 2  # resources that are made side by side
_OF_REPORT: Final = {"check": "webots_check_run", "events": "webots_find_events"}


def add_run_resources(mcp: MCPServer, recording: RecordingAccess) -> None:
    """Register the report and the plot of a run."""
    at_once: list[CapacityLimiter] = []  # which belongs to the event loop

    async def ask(tool: str, run_id: int, ctx: Context[Any]) -> Reply:
        from webots_mcp.questions.declaration import Caller

        if not at_once:
            at_once.append(CapacityLimiter(_AT_ONCE))
        question = next(each.question for each in listed_tools() if each.name == tool)
        companions = ctx.request_context.lifespan_context
        caller = Caller("mcp", ctx.report_progress, companions, requester_of(ctx))
        async with at_once[0]:
            try:
                await to_thread.run_sync(_require_run, recording, run_id)
                return await question.ask(recording, {"run_id": run_id}, caller)
            except (UnknownRunError, NothingRecordedError) as error:
                raise ResourceNotFoundError(str(error)) from error
            except WebotsMCPError as error:
                raise ResourceError(str(error)) from error

    @mcp.resource(
        REPORT_URI, title="Report of a run", mime_type="application/json",
        description="Whether the run is well, and what happened in it. Updated when it ends.",
    )  # fmt: skip
    async def report(run_id: int, ctx: Context[Any]) -> str:
        answers = {name: (await ask(tool, run_id, ctx)).data for name, tool in _OF_REPORT.items()}
        return compact_json({"run_id": run_id, "quoted": IS_DATA, **answers})

    @mcp.resource(
        PLOT_URI, title="Plot of a run", mime_type="image/png",
        description="The signals of the run that changed most, over time. Updated when it ends.",
    )  # fmt: skip
    async def plot(run_id: int, ctx: Context[Any]) -> bytes:
        reply = await ask("webots_plot", run_id, ctx)
        for each in reply.shown:
            if not isinstance(each, str):
                return each.data
        raise ResourceError(f"run {run_id} has nothing that could be drawn")

    _ = report, plot  # registered by their decorators


def _require_run(recording: RecordingAccess, run_id: int) -> None:
    """Raise an error where a tool would answer that nothing was recorded yet."""
    with recording.view(None, run_id):
        pass


class Subscriptions:
    """A middleware that notes who subscribes, and has the recording watched from then on."""

    def __init__(
        self, clients: ConnectedClients, bus: InMemorySubscriptionBus, watch: UpdateWatch
    ) -> None:
        self._clients, self._bus, self._watch = clients, bus, watch
        self._wanted: dict[int, tuple[Connection, set[str]]] = {}

    async def __call__(
        self, ctx: ServerRequestContext[Any, Any], call_next: CallNext
    ) -> HandlerResult:
        """Begin to watch before a client learns that it listens."""
        if ctx.method == "subscriptions/listen":
            await self._watch.begin()
        return await call_next(ctx)

    async def send(self, news: News) -> None:
        """Tell who subscribed of the runs that have ended."""
        for run_id in news.ended_runs[-MOST_UPDATES:]:
            for template in (REPORT_URI, PLOT_URI):
                uri = template.replace("{run_id}", str(run_id))
                await self._bus.publish(ResourceUpdated(uri=uri))
                wanting = {
                    key: connection
                    for key, (connection, uris) in self._wanted.items()
                    if uri in uris
                }
                await self._clients.notify("notifications/resources/updated", {"uri": uri}, wanting)

    def serve(self, mcp: MCPServer) -> None:
        """Answer the subscriptions of clients before 2026-07-28, for which the SDK has no way."""
        server = mcp._lowlevel_server  # pyright: ignore[reportPrivateUsage]
        server.add_request_handler("resources/subscribe", SubscribeRequestParams, self._subscribe)
        server.add_request_handler(
            "resources/unsubscribe", UnsubscribeRequestParams, self._unsubscribe
        )

    async def _subscribe(
        self, ctx: ServerRequestContext[Any, Any], params: SubscribeRequestParams
    ) -> EmptyResult:
        uri = str(params.uri)
        if not re.fullmatch(r"webots://run/[1-9][0-9]{0,17}/(report|plot)", uri):
            known = " and ".join((REPORT_URI, PLOT_URI))
            raise MCPError(INVALID_PARAMS, f"{uri[:200]!r} never changes; these do: {known}")
        connection = connection_of(ctx)
        key = id(connection)
        if key not in self._wanted:
            self._wanted[key] = connection, set()
            connection.exit_stack.callback(self._wanted.pop, key, None)
        uris = self._wanted[key][1]
        if uri not in uris and len(uris) >= MOST_SUBSCRIPTIONS:
            raise MCPError(
                INVALID_PARAMS,
                f"this client has {MOST_SUBSCRIPTIONS} subscriptions: end one of them first",
            )
        uris.add(uri)
        await self._watch.begin()
        return EmptyResult()

    async def _unsubscribe(
        self, ctx: ServerRequestContext[Any, Any], params: UnsubscribeRequestParams
    ) -> EmptyResult:
        _, uris = self._wanted.get(id(connection_of(ctx)), (None, set[str]()))
        uris.discard(str(params.uri))
        return EmptyResult()
