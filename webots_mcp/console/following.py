"""Following the console of one Webots, in a thread, as the only process that does."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from typing import Final

from webots_mcp.console.lines import ConsoleLines, note
from webots_mcp.errors import DatabaseError, WebotsMCPError
from webots_mcp.store import leases
from webots_mcp.store.console import ConsoleRows, Said
from webots_mcp.store.leases import Job
from webots_mcp.store.recording import Recording
from webots_mcp.webots.instances import Instance
from webots_mcp.webots.stream import Stream, begin_console, connected

_CONNECTING_S: Final = 2.0
_LOOK_S: Final = 0.25
# A line waits so long for what a bridge records of it, and for the run that a controller begins.
_HOLD_S: Final = 0.7
_SHORTEST_PAUSE_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 8.0
_RENEW_S: Final = 5.0
_WAITING_LOOK_S: Final = 2.0
_YOUNG_S: Final = 5.0  # a Webots that has just started has said nothing old
_MOST_HELD: Final = 5_000  # while the database is locked


def job_of(instance: Instance) -> str:
    """The name of the lease of whoever follows the console of that Webots."""
    return f"console of {instance.name}"


@contextmanager
def follow_console(instance: Instance, recording: Recording) -> Generator[ConsoleFollower]:
    """While this lasts, what that Webots says in its console is recorded, by one process of many.

    It begins as soon as there is a database. Where nobody can speak to Webots, `problem` says why.
    """
    follower = ConsoleFollower(instance, recording)
    follower.start()
    try:
        yield follower
    finally:
        follower.stop()


class ConsoleFollower(threading.Thread):
    """A daemon thread that records the console of one Webots until that ends.

    Attributes:
        problem: Why it does not at the moment; None where it does.
    """

    def __init__(self, instance: Instance, recording: Recording) -> None:
        super().__init__(name=f"webots-mcp console {instance.port}", daemon=True)
        self.instance = instance
        self.problem: str | None = "it has not begun yet"
        self._recording = recording
        self._ending = threading.Event()
        self._rows = ConsoleRows(instance.name, instance.started_wall_time_s)
        self._held: deque[tuple[float, Said]] = deque()  # when each came
        self._lost = 0
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
        with self._recording.writer() as connection:
            lease = leases.take(connection, job_of(self.instance))
        if lease is None:
            self.problem = "another process follows it"
            return
        job = Job(self._recording, lease)
        try:
            with job.writer() as connection:
                self._rows.begin(connection)
            self._follow(job)
        finally:
            with suppress(WebotsMCPError), self._recording.writer() as connection:
                leases.give_back(connection, lease)

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
                self._write_held(job, came_by_s=math.inf)

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
                    self._write_waiting(job)
                if self._held and self._held[0][0] < now_s - _HOLD_S:
                    self._write_held(job, now_s - _HOLD_S)

    @contextmanager
    def _keeping_on(self) -> Generator[None]:
        """A database that is locked may be written later; the lease that was lost never is."""
        try:
            yield
        except DatabaseError as error:
            self.problem = str(error)

    def _hold(self, lines: Iterable[Said]) -> None:
        """Keep lines until their time comes, and no more of them than is wise."""
        now_s = time.monotonic()
        self._held.extend((now_s, line) for line in lines)
        while len(self._held) > _MOST_HELD:
            self._held.popleft()
            self._lost += 1

    def _write_held(self, job: Job, came_by_s: float) -> None:
        """Record the lines that came until then."""
        lines = [line for came_s, line in self._held if came_s <= came_by_s]
        if self._lost:
            lines.insert(0, note(f"{self._lost} lines of the console: the database was locked"))
        if not lines:
            return
        with job.writer() as connection:
            self._rows.write(connection, lines)
        self.problem, self._lost = None, 0
        while self._held and self._held[0][0] <= came_by_s:
            self._held.popleft()

    def _write_waiting(self, job: Job) -> None:
        """Record the lines that have waited for a run, once it is there."""
        with self._recording.reader() as connection:
            goes_on = self._rows.may_go_on(connection)
        if goes_on:
            with job.writer() as connection:
                self._rows.write(connection, [])
