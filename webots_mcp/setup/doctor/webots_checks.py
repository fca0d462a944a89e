"""Checks of Webots and of MCP clients: what is installed, what runs, and whether clients connect.

The last check starts a server of its own.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from http import HTTPStatus
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, cast
from urllib.error import HTTPError
from urllib.request import urlopen

from webots_mcp.contract import VERSION
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.setup.client_entries import (
    TOKEN_VARIABLE,
    Client,
    can_be_started,
    claude_desktop,
    clients_of,
    is_ours,
    object_in,
    words_of,
)
from webots_mcp.setup.doctor import (
    Diagnosis,
    Examined,
    check,
    ok,
    unclear,
    warning,
    wrong,
)
from webots_mcp.setup.wsl import WAY_OUT, ask_windows, in_wsl, is_wsl, on_windows
from webots_mcp.simulator.installations import find_webots, installations

if TYPE_CHECKING:
    from typing import TextIO


_INIT: Final = "run 'webots-mcp init' in the project"


@dataclass(frozen=True)
class ProbeLimits:
    """Limits of a command that is run as a check.

    Attributes:
        timeout_s: Wall time.
        shown_characters: Length at which its output is cut.
    """

    timeout_s: float = 30.0
    shown_characters: int = 300


_PROBE: Final = ProbeLimits()


@check("Webots")
def installed(_: Examined) -> Iterator[Diagnosis]:
    """Report which Webots there are."""
    try:
        find_webots()
    except CommandRefusedError as error:
        seen, fix = str(error).rsplit(": ", 1)
        yield warning(seen, fix)
    for each in installations():
        seen = f"{each.version or 'a Webots without a version'} at {each.home or each.program}"
        seen = f"{seen} (by {each.found_by})"
        parts = {"webots-controller": each.launcher, "lib/controller/python": each.python_api}
        missing = [name for name, path in parts.items() if path is None]
        if each.home is None or not missing:
            yield ok(seen)
        else:
            fix = "install Webots again, or set WEBOTS_HOME to the folder of a whole one"
            yield warning(f"{seen} lacks {' and '.join(missing)}", fix)


@check("Running Webots", well="no Webots runs on this machine")
def running(subject: Examined) -> Iterator[Diagnosis]:
    """Report which of them run, and whether they can be steered from outside."""
    for each in subject.running_webots:
        world = f", {each.world.name}" if each.world else ""
        seen = f"port {each.port} (process {each.pid}{world}, mode {each.mode or 'of its own'})"
        if each.is_listening:
            obeys = "obeys" if each.streams else "was started without --stream and does not obey"
            yield ok(f"{seen} {obeys} orders from outside")
        else:
            yield warning(
                f"{seen} was not seen to listen there",
                "wait until it has started; the system does not show another user's processes",
            )


@check("WSL", well="this is not WSL: Webots, controllers and server are on one side")
def sides(subject: Examined) -> Iterator[Diagnosis]:
    """Report what there is in WSL and what on Windows, and whether they meet."""
    if not is_wsl():
        return
    here = installations()
    there = on_windows(subject.project)
    windows = ask_windows()
    on_this = f"Webots at {here[0].home or here[0].program}" if here else "no Webots"
    ours = f"webots-mcp {windows.version}" if windows.server else "no webots-mcp"
    webots = f"Webots at {windows.webots}" if windows.webots else "no Webots"
    seen = (
        f"in WSL: webots-mcp {VERSION}, {on_this}; on Windows: {ours}, {webots}; the project "
        f"is {f'on Windows ({there})' if there else f'in WSL ({subject.project})'}"
    )
    meet = windows.server and windows.webots if there else here
    yield ok(seen) if meet else warning(seen, WAY_OUT)


@check("Clients")
def clients(subject: Examined) -> Iterator[Diagnosis]:
    """Report each file that is there, and whether its server can start on this recording."""
    known = [*clients_of(subject.project), claude_desktop()]
    findings = [each for client in known for each in _servers_of(subject, client)]
    yield from findings
    if not findings:
        names = ", ".join(client.name for client in known)
        seen = f"no file of {names} for {subject.project} names webots-mcp"
        yield warning(seen, f"{_INIT}; other clients have files of their own")


def _servers_of(subject: Examined, client: Client) -> Iterator[Diagnosis]:
    """Report what a file says of our server: nothing where it names only others."""
    if not client.file.exists():
        return
    try:
        text = client.file.read_text("utf-8-sig")
        servers = object_in(text.strip() or "{}").get(client.servers)
    except (OSError, UnicodeDecodeError, InvalidInputError) as error:
        seen = f"{client.file} ({client.name}) cannot be read: {error}"
        yield wrong(seen, f"mend that file: {client.name} cannot read it either")
        return
    entries = cast("dict[str, Any]", servers) if isinstance(servers, dict) else {}
    for name, entry in entries.items():
        if is_ours(entry):
            yield _entry(subject, f"{client.name}, server {name!r}", entry)


def _entry(subject: Examined, name: str, entry: dict[str, Any]) -> Diagnosis:
    if "url" in entry:
        return _over_http(name, str(entry["url"]))
    command, *arguments = words_of(entry)
    if shutil.which(command) is None:
        return wrong(f"{name}: there is no program {command!r}", _INIT)
    if (other := _other_place(subject, arguments)) is not None:
        seen = f"{name} serves {other}, which is not what is looked at here"
        return warning(seen, "name the folder in which the controllers record")
    if not can_be_started(entry):
        return ok(
            f"{name}: {command!r} is found by the PATH alone, which programs with windows lack"
        )
    return ok(f"{name} starts {command}")


def _over_http(name: str, url: str) -> Diagnosis:
    """Check that a server asks for the token there; it is not sent, for anybody may listen."""
    try:
        with urlopen(url, timeout=3) as answer:
            status: int = answer.status
    except HTTPError as error:
        status = error.code
    except (OSError, ValueError) as error:
        seen = f"{name} is at {url}, where nothing answers: {error}"
        return wrong(seen, "start it there: webots-mcp serve --http PORT")
    if status != HTTPStatus.UNAUTHORIZED:
        seen = f"{name} is at {url}, where something answers that asks for no token ({status})"
        return wrong(seen, _INIT)
    return ok(f"{name} is at {url}, where a server asks for the token ({TOKEN_VARIABLE})")


def _other_place(subject: Examined, arguments: list[str]) -> str | None:
    """Return the recording that the arguments name, if it is another one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    for option, value in pairwise(words):
        if option in ("--data-dir", "--database") and "$" not in value:
            ours = subject.recording.data_dir if option == "--data-dir" else subject.file
            meant = subject.project / (in_wsl(value) if is_wsl() else value)
            same = ours is not None and meant.resolve() == ours.resolve()
            return None if same else value
    return None


@check("Server", starts_process=True)
def server(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether a server starts, names its tools and answers."""
    if subject.file is None:
        yield unclear("a recording in memory belongs to one process")
        return
    import anyio

    line = [*subject.server, "--database", str(subject.file)]
    started_s = time.monotonic()
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as complaints:
        try:
            tools, refused = anyio.run(_converse, line, complaints)
        except Exception as error:  # noqa: BLE001  (it is reported)
            complaints.seek(0)
            wrote = complaints.read().strip().splitlines()
            last = f"; it wrote: {wrote[-1][: _PROBE.shown_characters]}" if wrote else ""
            yield wrong(
                f"'{' '.join(line)}' did not answer: {_why(error)}{last}",
                "run the same command in a shell, see what it prints, and install webots-mcp again "
                "where a package is missing or broken",
            )
            return
    started = f"started over stdio, {tools} tools that only read"  # by --read-only
    if refused:
        seen = f"{started}, and answers: {refused[: _PROBE.shown_characters]}"
        yield warning(seen, "mend the recording: see Database and Schema")
    else:
        yield ok(f"{started}, one answer, {time.monotonic() - started_s:.1f} s in all")


async def _converse(line: list[str], complaints: TextIO) -> tuple[int, str]:
    """Return how many tools it has, and why it refuses a question; empty where it answers it."""
    import anyio
    from mcp import Client, StdioServerParameters
    from mcp.client.stdio import stdio_client

    command, *arguments = line
    parameters = StdioServerParameters(command=command, args=arguments, env=dict(os.environ))
    with anyio.fail_after(_PROBE.timeout_s):
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
        return f"nothing came within {_PROBE.timeout_s:g} s"
    return f"{error or type(error).__name__}"[: _PROBE.shown_characters]
