"""The view of plots, pictures and checks that an MCP client shows in its own window (MCP Apps).

Only a client that has negotiated the extension gets it: the tools in its list name the view, and
its list of resources has it. To all others the lists are as they are without this module.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path
from typing import Any, Final, cast

from mcp.server.apps import Apps, ResourceCsp, client_supports_apps
from mcp.server.context import CallNext, HandlerResult, ServerRequestContext

from webots_mcp.contract import VERSION

VIEW_URI: Final = "ui://webots-mcp/view.html"
SHOWN_TOOLS: Final = (  # those whose answers it draws
    "webots_plot",
    "webots_get_camera",
    "webots_take_screenshot",
    "webots_check_run",
    "webots_report",
)
_FOLDER: Final = Path(__file__).parent / "view"


def make_view() -> Apps:
    """Return the extension that serves the view as a resource."""
    apps = Apps()
    apps.add_html_resource(
        VIEW_URI,
        view_html(),
        name="view",
        title="View of plots, pictures and checks",
        description="Draws the answers of " + ", ".join(SHOWN_TOOLS) + ".",
        csp=ResourceCsp(),
        prefers_border=True,
    )
    return apps


@cache
def view_html() -> str:
    """Return the page: one file that loads nothing and runs no script but its own."""
    parts = {name: (_FOLDER / f"view.{name}").read_text("utf-8") for name in ("html", "css", "js")}
    script = parts["js"].replace("{{version}}", VERSION)
    policy = (
        f"default-src 'none'; script-src {_hash_of(script)}; style-src {_hash_of(parts['css'])}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    page = parts["html"].replace("{{policy}}", policy)
    return page.replace("{{style}}", parts["css"]).replace("{{script}}", script)


def _hash_of(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


async def name_the_view(ctx: ServerRequestContext[Any, Any], call_next: CallNext) -> HandlerResult:
    """Name the view in the lists that a client gets which shows it, and hide it from all others.

    Args:
        ctx: Of the request.
        call_next: Answers it.
    """
    result = await call_next(ctx)
    if ctx.method not in ("tools/list", "resources/list") or not isinstance(result, dict):
        return result
    shows_it = client_supports_apps(ctx)
    if ctx.method == "tools/list" and shows_it:
        for tool in cast("list[dict[str, Any]]", result["tools"]):
            if tool["name"] in SHOWN_TOOLS:
                tool["_meta"] = {**tool.get("_meta", {}), "ui": {"resourceUri": VIEW_URI}}
    elif ctx.method == "resources/list" and not shows_it:
        listed = cast("list[dict[str, Any]]", result["resources"])
        result["resources"] = [each for each in listed if each["uri"] != VIEW_URI]
    return result
