"""Which Webots run, why a simulation does not advance, and whether MCP clients reach the server.

The reason for a status is narrowed down from outside. A loop that is silent inside `step` looks the
same whatever keeps it there. The machine shows more: which controller's process is computing, and
how many robots of the world wait for a controller that a person has to start.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from webots_mcp.contract import UNSEEN, host_name
from webots_mcp.diagnosis import Examined, Finding, check, last_seen_s, worst
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.pauses import PAUSED, SEEN_PAUSED, SEEN_RUNNING
from webots_mcp.setup.client_entries import (
    Client,
    CommentedJSON,
    can_be_started,
    claude_desktop,
    clients_of,
    is_ours,
    words_of,
)
from webots_mcp.store.recording import View
from webots_mcp.store.robots import SILENT, Session, companions
from webots_mcp.webots import Installation, find_webots, installations
from webots_mcp.webots.orders import address_of

if TYPE_CHECKING:
    from typing import TextIO

    import psutil

    from webots_mcp.webots import Instance

_WATCHED_S: Final = 0.3
_LOOKS: Final = 6
_MOST_WATCHED: Final = 5  # simulations, one after the other
_BUSY: Final = 0.5  # of a processor; a controller that waits for its next step needs none
_EXTERN: Final = re.compile(r'^\s*controller\s+"<extern>"', re.MULTILINE)
_LARGEST_WORLD_BYTES: Final = 50_000_000
_ENDED_BADLY: Final = ("crashed", "reload")
_SEE_PAGE: Final = "see docs/troubleshooting.md#simulation"
_PRESS_PLAY: Final = "press play in Webots"
_RELOAD: Final = "end or mend that controller, then reload the world (Ctrl+Shift+R in Webots)"
_OBEYS: Final = "{}; or webots_simulation_control('{}'): this Webots obeys it by its WebSocket"


@check("Simulation", needs_recording=True)
def simulation(subject: Examined) -> Finding:
    """Whether time moves, and why it does not."""
    concerned = subject.live or _last_seen(subject.views)
    if not concerned:
        return Finding("ok", "no robot has been recorded yet")
    return worst([_judged(subject, view) for view in _once_each(concerned)])


def _once_each(views: list[View]) -> list[View]:
    """Of the robots that stand silent in the same simulation one: it is watched for them all."""
    watched = dict[str, View]()
    others = list[View]()
    for view in views:
        if view.session is not None and view.robot.live and _is_unclear(view):
            watched.setdefault(view.session.instance, view)
        else:
            others.append(view)
    return [*others, *list(watched.values())[:_MOST_WATCHED]]


def _last_seen(views: list[View]) -> list[View]:
    newest = max(views, key=last_seen_s, default=None)
    return [newest] if newest else []


def _judged(subject: Examined, view: View) -> Finding:
    name, status = view.robot.name, view.status
    seen = f"{name}: {status.text}{f' ({status.why})' if status.why else ''}"
    session = view.session
    if session is None or not view.robot.live:
        return _ended(view, seen)
    if status.is_moving:
        return Finding("warning" if status.why else "ok", seen)
    if status.text == PAUSED:
        return Finding("warning", seen, f"webots-mcp resume --robot {name}")
    if (status.why or "").startswith(SEEN_PAUSED):
        return Finding("warning", seen, "webots_simulation_control('resume'), or press play")
    if not _is_unclear(view):
        return Finding("wrong", seen, _SEE_PAGE)
    return _narrowed(subject, view, session)


def _is_unclear(view: View) -> bool:
    """Whether only the machine's processes can show which controller blocks the world."""
    return (view.status.why or "").startswith((SILENT, SEEN_RUNNING))


def _ended(view: View, seen: str) -> Finding:
    if view.status.why == UNSEEN:
        return Finding("warning", seen, _SEE_PAGE)
    if view.session is None or (view.session.end_reason or "crashed") not in _ENDED_BADLY:
        return Finding("ok", seen)
    fix = "see 'webots-mcp logs --level error', mend the controller and start it again"
    return Finding("wrong", seen, fix)


def _narrowed(subject: Examined, view: View, session: Session) -> Finding:
    """Of the reasons that look alike from inside, the one that shows from outside."""
    head = f"{view.robot.name}: {view.status.text}"
    webots = _webots_of(subject, session)
    busy = _busy_controllers(view, session, webots)
    if busy is not None and session.pid in busy:
        seen = f"{head}; its own process computes: its loop does not come back to step()"
        return Finding("wrong", seen, "look for a long computation or an endless loop in it")
    if busy:
        others = ", ".join(f"{what} (process {pid})" for pid, what in busy.items())
        seen = f"{head}; another controller computes and holds the step up: {others}"
        return Finding("wrong", seen, _also_by_websocket(_RELOAD, "reload", webots))
    if missing := _missing_externs(subject, view, webots):
        fix = "start it: 'webots-controller --robot-name=NAME FILE', or press play if it is paused"
        return Finding("wrong", f"{head}; {missing}", fix)
    press_play = _also_by_websocket(_PRESS_PLAY, "resume", webots)
    if (view.status.why or "").startswith(SEEN_RUNNING):
        seen = f"{head} ({view.status.why})"
        return Finding("wrong", seen, _also_by_websocket(_RELOAD, "reload", webots))
    if busy is None:
        return Finding("wrong", f"{head} ({view.status.why})", press_play)
    seen = (
        f"{head}; no controller computes and none is known to be missing: most likely it was "
        "paused by hand in Webots"
    )
    return Finding("wrong", seen, press_play)


def _also_by_websocket(fix: str, order: str, webots: Instance | None) -> str:
    """What a person can do, and what a client can where Webots was started with `--stream`."""
    is_open = webots is not None and webots.streams and webots.is_listening
    return _OBEYS.format(fix, order) if is_open else fix


def _webots_of(subject: Examined, session: Session) -> Instance | None:
    """The Webots that a session belongs to, where it runs here."""
    address = address_of(session.instance)
    return next((w for w in subject.running_webots if address and w.port == address.port), None)


def _busy_controllers(
    view: View, session: Session, webots: Instance | None
) -> dict[int, str] | None:
    """Controllers of the same simulation that compute now; None where that cannot be looked at."""
    if session.host != host_name():
        return None
    import psutil

    controllers = list(_controllers(view, session, webots))
    before_s = {process: _processor_s(process) for process in controllers}
    waited = set[psutil.Process]()
    for _ in range(_LOOKS):
        time.sleep(_WATCHED_S / _LOOKS)
        waited |= {process for process in controllers if not _wants_processor(process)}
    return {
        process.pid: _named(process)
        for process in controllers
        if process not in waited or _processor_s(process) - before_s[process] > _BUSY * _WATCHED_S
    }


def _wants_processor(process: psutil.Process) -> bool:
    """Whether it would continue if a processor were free; only Linux shows it."""
    import psutil

    try:
        return sys.platform == "linux" and process.status() == psutil.STATUS_RUNNING
    except psutil.Error:
        return False


def _controllers(view: View, session: Session, webots: Instance | None) -> Iterator[psutil.Process]:
    """The processes that record in this simulation, and those that its Webots has started."""
    import psutil

    pids = {session.pid}
    pids |= {each.pid for each in companions(view.connection, session, view.now_s)}
    if webots is not None:
        with suppress(psutil.Error):  # another user's: what records is known nevertheless
            pids |= {child.pid for child in psutil.Process(webots.pid).children(recursive=True)}
    for pid in sorted(pids):
        try:
            yield psutil.Process(pid)
        except psutil.Error:  # noqa: PERF203  (it has ended meanwhile)
            continue


def _processor_s(process: psutil.Process) -> float:
    import psutil

    try:
        used = process.cpu_times()
    except psutil.Error:
        return 0.0
    return used.user + used.system


def _named(process: psutil.Process) -> str:
    """What it runs: the file of a Python controller, else the program."""
    import psutil

    try:
        words = process.cmdline()
        file = next((word for word in words[1:] if word.endswith(".py")), None)
        return Path(file).name if file else process.name()
    except psutil.Error:
        return "a controller"


def _missing_externs(subject: Examined, view: View, webots: Instance | None) -> str | None:
    """That the world has more extern robots than record; by its text, so only perhaps."""
    world = (view.run and view.run.world) or (webots and webots.world)
    count = _externs_in(Path(world)) if world else 0
    session = view.session
    assert session is not None
    alive = [session, *companions(view.connection, session, view.now_s)]
    here = sum(each.extern for each in alive)
    if count <= here:
        return None
    return (
        f"{count} robots of {Path(str(world)).name} have the controller <extern> and {here} record "
        "here: one that has not been started stops the whole simulation"
    )


def _externs_in(world: Path) -> int:
    try:
        if world.stat().st_size > _LARGEST_WORLD_BYTES:
            return 0
        return len(_EXTERN.findall(world.read_text("utf-8", "replace")))
    except OSError:
        return 0


@check("Webots")
def installed(_: Examined) -> Finding:
    """Which Webots there are."""
    found = installations()
    if found:
        return worst([_complete(each) for each in found])
    try:
        find_webots()
    except CommandRefusedError as error:
        seen, fix = str(error).rsplit(": ", 1)
        return Finding("warning", seen, fix)
    return Finding("not checked", "it was installed while this looked")


def _complete(webots: Installation) -> Finding:
    where = webots.home or webots.program
    seen = f"{webots.version or 'a Webots without a version'} at {where} (by {webots.found_by})"
    missing = [
        name
        for name, path in (
            ("webots-controller", webots.launcher),
            ("lib/controller/python", webots.python_api),
        )
        if path is None
    ]
    if webots.home is None or not missing:
        return Finding("ok", seen)
    fix = "install Webots again, or set WEBOTS_HOME to the folder of a whole one"
    return Finding("warning", f"{seen} lacks {' and '.join(missing)}", fix)


@check("Running Webots")
def running(subject: Examined) -> Finding:
    """Which of them run, and whether they can be steered from outside."""
    if not subject.running_webots:
        return Finding("ok", "no Webots runs on this machine")
    return worst([_reachable(each) for each in subject.running_webots])


def _reachable(webots: Instance) -> Finding:
    world = f", {webots.world.name}" if webots.world else ""
    seen = f"port {webots.port} (process {webots.pid}{world}, mode {webots.mode or 'of its own'})"
    if not webots.is_listening:
        return Finding(
            "warning",
            f"{seen} was not seen to listen there",
            "wait until it has started; the system does not show another user's processes",
        )
    obeys = "obeys" if webots.streams else "was started without --stream and does not obey"
    return Finding("ok", f"{seen} {obeys} orders from outside")


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
