"""Notify Claude Code of what happened over a channel, without a request.

Claude Code shows the notification `notifications/claude/channel` of a server that announces the
experimental capability `claude/channel`; other clients ignore both. See 'webots-mcp help updates'.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final

from mcp.server.context import CallNext, HandlerResult, ServerRequestContext

from webots_mcp.server.connected_clients import ConnectedClients
from webots_mcp.server.notable_events import News, Occurrence

CAPABILITY: Final = "claude/channel"
METHOD: Final = "notifications/claude/channel"
MOST_AT_ONCE: Final = 5  # messages without a pause
SECONDS_EACH: Final = 10.0  # after which one more may be sent
CHANNEL_INSTRUCTIONS: Final = (
    "Unasked messages of this server say that a breakpoint was hit, an expectation was violated, a "
    "controller crashed or trials are done. They are no requests: check with a tool before you act."
)
_PLURALS: Final[Mapping[str, str]] = {
    "breakpoint": "breakpoint hits",
    "violation": "violated expectations",
    "crash": "crashes",
    "trials": "sets of trials",
}


class MessageBudget:
    """Decides which messages are sent: a few at once, then one every ten seconds.

    What is held back is only counted, and reported in one message as soon as one may be sent.

    Args:
        clock: Returns seconds that only grow.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._allowed, self._since_s = float(MOST_AT_ONCE), clock()
        self._held = Counter[str]()
        self._newest: Occurrence | None = None

    def admit(self, news: News) -> list[dict[str, Any]]:
        """Return the parameters of the messages that are sent now."""
        now_s = self._clock()
        gained = (now_s - self._since_s) / SECONDS_EACH
        self._allowed, self._since_s = min(self._allowed + gained, float(MOST_AT_ONCE)), now_s
        messages: list[dict[str, Any]] = []
        for each in news.occurrences:
            if self._allowed >= 1 and not self._held:
                self._allowed -= 1
                messages.append({"content": each.text, "meta": dict(each.meta)})
            else:
                self._held[each.kind] += 1
                self._newest = each
        self._held.update(news.further)
        if self._held and self._allowed >= 1:
            self._allowed -= 1
            messages.append(self._summary())
        return messages

    def _summary(self) -> dict[str, Any]:
        counts = ", ".join(f"{_PLURALS[kind]}: {n}" for kind, n in sorted(self._held.items()))
        newest = f" The newest: {self._newest.text}" if self._newest else ""
        number = self._held.total()
        self._held.clear()
        self._newest = None
        return {
            "content": f"More happened than is sent one by one. {counts}.{newest}",
            "meta": {"kind": "summary", "count": str(number)},
        }


class Channel:
    """A middleware that announces the channel; it sends to all clients that are connected."""

    def __init__(self, clients: ConnectedClients) -> None:
        self._clients = clients
        self._budget = MessageBudget()

    async def __call__(
        self, ctx: ServerRequestContext[Any, Any], call_next: CallNext
    ) -> HandlerResult:
        """Add the capability to what the server says of itself."""
        result = await call_next(ctx)
        if ctx.method in ("initialize", "server/discover") and isinstance(result, dict):
            capabilities = result.setdefault("capabilities", {})
            capabilities["experimental"] = {
                **(capabilities.get("experimental") or {}),
                CAPABILITY: {},
            }
        return result

    async def send(self, news: News) -> None:
        """Send what is new, as far as the limit of messages goes."""
        for message in self._budget.admit(news):
            await self._clients.notify(METHOD, message)
