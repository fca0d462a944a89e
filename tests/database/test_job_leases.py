"""Who holds a lease holds it for everybody, whenever they look."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.database.connection import connect
from webots_mcp.database.job_leases import (
    LEASE_S,
    JobLease,
    give_back,
    holder_of,
    lease_of,
    still_held,
    take,
)

JOB = "trial set 1"


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    recorded = Recorded(tmp_path / "webots.db")
    yield tmp_path / "webots.db"
    recorded.close()


@pytest.fixture
def lease(file: Path) -> JobLease:
    taken = lease_of(JOB)
    with closing(connect(file, "writer")) as connection:
        assert take(connection, taken)
    return taken


@contextmanager
def renewed_before_each_statement(file: Path, lease: JobLease) -> Generator[sqlite3.Connection]:
    """A connection whose every statement begins just after the holder renewed its lease."""
    with (
        closing(connect(file, "writer")) as holder,
        closing(connect(file, "writer")) as connection,
    ):

        def renew(_: str) -> None:
            with still_held(holder, lease):
                pass

        connection.set_trace_callback(renew)
        yield connection
        connection.set_trace_callback(None)


def test_a_lease_that_is_renewed_just_as_one_asks_is_held(file: Path, lease: JobLease) -> None:
    with renewed_before_each_statement(file, lease) as connection:
        assert holder_of(connection, JOB) == lease.holder


def test_a_lease_that_is_renewed_just_as_another_takes_it_stays_with_its_holder(
    file: Path, lease: JobLease
) -> None:
    with renewed_before_each_statement(file, lease) as connection:
        assert not take(connection, lease_of(JOB))
        assert holder_of(connection, JOB) == lease.holder


@pytest.mark.parametrize("left_s", [-1.0, 10 * LEASE_S])
def test_a_lease_that_ran_out_or_is_of_a_clock_that_was_set_back_is_nobodys(
    file: Path, lease: JobLease, left_s: float
) -> None:
    with closing(connect(file, "writer")) as connection:
        connection.execute("UPDATE lease SET until_wall_time_s = ?", (time.time() + left_s,))
        assert holder_of(connection, JOB) is None
        assert take(connection, lease_of(JOB))


def test_who_outranks_the_holder_of_a_lease_takes_it_and_gives_it_back(file: Path) -> None:
    bridge, server = lease_of(JOB)._replace(holder="bridge 1"), lease_of(JOB)
    with closing(connect(file, "writer")) as connection:
        assert take(connection, bridge)
        assert not take(connection, server, outranked="server %")
        assert take(connection, server, outranked="bridge %")
        assert not take(connection, bridge)
        give_back(connection, server)
        assert take(connection, bridge)
