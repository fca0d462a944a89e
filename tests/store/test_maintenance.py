"""The maintainer: whose lease counts, and what does not end its thread."""

from __future__ import annotations

import io
import sqlite3
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.store.recorded import Recorded
from webots_mcp.maintenance import LEASE_S, Maintainer

LEASE = "INSERT INTO lease (name, holder, until_wall_time_s) VALUES ('maintainer', ?, ?)"
HOLDER = "SELECT holder FROM lease"


class FullDisk(io.StringIO):
    def write(self, _: str, /) -> int:
        raise OSError(28, "No space left on device")


@pytest.mark.parametrize("stderr", [FullDisk(), None])
def test_neither_a_failing_work_nor_a_failing_stderr_ends_the_thread(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch, stderr: io.StringIO | None
) -> None:
    assert isinstance(recorded.database, Path)
    again = threading.Event()
    calls: list[int] = []

    def work(_: sqlite3.Connection) -> None:
        calls.append(1)
        if len(calls) > 1:
            again.set()
        raise ZeroDivisionError(len(calls))

    monkeypatch.setattr("webots_mcp.maintenance.INTERVAL_S", 0.02)
    monkeypatch.setattr("sys.stderr", stderr)
    maintainer = Maintainer(recorded.database, "server", work=work)
    maintainer.start()
    assert again.wait(timeout=10)
    assert maintainer.is_alive()
    maintainer.stop()
    assert maintainer.failures >= 1


@pytest.mark.parametrize(("ends_in_s", "taken"), [(-1.0, True), (LEASE_S, False), (3600.0, True)])
def test_a_lease_that_was_taken_before_the_clock_was_set_back_is_free(
    recorded: Recorded, ends_in_s: float, taken: bool
) -> None:
    assert isinstance(recorded.database, Path)
    recorded.connection.execute(LEASE, ("server 1 other", time.time() + ends_in_s))
    maintainer = Maintainer(recorded.database, "server")
    assert maintainer.tick() is taken
    with closing(sqlite3.connect(recorded.database)) as connection:
        (holder,) = connection.execute(HOLDER).fetchone()
    assert (holder != "server 1 other") is taken
    maintainer._disconnect()  # pyright: ignore[reportPrivateUsage]
