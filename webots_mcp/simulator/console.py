"""Recording the console of each Webots of a recording: one process at a time follows each of them.

`ConsoleWatch` looks for the Webots that run, `ConsoleFollower` follows one of them, `ConsoleLines`
limits how many of its lines are recorded and counts the rest. `StandInConsole` records that of a
stand-in which runs in this process.
"""

from __future__ import annotations

import math
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Final

from webots_mcp.contract import LogLevel, LogSource, host_name
from webots_mcp.database.files import full_path
from webots_mcp.database.liveness import give_back, held_jobs, holder_of, lease_of, take
from webots_mcp.database.location import find_project
from webots_mcp.errors import (
    CommandRefusedError,
    DatabaseError,
    NoDatabaseError,
    WebotsMCPError,
    warn,
)
from webots_mcp.simulator.instances import Instance, instances
from webots_mcp.simulator.orders import (
    ANSWER_S,
    Message,
    Stream,
    WebotsLine,
    begin_console,
    connected,
    console_lines,
)
from webots_mcp.store.logs import ConsoleRows, Said
from webots_mcp.store.recording import Job, RecordingAccess
from webots_mcp.store.robots import list_robots

MOST_LINES_PER_S: Final = 500  # of wall time
MOST_OLD_LINES: Final = 2_000  # of those printed before the console was followed, the newest

_LEVELS: Final[dict[str, LogLevel]] = {"stdout": "info", "stderr": "warning"}
# How Webots' own lines begin, by the stream that they come on.
_OWN: Final[dict[str, dict[str, LogLevel]]] = {
    "stdout": {"INFO: ": "info"},
    "stderr": {
        "WARNING: ": "warning", "ERROR: ": "error", "FATAL: ": "critical", "ODE ": "warning",
    },
}  # fmt: skip
_CONNECTING_S: Final = 2.0
_LOOK_S: Final = 0.25
# A line waits so long for what a bridge records of it, and for the run that a controller begins.
_HOLD_S: Final = 0.7
_SHORTEST_PAUSE_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 8.0
_RENEW_S: Final = 5.0
_WAITING_LOOK_S: Final = 2.0
_YOUNG_S: Final = 5.0  # a Webots that has just started has printed nothing old
_MOST_HELD: Final = 5_000  # while the database is locked
_LAST_WRITING_S: Final = 3.0
_FIRST_LOOK_S: Final = 1.0  # a server that has just started has answers to give
_LOOK_EVERY_S: Final = 5.0
_NOBODY: Final = "no Webots of this recording runs on this machine, so no console is followed"
_UNSURE: Final = "; it was started without --stream: if no lines appear, start it with --stream"


_JOB: Final = "console of "
_WORLD: Final = "SELECT EXISTS (SELECT 1 FROM run WHERE world = ?)"


def job_of(instance: Instance) -> str:
    """The name of the lease for following the console of that Webots."""
    return f"{_JOB}{instance.name}"


@contextmanager
def follow_console(instance: Instance, recording: RecordingAccess) -> Generator[ConsoleFollower]:
    """While this lasts, what that Webots says in its console is recorded, by one process of many.

    It begins as soon as there is a database. Where Webots cannot be reached, `problem` says why.
    """
    follower = ConsoleFollower(instance, recording)
    follower.start()
    try:
        yield follower
    finally:
        follower.stop()


class _RecordingThread(threading.Thread):
    """A daemon thread that records the lines of a console, each a moment after it came.

    Attributes:
        problem: Why it does not at the moment; None where it does.
    """

    def __init__(self, name: str, recording: RecordingAccess) -> None:
        super().__init__(name=name, daemon=True)
        self.problem: str | None = "it has not started yet"
        self._recording = recording
        self._ending = threading.Event()
        self._held: deque[tuple[float, Said]] = deque()  # when each came
        self._lost = 0

    def _hold(self, lines: Iterable[Said]) -> None:
        """Keep lines until their time comes, and no more of them than is wise."""
        now_s = time.monotonic()
        self._held.extend((now_s, line) for line in lines)
        while len(self._held) > _MOST_HELD:
            self._held.popleft()
            self._lost += 1

    @contextmanager
    def _keeping_on(self) -> Generator[None]:
        """A database that is locked may be written later; the lease that was lost never is."""
        try:
            yield
        except DatabaseError as error:
            self.problem = str(error)

    def _write_held(self, job: Job, rows: ConsoleRows, came_by_s: float) -> None:
        """Record the lines that came until then."""
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
        """Record the lines that have waited for a run, once it is there."""
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
        """Follow, and after a failure try again, ever more seldom."""
        pause_s = 0.0
        while not self._ending.wait(pause_s):
            began_s = time.monotonic()
            try:
                self._follow_if_free()
            except WebotsMCPError as error:
                self.problem = str(error)
            if not self.instance.runs:
                return
            lasted = time.monotonic() - began_s > _LONGEST_PAUSE_S
            longer_s = _SHORTEST_PAUSE_S if lasted else 2 * pause_s
            pause_s = min(max(longer_s, _SHORTEST_PAUSE_S), _LONGEST_PAUSE_S)

    def let_go(self) -> None:
        """Have it end soon."""
        self._ending.set()

    def stop(self) -> None:
        """End it: what has come is recorded, and others may follow at once."""
        self.let_go()
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
        """Until it is to end, or Webots hangs up; what has come is recorded in any case."""
        age_s = time.time() - self.instance.started_wall_time_s
        lines = ConsoleLines(old=self._was_connected or age_s > _YOUNG_S)
        try:
            with connected(self.instance.address, _CONNECTING_S) as stream:
                begin_console(stream)
                self.problem, self._was_connected = None, True
                self._listen(job, stream, lines)
        finally:
            self._hold(lines.idle())
            with suppress(WebotsMCPError):
                self._write_held(job, self._rows, came_by_s=math.inf)

    def _listen(self, job: Job, stream: Stream, lines: ConsoleLines) -> None:
        renew_s = look_s = 0.0
        while not self._ending.is_set():
            message = stream.receive(time.monotonic() + _LOOK_S)
            self._hold(lines.idle())
            if message is not None:
                self._hold(lines.take(message))
            now_s = time.monotonic()
            with self._keeping_on():
                if now_s > renew_s:
                    renew_s = now_s + _RENEW_S
                    job.require_held()
                if self._rows.waits and now_s > look_s:
                    look_s = now_s + _WAITING_LOOK_S
                    self._write_waiting(job, self._rows)
                if self._held and self._held[0][0] < now_s - _HOLD_S:
                    self._write_held(job, self._rows, now_s - _HOLD_S)


class StandInConsole(_RecordingThread):
    """Records the console of a stand-in that runs in this process, while its context lasts.

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
            self.join(timeout=_LAST_WRITING_S)

    def begin(self, port: int) -> None:
        """Begin to record: controllers know the simulation by this port."""
        self._name = f"{host_name()}:{port}"
        self.start()

    def put(self, stream: str, line: str) -> None:
        """Take a line; it is recorded later."""
        with self._adding:
            self._hold(self._lines.take_line(WebotsLine(stream, line)))

    def run(self) -> None:
        """Record until the context is left, and then what is left."""
        rows, lease = ConsoleRows(self._name, self._began_s), lease_of(_JOB + self._name)
        job = Job(self._recording, lease)
        try:
            self._recording.create()
            with self._recording.writer() as connection:
                take(connection, lease)
            renew_s = look_s = time.monotonic()
            while not self._ending.wait(_LOOK_S):
                now_s = time.monotonic()
                self._note_idle()
                with self._keeping_on():
                    if now_s > renew_s + _RENEW_S:
                        renew_s = now_s
                        job.require_held()
                    if rows.waits and now_s > look_s + _WAITING_LOOK_S:
                        look_s = now_s
                        self._write_waiting(job, rows)
                    self._write_held(job, rows, now_s - _HOLD_S)
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
    """A daemon thread that looks for Webots of the recording, and follows each of them.

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
        """Look until stopped; whatever goes wrong ends a look, never the thread."""
        pause_s = _FIRST_LOOK_S
        while not self._ending.wait(pause_s):
            pause_s = _LOOK_EVERY_S
            try:
                self.look()
            except Exception as error:  # noqa: BLE001  (it is reported)
                if str(error) != self._warned_of:
                    self._warned_of = str(error)
                    warn(f"no console of Webots is followed: {error}")

    def look(self) -> None:
        """Follow what is not followed yet.

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
        """Let others follow."""
        self._ending.set()
        if self.is_alive():
            self.join(timeout=2)
        for follower in self._followers.values():
            follower.let_go()
        for follower in self._followers.values():
            follower.stop()


class ConsoleLines:
    """Takes Webots' messages as they come, gives its lines.

    Args:
        old: Whether the first lines may have been printed long before they were read.
    """

    def __init__(self, *, old: bool) -> None:
        self._is_old = old
        self._is_first = True
        self._second = 0
        self._lines_in_second = 0
        self._left_out = 0

    def take(self, message: Message) -> Iterator[Said]:
        """The lines of a message; none of one that is about something else."""
        lines = list(console_lines(message.text))
        if lines and self._is_first:
            self._is_first = False
            yield from self._that_waited(lines)
        else:
            for line in lines:
                yield from self.take_line(line)
        if lines and message.dropped_bytes:
            yield note(f"{message.dropped_bytes} bytes of the console in one burst")

    def _that_waited(self, lines: list[WebotsLine]) -> Iterator[Said]:
        newest = lines[-MOST_OLD_LINES:]
        text = f"the next {len(newest)} lines were printed before the console was followed"
        if len(newest) < len(lines):
            text += f", the last of {len(lines)}"
        if self._is_old or len(newest) < len(lines):
            yield _about(f"({text}: when they were printed is not known)")
        for line in newest:
            yield as_row(line)._replace(is_old=True)

    def idle(self) -> Iterator[Said]:
        """Notes that are due although no line came."""
        if int(time.monotonic()) != self._second:
            yield from self._note_left_out()

    def rest(self) -> Iterator[Said]:
        """Notes of what has been left out until now."""
        yield from self._note_left_out()

    def take_line(self, line: WebotsLine) -> Iterator[Said]:
        """A line that has just been printed, unless it is one of too many."""
        second = int(time.monotonic())
        if second != self._second:
            yield from self._note_left_out()
            self._second, self._lines_in_second = second, 0
        self._lines_in_second += 1
        if self._lines_in_second > MOST_LINES_PER_S:
            self._left_out += 1
        else:
            yield as_row(line)

    def _note_left_out(self) -> Iterator[Said]:
        if self._left_out:
            lost = f"{self._left_out} lines of the console"
            yield note(f"{lost}: more than {MOST_LINES_PER_S} in a second")
            self._left_out = 0


def as_row(line: WebotsLine) -> Said:
    """A line as a row of this moment: its source, and its severity."""
    # What a terminal shows of a line that was written over, as by a progress bar.
    text = line.text.rstrip("\r").rpartition("\r")[2].replace("\0", "�")
    level, source = _judged(line.stream, text)
    return Said(time.time(), level, source, text, line.stream)


def _judged(stream: str, text: str) -> tuple[LogLevel, LogSource]:
    for begin, level in _OWN[stream].items():
        if text.startswith(begin):
            return level, "webots"
    return _LEVELS[stream], "console"


def note(lost: str) -> Said:
    """A line about what was left out."""
    return _about(f"(not recorded: {lost})")


def _about(text: str) -> Said:
    """A line about the lines."""
    return Said(time.time(), "warning", "console", text, None)


# -- whether it is followed ---------------------------------------------------------------------


def console_state(recording: RecordingAccess, connection: sqlite3.Connection) -> str:
    """In a sentence, of all Webots of a recording.

    Args:
        recording: Which is asked about.
        connection: To it.
    """
    running = own_webots(recording)
    states = [_state(each, recording, connection) for each in running]
    recorded = {job_of(each) for each in running}
    states += [
        f"the console of the stand-in {name.removeprefix(_JOB)} is recorded"
        for name in held_jobs(connection, _JOB)
        if name not in recorded
    ]
    return "; ".join(states) or _NOBODY


def _state(instance: Instance, recording: RecordingAccess, connection: sqlite3.Connection) -> str:
    console = f"the console of Webots at port {instance.port}"
    if holder_of(connection, job_of(instance)) is not None:
        unsure = "" if instance.streams else _UNSURE
        return f"{console} is followed{unsure}"
    try:
        with connected(instance.address, ANSWER_S):
            pass
    except CommandRefusedError as error:
        return f"{console} is not followed: {error}"
    if recording.read_only:
        return f"{console} is not followed: a server with --read-only does not, one without does"
    return f"{console} is not followed yet: a server looks for it every few seconds"


# Which of the Webots that run here belong to a recording: no other is followed or steered unasked.
#
# A Webots belongs to a recording where a living session of the recording runs in it; or where it
# was started with a world of the recording's project, or with one that was recorded here before,
# unless its controllers record elsewhere.


def own_webots(recording: RecordingAccess) -> list[Instance]:
    """Those that run on this machine.

    Raises:
        DatabaseError: The recording cannot be read.
    """
    running = instances()
    return [each for each in running if belongs(each, recording)] if running else []


def belongs(instance: Instance, recording: RecordingAccess) -> bool:
    """Whether a Webots is of a recording.

    Raises:
        DatabaseError: The recording cannot be read.
    """
    into = instance.data_dir  # that of a trial has one of its own
    is_elsewhere = into is not None and full_path(into) != full_path(recording.data_dir)
    if not is_elsewhere and _is_in_project(instance, recording):
        return True
    try:
        with recording.reader() as connection:
            is_known = not is_elsewhere and _has_known_world(instance, connection)
            return is_known or _has_live_session(instance, connection)
    except NoDatabaseError:
        return False


def _is_in_project(instance: Instance, recording: RecordingAccess) -> bool:
    project = find_project(full_path(recording.data_dir))
    if project is None or instance.world is None:
        return False
    return instance.world.resolve().is_relative_to(project)


def _has_known_world(instance: Instance, connection: sqlite3.Connection) -> bool:
    if instance.world is None:
        return False
    return bool(connection.execute(_WORLD, (str(instance.world.resolve()),)).fetchone()[0])


def _has_live_session(instance: Instance, connection: sqlite3.Connection) -> bool:
    live = (robot.session for robot in list_robots(connection, time.time()) if robot.live)
    return any(session is not None and session.instance == instance.name for session in live)
