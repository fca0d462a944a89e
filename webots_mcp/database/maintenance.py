"""Periodic work and checkpoints, done by one process at a time and never in a control loop.

A `Maintainer` calls `work` once a second: a server makes chunks there, deletes what is too old,
and ends the sessions of dead processes.

The log of a WAL database grows until a checkpoint copies it back. An automatic checkpoint would
be the slowest step of a control loop (5 ms at p99.9, measured), so the bridge's connection makes
none. Exactly one maintainer does: the holder of the lease.

Nearly all is copied without the write lock (a PASSIVE checkpoint), and only what is left when the
log is long is copied with it, to begin the log anew (RESTART). In SQLite before 3.51.3 a checkpoint
without the lock can damage the file, if it starts while another's commit begins the log anew (the
WAL-reset bug). A commit does that only where the whole log has been copied. The maintainer
therefore renews its lease, which is a commit, before each checkpoint: until its own checkpoint
copies that commit, the log is not copied as a whole, and no other commit can begin it anew.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sqlite3
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal, NamedTuple

from webots_mcp.database.connection import CHECKPOINT_TIMEOUT_MS, connect, identify_files
from webots_mcp.database.job_leases import JobLease, give_back, take
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.database.schema import require_current
from webots_mcp.database.transactions import is_busy, text_of
from webots_mcp.database.waiting_file import adopt
from webots_mcp.errors import WebotsMCPError, warn

INTERVAL_S: Final = 1.0
LEASE_S: Final = 5.0
_JOB: Final = "maintainer"
_BRIDGES: Final = "bridge %"  # which give way to a server
LONG_LOG_BYTES: Final = 12_000_000  # it begins anew, for which rows wait a few milliseconds
LONGEST_LOG_BYTES: Final = 32_000_000  # its file is cut
# A log that a reader holds cannot begin anew. A warning is printed if it is longer than this or, on
# a disk with little space, than `share_of_free_space`.
HELD_LOG_BYTES: Final = 100_000_000
FREE_THE_LOG: Final = (
    "end the transaction of the program that reads the database, or close that program (a sqlite3 "
    "shell, a notebook, a browser of databases); the log is cut by itself then, as long as "
    "'webots-mcp serve' (not --read-only) or a controller runs"
)


Kind = Literal["server", "bridge", "prune", "question"]


class LogLimits(NamedTuple):
    """Sizes of the write-ahead log, and times for keeping it short.

    Attributes:
        hurried_interval_s: Interval of maintenance while the log grows fast, because a long one
            takes long to copy.
        short_bytes: Size up to which a log is left alone.
        fast_growth_bytes: Growth in one interval that counts as fast.
        share_of_free_space: Share of the free space from which a held log is reported, on a disk
            with little space.
        shortest_held_bytes: Size up to which a log may grow that nobody holds.
        held_retry_s: Time between two attempts while nothing is written; each attempt makes the log
            longer.
        restart_wait_ms: Wait for the write lock, which a loop that writes without a pause rarely
            leaves free, and then for readers. A row may wait that long.
    """

    hurried_interval_s: float = 0.25
    short_bytes: int = 1_000_000
    fast_growth_bytes: int = 4_000_000
    share_of_free_space: float = 0.1
    shortest_held_bytes: int = 40_000_000
    held_retry_s: float = 10.0
    restart_wait_ms: int = 3


LOG_LIMITS: Final = LogLimits()


class Maintainer(threading.Thread):
    """A daemon thread that keeps the log short while it holds the lease.

    Args:
        database: The file; it may appear later.
        kind: Who maintains. A server takes the lease from a bridge.
        on_tick: Called once an interval, lease or not; must not wait.
        work: Called once an interval with a connection while the lease is held.
    """

    def __init__(
        self,
        database: Path,
        kind: Kind,
        on_tick: Callable[[], object] | None = None,
        work: Callable[[sqlite3.Connection], object] | None = None,
    ) -> None:
        super().__init__(name="webots-mcp maintainer", daemon=True)
        self._database = database
        self._lease = JobLease(_JOB, f"{kind} {os.getpid()} {os.urandom(3).hex()}", LEASE_S)
        self._outranked = _BRIDGES if kind == "server" else None
        self._on_tick = on_tick
        self._work = work
        self._connection: sqlite3.Connection | None = None
        self._files: tuple[int, ...] = ()
        self._ending = threading.Event()
        self._held_before = False
        self._interval_s = LOG_LIMITS.hurried_interval_s
        self._data_version = -1
        self._log_bytes = 0  # after the last checkpoint
        self._copied_bytes = 0  # of the log, by the last checkpoint
        self._is_held = False  # a reader keeps the log from beginning anew
        self._retry_s = 0.0
        self._has_warned_of_reader = False
        self._warned_of = ""
        self.failures = 0  # rounds that were not finished

    def run(self) -> None:
        """Tick until stopped; whatever goes wrong ends a tick, never the thread."""
        while not self._ending.wait(self._interval_s):
            self._tick_safely()
        self._give_back()

    def _tick_safely(self) -> None:
        try:
            self.tick()
        except Exception as error:  # noqa: BLE001  (`work` is anybody's)
            self._disconnect()
            self.failures += 1
            if not is_busy(error) and repr(error) != self._warned_of:
                self._warned_of = repr(error)
                warn(f"maintenance waits: {_described(error)}")

    def stop(self) -> None:
        """End the thread within an instant and give the lease back."""
        self._ending.set()
        if self.is_alive():
            self.join(timeout=2)
        elif self.ident is None:  # never started: `tick` was called without a thread that ends it
            self._give_back()

    def tick(self) -> bool:
        """Do one round of work; return whether this maintainer holds the lease."""
        self._interval_s = INTERVAL_S
        if self._on_tick is not None:
            self._on_tick()
        if self._files != identify_files(self._database):
            self._disconnect()
        if not self._database.exists():
            return False
        if self._connection is None:
            self._connection = self._connect()
            self._files = identify_files(self._database)
        held = self._hold_lease(self._connection)
        # A lease that was just taken from another: give a checkpoint of theirs time to end.
        if held and self._held_before:
            self._checkpoint(self._connection)
            adopt(self._connection, self._database)
            if self._work is not None:
                self._work(self._connection)
        self._held_before = held
        return held

    def _connect(self) -> sqlite3.Connection:
        connection = connect(self._database, "writer", patient=False)
        try:
            require_current(connection)
            connection.execute(f"PRAGMA busy_timeout={CHECKPOINT_TIMEOUT_MS}")
        except BaseException:
            connection.close()
            raise
        return connection

    def _hold_lease(self, connection: sqlite3.Connection) -> bool:
        """Take or renew the lease; it is renewed at half time, so that most ticks write nothing."""
        now = time.time()
        # Another program may have written anything: an end that is not a number counts as expired.
        lease = connection.execute(
            f"SELECT holder = :holder, holder LIKE '{_BRIDGES}', "
            "iif(typeof(until_wall_time_s) IN ('real', 'integer'), until_wall_time_s, 0) "
            f"FROM lease WHERE name = '{_JOB}'",
            {"holder": self._lease.holder},
        ).fetchone()
        is_ours, is_bridges, until_s = lease or (False, False, 0.0)
        if is_ours and LEASE_S / 2 < until_s - now <= LEASE_S:
            return True
        outranked = is_bridges and self._outranked
        if not is_ours and now <= until_s <= self._lease.latest_s(now) and not outranked:
            return False
        if lease is None:  # it was free: there is no checkpoint of another's to wait for
            self._held_before = True
        return self._take_lease(connection)

    def _take_lease(self, connection: sqlite3.Connection) -> bool:
        """Take or renew the lease; a server takes it from a bridge."""
        return take(connection, self._lease, outranked=self._outranked)

    def _checkpoint(self, connection: sqlite3.Connection) -> None:
        """Copy the log back, if it is long and grew since the last time; cut it once it rests."""
        log = Path(f"{self._database}-wal")
        file_bytes = log.stat().st_size if log.exists() else 0
        if file_bytes < LOG_LIMITS.short_bytes:
            return
        version = int(connection.execute("PRAGMA data_version").fetchone()[0])
        rests, self._data_version = version == self._data_version, version
        if rests and self._is_held and time.monotonic() < self._retry_s:
            return
        copied_before_bytes = self._copied_bytes
        log_bytes = self._copy_log(connection, "PASSIVE")
        if log_bytes - self._log_bytes > LOG_LIMITS.fast_growth_bytes:
            self._interval_s = LOG_LIMITS.hurried_interval_s
        # The file stays long where a commit began the log anew before it could be cut.
        cut = rests or file_bytes > LONGEST_LOG_BYTES
        if cut or log_bytes > LONG_LOG_BYTES:
            log_bytes = self._copy_log(connection, "TRUNCATE" if cut else "RESTART")
            # The first commit into a new log waits until the disk has the log's header. Made here
            # it costs no control loop its time: 5 ms at p99.9.
            self._take_lease(connection)
            # A reader lets nothing be copied beyond the rows that it sees; a writer lets more.
            self._note_held(is_held=log_bytes > 0 and self._copied_bytes == copied_before_bytes)
        self._log_bytes = log_bytes

    def _note_held(self, *, is_held: bool) -> None:
        """Warn of a reader that holds a long log, once until it releases it."""
        self._is_held, self._retry_s = is_held, time.monotonic() + LOG_LIMITS.held_retry_s
        description = held_log(self._database) if is_held else None
        if description is not None and not self._has_warned_of_reader:
            warn(f"{description}: {FREE_THE_LOG}")
        has_warned = self._has_warned_of_reader or description is not None
        self._has_warned_of_reader = is_held and has_warned

    def _copy_log(self, connection: sqlite3.Connection, how: str) -> int:
        """Checkpoint right after a commit of our own, so that no other commit restarts the log.

        Returns:
            The length of the log in bytes; 0 once it begins anew.
        """
        if not self._take_lease(connection):
            return 0
        connection.execute(f"PRAGMA busy_timeout={LOG_LIMITS.restart_wait_ms}")
        try:
            (checkpoint,) = connection.execute(f"PRAGMA wal_checkpoint({how})").fetchall()
        finally:
            connection.execute(f"PRAGMA busy_timeout={CHECKPOINT_TIMEOUT_MS}")
        is_kept, pages, copied_pages = map(int, checkpoint)
        page_bytes = int(connection.execute("PRAGMA page_size").fetchone()[0])
        self._copied_bytes = copied_pages * page_bytes
        if how != "PASSIVE" and not is_kept:
            return 0
        return max(pages, 1) * page_bytes

    def _give_back(self) -> None:
        if self._connection is None:
            return
        try:
            give_back(self._connection, self._lease)
        except sqlite3.Error as error:
            warn(f"the lease will expire by itself: {error}")
        self._disconnect()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._held_before = False


def held_log(database: Database) -> str | None:
    """Describe a log whose length shows that a reader holds it; None for a shorter one."""
    if isinstance(database, MemoryDatabase):
        return None
    import shutil  # which a controller loads only here, in the maintainer's thread

    log = Path(f"{database}-wal")
    try:
        log_bytes, free_bytes = log.stat().st_size, shutil.disk_usage(log.parent).free
    except OSError:
        return None  # there is none
    share_bytes = max(LOG_LIMITS.share_of_free_space * free_bytes, LOG_LIMITS.shortest_held_bytes)
    if log_bytes <= min(HELD_LOG_BYTES, share_bytes):
        return None
    return (
        f"{log.name} is {log_bytes / 1e6:.0f} MB long, with {free_bytes / 1e9:.1f} GB free: it "
        "grows until the disk is full while a program holds a read transaction"
    )


def _described(error: Exception) -> str:
    """Return the text of an error of the database or of ours; the `repr` of any other."""
    if isinstance(error, (sqlite3.Error, WebotsMCPError, OSError)):
        return text_of(error)
    return repr(error)
