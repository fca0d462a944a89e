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
from http import HTTPStatus
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast
from urllib.error import HTTPError
from urllib.request import urlopen

from webots_mcp.contract import UNSEEN, VERSION, host_name, instance_of
from webots_mcp.database.pauses import PAUSED, SEEN_PAUSED, SEEN_RUNNING
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
    last_seen_s,
    ok,
    unclear,
    warning,
    wrong,
)
from webots_mcp.setup.wsl import WAY_OUT, ask_windows, in_wsl, is_wsl, on_windows
from webots_mcp.simulator.instances import find_webots, installations, shown_of
from webots_mcp.simulator.orders import address_of
from webots_mcp.store.recording import RobotView
from webots_mcp.store.robots import SILENT, WAITING_IN_STEP, SessionRecord, companions

if TYPE_CHECKING:
    from typing import TextIO

    from webots_mcp.simulator.instances import Instance

_ANSWER_S: Final = 3  # for a server that runs to answer
_WATCHED_S: Final = 0.3
_LOOKS: Final = 6
_MOST_WATCHED: Final = 5  # simulations, one after the other
_MOST_NAMED: Final = 5  # controllers
_BUSY: Final = 0.5  # of a processor; a controller that waits for its next step needs none
_EXTERN: Final = re.compile(r'^\s*controller\s+"<extern>"', re.MULTILINE)
_OF_CONTROLLERS: Final = ("WEBOTS_CONTROLLER_URL", "WEBOTS_INSTANCE_PATH")
_LARGEST_WORLD_BYTES: Final = 50_000_000
_ENDED_BADLY: Final = ("crashed", "reload")
_SEE_PAGE: Final = "see docs/troubleshooting.md#simulation"
_MEND_LINE: Final = f"mend that line; else {_SEE_PAGE}"
_PRESS_PLAY: Final = "press play in Webots"
_RELOAD: Final = "end or mend that controller, then reload the world (Ctrl+Shift+R in Webots)"
_PLACES: Final = ("--data-dir", "--database")
_INIT: Final = "run 'webots-mcp init' in the project"
_OBEYS: Final = "{}; or webots_simulation_control('{}'): this Webots obeys it by its WebSocket"
_TIMEOUT_S: Final = 30.0
_SHOWN_CHARACTERS: Final = 300
_FIX: Final = (
    "run the same command in a shell, see what it prints, and install webots-mcp again where a "
    "package is missing or broken"
)


@check("Simulation", needs_recording=True, well="no robot has been recorded yet")
def simulation(subject: Examined) -> Iterator[Diagnosis]:
    """Whether time moves, and why it does not.

    Of the robots that stand silent in the same simulation one is watched for them all.
    """
    watched = dict[str, RobotView]()
    for view in subject.live or _ran_last(subject.views):
        if view.session is not None and view.robot.live and _is_unclear(view):
            watched.setdefault(view.session.instance, view)
        else:
            yield _judged(view)
    for view in list(watched.values())[:_MOST_WATCHED]:
        yield _narrowed(subject, view)


def _ran_last(views: list[RobotView]) -> list[RobotView]:
    """The robots of the simulation that was seen last: one of them may have crashed before."""
    newest = max(views, key=last_seen_s, default=None)
    if newest is None or newest.session is None:
        return [] if newest is None else [newest]
    instance = newest.session.instance
    return [each for each in views if each.session and each.session.instance == instance]


def _is_unclear(view: RobotView) -> bool:
    """Whether only the machine's processes can show which controller blocks the world."""
    return (view.status.why or "").startswith((SILENT, WAITING_IN_STEP, SEEN_RUNNING))


def _judged(view: RobotView) -> Diagnosis:
    name, status = view.robot.name, view.status
    seen = f"{name}: {status.text}{f' ({status.why})' if status.why else ''}"
    if view.session is None or not view.robot.live:
        if status.why == UNSEEN:
            return warning(seen, _SEE_PAGE)
        if view.session and (view.session.end_reason or "crashed") in _ENDED_BADLY:
            return wrong(seen, "see 'webots-mcp logs --level error', mend the controller and start "
                         "it again")  # fmt: skip
        return ok(seen)
    hangs = _MEND_LINE if "silent for " in (status.why or "") else None
    if status.is_moving:
        return Diagnosis("warning" if status.why else "ok", seen, hangs)
    if status.text == PAUSED:
        return warning(seen, f"webots-mcp resume --robot {name}")
    if (status.why or "").startswith(SEEN_PAUSED):
        return warning(seen, "webots_simulation_control('resume'), or press play")
    return wrong(seen, hangs or _SEE_PAGE)


def _narrowed(subject: Examined, view: RobotView) -> Diagnosis:
    """Of the reasons that look alike from inside, the one that shows from outside."""
    session = view.session
    assert session is not None
    head, why = f"{view.robot.name}: {view.status.text}", view.status.why or ""
    webots = _webots_of(subject, session)
    reload, play = (
        _also_by_websocket(fix, order, webots)
        for fix, order in ((_RELOAD, "reload"), (_PRESS_PLAY, "resume"))
    )
    others = None if session.host != host_name() else _controllers_beside(view, session, webots)
    busy = None if others is None else _computing({session.pid, *others.pids})
    if busy is not None and session.pid in busy:
        seen = f"{head}; its own process computes: its loop does not come back to step()"
        return wrong(seen, "look for a long computation or an endless loop in it")
    if busy:
        named = _listed(busy)
        return wrong(f"{head}; another controller computes and holds the step up: {named}", reload)
    if missing := _missing_externs(view, session, webots):
        fix = "start it: 'webots-controller --robot-name=NAME FILE', or press play if it is paused"
        return wrong(f"{head}; {missing}", fix)
    if why.startswith(SEEN_RUNNING):
        return wrong(f"{head} ({why})", reload)
    if others is None:
        return wrong(f"{head} ({why})", play)
    if others.silent:
        named = _listed(others.silent)
        seen = (
            f"{head}; no controller computes, but {named} records nothing: whether it waits in "
            "step() is not known. If it does, the simulation was paused by hand"
        )
        return wrong(seen, f"{play}; if that does not help, {reload}")
    if not others.is_all:
        seen = (
            f"{head}; no controller that records computes. Others of this simulation were not "
            "looked at, since its simulator is not seen on this machine. If none of them hangs, it "
            "was paused by hand in Webots"
        )
        return wrong(seen, play)
    seen = (
        f"{head}; no controller computes and none is known to be missing: most likely it was "
        "paused by hand in Webots"
    )
    return wrong(seen, play)


def _also_by_websocket(fix: str, order: str, webots: Instance | None) -> str:
    """What a person can do, and what a client can where Webots was started with `--stream`."""
    is_open = webots is not None and webots.streams and webots.is_listening
    return _OBEYS.format(fix, order) if is_open else fix


def _webots_of(subject: Examined, session: SessionRecord) -> Instance | None:
    """The Webots that a session belongs to, where it runs here."""
    address = address_of(session.instance)
    return next((w for w in subject.running_webots if address and w.port == address.port), None)


class _Others(NamedTuple):
    """The other controllers of a simulation that run on this machine.

    Attributes:
        pids: Their processes, and what these have started.
        silent: Of them, the controllers that record nothing.
        is_all: Those that record nothing were looked for as well.
    """

    pids: set[int]
    silent: list[int]
    is_all: bool


def _controllers_beside(
    view: RobotView, session: SessionRecord, webots: Instance | None
) -> _Others:
    recorded = {each.pid for each in companions(view.connection, session, view.now_s)}
    started = _started_for(session.instance)
    pids = recorded | started.keys()
    if webots is not None:  # the processes that it has started
        pids |= {each.pid for each in shown_of(webots.pid, lambda p: p.children(True), [])}
    recording = {session.pid, *recorded}
    silent = [pid for pid, parent in started.items() if not {pid, parent} & recording]
    silent = [pid for pid in silent if started[pid] not in silent]
    is_all = webots is not None or session.pid in started
    return _Others(pids - {session.pid}, silent, is_all)


def _started_for(instance: str) -> dict[int, int]:
    """The processes that have that simulator in their environment, each with its parent's.

    So have controllers that a simulator starts and extern ones, and what these start themselves.
    """
    import psutil

    found: dict[int, int] = {}
    own = {os.getpid(), *(each.pid for each in psutil.Process().parents())}
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):  # another user's, or one that has just ended
            environment, parent = process.environ(), process.ppid()
            is_controller = not environment.keys().isdisjoint(_OF_CONTROLLERS)
            if is_controller and instance_of(environment, parent) == instance:
                found[process.pid] = parent
    return {pid: parent for pid, parent in found.items() if pid not in own}


def _listed(pids: list[int]) -> str:
    more = f" and {len(pids) - _MOST_NAMED} more" if len(pids) > _MOST_NAMED else ""
    return ", ".join(map(_named, pids[:_MOST_NAMED])) + more


def _named(pid: int) -> str:
    """A controller by its robot, its program and its process."""
    robot = shown_of(pid, lambda process: process.environ().get("WEBOTS_ROBOT_NAME"), None)
    return f"{f'{robot}: ' if robot else ''}{_program_of(pid)} (process {pid})"


def _computing(pids: set[int]) -> list[int]:
    """Those of the processes that compute now.

    One that waits for its next step needs no processor. One that computes wants to continue at each
    look, also where a busy machine gives it little; only Linux shows that.
    """
    before_s = {pid: _processor_s(pid) for pid in sorted(pids)}
    waited = set[int]()
    for _ in range(_LOOKS):
        time.sleep(_WATCHED_S / _LOOKS)
        waited |= {pid for pid in pids if not _wants_processor(pid)}
    return [
        pid
        for pid, used_s in before_s.items()
        if pid not in waited or _processor_s(pid) - used_s > _BUSY * _WATCHED_S
    ]


def _wants_processor(pid: int) -> bool:
    is_linux = sys.platform == "linux"
    return is_linux and shown_of(pid, lambda process: process.status(), "") == "running"


def _processor_s(pid: int) -> float:
    return shown_of(pid, lambda process: sum(process.cpu_times()[:2]), 0.0)


def _program_of(pid: int) -> str:
    """What it runs: the file of a Python controller, else the program."""
    words = shown_of(pid, lambda process: process.cmdline(), list[str]())
    file = next((word for word in words[1:] if word.endswith(".py")), None)
    return Path(file).name if file else shown_of(pid, lambda p: p.name(), "a controller")


def _missing_externs(
    view: RobotView, session: SessionRecord, webots: Instance | None
) -> str | None:
    """That the world has more extern robots than record; by its text, so only perhaps."""
    named = (view.run and view.run.world) or (webots and webots.world)
    world = Path(named) if named else None
    count = 0
    with suppress(OSError):
        if world is not None and world.stat().st_size <= _LARGEST_WORLD_BYTES:
            count = len(_EXTERN.findall(world.read_text("utf-8", "replace")))
    alive = [session, *companions(view.connection, session, view.now_s)]
    here = sum(each.extern for each in alive)
    if world is None or count <= here:
        return None
    return (
        f"{count} robots of {world.name} have the controller <extern> and {here} record "
        "here: one that has not been started stops the whole simulation"
    )


@check("Webots")
def installed(_: Examined) -> Iterator[Diagnosis]:
    """Which Webots there are."""
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
    """Which of them run, and whether they can be steered from outside."""
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
    """What there is in WSL and what on Windows, and whether they meet."""
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
    """Each file that is there, and whether its server can start on this recording."""
    known = [*clients_of(subject.project), claude_desktop()]
    findings = [each for client in known for each in _servers_of(subject, client)]
    yield from findings
    if not findings:
        names = ", ".join(client.name for client in known)
        seen = f"no file of {names} for {subject.project} names webots-mcp"
        yield warning(seen, f"{_INIT}; other clients have files of their own")


def _servers_of(subject: Examined, client: Client) -> Iterator[Diagnosis]:
    """What a file says of our server: nothing where it names only others."""
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
    """Whether a server asks for the token there; it is not sent, as anybody may have written it."""
    try:
        with urlopen(url, timeout=_ANSWER_S) as answer:
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
    """The recording that the arguments name, if it is another one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    for option, value in pairwise(words):
        if option in _PLACES and "$" not in value:
            ours = subject.recording.data_dir if option == "--data-dir" else subject.file
            meant = subject.project / (in_wsl(value) if is_wsl() else value)
            same = ours is not None and meant.resolve() == ours.resolve()
            return None if same else value
    return None


@check("Server", starts_process=True)
def server(subject: Examined) -> Iterator[Diagnosis]:
    """Whether a server starts, names its tools and answers."""
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
            last = f"; it wrote: {wrote[-1][:_SHOWN_CHARACTERS]}" if wrote else ""
            yield wrong(f"'{' '.join(line)}' did not answer: {_why(error)}{last}", _FIX)
            return
    started = f"started over stdio, {tools} tools that only read"  # by --read-only
    if refused:
        seen = f"{started}, and answers: {refused[:_SHOWN_CHARACTERS]}"
        yield warning(seen, "mend the recording: see Database and Schema")
    else:
        yield ok(f"{started}, one answer, {time.monotonic() - started_s:.1f} s in all")


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
