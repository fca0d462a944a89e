"""The maintainer: whose lease counts, and what does not end its thread."""

from __future__ import annotations

import io
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.database.maintenance import LEASE_S, Maintainer
from webots_mcp.questions.list_robots import webots_list_robots
from webots_mcp.setup.doctor import diagnose, subject_of
from webots_mcp.setup.doctor.recording_checks import database as checked_database
from webots_mcp.store.recording import RecordingAccess

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

    monkeypatch.setattr("webots_mcp.database.maintenance.INTERVAL_S", 0.02)
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


def test_a_log_is_copied_while_it_is_written_begun_anew_when_it_is_long_and_cut_when_it_rests(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.database.maintenance.LONG_LOG_BYTES", 4_000_000)
    assert isinstance(recorded.database, Path)
    log = Path(f"{recorded.database}-wal")
    robot = recorded.robot()
    maintainer = Maintainer(recorded.database, "server")

    def grow(rows: int) -> int:
        """The log's length after so many rows, and a round of the maintainer."""
        for i in range(rows):
            robot.state(i * 1.0, {"text": "x" * 3000})
        assert maintainer.tick()
        return log.stat().st_size

    whole = grow(100)
    assert whole > 1_000_000
    with closing(sqlite3.connect(recorded.database, isolation_level=None)) as reader:
        assert grow(10) == whole  # all was copied, and the next commit began the log anew
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM state").fetchone()
        long = grow(200)  # what the reader looks at keeps the log from that
        assert long > 4_000_000
    assert grow(10) < long + 1_000_000
    assert grow(100) < long + 1_000_000  # where 3 MB would have been added
    assert grow(0) < 10_000
    assert recorded.connection.execute("SELECT count(*) FROM state").fetchone() == (420,)
    assert recorded.connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    maintainer._disconnect()  # pyright: ignore[reportPrivateUsage]


READER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN")
print(connection.execute("SELECT count(*) FROM state").fetchone(), flush=True)
sys.stdin.read()
"""


def test_a_reader_of_another_program_that_holds_the_log_is_told_until_it_ends(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("webots_mcp.database.maintenance.LONG_LOG_BYTES", 1_000_000)
    monkeypatch.setattr("webots_mcp.database.maintenance.LONGEST_LOG_BYTES", 2_000_000)
    monkeypatch.setattr("webots_mcp.database.maintenance.HELD_LOG_BYTES", 3_000_000)
    file = recorded.database
    assert isinstance(file, Path)
    recording = RecordingAccess(file, file.parent)
    robot = recorded.robot()
    maintainer = Maintainer(file, "server")

    def grow() -> None:
        for i in range(200):
            robot.state(i * 1.0, {"text": "x" * 9000})
        assert maintainer.tick()

    def told() -> tuple[str, str]:
        found = diagnose(subject_of(recording, "the test"), [checked_database])[0].finding
        return webots_list_robots.function(
            recording
        ).storage or "", f"{found.seen} {found.fix or ''}"

    grow()
    assert not any("holds a read transaction" in text for text in told())
    with subprocess.Popen(
        [sys.executable, "-c", READER, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as reader:
        assert reader.stdout is not None and reader.stdout.readline()
        for _ in range(3):
            grow()
        assert Path(f"{file}-wal").stat().st_size > 3_000_000
        for text in told():
            assert "MB long" in text and "holds a read transaction" in text
            assert "end the transaction" in text
        assert capsys.readouterr().err.count("holds a read transaction") == 1
        reader.communicate()
    grow()
    assert Path(f"{file}-wal").stat().st_size < 100_000
    assert not any("holds a read transaction" in text for text in told())
    maintainer._disconnect()  # pyright: ignore[reportPrivateUsage]


def test_before_each_checkpoint_there_is_a_commit_that_no_checkpoint_has_copied(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else another's commit could begin the log anew while a checkpoint starts."""
    monkeypatch.setattr("webots_mcp.database.maintenance.LONG_LOG_BYTES", 0)
    assert isinstance(recorded.database, Path)
    robot = recorded.robot()
    maintainer = Maintainer(recorded.database, "server")
    statements: list[str] = []
    maintainer.tick()
    maintainer._connection.set_trace_callback(statements.append)  # pyright: ignore[reportPrivateUsage, reportOptionalMemberAccess]
    for i in range(100):
        robot.state(i * 1.0, {"text": "x" * 9000})
    maintainer.tick()
    found = [text[:11] for text in statements if "wal_checkpoint" in text or "INTO lease" in text]
    assert found == ["INSERT INTO", "PRAGMA wal_", "INSERT INTO", "PRAGMA wal_", "INSERT INTO"]
    maintainer._disconnect()  # pyright: ignore[reportPrivateUsage]


def test_where_another_took_the_lease_no_checkpoint_is_made(recorded: Recorded) -> None:
    assert isinstance(recorded.database, Path)
    robot = recorded.robot()
    maintainer = Maintainer(recorded.database, "bridge")
    assert maintainer.tick()
    for i in range(100):
        robot.state(i * 1.0, {"text": "x" * 9000})
    taken = ("server 1 other", time.time() + LEASE_S)
    recorded.connection.execute("UPDATE lease SET holder = ?, until_wall_time_s = ?", taken)
    assert maintainer._copy_log(maintainer._connection, "RESTART") == 0  # pyright: ignore[reportPrivateUsage, reportArgumentType]
    assert Path(f"{recorded.database}-wal").stat().st_size > 1_000_000
    maintainer._disconnect()  # pyright: ignore[reportPrivateUsage]


def test_a_loop_that_writes_without_a_pause_is_not_told_as_a_reader(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("webots_mcp.database.maintenance.LONG_LOG_BYTES", 1_000_000)
    monkeypatch.setattr("webots_mcp.database.maintenance.HELD_LOG_BYTES", 500_000)
    file, stopped = recorded.database, threading.Event()
    assert isinstance(file, Path)
    recorded.robot()

    def write() -> None:
        with closing(sqlite3.connect(file, isolation_level=None, timeout=60)) as writer:
            writer.execute("PRAGMA wal_autocheckpoint=0")
            while not stopped.is_set():
                writer.execute("UPDATE robot SET name = name")

    thread = threading.Thread(target=write)
    thread.start()
    maintainer = Maintainer(file, "server")
    try:
        for _ in range(40):
            assert maintainer.tick()
    finally:
        stopped.set()
        thread.join()
    assert "holds a read transaction" not in capsys.readouterr().err
    maintainer._disconnect()  # pyright: ignore[reportPrivateUsage]
