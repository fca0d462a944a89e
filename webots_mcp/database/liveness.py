"""Whether a session lives, and what becomes of what a dead one left; leases of one process.

The host's operating system says whether a process runs. Bridge and store close dead sessions alike.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import signal
import sqlite3
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import ISSUED_TIME_TO_LIVE_S, REMOTE_SILENCE_S, host_name
from webots_mcp.database.connection import transaction
from webots_mcp.database.queue import CLAIMED_BY_ENDED, EXPIRE, LOSE
from webots_mcp.database.waiting_file import waiting_path
from webots_mcp.errors import LeaseLostError

# A controller may be silent for hours (paused in Webots) and live; so it is not the silence that
# decides. But a process that started after the last sign of life has only inherited the pid: after
# a reboot, in a container that was started again. Clocks are trusted to so much:
_PIDS: Final = 2**31  # no system gives a process a higher id
_TOLERANCE_S: Final = 2.0
_WINDOWS_EPOCH_S: Final = 11_644_473_600  # from 1601 to 1970

# A sign of life is proof against a judgement by others that the process was gone; but a session
# that a later one has followed stays ended.
_ALIVE: Final = (
    "CASE WHEN end_reason = 'crashed' AND NOT EXISTS (SELECT 1 FROM session n "
    "WHERE n.robot_id = {0}.robot_id AND n.id > {0}.{1}) THEN NULL ELSE {2} END"
)
_BEAT_SESSION: Final = (
    "UPDATE session SET last_seen_wall_time_s = ?, last_seen_monotonic_s = ?, "
    "last_poll_wall_time_s = ?, moved_wall_time_s = ?, sim_time_s = ?, pause_state = ?, "
    "mode_before_pause = ?, rows_waiting = ?, rows_dropped = ?, last_error = ?, "
    f"ended_wall_time_s = {_ALIVE.format('session', 'id', 'ended_wall_time_s')}, "
    f"end_reason = {_ALIVE.format('session', 'id', 'end_reason')} WHERE id = ?"
)
NO_TIMES: Final = (None, None, None)  # in place of `LoopTimes`: no round of the loop was seen
_BEAT_RUN: Final = (
    "UPDATE run SET last_wall_time_s = ?, last_sim_time_s = ?, row_count = ?, "
    "own_wall_s = ?, step_wait_wall_s = ?, steps = ?, "
    f"ended_wall_time_s = {_ALIVE.format('run', 'session_id', 'ended_wall_time_s')}, "
    f"end_reason = {_ALIVE.format('run', 'session_id', 'end_reason')} WHERE id = ?"
)
END_SESSION: Final = (
    "UPDATE session SET ended_wall_time_s = last_seen_wall_time_s, end_reason = :reason "
    "WHERE id = :id AND ended_wall_time_s IS NULL"
)
# For sessions of dead processes: the rows are counted, since the process cannot report them, and
# the last row may be younger than the last heartbeat. Counting takes long, so it comes first, when
# no robot waits for it; its result stays true, since no other process writes to these runs.
_LAST_ROW: Final = (
    "coalesce((SELECT {0} FROM state WHERE run_id = run.id ORDER BY sim_time_s DESC LIMIT 1), {1})"
)
_FOUND: Final = (
    f"SELECT id AS run, "
    f"max(last_wall_time_s, {_LAST_ROW.format('wall_time_s', 'last_wall_time_s')}), "
    f"max(last_sim_time_s, {_LAST_ROW.format('sim_time_s', 'last_sim_time_s')}), "
    "purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) "
    "FROM run WHERE session_id = ? AND ended_wall_time_s IS NULL AND coalesce(uuid, '') <> ?"
)
END_RUN: Final = (
    "UPDATE run SET ended_wall_time_s = :last_s, last_wall_time_s = :last_s, "
    "last_sim_time_s = :last_sim_s, end_reason = :reason, row_count = :rows "
    "WHERE id = :id AND ended_wall_time_s IS NULL"
)
EXTERN: Final = "Webots does not restart an extern controller: start it by hand"
_OPEN_SESSIONS: Final = (
    "SELECT id, pid, CAST(process AS BLOB), last_seen_wall_time_s, EXISTS (SELECT 1 FROM command "
    "WHERE session_id = session.id AND action = 'reload' AND issued_wall_time_s IS NOT NULL) "
    "FROM session WHERE ended_wall_time_s IS NULL AND host = ?"
)
_SESSIONS_OF: Final = (
    "SELECT s.id, s.host, s.pid, s.process, s.last_seen_wall_time_s, s.instance, r.kind "
    "FROM session s JOIN robot r ON r.id = s.robot_id "
    "WHERE r.name = ? AND s.ended_wall_time_s IS NULL"
)
_FILE: Final = "SELECT file FROM pragma_database_list WHERE name = 'main'"
_LOCAL_STATES: Final = {"01": False, "08": True}  # of tcp(7): established; the other end has closed
LEASE_S: Final = 30.0
# One that ends later was taken before the clock was set back. It is not one lease from now: the
# holder may renew after the asker looked at the clock and before its statement reads the row.
_TIMES: Final = 2
_TAKE: Final = (
    "INSERT INTO lease (name, holder, until_wall_time_s) VALUES (:name, :holder, :until) "
    "ON CONFLICT (name) DO UPDATE SET holder = :holder, until_wall_time_s = :until "
    "WHERE holder = :holder OR until_wall_time_s NOT BETWEEN :now AND :latest "
    "OR :forced OR holder LIKE :outranked"
)
_RENEW: Final = "UPDATE lease SET until_wall_time_s = ? WHERE name = ? AND holder = ?"
_GIVE_BACK: Final = "DELETE FROM lease WHERE name = ? AND holder = ?"
_HOLDER: Final = "SELECT holder FROM lease WHERE name = ? AND until_wall_time_s BETWEEN ? AND ?"
_HELD: Final = (
    "SELECT name FROM lease WHERE substr(name, 1, length(:prefix)) = :prefix "
    "AND until_wall_time_s BETWEEN :now AND :latest ORDER BY name"
)
_LOST: Final = (
    "{} was taken over by another process{}, since this one had not renewed its lease for {:g} s: "
    "it wrote nothing more"
)


def is_living(
    host: str, pid: int, process: str | None, last_seen_wall_time_s: float, now_s: float
) -> bool:
    """Whether the process of a session that has not ended still runs.

    On this host the process shows it, as `process_alive` says; on another only a recent heartbeat
    does.
    """
    if host != host_name():
        return now_s - last_seen_wall_time_s < REMOTE_SILENCE_S
    return process_alive(pid, process, last_seen_wall_time_s)


def process_alive(pid: int, process: str | None, last_seen_wall_time_s: float) -> bool:
    """Whether a process of this host still runs.

    Args:
        pid: Its id, which another process may have by now.
        process: Its `process_identity`, which no other has, whatever clocks are set to.
        last_seen_wall_time_s: Its newest sign of life, Unix time: what there is to go by where the
            identity is not known. Where the system does not show either when a process started
            (macOS), any process of that pid counts.
    """
    if not (_is_pid(pid) and isinstance(last_seen_wall_time_s, (int, float))):  # pyright: ignore[reportUnnecessaryIsInstance]
        return False  # no bridge has written this: a recording may come from anywhere
    now = process_identity(pid) if process is not None else None
    if now is not None:
        return now == process
    if sys.platform == "win32":
        started_s = _windows_start(pid)
    else:
        started_s = _posix_start(pid)
    if started_s is None:
        return False
    return started_s <= last_seen_wall_time_s + _TOLERANCE_S


def _is_pid(pid: object) -> bool:
    return isinstance(pid, int) and 0 < pid < _PIDS


def process_identity(pid: int) -> str | None:
    """Which process of this host that pid names now, whatever the wall clock is set to.

    A pid comes back; its boot and its start within that boot do not. On Windows the creation
    time, which setting the clock does not change afterwards. None where no such process runs, or
    the system does not show it (macOS).
    """
    if sys.platform == "win32":
        created = _windows_creation(pid)
        return f"{created}" if created else None
    try:
        fields = _linux_stat(pid)
        if fields[0] == b"Z":
            return None
        with open("/proc/sys/kernel/random/boot_id", "rb") as file:  # noqa: PTH123
            return f"{file.read().decode().strip()} {int(fields[19])}"
    except (OSError, IndexError, ValueError):
        return None


def _posix_start(pid: int) -> float | None:
    """Unix time of the process' start; 0 where it is not shown, None where there is no process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass  # it lives, under another user
    return _linux_start(pid)


def _linux_start(pid: int) -> float | None:
    """A process that ended but was not yet waited for ("Z") still has a pid."""
    try:
        fields = _linux_stat(pid)
        if fields[0] == b"Z":
            return None
        since_boot_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + since_boot_s
    except (OSError, IndexError, ValueError, AttributeError):
        return 0.0


def _linux_stat(pid: int) -> list[bytes]:
    """From its state on, which proc_pid_stat(5) has third; the start in clock ticks is 22nd."""
    with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123  (no pathlib in the loop)
        return file.read().rpartition(b") ")[2].split()


def is_stopped(pid: int) -> bool:
    """Whether a signal or a debugger has stopped a process; only Linux shows that."""
    try:
        return _linux_stat(pid)[0] in (b"T", b"t")
    except (OSError, IndexError):
        return False


def has_lost_simulator(pid: int, instance: str) -> bool:
    """Whether Webots has closed its connection to a controller, which waits for it regardless.

    Over TCP, Webots' library then waits for an answer without end; over a local socket it ends the
    process. Only Linux shows it, to the user whose process it is.

    Args:
        pid: The controller's process.
        instance: Its simulator, as `contract.instance_of` names it: `host:port`.
    """
    port = instance.rpartition(":")[2]
    if not (_is_pid(pid) and port.isascii() and port.isdecimal()):
        return False
    try:
        closed_by_inode = dict(_connections_to(pid, int(port)))
        inodes = set(_open_files(pid))
    except (OSError, ValueError, IndexError):
        return False
    found = [closed for inode, closed in closed_by_inode.items() if f"socket:[{inode}]" in inodes]
    return bool(found) and all(found)


def _open_files(pid: int) -> Generator[str]:
    """What the descriptors of a process lead to; one may be closed meanwhile."""
    folder = f"/proc/{pid}/fd"
    for name in os.listdir(folder):  # noqa: PTH208
        with suppress(FileNotFoundError):
            yield os.readlink(f"{folder}/{name}")  # noqa: PTH115


def _connections_to(pid: int, port: int) -> Generator[tuple[str, bool]]:
    """Sockets in the network of a process that lead to a port: inode, and whether it is closed."""
    for table in ("tcp", "tcp6"):
        with suppress(FileNotFoundError), open(f"/proc/{pid}/net/{table}") as file:  # noqa: PTH123
            for line in file.readlines()[1:]:
                fields = line.split()
                if int(fields[2].rpartition(":")[2], 16) == port and fields[3] in _LOCAL_STATES:
                    yield fields[9], _LOCAL_STATES[fields[3]]


def signal_process(pid: int, process: str | None, number: int) -> None:
    """Send a signal that would end whoever does not expect it.

    It is sent to that very process (`process_identity`) only, not to another of its pid, and where
    a handler is installed: another program, begun by `exec`, has none. Linux only.

    Raises:
        OSError: No such process runs, or the system does not tell.
    """
    if sys.platform != "linux":
        return
    handle = os.pidfd_open(pid)
    try:
        with open(f"/proc/{pid}/status", "rb") as file:  # noqa: PTH123
            caught = int(file.read().partition(b"\nSigCgt:")[2].split()[0], 16)
        if caught >> number - 1 & 1 and process is not None and process_identity(pid) == process:
            signal.pidfd_send_signal(handle, number)
    finally:
        os.close(handle)


def _windows_start(pid: int) -> float | None:
    """As `_posix_start`."""
    created = _windows_creation(pid)
    return created / 1e7 - _WINDOWS_EPOCH_S if created else created


def _windows_creation(pid: int) -> int | None:
    """In 100 ns since 1601; 0 where it is not shown, None where there is no process.

    os.kill(pid, 0) would end the process on Windows, asking does not.
    """
    import ctypes

    query_limited_information, still_active = 0x1000, 259
    kernel: Any = getattr(ctypes, "WinDLL")("kernel32")  # noqa: B009  (exists on Windows only)
    handle = kernel.OpenProcess(query_limited_information, False, pid)
    if not handle:
        return None
    code, times = ctypes.c_ulong(), (ctypes.c_ulonglong * 4)()  # created, ended, kernel, user
    kernel.GetExitCodeProcess(handle, ctypes.byref(code))
    known = kernel.GetProcessTimes(handle, *(ctypes.byref(times, 8 * i) for i in range(4)))
    kernel.CloseHandle(handle)
    if code.value != still_active:
        return None
    return int(times[0]) if known else 0


class LoopTimes(NamedTuple):
    """What the rounds of a run took of wall time, from one end of a step to the next."""

    own_s: float
    step_wait_s: float
    steps: int


class LoopStatus(NamedTuple):
    """What a heartbeat says of the loop."""

    sim_time_s: float
    last_poll_wall_time_s: float | None
    moved_wall_time_s: float | None
    command: str | None
    mode_before: str | None
    times: LoopTimes | None = None


class RecordingStatus(NamedTuple):
    """What a heartbeat says of the recording."""

    rows_waiting: int
    rows_dropped: int
    last_error: str | None


def write_heartbeat(
    connection: sqlite3.Connection,
    loop: LoopStatus,
    recording: RecordingStatus,
    session_id: int,
    run_id: int | None,
    rows: int,
) -> None:
    """Write a session and its run as they are now, inside a transaction of the caller.

    Args:
        connection: To the database.
        loop: What the loop does.
        recording: What became of its rows.
        session_id: The session.
        run_id: Its run.
        rows: How many states of that run are in the database.
    """
    now = time.time()
    seen = (now, time.monotonic(), loop.last_poll_wall_time_s, loop.moved_wall_time_s)
    how = (loop.sim_time_s, loop.command, loop.mode_before)
    connection.execute(_BEAT_SESSION, (*seen, *how, *recording, session_id))
    connection.execute(_BEAT_RUN, (now, loop.sim_time_s, rows, *(loop.times or NO_TIMES), run_id))


class OpenSession(NamedTuple):
    """A session that has not ended."""

    session_id: int
    host: str
    pid: int
    process: str | None
    last_seen_wall_time_s: float
    instance: str
    kind: str


def free_name(
    connection: sqlite3.Connection, name: str, makes_way: Callable[[OpenSession], bool]
) -> str:
    """The name for a robot's new session: where a living one has it, `#2` and so on is appended.

    A living one may make way, as an observer's does, of `customData`, for a bridge. Sessions of
    that name which are over are ended as superseded; the caller opens the transaction.
    """
    wanted, number = name, 1
    while True:
        sessions = [OpenSession(*row) for row in connection.execute(_SESSIONS_OF, (wanted,))]
        living = (each for each in sessions if is_living(*each[1:5], time.time()))
        if all(map(makes_way, living)):
            for session in sessions:
                end_session(connection, session.session_id, "superseded")
            return wanted
        number += 1
        wanted = f"{name}#{number}"


def reap(connection: sqlite3.Connection, now_s: float) -> None:
    """Settle everything that no live process will finish.

    Pending commands past their time become `expired`. Open sessions whose process on this host is
    gone are ended (`reload` if they asked for one, else `crashed`). Commands claimed by an ended
    session become `lost`, and are never run again by themselves; only one that asked Webots for a
    reload gets a minute for the next session to confirm it, where Webots starts one. Where a file
    of the session waits next to the database, the command's result may be in it: the process that
    takes the file in settles the rest.

    The caller opens the transaction, or accepts that each statement is one of its own.
    """
    connection.execute(EXPIRE, {"now": now_s})
    for session_id, reason in dead_sessions(connection):
        end_session(connection, session_id, reason)
    for command_id, issued_s, extern, uuid in connection.execute(CLAIMED_BY_ENDED).fetchall():
        if _may_wait(connection, uuid):
            continue
        if issued_s is None:
            why = "its controller ended before it finished; it may have run in part"
        elif extern:
            why = f"it was issued to Webots, and its controller's process ended; {EXTERN}"
        elif now_s - issued_s > ISSUED_TIME_TO_LIVE_S:
            why = "it was issued to Webots, but no new controller session confirmed it"
        else:
            continue
        connection.execute(LOSE, {"id": command_id, "now": now_s, "why": why})


def _may_wait(connection: sqlite3.Connection, session_uuid: str | None) -> bool:
    """Whether entries of that session may still wait next to the database."""
    ((file,),) = connection.execute(_FILE).fetchall()
    return bool(file and session_uuid) and waiting_path(Path(file), f"{session_uuid}").exists()


def reap_if_dead(connection: sqlite3.Connection) -> None:
    """Settle where a session looks open and is not: views and SQL can't judge processes."""
    if dead_sessions(connection):
        reap(connection, time.time())


def dead_sessions(connection: sqlite3.Connection) -> list[tuple[int, str]]:
    """Sessions that look open although their process on this host is gone, and how they ended."""
    sessions = connection.execute(_OPEN_SESSIONS, (host_name(),)).fetchall()
    return [
        (session_id, "reload" if reloading else "crashed")
        for session_id, pid, process, seen_s, reloading in sessions
        if not process_alive(pid, process and process.decode("utf-8", "replace"), seen_s)
    ]


def end_session(connection: sqlite3.Connection, session_id: int, reason: str) -> None:
    """End a session that another process left open, and its runs, as of their last sign of life."""
    end_runs(connection, session_id, reason)
    # Last: a process that is killed before this leaves a session that will be settled again.
    connection.execute(END_SESSION, {"id": session_id, "reason": reason})


def end_runs(
    connection: sqlite3.Connection, session_id: int, reason: str, going_on: str = "none"
) -> None:
    """End the open runs of a session, as of their last sign of life, but for that UUID."""
    values = (session_id, going_on)
    for run_id, last_s, last_sim_s, rows in connection.execute(_FOUND, values).fetchall():
        times = {"last_s": last_s, "last_sim_s": last_sim_s}
        connection.execute(END_RUN, {"id": run_id, "reason": reason, "rows": rows, **times})


# Leases: one process at a time does a job, on whatever host; who is gone or stopped loses it.
#
# The holder renews its lease while it works. Where it does not any more, whatever the reason, the
# lease runs out and another takes it. A holder that was only stopped finds out at its next write:
# what it writes for the job, it writes with the lease in the same transaction (`still_held`).


class JobLease(NamedTuple):
    """The right to do a job.

    Attributes:
        name: Of the job.
        holder: Of the process that does it, as no other has it.
        lasts_s: Of wall time, each time that it is taken or renewed.
    """

    name: str
    holder: str
    lasts_s: float = LEASE_S

    def latest_s(self, now_s: float) -> float:
        """The latest wall time up to which a held lease may last."""
        return now_s + _TIMES * self.lasts_s


def lease_of(name: str) -> JobLease:
    """A lease that this process may take, by the name of the job."""
    return JobLease(name, f"{host_name()} {os.getpid()} {os.urandom(4).hex()}")


def holder_of(connection: sqlite3.Connection, name: str) -> str | None:
    """Who renewed the lease of that job lately; None where no process did."""
    now_s = time.time()
    row = connection.execute(_HOLDER, (name, now_s, now_s + _TIMES * LEASE_S)).fetchone()
    return row and str(row[0])


def held_jobs(connection: sqlite3.Connection, prefix: str) -> list[str]:
    """The jobs that a process does, of those whose names begin so."""
    now_s = time.time()
    asked = {"prefix": prefix, "now": now_s, "latest": now_s + _TIMES * LEASE_S}
    return [str(name) for (name,) in connection.execute(_HELD, asked)]


def take(
    connection: sqlite3.Connection,
    lease: JobLease,
    *,
    forced: bool = False,
    outranked: str | None = None,
) -> bool:
    """Take a lease, or renew it; False where another process has it.

    Args:
        connection: In the role "writer".
        lease: The lease, and its holder.
        forced: Take it from its holder, whose process is known to have ended.
        outranked: Live holders from which it may be taken, as a pattern of SQL's LIKE.
    """
    now_s = time.time()
    times = {"now": now_s, "until": now_s + lease.lasts_s, "latest": lease.latest_s(now_s)}
    names = {"name": lease.name, "holder": lease.holder, "outranked": outranked}
    return connection.execute(_TAKE, {**names, **times, "forced": forced}).rowcount > 0


def give_back(connection: sqlite3.Connection, lease: JobLease) -> None:
    """Let others take it at once."""
    connection.execute(_GIVE_BACK, (lease.name, lease.holder))


@contextmanager
def still_held(connection: sqlite3.Connection, lease: JobLease) -> Generator[None]:
    """A transaction for what only the holder may write; it renews the lease.

    Raises:
        LeaseLostError: Another process has taken it; nothing is written.
    """
    with transaction(connection):
        values = (time.time() + lease.lasts_s, lease.name, lease.holder)
        if connection.execute(_RENEW, values).rowcount == 0:
            holder = holder_of(connection, lease.name)  # None where that one is done by now
            by = f" ({holder})" if holder else ""
            raise LeaseLostError(_LOST.format(lease.name, by, lease.lasts_s))
        yield
