"""The check whether simulation time advances, and why it does not.

The reason for a status is narrowed down from outside. A loop that is silent inside `step` looks the
same whatever keeps it there. The machine shows more: which controller's process is computing, and
how many robots of the world wait for a controller that a person has to start.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from webots_mcp.contract import UNSEEN, host_name, instance_of
from webots_mcp.database.pause_states import PAUSED, SEEN_PAUSED, SEEN_RUNNING
from webots_mcp.setup.doctor import (
    Diagnosis,
    Examined,
    check,
    last_seen_s,
    ok,
    warning,
    wrong,
)
from webots_mcp.simulator.instances import shown_of
from webots_mcp.simulator.orders import address_of
from webots_mcp.store.recording import RobotView
from webots_mcp.store.robot_status import SILENT, WAITING_IN_STEP
from webots_mcp.store.sessions import SessionRecord, companions

if TYPE_CHECKING:
    from webots_mcp.simulator.instances import Instance


@dataclass(frozen=True)
class WatchLimits:
    """How processes of a simulation are watched.

    Attributes:
        watched_s: Wall time for which they are watched.
        samples: Samples in that time.
        simulations: Simulations that are watched, one after the other.
        named: Controllers that are named.
        busy_share: Share of a processor from which on a process computes: one that waits for its
            next step needs none.
        world_bytes: Size of a world file that is searched for extern robots.
    """

    watched_s: float = 0.3
    samples: int = 6
    simulations: int = 5
    named: int = 5
    busy_share: float = 0.5
    world_bytes: int = 50_000_000


_LIMITS: Final = WatchLimits()


@check("Simulation", needs_recording=True, well="no robot has been recorded yet")
def simulation(subject: Examined) -> Iterator[Diagnosis]:
    """Check whether time moves, and why it does not.

    Of the robots that stand silent in the same simulation one is watched for them all.
    """
    watched = dict[str, RobotView]()
    for view in subject.live or _ran_last(subject.views):
        if view.session is not None and view.robot.live and _is_unclear(view):
            watched.setdefault(view.session.instance, view)
        else:
            yield _judged(view)
    for view in list(watched.values())[: _LIMITS.simulations]:
        yield _narrowed(subject, view)


def _ran_last(views: list[RobotView]) -> list[RobotView]:
    """Return the robots of the newest simulation: one of them may have crashed earlier."""
    newest = max(views, key=last_seen_s, default=None)
    if newest is None or newest.session is None:
        return [] if newest is None else [newest]
    instance = newest.session.instance
    return [each for each in views if each.session and each.session.instance == instance]


def _is_unclear(view: RobotView) -> bool:
    """Return whether only the machine's processes can show which controller blocks the world."""
    return (view.status.why or "").startswith((SILENT, WAITING_IN_STEP, SEEN_RUNNING))


def _judged(view: RobotView) -> Diagnosis:
    name, status = view.robot.name, view.status
    seen = f"{name}: {status.text}{f' ({status.why})' if status.why else ''}"
    see_page = "see 'webots-mcp help troubleshooting simulation'"
    if view.session is None or not view.robot.live:
        if status.why == UNSEEN:
            return warning(seen, see_page)
        if view.session and (view.session.end_reason or "crashed") in ("crashed", "reload"):
            return wrong(seen, "see 'webots-mcp logs --level error', mend the controller and start "
                         "it again")  # fmt: skip
        return ok(seen)
    hangs = f"mend that line; else {see_page}" if "silent for " in (status.why or "") else None
    if status.is_moving:
        return Diagnosis("warning" if status.why else "ok", seen, hangs)
    if status.text == PAUSED:
        return warning(seen, f"webots-mcp resume --robot {name}")
    if (status.why or "").startswith(SEEN_PAUSED):
        return warning(seen, "webots_simulation_control('resume'), or press play")
    return wrong(seen, hangs or see_page)


def _narrowed(subject: Examined, view: RobotView) -> Diagnosis:
    """Return which of the reasons that are indistinguishable from inside shows from outside."""
    session = view.session
    assert session is not None
    head, why = f"{view.robot.name}: {view.status.text}", view.status.why or ""
    webots = _webots_of(subject, session)
    reload, play = (
        _also_by_websocket(fix, order, webots)
        for fix, order in (
            (
                "end or mend that controller, then reload the world (Ctrl+Shift+R in Webots)",
                "reload",
            ),
            ("press play in Webots", "resume"),
        )
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
    return _paused_by_hand(head, others, play, reload)


def _paused_by_hand(head: str, others: _Others, play: str, reload: str) -> Diagnosis:
    """Say how likely it is that a person paused the simulation, since no controller computes."""
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
    """Return what a person can do, and what a client can if Webots was started with --stream."""
    is_open = webots is not None and webots.streams and webots.is_listening
    if not is_open:
        return fix
    return f"{fix}; or webots_simulation_control('{order}'): this Webots obeys it by its WebSocket"


def _webots_of(subject: Examined, session: SessionRecord) -> Instance | None:
    """Return the Webots that a session belongs to, where it runs here."""
    address = address_of(session.instance)
    return next((w for w in subject.running_webots if address and w.port == address.port), None)


class _Others(NamedTuple):
    """The other controllers of a simulation that run on this machine.

    Attributes:
        pids: Their processes, and what these have started.
        silent: Of them, the controllers that record nothing.
        is_all: Whether the ones that record nothing were searched as well.
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
    """Return the processes that have that simulator in their environment, each with its parent's.

    So have controllers that a simulator starts and extern ones, and what these start themselves.
    """
    import psutil

    found: dict[int, int] = {}
    own = {os.getpid(), *(each.pid for each in psutil.Process().parents())}
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):  # another user's, or one that has just ended
            environment, parent = process.environ(), process.ppid()
            is_controller = not environment.keys().isdisjoint(
                ("WEBOTS_CONTROLLER_URL", "WEBOTS_INSTANCE_PATH")
            )
            if is_controller and instance_of(environment, parent) == instance:
                found[process.pid] = parent
    return {pid: parent for pid, parent in found.items() if pid not in own}


def _listed(pids: list[int]) -> str:
    more = f" and {len(pids) - _LIMITS.named} more" if len(pids) > _LIMITS.named else ""
    return ", ".join(map(_named, pids[: _LIMITS.named])) + more


def _named(pid: int) -> str:
    """Return a controller by its robot, its program and its process."""
    robot = shown_of(pid, lambda process: process.environ().get("WEBOTS_ROBOT_NAME"), None)
    return f"{f'{robot}: ' if robot else ''}{_program_of(pid)} (process {pid})"


def _computing(pids: set[int]) -> list[int]:
    """Return those of the processes that compute now.

    One that waits for its next step needs no processor. One that computes wants to continue at each
    look, also where a busy machine gives it little; only Linux shows that.
    """
    before_s = {pid: _processor_s(pid) for pid in sorted(pids)}
    waited = set[int]()
    for _ in range(_LIMITS.samples):
        time.sleep(_LIMITS.watched_s / _LIMITS.samples)
        waited |= {pid for pid in pids if not _wants_processor(pid)}
    return [
        pid
        for pid, used_s in before_s.items()
        if pid not in waited or _processor_s(pid) - used_s > _LIMITS.busy_share * _LIMITS.watched_s
    ]


def _wants_processor(pid: int) -> bool:
    is_linux = sys.platform == "linux"
    return is_linux and shown_of(pid, lambda process: process.status(), "") == "running"


def _processor_s(pid: int) -> float:
    return shown_of(pid, lambda process: sum(process.cpu_times()[:2]), 0.0)


def _program_of(pid: int) -> str:
    """Return what it runs: the file of a Python controller, else the program."""
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
        if world is not None and world.stat().st_size <= _LIMITS.world_bytes:
            text = world.read_text("utf-8", "replace")
            count = len(re.findall(r'^\s*controller\s+"<extern>"', text, re.MULTILINE))
    alive = [session, *companions(view.connection, session, view.now_s)]
    here = sum(each.extern for each in alive)
    if world is None or count <= here:
        return None
    return (
        f"{count} robots of {world.name} have the controller <extern> and {here} record "
        "here: one that has not been started stops the whole simulation"
    )
