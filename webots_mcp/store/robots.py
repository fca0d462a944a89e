"""Which robots were ever seen, which one is meant, their sessions, and whether their time moves."""

from __future__ import annotations

import contextlib
import difflib
import json
import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import (
    BUILT_IN_ACTIONS,
    CUSTOM_DATA,
    ENDED_BY,
    HEARTBEAT_INTERVAL_S,
    HEARTBEAT_LATE_S,
    ISSUED_TIME_TO_LIVE_S,
    MODE_EVENT,
    OBSERVER,
    UNMOVED,
    UNSEEN,
    WORLD_EVENT,
    host_name,
    recorded_name,
)
from webots_mcp.database.dead_sessions import EXTERN
from webots_mcp.database.pauses import (
    HELD_ELSEWHERE,
    LEFT_PAUSED,
    PAUSE,
    PAUSED,
    RESUME,
    SEEN_PAUSED,
    SEEN_PAUSED_BY,
    SEEN_RUNNING,
    SEEN_RUNNING_BY,
    breakpoint_at,
    change_since,
)
from webots_mcp.database.processes import (
    has_lost_simulator,
    is_living,
    is_stopped,
    process_alive,
    signal_process,
)
from webots_mcp.database.stacks import LOGGER, SIGNAL, Stacks, needs_signal, stacks_at, stacks_path
from webots_mcp.database.waiting_file import (
    WaitingEntry,
    count_rows,
    next_entries,
    read_header,
    waiting_path,
)
from webots_mcp.errors import AmbiguousRobotError, NothingRecordedError, UnknownRobotError
from webots_mcp.signals.naming import SOLIDS, WORLD
from webots_mcp.store.run_rows import (
    RunRecord,
    columns_of,
    newest_state,
    recent_interval_s,
    state_at,
)

# Of the newest Webots, unless a controller has begun to record since. What a controller printed
# comes first: its traceback ends with the reason, and Webots itself only says that it exited.
_CONSOLE_TROUBLE: Final = (
    "WITH trouble AS (SELECT id, instance, source, message FROM console_line WHERE level IN "
    "('warning', 'error', 'critical') AND wall_time_s > "
    "(SELECT coalesce(max(started_wall_time_s), 0) FROM session)) "
    "SELECT substr(message, 1, 200) FROM trouble WHERE id IN (SELECT max(id) FROM trouble WHERE "
    "instance = (SELECT instance FROM trouble ORDER BY id DESC LIMIT 1) GROUP BY source) "
    "ORDER BY source = 'console' DESC, id"
)
_ALL: Final = (
    "SELECT id, name, kind, devices, first_seen_wall_time_s, last_seen_wall_time_s "
    "FROM robot ORDER BY id"
)
_KIND: Final = "SELECT kind FROM robot WHERE id = ?"
_NAME: Final = "SELECT name FROM robot WHERE id = ?"
_SHOWN_NAMES: Final = 20
_BESIDE: Final = (
    "SELECT r.id, b.name FROM session s JOIN robot b ON b.id = s.robot_id "
    "JOIN run r ON r.session_id = s.id JOIN session me ON me.id = :session "
    f"WHERE b.kind = '{OBSERVER}' AND s.instance = me.instance "
    "AND r.started_wall_time_s <= :last AND r.last_wall_time_s >= :first "
    "ORDER BY r.id DESC LIMIT 1"
)
_SEEN: Final = (
    "SELECT data FROM event WHERE run_id IN (SELECT id FROM run WHERE session_id = "
    f"(SELECT session_id FROM run WHERE id = ?)) AND kind = '{WORLD_EVENT}' AND run_id <= ? "
    "ORDER BY id DESC LIMIT 1"
)
NEVER_SEEN: Final = "never seen"
RUNNING: Final = "running"
STARTING: Final = "starting"
_CLAIMED: Final = (
    "SELECT id, action, coalesce(claimed_wall_time_s, created_wall_time_s) FROM command "
    "WHERE robot_id = ? AND session_id = ? "
    "AND status = 'claimed' ORDER BY id DESC"
)
_STILL_MOVING_S: Final = 1.0
_WRITING_S: Final = 0.1  # after a signal
_SLOWEST_STILL_MOVING_S: Final = 15.0
_UNPUBLISHED_S: Final = 5.0  # of wall time without a row
_UNPUBLISHED_INTERVALS: Final = 10.0  # of the usual time between two rows
_UNPUBLISHED: Final = (
    "its loop runs, but for {:.1f} s of simulation time it recorded no state: is bridge.publish() "
    "still called in the loop?"
)
_ENDED: Final = {
    "finished": "its controller finished",
    "reload": "the world was reloaded and no new controller session has appeared yet",
    "crashed": "its controller process is gone without having finished (killed or crashed)",
    "superseded": "a newer session took its place",
}
_ENDED_BY: Final = (
    "SELECT message FROM log WHERE run_id = (SELECT max(id) FROM run WHERE session_id = ?) "
    "AND level = 'error' AND source = 'controller' AND message GLOB ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_HUNG: Final = (
    "SELECT message FROM log WHERE run_id = (SELECT max(id) FROM run WHERE session_id = ?) "
    f"AND logger = '{LOGGER}' AND wall_time_s > ? ORDER BY id DESC LIMIT 1"
)
_MOST_ERROR_CHARACTERS: Final = 300
_READ_NO_MORE: Final = (
    "it was recorded by the observer from its customData: the observer ended, or the robot is gone"
)
_RELOADED_EXTERN: Final = f"the world was reloaded, which ended its controller; {EXTERN}"
# From inside these look alike; `diagnosis.webots_checks` looks at it from outside.
SILENT: Final = (
    "its controller process lives but its loop is silent: paused by hand in Webots, at a "
    "breakpoint, another controller looping, or an extern controller missing; from inside the "
    "simulation these look alike"
)
_WAITING: Final = (
    "the database takes no rows: those of its controller wait in {0} next to it, for {1:.0f} s now "
    "(is the disk full, or does another program hold a lock?); what is shown here is older"
)
_LEFT_WAITING: Final = (
    "its last rows wait in {} next to the database, until a server that may write there (not "
    "--read-only) takes them in: what is shown here is older"
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
_AWAITS_PERSON: Final = "its loop waits for a person, in a debugger or for a key or click, in {}"
_HELD_UP_BY: Final = "its loop waits in step(), as the whole world does, for {}: {}"
_STARTED: Final = "its controller has just started; simulation time has not moved yet"
_NOT_STARTED: Final = (
    "its controller has started, but simulation time has not moved since: the simulation may be "
    "paused in Webots, or the controller has not reached its loop"
)
_SEEN_MODE: Final = (
    "SELECT json_extract(data, '$.mode') FROM event WHERE run_id IN "
    f"(SELECT id FROM run WHERE session_id = ?) AND kind = '{MODE_EVENT}' ORDER BY id DESC LIMIT 1"
)
_STANDING: Final = (
    "its loop is alive but simulation time stands still: paused by the controller's own code, or "
    "it calls step(0) only"
)
_BEGINNING_S: Final = 10.0  # in which a first step may take long: Webots loads, or compiles shaders
_SURE_OF_HANG: Final = 2.0  # limits of the bridge, or of the silences from which it came back
_MOST_SILENCES: Final = 20
_SILENCES: Final = (
    "SELECT l.wall_time_s, (SELECT s.wall_time_s FROM state s WHERE s.run_id = l.run_id "
    "AND s.sim_time_s >= l.sim_time_s AND s.wall_time_s > l.wall_time_s "
    "ORDER BY s.sim_time_s, s.id LIMIT 1) FROM log l "
    "WHERE l.run_id IN (SELECT id FROM run WHERE session_id = ?) "
    f"AND l.logger = '{LOGGER}' ORDER BY l.id DESC LIMIT {_MOST_SILENCES}"
)
_SLOW_STEPS: Final = 3.0  # usual steps that one may last before the world counts as standing
_USUAL_STEP: Final = (
    "SELECT sum(step_wait_wall_s) / nullif(sum(steps), 0) FROM run WHERE session_id = ?"
)
PRESS_PLAY: Final = (
    "press play in Webots if it is paused there: only a person can resume it while the controller "
    "is inside step(); else check what its loop is waiting for"
)
_RESUME_BY: Final = "webots_simulation_control('resume') resumes it"
_FREE_IT: Final = "mend that line, or end the controller and start it again"

# Controller processes: who they are, and whether they still live.


@dataclass(frozen=True)
class SessionRecord:
    """One controller process; the row is its bridge's heartbeat. Columns as in `store.models`."""

    id: int
    robot_id: int
    pid: int
    process: str | None
    host: str
    instance: str
    extern: bool
    controller: str | None
    controller_sha256: str | None
    git_commit: str | None
    versions: dict[str, Any]
    supervisor: bool
    actions: dict[str, Any]
    started_wall_time_s: float
    last_seen_wall_time_s: float
    last_seen_monotonic_s: float | None
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    sim_time_s: float | None
    pause_state: str | None
    rows_waiting: int
    rows_dropped: int
    last_error: str | None
    ended_wall_time_s: float | None
    end_reason: str | None

    @property
    def has_bridge(self) -> bool:
        """Whether it takes commands; what was read from a journal or from customData does not."""
        return not self.versions or "webots_mcp" in self.versions

    def is_alive(self, now_s: float) -> bool:
        """Whether it has not ended, and its process still runs."""
        process = (self.host, self.pid, self.process, self.last_seen_wall_time_s)
        return self.ended_wall_time_s is None and is_living(*process, now_s)

    def silent_s(self, now_s: float) -> float:
        """Time since its newest sign of life; of a process here by a clock that cannot be set."""
        beat_s = self.last_seen_monotonic_s
        if beat_s is None or self.process is None or not self._is_of_this_boot():
            return now_s - self.last_seen_wall_time_s
        return time.monotonic() - beat_s  # the wall clock may have been set meanwhile

    def age_s(self, wall_time_s: float, now_s: float) -> float:
        """How long ago that was, which its bridge stamped for its newest sign of life."""
        return self.silent_s(now_s) + self.last_seen_wall_time_s - wall_time_s

    def heartbeat_is_fresh(self, now_s: float) -> bool:
        """Whether its loop gave a sign of life lately."""
        return self.silent_s(now_s) <= HEARTBEAT_LATE_S

    def _is_of_this_boot(self) -> bool:
        """A clock that counts from the boot knows nothing of the time before it."""
        process = (self.pid, self.process, self.last_seen_wall_time_s)
        return self.host == host_name() and process_alive(*process)


_COLUMNS: Final = columns_of(SessionRecord)
_NEWEST: Final = f"SELECT {_COLUMNS} FROM session WHERE robot_id = ? ORDER BY id DESC LIMIT 1"
_BY_ID: Final = f"SELECT {_COLUMNS} FROM session WHERE id = ?"
_COMPANIONS: Final = (
    f"SELECT {_COLUMNS} FROM session WHERE instance = :instance "
    "AND id <> :id AND ended_wall_time_s IS NULL ORDER BY id"
)
_LEFT_HOLDING: Final = (
    f"SELECT {_COLUMNS} FROM session WHERE instance = :instance AND pause_state = '{PAUSED}' "
    "AND last_seen_wall_time_s >= :started AND id = (SELECT max(id) FROM session n "
    "WHERE n.robot_id = session.robot_id) ORDER BY id DESC LIMIT 1"
)


def newest_session(connection: sqlite3.Connection, robot_id: int) -> SessionRecord | None:
    """The robot's latest controller process, alive or not."""
    return _session(connection.execute(_NEWEST, (robot_id,)).fetchone())


def fetch_session(connection: sqlite3.Connection, session_id: int) -> SessionRecord | None:
    """The session of that id."""
    return _session(connection.execute(_BY_ID, (session_id,)).fetchone())


def companions(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> list[SessionRecord]:
    """The other living sessions in the same simulation."""
    values = {"instance": session.instance, "id": session.id}
    rows = connection.execute(_COMPANIONS, values).fetchall()
    return [found for row in rows if (found := _session(row)) and found.is_alive(now_s)]


def left_holding(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> SessionRecord | None:
    """The newest session in the same simulation, if it is gone and held its loop to the end."""
    values = {"instance": session.instance, "started": session.started_wall_time_s}
    found = _session(connection.execute(_LEFT_HOLDING, values).fetchone())
    return found if found is not None and not found.is_alive(now_s) else None


def _session(row: tuple[Any, ...] | None) -> SessionRecord | None:
    if row is None:
        return None
    values = dict(zip(_COLUMNS.split(", "), row, strict=True))
    values["versions"] = json.loads(values["versions"] or "{}")
    values["actions"] = json.loads(values["actions"] or "{}")
    values["supervisor"] = bool(values["supervisor"])
    values["extern"] = bool(values["extern"])
    return SessionRecord(**values)


@dataclass(frozen=True)
class RobotRecord:
    """A robot name that was ever seen, with its latest session."""

    id: int
    name: str
    kind: str
    devices: dict[str, str]
    first_seen_wall_time_s: float
    last_seen_wall_time_s: float
    session: SessionRecord | None
    live: bool


@dataclass(frozen=True)
class WorldSeen:
    """What an observer has seen of a world.

    Attributes:
        observer: Its name.
        content: What there is: title, robots, solids.
        places: Where each is, by the word that it has in signals; its newest of the run.
    """

    observer: str
    content: dict[str, Any]
    places: dict[str, dict[str, float | None]]


def list_robots(connection: sqlite3.Connection, now_s: float) -> list[RobotRecord]:
    """Every robot ever seen, in the order in which they first appeared."""
    return [_robot(connection, row, now_s) for row in connection.execute(_ALL).fetchall()]


def robot_name(connection: sqlite3.Connection, robot_id: int) -> str:
    """The name of the robot of that id.

    Raises:
        NothingRecordedError: Its row is not there, or cannot be read.
    """
    row = connection.execute(_NAME, (robot_id,)).fetchone()
    if row is None:
        raise NothingRecordedError(f"robot {robot_id} has no row that can be read")
    return row[0]


def nothing_recorded(connection: sqlite3.Connection) -> str:
    """Return that no robot was ever seen, with what Webots' console says about it."""
    text = "no robot has been recorded in this database yet"
    trouble = console_trouble(connection)
    return f"{text}. {trouble}" if trouble else text


def console_trouble(connection: sqlite3.Connection) -> str | None:
    """Return the newest warnings of Webots' console that belong to no run; None without any.

    A controller that fails before its bridge exists leaves nothing else. What was said before the
    newest session began is left out: a controller has recorded since.
    """
    said = [repr(message) for (message,) in connection.execute(_CONSOLE_TROUBLE).fetchall()]
    if not said:
        return None
    return (
        f"Webots' console says {' and '.join(said)}: a controller may have failed before it "
        "recorded anything. webots_get_logs shows the console"
    )


def resolve_robot(connection: sqlite3.Connection, name: str | None, now_s: float) -> RobotRecord:
    """The robot of that name; without a name the only live one, else the only one ever seen.

    An observer is meant without a name only where there is no other robot.

    Raises:
        NothingRecordedError: No robot was ever seen.
        UnknownRobotError: None has that name; the text offers near ones.
        AmbiguousRobotError: No name was given and several are possible; the text lists them.
    """
    robots = list_robots(connection, now_s)
    if not robots:
        raise NothingRecordedError(nothing_recorded(connection))
    if name is not None:
        return _named(robots, name)
    live = [robot for robot in robots if robot.live]
    candidates = without_observers(live or robots)
    if len(candidates) == 1:
        return candidates[0]
    state = "are live" if live else "were recorded and none is live"
    start = "" if live else "start the simulation, or for what was recorded "
    raise AmbiguousRobotError(
        f"{len(candidates)} robots {state}: {_listed(candidates)}; "
        f"{start}say which one with robot=..."
    )


def without_observers(robots: list[RobotRecord]) -> list[RobotRecord]:
    """Those that do something; the observers where there are no others."""
    return [robot for robot in robots if robot.kind != OBSERVER] or robots


def _named(robots: list[RobotRecord], name: str) -> RobotRecord:
    for robot in robots:
        if robot.name in (name, recorded_name(name)):
            return robot
    near = difflib.get_close_matches(name, [robot.name for robot in robots], n=3, cutoff=0.5)
    offer = f"did you mean {' or '.join(map(repr, near))}?" if near else "they are"
    raise UnknownRobotError(f"no robot named {name!r} was recorded; {offer} {_listed(robots)}")


def _listed(robots: list[RobotRecord]) -> str:
    shown = [_described(robot) for robot in robots[:_SHOWN_NAMES]]
    more = len(robots) - len(shown)
    return ", ".join(shown) + (f" and {more} more (webots_list_robots)" if more else "")


def _described(robot: RobotRecord) -> str:
    return f"{robot.name!r} ({robot.kind}, {'live' if robot.live else 'not live'})"


def _robot(
    connection: sqlite3.Connection,
    row: tuple[int, str, str, str | None, float, float],
    now_s: float,
) -> RobotRecord:
    robot_id, name, kind, devices, first_seen_s, last_seen_s = row
    session = newest_session(connection, robot_id)
    live = session is not None and session.is_alive(now_s)
    known = json.loads(devices or "{}")
    return RobotRecord(robot_id, name, kind, known, first_seen_s, last_seen_s, session, live)


def live_observer(
    connection: sqlite3.Connection, session: SessionRecord | None, now_s: float
) -> RobotRecord | None:
    """The observer of a session's simulation; without a session the only one that lives."""
    robots = [robot for robot in list_robots(connection, now_s) if robot.live]
    found = [robot for robot in robots if robot.kind == OBSERVER and robot.session is not None]
    if session is not None:
        here = session.instance
        found = [each for each in found if each.session and each.session.instance == here]
    return found[0] if len(found) == 1 or (found and session is not None) else None


def world_seen(connection: sqlite3.Connection, run: RunRecord) -> WorldSeen | None:
    """What an observer saw while that run lasted, last of all; None where none was there."""
    values = {
        "session": run.session_id,
        "first": run.started_wall_time_s,
        "last": run.last_wall_time_s,
    }
    row = connection.execute(_BESIDE, values).fetchone()
    if row is None:
        return None
    run_id, observer = row
    found = connection.execute(_SEEN, (run_id, run_id)).fetchone()
    if found is None:
        return None
    return WorldSeen(observer, json.loads(found[0]), _places(connection, run_id, run))


def _places(connection: sqlite3.Connection, run_id: int, run: RunRecord) -> dict[str, Any]:
    until_s = run.last_sim_time_s if run.ended_wall_time_s is not None else float("inf")
    state = state_at(connection, run_id, until_s)
    seen = state.value() if state else {}
    return {**seen.get(WORLD, {}), **seen.get(SOLIDS, {})}


# Whether a robot's time is moving, judged from its session row, its process and its companions.


class Status(NamedTuple):
    """What to say about a robot, and why where that helps."""

    text: str
    why: str | None = None

    @property
    def is_moving(self) -> bool:
        """Whether simulation time is going on."""
        return self.text == RUNNING


def judge(
    connection: sqlite3.Connection,
    session: SessionRecord | None,
    run: RunRecord | None,
    now_s: float,
) -> Status:
    """Say whether the robot's time is moving now.

    Args:
        connection: An open database.
        session: The robot's latest session.
        run: Its latest run; the pace of its rows decides how soon silence is significant.
        now_s: Unix time.
    """
    if session is None:
        return Status(NEVER_SEEN)
    moved_s = _moved_wall_time_s(connection, session, run)
    if not session.is_alive(now_s):
        why = _why_ended(connection, session)
        if (backlog := find_backlog(connection, session)) is not None:
            moved_s = max(moved_s or 0.0, backlog.newest_wall_time_s)
            why = "; ".join(filter(None, (why, _LEFT_WAITING.format(backlog.file_name))))
        return _stopped(session, moved_s, now_s, why)
    if holder := find_holder(connection, session, now_s):
        if holder is session:
            return Status(PAUSED, breakpoint_at(connection, session.id))
        return Status(PAUSED, HELD_ELSEWHERE.format(robot_name(connection, holder.robot_id)))
    fresh = session.heartbeat_is_fresh(now_s)
    if fresh and _change_since_beat(connection, session) == RESUME:
        return Status(RUNNING)
    still_moving_s = _still_moving_s(connection, run)
    if not _is_unseen(session, moved_s) and (hang := _hang(connection, session, now_s)):
        is_slow = moved_s is not None and session.age_s(moved_s, now_s) <= still_moving_s
        return Status(RUNNING, hang) if is_slow else _stopped(session, moved_s, now_s, hang)
    if not fresh and (backlog := find_backlog(connection, session)) is not None:
        moved_s = max(moved_s or 0.0, backlog.newest_wall_time_s)
        why = _WAITING.format(backlog.file_name, max(now_s - backlog.oldest_wall_time_s, 0.0))
        if session.age_s(moved_s, now_s) <= still_moving_s:
            return Status(RUNNING, why)
        return _stopped(session, moved_s, now_s, why)
    if moved_s is None and session.age_s(session.started_wall_time_s, now_s) <= still_moving_s:
        return Status(STARTING, _STARTED)
    if moved_s is not None and session.age_s(moved_s, now_s) <= still_moving_s:
        return Status(RUNNING, _why_unpublished(connection, session, run))
    return _stopped(session, moved_s, now_s, _why_standing(connection, session, moved_s, now_s))


class BlockedLoop(NamedTuple):
    """Why a robot's loop is known not to ask for commands, until somebody does something.

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
    """What is known to keep a loop from asking for commands; None where it may yet ask.

    Only what is known counts. A loop that has been silent for a while may be slow: one that came
    round as slowly before, or computes no longer than it did before, is given its time.

    Args:
        connection: An open database.
        session: The robot's latest session.
        run: Its latest run, whose pace shows how long a round usually takes.
        now_s: Unix time.
    """
    if session is None:
        return None
    if not session.is_alive(now_s):
        why = _why_ended(connection, session) or "its controller is gone"
        return None if may_return(session, now_s) else BlockedLoop(why, "start its controller")
    holder = find_holder(connection, session, now_s)
    if holder is not None and holder.id != session.id:
        name = robot_name(connection, holder.robot_id)
        return BlockedLoop(HELD_ELSEWHERE.format(name), f"resume or step it there (robot={name!r})")
    if session.host == host_name() and is_stopped(session.pid):
        fix = f"let it go on (kill -CONT {session.pid}, or the debugger)"
        return BlockedLoop(_STOPPED_PROCESS.format(session.pid), fix)
    moved_s = _moved_wall_time_s(connection, session, run)
    if session.heartbeat_is_fresh(now_s) or find_backlog(connection, session) is not None:
        return None
    if moved_s is not None and session.age_s(moved_s, now_s) <= _still_moving_s(connection, run):
        return None
    if _has_lost_simulator(session):
        fix = f"end process {session.pid}, start Webots, then the controller"
        return BlockedLoop(CONNECTION_LOST.format(session.pid), fix)
    seen = _seen_by_observer(connection, session, now_s)
    if seen and seen.startswith(SEEN_PAUSED):
        return BlockedLoop(seen, _RESUME_BY)
    if moved_s is None and session.age_s(session.started_wall_time_s, now_s) <= _BEGINNING_S:
        return None
    return _block_in_code(connection, session, moved_s, now_s)


def _block_in_code(
    connection: sqlite3.Connection, session: SessionRecord, moved_s: float | None, now_s: float
) -> BlockedLoop | None:
    """What the stacks of a silent loop show; None where they show nothing, or a slow round."""
    stacks = find_stacks(connection, session, now_s)
    if stacks is None:
        return None
    if stacks.is_in_step:
        for other in companions(connection, session, now_s):
            if (hang := _hang(connection, other, now_s)) is None:
                continue
            if not _is_sure(connection, other, now_s):
                return None
            held_up = _HELD_UP_BY.format(robot_name(connection, other.robot_id), hang)
            return BlockedLoop(held_up, _FREE_IT)
        if session.silent_s(now_s) < _SLOW_STEPS * _usual_step_s(connection, session):
            return None
        return BlockedLoop(_why_standing(connection, session, moved_s, now_s), PRESS_PLAY)
    if not stacks.is_hang:
        return BlockedLoop(_AWAITS_PERSON.format(stacks.place), "let it go on")
    if _is_unseen(session, moved_s) or handler_at_work(connection, session, now_s):
        return None
    hang = _hang(connection, session, now_s)
    return BlockedLoop(hang, _FREE_IT) if hang and _is_sure(connection, session, now_s) else None


def _usual_step_s(connection: sqlite3.Connection, session: SessionRecord) -> float:
    """How long the loop has waited in a step on average, in wall seconds; 0 before it is known."""
    (usual_s,) = connection.execute(_USUAL_STEP, (session.id,)).fetchone()
    return usual_s or 0.0


def _is_sure(connection: sqlite3.Connection, session: SessionRecord, now_s: float) -> bool:
    """Whether a loop is silent for much longer than its limit, and than it ever was before."""
    stacks = find_stacks(connection, session, now_s)
    if stacks is None:
        return False
    silences = connection.execute(_SILENCES, (session.id,)).fetchall()
    lasted_s = [
        end_s - noted_s + stacks.limit_s for noted_s, end_s in silences if end_s is not None
    ]
    return session.silent_s(now_s) >= _SURE_OF_HANG * max([stacks.limit_s, *lasted_s])


def may_return(session: SessionRecord, now_s: float) -> bool:
    """Whether Webots may start its controller again by itself: the world is being reloaded."""
    ended_s = session.ended_wall_time_s or session.last_seen_wall_time_s
    is_soon = now_s - ended_s < ISSUED_TIME_TO_LIVE_S
    return session.end_reason == "reload" and not session.extern and is_soon


def _moved_wall_time_s(
    connection: sqlite3.Connection, session: SessionRecord, run: RunRecord | None
) -> float | None:
    """When simulation time last grew: a row that is newer than the heartbeat shows it sooner."""
    row = newest_state(connection, run.id) if run and run.session_id == session.id else None
    if row is None or row.sim_time_s <= (session.sim_time_s or 0.0):
        return session.moved_wall_time_s
    if not session.has_bridge:  # its clock may be another's: what it says is seen when it is read
        return min(row.wall_time_s, session.last_seen_wall_time_s)
    return max(row.wall_time_s, session.moved_wall_time_s or row.wall_time_s)


def _why_unpublished(
    connection: sqlite3.Connection, session: SessionRecord, run: RunRecord | None
) -> str | None:
    """That the loop goes on and records no state; None where it records, or has just begun."""
    if run is None or run.session_id != session.id or session.sim_time_s is None:
        return None
    row = newest_state(connection, run.id)
    since_s = run.started_sim_time_s if row is None else row.sim_time_s
    usual_s = recent_interval_s(connection, run.id) or 0.0
    unpublished_s = session.sim_time_s - since_s
    beaten_since_s = session.last_seen_wall_time_s - (
        run.started_wall_time_s if row is None else row.wall_time_s
    )
    if (
        beaten_since_s <= max(_UNPUBLISHED_S, _UNPUBLISHED_INTERVALS * usual_s)
        or unpublished_s <= 0
    ):
        return None
    return _unseen(session) or _UNPUBLISHED.format(unpublished_s)


def _unseen(session: SessionRecord) -> str | None:
    """That its loop stepped in a way that the bridge did not see, as its bridge found."""
    return UNSEEN if (session.last_error or "").startswith(UNSEEN) else None


def _why_ended(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    (kind,) = connection.execute(_KIND, (session.robot_id,)).fetchone() or (None,)
    if kind == CUSTOM_DATA:
        return _READ_NO_MORE
    if session.end_reason == "reload" and session.extern:
        return _RELOADED_EXTERN
    if session.end_reason == "finished" and (unseen := _unseen(session)):
        return unseen
    if session.end_reason == "crashed" and (error := ended_by(connection, session.id)):
        return f"its controller ended by {error}"
    why = _ENDED.get(session.end_reason or "crashed")
    if session.end_reason in (None, "crashed"):
        hung = connection.execute(_HUNG, (session.id, session.last_seen_wall_time_s)).fetchone()
        said = hung[0] if hung else _left_stacks(connection, session)
        why = f"{why}; it was {said.partition(chr(10))[0]}" if said else why
    return why


def _left_stacks(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    """Where a dead process had hung, as the file has it that nobody has taken in yet."""
    path = _path_of(connection, session, stacks_path)
    stacks = stacks_at(path) if path else None
    is_current = stacks and stacks.is_hang and stacks.began_after(session.last_seen_wall_time_s)
    return f"{stacks.log_values(None)['message']}" if stacks and is_current else None


def ended_by(connection: sqlite3.Connection, session_id: int) -> str | None:
    """The exception that ended a controller, as its bridge logged it; None where it had no time."""
    found = connection.execute(_ENDED_BY, (session_id, f"{ENDED_BY} *")).fetchone()
    return found[0].removeprefix(f"{ENDED_BY} ")[:_MOST_ERROR_CHARACTERS] if found else None


def _why_standing(
    connection: sqlite3.Connection, session: SessionRecord, moved_s: float | None, now_s: float
) -> str:
    """Why the time of a living controller, which its bridge does not hold, stands still."""
    if session.host == host_name() and is_stopped(session.pid):
        return _STOPPED_PROCESS.format(session.pid)
    if _has_lost_simulator(session):
        return CONNECTION_LOST.format(session.pid)
    if inside := handler_at_work(connection, session, now_s):
        return inside
    stacks = find_stacks(connection, session, now_s)
    for other in companions(connection, session, now_s) if stacks and stacks.is_in_step else ():
        if hang := _hang(connection, other, now_s):
            return _HELD_UP_BY.format(robot_name(connection, other.robot_id), hang)
    unseen = _is_unseen(session, moved_s)
    seen = _seen_by_observer(connection, session, now_s)
    if seen and not (unseen and seen.startswith(SEEN_RUNNING)):
        return seen
    if unseen:
        at = f"; {stacks.limit_s:g} s after it began it was in {stacks.place}" if stacks else ""
        return f"{UNMOVED}{at}"
    if moved_s is None:
        return _NOT_STARTED
    # A loop that hangs in a step beat last when it last moved: only a later beat shows it alive.
    beaten_since_s = session.last_seen_wall_time_s - moved_s
    if session.heartbeat_is_fresh(now_s) and beaten_since_s > HEARTBEAT_INTERVAL_S:
        return _STANDING
    left = left_holding(connection, session, now_s)
    if left is None:
        return WAITING_IN_STEP if stacks and stacks.is_in_step else SILENT
    return LEFT_PAUSED.format(robot_name(connection, left.robot_id))


def _has_lost_simulator(session: SessionRecord) -> bool:
    """Whether Webots has closed the connection to its controller."""
    return session.host == host_name() and has_lost_simulator(session.pid, session.instance)


def _is_unseen(session: SessionRecord, moved_s: float | None) -> bool:
    """Whether its bridge has seen nothing of the loop yet."""
    return moved_s is None and session.last_poll_wall_time_s is None


def find_stacks(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> Stacks | None:
    """Where the loop of a session is silent now; None where it is not, or that is not known."""
    path = _path_of(connection, session, stacks_path)
    stacks = stacks_at(path) if path else None
    return stacks if stacks and stacks.began_after(session.last_seen_wall_time_s) else None


def ask_stuck(connection: sqlite3.Connection, session: SessionRecord, now_s: float) -> bool:
    """Have the processes of a simulation that cannot do it otherwise write where they hang.

    The signal for it is sent only where the loop is silent for the limit of its bridge and the
    thread of the bridge could not write the stacks, which C code that keeps Python's lock prevents.

    Returns:
        Whether a signal was sent.
    """
    asked = False
    for each in (session, *companions(connection, session, now_s)):
        path = _path_of(connection, each, stacks_path) if each.host == host_name() else None
        if path is None or each.ended_wall_time_s is not None:
            continue
        if not needs_signal(path, each.silent_s(now_s)) or is_stopped(each.pid):
            continue
        if find_backlog(connection, each) is None:  # else that thread may wait for the database
            with contextlib.suppress(OSError):
                signal_process(each.pid, each.process, SIGNAL)
                asked = True
    if asked:
        time.sleep(_WRITING_S)
    return asked


def _hang(connection: sqlite3.Connection, session: SessionRecord, now_s: float) -> str | None:
    """That the loop is silent in the controller's code, and in which; None where it is not."""
    stacks = find_stacks(connection, session, now_s)
    if stacks is None or not stacks.is_hang:
        return None
    silent_s = session.silent_s(now_s)
    hangs = f"silent for {silent_s:.{1 if silent_s < 10 else 0}f} s in {stacks.place}"
    return "; ".join(filter(None, (hangs, handler_at_work(connection, session, now_s))))


def _seen_by_observer(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> str | None:
    """What a live observer of the simulation knows of it; None where there is none."""
    for each in (session, *companions(connection, session, now_s)):
        found = connection.execute(_SEEN_MODE, (each.id,)).fetchone()
        if found is not None and each.heartbeat_is_fresh(now_s):
            text = SEEN_PAUSED_BY if found[0] == "pause" else SEEN_RUNNING_BY
            return text.format(robot_name(connection, each.robot_id))
    return None


def handler_at_work(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> str | None:
    """The custom action that the loop is inside of; it beats and steps only by itself there."""
    claimed = connection.execute(_CLAIMED, (session.robot_id, session.id)).fetchall()
    for command_id, action, since_s in claimed:
        built_in = BUILT_IN_ACTIONS.get(action)
        if built_in is None or built_in.runs_user_code:
            return (
                f"its loop is inside the handler of command {command_id} ({action}) for "
                f"{max(now_s - since_s, 0.0):.1f} s"
            )
    return None


def stopped_for(seconds: float) -> str:
    """`stopped N s ago`, with a decimal only where it matters."""
    return f"stopped {max(seconds, 0.0):.{1 if seconds < 10 else 0}f} s ago"


def _stopped(
    session: SessionRecord, moved_s: float | None, now_s: float, why: str | None
) -> Status:
    seconds = session.age_s(moved_s or session.started_wall_time_s, now_s)
    if why and why.startswith(UNMOVED):
        return Status(f"not seen moving for {max(seconds, 0.0):.0f} s", why)
    return Status(stopped_for(seconds), why)


def find_holder(
    connection: sqlite3.Connection, session: SessionRecord, now_s: float
) -> SessionRecord | None:
    """The session whose bridge holds the loop: one that is held freezes its whole simulation."""
    for candidate in (session, *companions(connection, session, now_s)):
        if candidate.heartbeat_is_fresh(now_s) and _is_holding(connection, candidate):
            return candidate
    return None


def _is_holding(connection: sqlite3.Connection, session: SessionRecord) -> bool:
    since = _change_since_beat(connection, session)
    return session.pause_state == PAUSED if since is None else since == PAUSE


def _change_since_beat(connection: sqlite3.Connection, session: SessionRecord) -> str | None:
    beat = (session.sim_time_s or 0.0, session.last_seen_wall_time_s)
    return change_since(connection, session.id, *beat)


def _still_moving_s(connection: sqlite3.Connection, run: RunRecord | None) -> float:
    """How old the last movement may be; heartbeats tell it only every so often."""
    interval_s = (recent_interval_s(connection, run.id) if run else None) or 0.0
    pace_s = min(max(_STILL_MOVING_S, 3 * interval_s), _SLOWEST_STILL_MOVING_S)
    return pace_s + HEARTBEAT_INTERVAL_S


class FileBacklog(NamedTuple):
    """Rows that wait in a file next to the database: when the first and the newest came."""

    file_name: str
    oldest_wall_time_s: float
    newest_wall_time_s: float


def rows_waiting(connection: sqlite3.Connection, session: SessionRecord | None) -> dict[str, Any]:
    """`rows_waiting`, and `waiting_in` where there are any: a file next to the database, or memory.

    The session's row has the number at the last heartbeat, which waits for the same lock.
    """
    if session is None:
        return {"rows_waiting": 0}
    path = _path_of(connection, session)
    if path is not None and (rows := count_rows(path)):
        return {"rows_waiting": rows, "waiting_in": path.name}
    if session.rows_waiting:
        return {"rows_waiting": session.rows_waiting, "waiting_in": "the controller's memory"}
    return {"rows_waiting": 0}


def find_backlog(connection: sqlite3.Connection, session: SessionRecord) -> FileBacklog | None:
    """What waits in the file of a session; None where nothing does."""
    path = _path_of(connection, session)
    if path is None:
        return None
    with contextlib.suppress(OSError, ValueError), path.open("rb") as file:
        if read_header(file) is not None and (entries := next_entries(file, file.tell())):
            newest_s = path.stat().st_mtime
            return FileBacklog(path.name, min(_oldest_s(entries), newest_s), newest_s)
    return None


def _path_of(
    connection: sqlite3.Connection,
    session: SessionRecord,
    path_in: Callable[[Path, str], Path] = waiting_path,
) -> Path | None:
    """None for a database in memory, and where there is no such file."""
    (file,) = connection.execute("SELECT file FROM pragma_database_list").fetchone()
    (uuid,) = connection.execute("SELECT uuid FROM session WHERE id = ?", (session.id,)).fetchone()
    path = path_in(Path(file), uuid) if file else None
    return path if path and path.is_file() else None  # a FIFO would wait for a writer


def _oldest_s(entries: list[tuple[int, WaitingEntry]]) -> float:
    """When the first state, log line or event came; infinite where there is none."""
    stamped = ("state", "log", "event")
    times = (entry.values for _, entry in entries if entry.kind in stamped)
    return next((float(values[1]) for values in times if isinstance(values, tuple)), float("inf"))
