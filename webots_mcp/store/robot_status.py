"""Decide and word the state of a robot: running, starting, paused, stopped, ended, hanging.

`decide_status` says which it is and why. `find_block` says what keeps a loop from commands.
"""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from typing import Final, NamedTuple

from webots_mcp.contract import (
    HEARTBEAT_INTERVAL_S,
    ISSUED_TIME_TO_LIVE_S,
    UNMOVED,
    host_name,
)
from webots_mcp.database.pause_states import (
    HELD_ELSEWHERE,
    LEFT_PAUSED,
    PAUSED,
    RESUME,
    SEEN_PAUSED,
    SEEN_RUNNING,
    breakpoint_at,
)
from webots_mcp.database.processes import is_stopped
from webots_mcp.store.loop_evidence import (
    change_since_heartbeat,
    find_backlog,
    find_hang,
    find_holder,
    find_stacks,
    handler_at_work,
    is_disconnected,
    is_recent,
    is_sure_to_hang,
    is_unseen,
    moved_wall_time_s,
    seen_by_observer,
    usual_step_s,
)
from webots_mcp.store.relative_times import age_in_words, ago
from webots_mcp.store.robots import robot_name
from webots_mcp.store.run_rows import (
    RunRecord,
    newest_state,
    recent_interval_s,
)
from webots_mcp.store.sessions import SessionRecord, companions, left_holding
from webots_mcp.store.why_ended import unseen_report, why_ended

NEVER_SEEN: Final = "never seen"
RUNNING: Final = "running"
STARTING: Final = "starting"
# These causes are indistinguishable from inside the simulation; `setup.doctor` distinguishes them.
SILENT: Final = (
    "its controller process lives but its loop is silent: paused by hand in Webots, at a "
    "breakpoint, another controller looping, or an extern controller missing; from inside the "
    "simulation these look alike"
)
WAITING_IN_STEP: Final = (
    "its loop waits in step(): paused by hand in Webots or at a breakpoint, another controller "
    "holds the world up, or an extern one is missing; from inside the simulation these look alike"
)
CONNECTION_LOST: Final = (
    "Webots has gone: it has closed its connection to the controller (process {}), which waits for "
    "its answer in step()"
)
_STOPPED_PROCESS: Final = "its controller (process {}) is stopped, by a signal or a debugger"
_HELD_UP_BY: Final = "its loop waits in step(), as the whole world does, for {}: {}"
PRESS_PLAY: Final = (
    "press play in Webots if it is paused there: only a person can resume it while the controller "
    "is inside step(); else check what its loop is waiting for"
)


@dataclass(frozen=True)
class _StatusLimits:
    """How long a loop may take before its state is named.

    Attributes:
        unpublished_s: Wall time without a row after which `publish` counts as forgotten.
        unpublished_intervals: The same, in usual intervals between two rows.
        beginning_s: Time that the first step may take: Webots loads, or compiles shaders.
        slow_steps: Usual steps that one step may last before the world counts as standing.
    """

    unpublished_s: float = 5.0
    unpublished_intervals: float = 10.0
    beginning_s: float = 10.0
    slow_steps: float = 3.0


_LIMITS: Final = _StatusLimits()


class Status(NamedTuple):
    """The state of a robot in words, and the reason where it helps."""

    text: str
    why: str | None = None

    @property
    def is_moving(self) -> bool:
        """Return whether simulation time moves."""
        return self.text == RUNNING


def decide_status(
    connection: sqlite3.Connection,
    session: SessionRecord | None,
    run: RunRecord | None,
    now_s: float,
) -> Status:
    """Decide the state of a robot and word the reason.

    Args:
        connection: An open database.
        session: The robot's latest session.
        run: Its latest run; the pace of its rows decides how soon silence is significant.
        now_s: Unix time.
    """
    if session is None:
        return Status(NEVER_SEEN)
    moved_s = moved_wall_time_s(connection, session, run)
    if not session.is_alive(now_s):
        return _decide_dead(connection, session, moved_s, now_s)
    if holder := find_holder(connection, session, now_s):
        if holder is session:
            return Status(PAUSED, breakpoint_at(connection, session.id))
        return Status(PAUSED, HELD_ELSEWHERE.format(robot_name(connection, holder.robot_id)))
    return _decide_alive(connection, session, run, moved_s, now_s)


def _decide_dead(
    connection: sqlite3.Connection, session: SessionRecord, moved_s: float | None, now_s: float
) -> Status:
    """Return the state of a robot whose controller process has ended, and why it ended."""
    why = why_ended(connection, session)
    if (backlog := find_backlog(connection, session)) is not None:
        moved_s = max(moved_s or 0.0, backlog.newest_wall_time_s)
        left_waiting = (
            "its last rows wait in {} next to the database, until a server that may write there "
            "(not --read-only) takes them in: what is shown here is older"
        )
        why = "; ".join(filter(None, (why, left_waiting.format(backlog.file_name))))
    return _stopped(session, moved_s, now_s, why)


def _decide_alive(
    connection: sqlite3.Connection,
    session: SessionRecord,
    run: RunRecord | None,
    moved_s: float | None,
    now_s: float,
) -> Status:
    """Return the state of a living robot that no bridge pauses: running, hanging or standing."""
    fresh = session.heartbeat_is_fresh(now_s)
    if fresh and change_since_heartbeat(connection, session) == RESUME:
        return Status(RUNNING)
    if not is_unseen(session, moved_s) and (hang := find_hang(connection, session, now_s)):
        is_slow = moved_s is not None and is_recent(connection, run, session.age_s(moved_s, now_s))
        return Status(RUNNING, hang) if is_slow else _stopped(session, moved_s, now_s, hang)
    if not fresh and (backlog := find_backlog(connection, session)) is not None:
        moved_s = max(moved_s or 0.0, backlog.newest_wall_time_s)
        waited = age_in_words(now_s - backlog.oldest_wall_time_s)
        why = (
            f"the database takes no rows: those of its controller wait in {backlog.file_name} "
            f"next to it, for {waited} now (is the disk full, or does another program hold a "
            "lock?); what is shown here is older"
        )
        if is_recent(connection, run, session.age_s(moved_s, now_s)):
            return Status(RUNNING, why)
        return _stopped(session, moved_s, now_s, why)
    started_ago_s = session.age_s(session.started_wall_time_s, now_s)
    if moved_s is None and is_recent(connection, run, started_ago_s):
        return Status(
            STARTING, "its controller has just started; simulation time has not moved yet"
        )
    if moved_s is not None and is_recent(connection, run, session.age_s(moved_s, now_s)):
        return Status(RUNNING, _why_unpublished(connection, session, run))
    return _stopped(session, moved_s, now_s, _why_standing(connection, session, moved_s, now_s))


class BlockedLoop(NamedTuple):
    """Why a robot's loop cannot take commands until a person does something.

    Attributes:
        why: What keeps the loop.
        fix: What to do.
    """

    why: str
    fix: str


def find_block(
    connection: sqlite3.Connection,
    session: SessionRecord | None,
    run: RunRecord | None,
    now_s: float,
) -> BlockedLoop | None:
    """Return what keeps a loop from taking commands; None if it may still take them.

    Only certain knowledge counts. A silent loop may just be slow: it gets as much time as it needed
    before.

    Args:
        connection: An open database.
        session: The robot's latest session.
        run: Its latest run, whose pace shows how long a round usually takes.
        now_s: Unix time.
    """
    if session is None:
        return None
    if not session.is_alive(now_s):
        why = why_ended(connection, session) or "its controller is gone"
        return None if may_return(session, now_s) else BlockedLoop(why, "start its controller")
    holder = find_holder(connection, session, now_s)
    if holder is not None and holder.id != session.id:
        name = robot_name(connection, holder.robot_id)
        return BlockedLoop(HELD_ELSEWHERE.format(name), f"resume or step it there (robot={name!r})")
    if session.host == host_name() and is_stopped(session.pid):
        fix = f"let it go on (kill -CONT {session.pid}, or the debugger)"
        return BlockedLoop(_STOPPED_PROCESS.format(session.pid), fix)
    moved_s = moved_wall_time_s(connection, session, run)
    if session.heartbeat_is_fresh(now_s) or find_backlog(connection, session) is not None:
        return None
    if moved_s is not None and is_recent(connection, run, session.age_s(moved_s, now_s)):
        return None
    if is_disconnected(session):
        fix = f"end process {session.pid}, start Webots, then the controller"
        return BlockedLoop(CONNECTION_LOST.format(session.pid), fix)
    seen = seen_by_observer(connection, session, now_s)
    if seen and seen.startswith(SEEN_PAUSED):
        return BlockedLoop(seen, "webots_simulation_control('resume') resumes it")
    if moved_s is None and session.age_s(session.started_wall_time_s, now_s) <= _LIMITS.beginning_s:
        return None
    return _block_in_code(connection, session, moved_s, now_s)


def _block_in_code(
    connection: sqlite3.Connection, session: SessionRecord, moved_s: float | None, now_s: float
) -> BlockedLoop | None:
    """Return what the stacks of a silent loop show; None if they show a slow round or nothing."""
    stacks = find_stacks(connection, session, now_s)
    if stacks is None:
        return None
    free_it = "mend that line, or end the controller and start it again"
    if stacks.is_in_step:
        for other in companions(connection, session, now_s):
            if (hang := find_hang(connection, other, now_s)) is None:
                continue
            if not is_sure_to_hang(connection, other, now_s):
                return None
            held_up = _HELD_UP_BY.format(robot_name(connection, other.robot_id), hang)
            return BlockedLoop(held_up, free_it)
        if session.silent_s(now_s) < _LIMITS.slow_steps * usual_step_s(connection, session):
            return None
        return BlockedLoop(_why_standing(connection, session, moved_s, now_s), PRESS_PLAY)
    if not stacks.is_hang:
        return BlockedLoop(
            f"its loop waits for a person, in a debugger or for a key or click, in {stacks.place}",
            "let it go on",
        )
    if is_unseen(session, moved_s) or handler_at_work(connection, session, now_s):
        return None
    hang = find_hang(connection, session, now_s)
    return (
        BlockedLoop(hang, free_it) if hang and is_sure_to_hang(connection, session, now_s) else None
    )


def may_return(session: SessionRecord, now_s: float) -> bool:
    """Return whether Webots may restart the controller itself, because the world reloads."""
    ended_s = session.ended_wall_time_s or session.last_seen_wall_time_s
    is_soon = now_s - ended_s < ISSUED_TIME_TO_LIVE_S
    return session.end_reason == "reload" and not session.extern and is_soon


def _why_unpublished(
    connection: sqlite3.Connection, session: SessionRecord, run: RunRecord | None
) -> str | None:
    """Return in words that the loop runs but records no state; None if it records or just began."""
    if run is None or run.session_id != session.id or session.sim_time_s is None:
        return None
    row = newest_state(connection, run.id)
    since_s = run.started_sim_time_s if row is None else row.sim_time_s
    unpublished_s = session.sim_time_s - since_s
    beaten_since_s = session.last_seen_wall_time_s - (
        run.started_wall_time_s if row is None else row.wall_time_s
    )
    if beaten_since_s <= _LIMITS.unpublished_s or unpublished_s <= 0:
        return None
    usual_s = recent_interval_s(connection, run.id) or 0.0
    if beaten_since_s <= _LIMITS.unpublished_intervals * usual_s:
        return None
    return unseen_report(session) or (
        f"its loop runs, but for {unpublished_s:.1f} s of simulation time it recorded no "
        "state: is bridge.publish() still called in the loop?"
    )


def _why_standing(
    connection: sqlite3.Connection, session: SessionRecord, moved_s: float | None, now_s: float
) -> str:
    """Return why simulation time stands still for a living controller that no bridge pauses."""
    if session.host == host_name() and is_stopped(session.pid):
        return _STOPPED_PROCESS.format(session.pid)
    if is_disconnected(session):
        return CONNECTION_LOST.format(session.pid)
    if inside := handler_at_work(connection, session, now_s):
        return inside
    stacks = find_stacks(connection, session, now_s)
    for other in companions(connection, session, now_s) if stacks and stacks.is_in_step else ():
        if hang := find_hang(connection, other, now_s):
            return _HELD_UP_BY.format(robot_name(connection, other.robot_id), hang)
    unseen = is_unseen(session, moved_s)
    seen = seen_by_observer(connection, session, now_s)
    if seen and not (unseen and seen.startswith(SEEN_RUNNING)):
        return seen
    if unseen:
        at = f"; {stacks.limit_s:g} s after it began it was in {stacks.place}" if stacks else ""
        return f"{UNMOVED}{at}"
    if moved_s is None:
        return (
            "its controller has started, but simulation time has not moved since: the "
            "simulation may be paused in Webots, or the controller has not reached its loop"
        )
    # A loop that hangs in a step sent its last heartbeat when it last moved. Only a later heartbeat
    # shows that it is alive.
    beaten_since_s = session.last_seen_wall_time_s - moved_s
    if session.heartbeat_is_fresh(now_s) and beaten_since_s > HEARTBEAT_INTERVAL_S:
        return (
            "its loop is alive but simulation time stands still: paused by the controller's "
            "own code, or it calls step(0) only"
        )
    left = left_holding(connection, session, now_s)
    if left is None:
        return WAITING_IN_STEP if stacks and stacks.is_in_step else SILENT
    return LEFT_PAUSED.format(robot_name(connection, left.robot_id))


def stopped_for(seconds: float) -> str:
    """Return how long ago it stopped: `stopped 42 s ago`, `stopped 3 years ago`."""
    return f"stopped {ago(seconds)}"


def _stopped(
    session: SessionRecord, moved_s: float | None, now_s: float, why: str | None
) -> Status:
    seconds = session.age_s(moved_s or session.started_wall_time_s, now_s)
    if why and why.startswith(UNMOVED):
        return Status(f"not seen moving for {age_in_words(seconds)}", why)
    return Status(stopped_for(seconds), why)
