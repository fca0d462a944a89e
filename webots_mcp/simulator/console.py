"""Record the console of each Webots of a recording; one process at a time follows each of them.

`ConsoleWatch` finds the running Webots, `ConsoleFollower` follows one of them, and `StandInConsole`
records a stand-in that runs in this process.
"""

from __future__ import annotations

import math
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final

from webots_mcp.contract import host_name
from webots_mcp.database.job_leases import give_back, held_jobs, holder_of, lease_of, take
from webots_mcp.errors import (
    CommandRefusedError,
    DatabaseError,
    WebotsMCPError,
    warn,
)
from webots_mcp.simulator.console_lines import ConsoleLines, note
from webots_mcp.simulator.instances import Instance
from webots_mcp.simulator.orders import (
    ANSWER_S,
    Stream,
    WebotsLine,
    begin_console,
    connected,
)
from webots_mcp.simulator.own_webots import own_webots
from webots_mcp.store.logs import ConsoleRows, Said
from webots_mcp.store.recording import Job, RecordingAccess

_JOB: Final = "console of "


@dataclass(frozen=True)
class ConsoleTimes:
    """Times of following a console, in seconds of wall time.

    Attributes:
        connecting_s: For a connection.
        receive_s: For the next message.
        hold_s: How long a line waits for what a bridge records of it, and for the run that a
            controller begins.
        min_pause_s: Shortest pause after a failure.
        max_pause_s: Longest pause after a failure.
        renew_s: Between two checks of the lease.
        waiting_s: Between two checks whether lines that wait for a run can be recorded.
        young_s: Age up to which a Webots has printed nothing before it was followed.
        last_write_s: For the last lines of a stand-in.
        first_search_s: Before the first search: a server that has just started has answers to give.
        search_s: Between two searches for a running Webots.
    """

    connecting_s: float = 2.0
    receive_s: float = 0.25
    hold_s: float = 0.7
    min_pause_s: float = 0.5
    max_pause_s: float = 8.0
    renew_s: float = 5.0
    waiting_s: float = 2.0
    young_s: float = 5.0
    last_write_s: float = 3.0
    first_search_s: float = 1.0
    search_s: float = 5.0


_TIMES: Final = ConsoleTimes()


def job_of(instance: Instance) -> str:
    """Return the name of the lease for following the console of that Webots."""
    return f"{_JOB}{instance.name}"


@contextmanager
def follow_console(instance: Instance, recording: RecordingAccess) -> Generator[ConsoleFollower]:
    """Record the console of a Webots inside the block; of several processes, one does so.

    Recording begins as soon as there is a database. If Webots cannot be reached, `problem` of the
    follower says why.
    """
    follower = ConsoleFollower(instance, recording)
    follower.start()
    try:
        yield follower
    finally:
        follower.stop()


class _RecordingThread(threading.Thread):
    """A daemon thread that records the lines of a console, each a moment after it arrived.

    Attributes:
        problem: Why nothing is recorded at the moment; None while lines are recorded.
    """

    def __init__(self, name: str, recording: RecordingAccess) -> None:
        super().__init__(name=name, daemon=True)
        self.problem: str | None = "it has not started yet"
        self._recording = recording
        self._ending = threading.Event()
        self._held: deque[tuple[float, Said]] = deque()  # when each came
        self._lost = 0

    def _hold(self, lines: Iterable[Said]) -> None:
        """Hold lines until they are due; beyond 5,000 the oldest are dropped."""
        now_s = time.monotonic()
        self._held.extend((now_s, line) for line in lines)
        while len(self._held) > 5_000:  # while the database is locked
            self._held.popleft()
            self._lost += 1

    @contextmanager
    def _keeping_on(self) -> Generator[None]:
        """Note a locked database and continue: it may be written later. A lost lease is raised."""
        try:
            yield
        except DatabaseError as error:
            self.problem = str(error)

    def _write_held(self, job: Job, rows: ConsoleRows, came_by_s: float) -> None:
        """Record the lines that arrived until a monotonic time."""
        held = [(came_s, line) for came_s, line in list(self._held) if came_s <= came_by_s]
        lines = [line for _, line in held]
        lost = self._lost
        if lost:
            lines.insert(0, note(f"{lost} lines of the console: the database was locked"))
        if not lines:
            return
        with job.writer() as connection:
            rows.write(connection, lines)
        self.problem = None
        self._lost -= lost
        while self._held and self._held[0][0] <= came_by_s:
            self._held.popleft()

    def _write_waiting(self, job: Job, rows: ConsoleRows) -> None:
        """Record the lines that have waited for a run, once it has begun."""
        with self._recording.reader() as connection:
            goes_on = rows.may_go_on(connection)
        if goes_on:
            with job.writer() as connection:
                rows.write(connection, [])


class ConsoleFollower(_RecordingThread):
    """A daemon thread that records the console of one Webots until that ends."""

    def __init__(self, instance: Instance, recording: RecordingAccess) -> None:
        super().__init__(f"webots-mcp console {instance.port}", recording)
        self.instance = instance
        self._rows = ConsoleRows(instance.name, instance.started_wall_time_s)
        self._was_connected = False

    def run(self) -> None:
        """Follow the console; after a failure try again, with pauses that grow."""
        pause_s = 0.0
        while not self._ending.wait(pause_s):
            began_s = time.monotonic()
            try:
                self._follow_if_free()
            except WebotsMCPError as error:
                self.problem = str(error)
            if not self.instance.runs:
                return
            lasted = time.monotonic() - began_s > _TIMES.max_pause_s
            longer_s = _TIMES.min_pause_s if lasted else 2 * pause_s
            pause_s = min(max(longer_s, _TIMES.min_pause_s), _TIMES.max_pause_s)

    def ask_to_end(self) -> None:
        """Ask the thread to end, without waiting for it."""
        self._ending.set()

    def stop(self) -> None:
        """End the thread: lines that have arrived are recorded, and others may follow at once."""
        self.ask_to_end()
        self.join(timeout=3)

    def _follow_if_free(self) -> None:
        lease = lease_of(job_of(self.instance))
        with self._recording.writer() as connection:
            if not take(connection, lease):
                self.problem = "another process follows it"
                return
        job = Job(self._recording, lease)
        try:
            with job.writer() as connection:
                self._rows.begin(connection)
            self._follow(job)
        finally:
            with suppress(WebotsMCPError), self._recording.writer() as connection:
                give_back(connection, lease)

    def _follow(self, job: Job) -> None:
        """Record until the thread is to end or Webots closes the connection."""
        age_s = time.time() - self.instance.started_wall_time_s
        lines = ConsoleLines(old=self._was_connected or age_s > _TIMES.young_s)
        try:
            with connected(self.instance.address, _TIMES.connecting_s) as stream:
                begin_console(stream)
                self.problem, self._was_connected = None, True
                self._listen(job, stream, lines)
        finally:
            self._hold(lines.idle())
            with suppress(WebotsMCPError):
                self._write_held(job, self._rows, came_by_s=math.inf)

    def _listen(self, job: Job, stream: Stream, lines: ConsoleLines) -> None:
        renew_s = check_s = 0.0
        while not self._ending.is_set():
            message = stream.receive(time.monotonic() + _TIMES.receive_s)
            self._hold(lines.idle())
            if message is not None:
                self._hold(lines.take(message))
            now_s = time.monotonic()
            with self._keeping_on():
                if now_s > renew_s:
                    renew_s = now_s + _TIMES.renew_s
                    job.require_held()
                if self._rows.waits and now_s > check_s:
                    check_s = now_s + _TIMES.waiting_s
                    self._write_waiting(job, self._rows)
                if self._held and self._held[0][0] < now_s - _TIMES.hold_s:
                    self._write_held(job, self._rows, now_s - _TIMES.hold_s)


class StandInConsole(_RecordingThread):
    """Record the console of a stand-in that runs in this process, while its context lasts.

    The lines have the names of the robots whose controllers printed them.

    Args:
        recording: Where the lines are to be recorded.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        super().__init__("webots-mcp console of the stand-in", recording)
        self._began_s = time.time()
        self._lines = ConsoleLines(old=False)
        self._adding = threading.Lock()
        self._name = ""

    def __enter__(self) -> StandInConsole:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        if self.is_alive():
            self.join(timeout=_TIMES.last_write_s)

    def begin(self, port: int) -> None:
        """Begin to record: controllers know the simulation by this port."""
        self._name = f"{host_name()}:{port}"
        self.start()

    def put(self, stream: str, line: str) -> None:
        """Take a line; it is recorded later."""
        with self._adding:
            self._hold(self._lines.take_line(WebotsLine(stream, line)))

    def run(self) -> None:
        """Record until the context is left, and then the remaining lines."""
        rows, lease = ConsoleRows(self._name, self._began_s), lease_of(_JOB + self._name)
        job = Job(self._recording, lease)
        try:
            self._recording.create()
            with self._recording.writer() as connection:
                take(connection, lease)
            renew_s = check_s = time.monotonic()
            while not self._ending.wait(_TIMES.receive_s):
                now_s = time.monotonic()
                self._note_idle()
                with self._keeping_on():
                    if now_s > renew_s + _TIMES.renew_s:
                        renew_s = now_s
                        job.require_held()
                    if rows.waits and now_s > check_s + _TIMES.waiting_s:
                        check_s = now_s
                        self._write_waiting(job, rows)
                    self._write_held(job, rows, now_s - _TIMES.hold_s)
            self._note_idle(at_the_end=True)
            self._write_held(job, rows, came_by_s=math.inf)
            with self._recording.writer() as connection:
                give_back(connection, lease)
        except WebotsMCPError as error:
            warn(f"the console of the stand-in is not recorded: {error}")

    def _note_idle(self, *, at_the_end: bool = False) -> None:
        with self._adding:
            self._hold(self._lines.rest() if at_the_end else self._lines.idle())


class ConsoleWatch(threading.Thread):
    """A daemon thread that searches for Webots of the recording, and follows each of them.

    Args:
        recording: Where the lines are to be recorded.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        super().__init__(name="webots-mcp consoles", daemon=True)
        self._recording = recording
        self._ending = threading.Event()
        self._followers: dict[tuple[int, int], ConsoleFollower] = {}
        self._warned_of = ""

    def run(self) -> None:
        """Search until stopped; whatever goes wrong ends one search, never the thread."""
        pause_s = _TIMES.first_search_s
        while not self._ending.wait(pause_s):
            pause_s = _TIMES.search_s
            try:
                self.follow_new()
            except Exception as error:  # noqa: BLE001  (it is reported)
                if str(error) != self._warned_of:
                    self._warned_of = str(error)
                    warn(f"no console of Webots is followed: {error}")

    def follow_new(self) -> None:
        """Follow each Webots of the recording that is not followed yet.

        Raises:
            DatabaseError: The recording cannot be read.
        """
        over = [key for key, follower in self._followers.items() if not follower.is_alive()]
        for key in over:
            del self._followers[key]
        for instance in own_webots(self._recording):
            key = (instance.pid, instance.port)
            if instance.is_listening and key not in self._followers:
                self._followers[key] = ConsoleFollower(instance, self._recording)
                self._followers[key].start()

    def stop(self) -> None:
        """Let other processes follow."""
        self._ending.set()
        if self.is_alive():
            self.join(timeout=2)
        for follower in self._followers.values():
            follower.ask_to_end()
        for follower in self._followers.values():
            follower.stop()


# -- whether a console is followed --------------------------------------------------------------


def console_state(recording: RecordingAccess, connection: sqlite3.Connection) -> str:
    """Say in a sentence whether the console of each Webots of a recording is followed.

    Args:
        recording: The recording.
        connection: A connection to it.
    """
    running = own_webots(recording)
    states = [_state(each, recording, connection) for each in running]
    recorded = {job_of(each) for each in running}
    states += [
        f"the console of the stand-in {name.removeprefix(_JOB)} is recorded"
        for name in held_jobs(connection, _JOB)
        if name not in recorded
    ]
    return (
        "; ".join(states)
        or "no Webots of this recording runs on this machine, so no console is followed"
    )


def _state(instance: Instance, recording: RecordingAccess, connection: sqlite3.Connection) -> str:
    console = f"the console of Webots at port {instance.port}"
    if holder_of(connection, job_of(instance)) is not None:
        unsure = (
            ""
            if instance.streams
            else "; it was started without --stream: if no lines appear, start it with --stream"
        )
        return f"{console} is followed{unsure}"
    try:
        with connected(instance.address, ANSWER_S):
            pass
    except CommandRefusedError as error:
        return f"{console} is not followed: {error}"
    if recording.read_only:
        return f"{console} is not followed: a server with --read-only does not, one without does"
    return f"{console} is not followed yet: a server searches for it every few seconds"
