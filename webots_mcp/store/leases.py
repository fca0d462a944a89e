"""Leases: one process at a time does a job, on whatever host; who is gone or stopped loses it.

The holder renews its lease while it works. Where it does not any more, whatever the reason, the
lease runs out and another takes it. A holder that was only stopped finds out at its next write:
what it writes for the job, it writes with the lease in the same transaction (`still_held`).
"""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final

from webots_mcp.contract import host_name
from webots_mcp.errors import DatabaseError, LeaseLostError
from webots_mcp.store.recording import Recording
from webots_mcp.transactions import transaction

LEASE_S: Final = 30.0
# One that ends later was taken before the clock was set back. It is not one lease from now: the
# holder may renew after the asker looked at the clock and before its statement reads the row.
_LATEST_S: Final = 2 * LEASE_S
_RENEW_EVERY_S: Final = 3.0
_TAKE: Final = (
    "INSERT INTO lease (name, holder, until_wall_time_s) VALUES (:name, :holder, :until) "
    "ON CONFLICT (name) DO UPDATE SET holder = :holder, until_wall_time_s = :until "
    "WHERE :forced OR until_wall_time_s NOT BETWEEN :now AND :latest"
)
_RENEW: Final = "UPDATE lease SET until_wall_time_s = ? WHERE name = ? AND holder = ?"
_GIVE_BACK: Final = "DELETE FROM lease WHERE name = ? AND holder = ?"
_HOLDER: Final = "SELECT holder FROM lease WHERE name = ? AND until_wall_time_s BETWEEN ? AND ?"
_LOST: Final = (
    "{} was taken over by another process{}, since this one had not renewed its lease for "
    f"{LEASE_S:g} s: it wrote nothing more"
)

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Lease:
    """The right to do a job, by the name of the job."""

    name: str
    holder: str


def holder_of(connection: sqlite3.Connection, name: str) -> str | None:
    """Who renewed the lease of that job lately; None where nobody did."""
    now_s = time.time()
    row = connection.execute(_HOLDER, (name, now_s, now_s + _LATEST_S)).fetchone()
    return row and str(row[0])


def take(connection: sqlite3.Connection, name: str, *, forced: bool = False) -> Lease | None:
    """Take the lease of a job; None where somebody has it.

    Args:
        connection: In the role "writer".
        name: Of the job.
        forced: Take it from its holder, who is known to be gone.
    """
    now_s = time.time()
    lease = Lease(name, f"{host_name()} {os.getpid()} {os.urandom(4).hex()}")
    times = {"now": now_s, "until": now_s + LEASE_S, "latest": now_s + _LATEST_S}
    values = {**vars(lease), **times, "forced": forced}
    return lease if connection.execute(_TAKE, values).rowcount else None


def give_back(connection: sqlite3.Connection, lease: Lease) -> None:
    """Let others take it at once."""
    connection.execute(_GIVE_BACK, (lease.name, lease.holder))


@contextmanager
def still_held(connection: sqlite3.Connection, lease: Lease) -> Generator[None]:
    """A transaction for what only the holder may write; it renews the lease.

    Raises:
        LeaseLostError: Another process has taken it; nothing is written.
    """
    with transaction(connection):
        values = (time.time() + LEASE_S, lease.name, lease.holder)
        if connection.execute(_RENEW, values).rowcount == 0:
            holder = holder_of(connection, lease.name)  # None where that one is done by now
            raise LeaseLostError(_LOST.format(lease.name, f" ({holder})" if holder else ""))
        yield


@dataclass(frozen=True)
class Job:
    """What this process does as long as it holds the lease.

    Attributes:
        recording: In which the lease is.
        lease: As `take` gave it.
    """

    recording: Recording
    lease: Lease

    @contextmanager
    def writer(self) -> Generator[sqlite3.Connection]:
        """A connection in a transaction, for what only the holder may write.

        Raises:
            LeaseLostError: Another process has the lease; nothing is written.
        """
        with self.recording.writer() as connection, still_held(connection, self.lease):
            yield connection

    def require_held(self) -> None:
        """See that it is still this process that does it.

        Raises:
            LeaseLostError: Another one does.
        """
        with self.writer():
            pass

    @contextmanager
    def renewed(self) -> Generator[None]:
        """While this lasts, the lease does not run out."""
        over = threading.Event()
        thread = threading.Thread(target=self._renew, args=(over,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _renew(self, over: threading.Event) -> None:
        while not over.wait(_RENEW_EVERY_S):
            with suppress(LeaseLostError):  # whoever works finds out when it writes
                self._renew_now()

    def _renew_now(self) -> None:
        try:
            self.require_held()
        except DatabaseError as error:  # there is time to try again
            _log.warning("%s is not renewed: %s", self.lease.name, error)
