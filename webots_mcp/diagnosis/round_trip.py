"""A server of our own, started as a client starts it, and asked once."""

from __future__ import annotations

import os
import tempfile
import time
from typing import TYPE_CHECKING, Final

from webots_mcp.diagnosis.finding import Finding, Subject

if TYPE_CHECKING:
    from typing import TextIO

_TIMEOUT_S: Final = 30.0
_SHOWN_CHARACTERS: Final = 300
_FIX: Final = (
    "run the same command in a shell, see what it prints, and install webots-mcp again where a "
    "package is missing or broken"
)


def server(subject: Subject) -> Finding:
    """Whether a server starts, names its tools and answers."""
    if subject.file is None:
        return Finding("not looked at", "a recording in memory belongs to one process")
    import anyio

    line = [*subject.server, "--database", str(subject.file)]
    started_s = time.monotonic()
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        try:
            tools, refused = anyio.run(_converse, line, complaints)
        except Exception as error:  # noqa: BLE001  (it is told)
            seen = f"'{' '.join(line)}' did not answer: {_why(error)}{_last_line(complaints)}"
            return Finding("wrong", seen, _FIX)
    if refused:
        seen = f"it starts and has {tools} tools, and answers: {refused[:_SHOWN_CHARACTERS]}"
        return Finding("warning", seen, "mend the recording: see Database and Schema")
    took_s = time.monotonic() - started_s
    return Finding("ok", f"started over stdio, {tools} tools, one answer, {took_s:.1f} s in all")


async def _converse(line: list[str], complaints: TextIO) -> tuple[int, str]:
    """How many tools it has, and why it refuses a question; empty where it answers it."""
    import anyio
    from mcp import Client, StdioServerParameters
    from mcp.client.stdio import stdio_client

    command, *arguments = line
    parameters = StdioServerParameters(command=command, args=arguments, env=dict(os.environ))
    with anyio.fail_after(_TIMEOUT_S):
        async with Client(stdio_client(parameters, complaints)) as client:
            tools = (await client.list_tools()).tools
            answer = await client.call_tool("webots_list_robots", {})
    text = "".join(getattr(block, "text", "") for block in answer.content)
    return len(tools), text.partition(": ")[2] or text if answer.is_error else ""


def _why(error: BaseException) -> str:
    """Of a group of errors the first one."""
    parts: tuple[BaseException, ...] = getattr(error, "exceptions", ())
    if parts:
        return _why(parts[0])
    if isinstance(error, TimeoutError):
        return f"nothing came within {_TIMEOUT_S:g} s"
    return f"{error or type(error).__name__}"[:_SHOWN_CHARACTERS]


def _last_line(complaints: TextIO) -> str:
    """What it wrote on stderr last."""
    complaints.seek(0)
    lines = complaints.read().strip().splitlines()
    return f"; it wrote: {lines[-1][:_SHOWN_CHARACTERS]}" if lines else ""
