"""Leases: one process at a time does a job, on whatever host.

The holder renews its lease while it works. Where it no longer does, for whatever reason, the lease
runs out and another process takes it. A holder that was only stopped finds out at its next write:
what it writes for the job, it writes with the lease in the same transaction (`still_held`).

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Final, NamedTuple

from webots_mcp.contract import host_name
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import LeaseLostError

LEASE_S: Final = 30.0
# One that ends later was taken before the clock was set back. It is not one lease from now: the
# holder may renew after the caller read the clock and before its statement reads the row.
_TIMES: Final = 2


class JobLease(NamedTuple):
    """The right to do a job.

    Attributes:
        name: The name of the job.
        holder: A text that identifies the process that does it.
        lasts_s: Wall time for which the lease holds each time it is taken or renewed, in seconds.
    """

    name: str
    holder: str
    lasts_s: float = LEASE_S

    def latest_s(self, now_s: float) -> float:
        """Return the latest wall time up to which a held lease may last."""
        return now_s + _TIMES * self.lasts_s


def lease_of(name: str) -> JobLease:
    """Return a lease for a job that this process can take."""
    return JobLease(name, f"{host_name()} {os.getpid()} {os.urandom(4).hex()}")


def holder_of(connection: sqlite3.Connection, name: str) -> str | None:
    """Return the process that holds the lease of a job; None if no process renewed it lately."""
    now_s = time.time()
    statement = "SELECT holder FROM lease WHERE name = ? AND until_wall_time_s BETWEEN ? AND ?"
    row = connection.execute(statement, (name, now_s, now_s + _TIMES * LEASE_S)).fetchone()
    return row and str(row[0])


def held_jobs(connection: sqlite3.Connection, prefix: str) -> list[str]:
    """Return the names of the jobs with this prefix whose lease some process holds."""
    now_s = time.time()
    asked = {"prefix": prefix, "now": now_s, "latest": now_s + _TIMES * LEASE_S}
    statement = (
        "SELECT name FROM lease WHERE substr(name, 1, length(:prefix)) = :prefix "
        "AND until_wall_time_s BETWEEN :now AND :latest ORDER BY name"
    )
    return [str(name) for (name,) in connection.execute(statement, asked)]


def take(
    connection: sqlite3.Connection,
    lease: JobLease,
    *,
    forced: bool = False,
    outranked: str | None = None,
) -> bool:
    """Take a lease, or renew it; False if another process has it.

    Args:
        connection: A connection in the role "writer".
        lease: The lease, and its holder.
        forced: Take it from its holder, whose process is known to have ended.
        outranked: Live holders from which it may be taken, as a LIKE pattern.
    """
    now_s = time.time()
    times = {"now": now_s, "until": now_s + lease.lasts_s, "latest": lease.latest_s(now_s)}
    names = {"name": lease.name, "holder": lease.holder, "outranked": outranked}
    statement = (
        "INSERT INTO lease (name, holder, until_wall_time_s) VALUES (:name, :holder, :until) "
        "ON CONFLICT (name) DO UPDATE SET holder = :holder, until_wall_time_s = :until "
        "WHERE holder = :holder OR until_wall_time_s NOT BETWEEN :now AND :latest "
        "OR :forced OR holder LIKE :outranked"
    )
    return connection.execute(statement, {**names, **times, "forced": forced}).rowcount > 0


def give_back(connection: sqlite3.Connection, lease: JobLease) -> None:
    """Release a lease, so that others can take it at once."""
    statement = "DELETE FROM lease WHERE name = ? AND holder = ?"
    connection.execute(statement, (lease.name, lease.holder))


@contextmanager
def still_held(connection: sqlite3.Connection, lease: JobLease) -> Generator[None]:
    """Open a transaction for what only the holder may write; it renews the lease.

    Raises:
        LeaseLostError: If another process has taken the lease; nothing is written.
    """
    with transaction(connection):
        values = (time.time() + lease.lasts_s, lease.name, lease.holder)
        if (
            connection.execute(
                "UPDATE lease SET until_wall_time_s = ? WHERE name = ? AND holder = ?", values
            ).rowcount
            == 0
        ):
            holder = holder_of(connection, lease.name)  # None where that one is done by now
            by = f" ({holder})" if holder else ""
            raise LeaseLostError(
                f"{lease.name} was taken over by another process{by}, since this one had not "
                f"renewed its lease for {lease.lasts_s:g} s: it wrote nothing more"
            )
        yield
