"""Whether MCP clients find a server of ours, and whether it starts and answers."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, cast

from webots_mcp.diagnosis.doctor import Examined, Finding, check, worst
from webots_mcp.errors import InvalidInputError
from webots_mcp.setup.client_entries import (
    Client,
    can_be_started,
    claude_desktop,
    clients_of,
    is_ours,
    words_of,
)
from webots_mcp.setup.file_changes import CommentedJSON

_PLACES: Final = ("--data-dir", "--database")
_INIT: Final = "run 'webots-mcp init' in the project"


@check("Clients")
def clients(subject: Examined) -> Finding:
    """Each file that is there, and whether its server can start on this recording."""
    known = [*clients_of(subject.project), claude_desktop()]
    there = [client for client in known if client.file.exists()]
    findings = [found for client in there for found in _look(subject, client)]
    if findings:
        return worst(findings)
    names = ", ".join(client.name for client in known)
    seen = f"no file of {names} for {subject.project} names webots-mcp"
    return Finding("warning", seen, f"{_INIT}; other clients have files of their own")


def _look(subject: Examined, client: Client) -> list[Finding]:
    """What a file says of our server: nothing where it names only others."""
    try:
        text = client.file.read_text("utf-8-sig")
        servers = CommentedJSON(text.strip() or "{}").value.get(client.servers)
    except (OSError, UnicodeDecodeError, InvalidInputError) as error:
        seen = f"{client.file} ({client.name}) cannot be read: {error}"
        return [Finding("wrong", seen, f"mend that file: {client.name} cannot read it either")]
    entries = cast("dict[str, Any]", servers) if isinstance(servers, dict) else {}
    return [
        _entry(subject, f"{client.name}, server {name!r}", entry)
        for name, entry in entries.items()
        if is_ours(entry)
    ]


def _entry(subject: Examined, name: str, entry: dict[str, Any]) -> Finding:
    command, *arguments = words_of(entry)
    if shutil.which(command) is None:
        return Finding("wrong", f"{name}: there is no program {command!r}", _INIT)
    if (other := _other_place(subject, arguments)) is not None:
        seen = f"{name} serves {other}, which is not what is looked at here"
        return Finding("warning", seen, "name the folder in which the controllers record")
    if not can_be_started(entry):
        seen = f"{name}: {command!r} is found by the PATH alone, which programs with windows lack"
        return Finding("ok", seen)
    return Finding("ok", f"{name} starts {command}")


def _other_place(subject: Examined, arguments: list[str]) -> str | None:
    """The recording that the arguments name, if it is another one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    for option, value in pairwise(words):
        if option in _PLACES and "$" not in value:
            ours = subject.recording.data_dir if option == "--data-dir" else subject.file
            same = ours is not None and (subject.project / value).resolve() == ours.resolve()
            return None if same else value
    return None


if TYPE_CHECKING:
    from typing import TextIO

_TIMEOUT_S: Final = 30.0
_SHOWN_CHARACTERS: Final = 300
_FIX: Final = (
    "run the same command in a shell, see what it prints, and install webots-mcp again where a "
    "package is missing or broken"
)


@check("Server", starts_process=True)
def server(subject: Examined) -> Finding:
    """Whether a server starts, names its tools and answers."""
    if subject.file is None:
        return Finding("not checked", "a recording in memory belongs to one process")
    import anyio

    line = [*subject.server, "--database", str(subject.file)]
    started_s = time.monotonic()
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        try:
            tools, refused = anyio.run(_converse, line, complaints)
        except Exception as error:  # noqa: BLE001  (it is reported)
            seen = f"'{' '.join(line)}' did not answer: {_why(error)}{_last_line(complaints)}"
            return Finding("wrong", seen, _FIX)
    started = f"started over stdio, {tools} tools that only read"  # by --read-only
    if refused:
        seen = f"{started}, and answers: {refused[:_SHOWN_CHARACTERS]}"
        return Finding("warning", seen, "mend the recording: see Database and Schema")
    took_s = time.monotonic() - started_s
    return Finding("ok", f"{started}, one answer, {took_s:.1f} s in all")


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
