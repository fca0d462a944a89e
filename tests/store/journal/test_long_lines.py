"""Journals with lines of 3 MB hold up no question for long, no memory, and no end by SIGTERM."""

from __future__ import annotations

import json
import re
import signal
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.store.journal.test_conformance import part
from tests.store.journal.test_unfit_values import HEADER, RUN, RUN_VALUES
from tests.waiting import wait_for
from webots_mcp.errors import DatabaseError
from webots_mcp.store.journal_intake import ingest_journals
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.slow

LINES = 30


def write(folder: Path, branches: int) -> Path:
    """Write a journal of long states, of 300 values for each branch."""
    data = {f"b{i}": {f"c{j}": [1, 2, 3] for j in range(100)} for i in range(branches)}
    text = json.dumps(data, separators=(",", ":"))
    with part(folder).open("w") as journal:
        journal.write(f"{json.dumps(HEADER)}\n{json.dumps([1, 'run', None, RUN_VALUES])}\n")
        for number in range(2, LINES + 2):
            journal.write(f'[{number},"state","{RUN}",[{number},1000.0,{text}]]\n')
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a journal of states of which an intake reads one at once: each is over 1 MB."""
    return write(tmp_path, 800)


@pytest.fixture
def longest(tmp_path: Path) -> Path:
    """With a journal of states of 3 MB."""
    return write(tmp_path, 2000)


def states(folder: Path) -> int:
    with closing(sqlite3.connect(folder / "webots.db")) as connection:
        return connection.execute("SELECT count(*) FROM state").fetchone()[0]


def test_an_intake_ends_with_its_budget_goes_on_later_and_says_what_is_left(folder: Path) -> None:
    recording = RecordingAccess(folder / "webots.db", folder)
    recording.create()
    with recording.writer() as connection:
        counts = [0]
        for _ in range(6):
            ingest_journals(connection, folder / "webots.db", budget_s=0.0)
            counts.append(states(folder))
    assert all(after - before in (0, 1) for before, after in pairwise(counts))
    assert 0 < counts[-1] < LINES
    unread = RecordingAccess(folder / "webots.db", folder, read_only=True)
    with unread.view() as view:
        assert part(folder).name in view.header()["storage"]


def peak_memory_bytes(process: subprocess.Popen[Any]) -> int:
    """Return the peak of its resident memory, 0 once it has ended or where there is no /proc.

    Not `ru_maxrss`: a child begins with its parent's peak there, which is the one of pytest.
    """
    try:
        status = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return 0
    found = re.search(r"^VmHWM:\s+(\d+) kB$", status, re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


def test_an_intake_waits_for_that_of_another_thread_no_longer_than_its_budget(
    folder: Path,
) -> None:
    recording = RecordingAccess(folder / "webots.db", folder)
    recording.create()
    taken_in: list[int] = []

    def take_in_all() -> None:
        with suppress(DatabaseError), recording.writer() as connection:
            connection.set_progress_handler(ending.is_set, 100)
            ingest_journals(connection, folder / "webots.db")

    ending = threading.Event()
    other = threading.Thread(target=take_in_all)
    other.start()
    try:
        wait_for(lambda: states(folder) > 0)
        with recording.writer() as connection:
            ingest_journals(connection, folder / "webots.db", budget_s=0.0)
        taken_in.append(states(folder))
    finally:
        ending.set()
        other.join()
    assert 0 < taken_in[0] < LINES


def test_a_server_looks_after_the_database_while_it_takes_in_a_long_journal(folder: Path) -> None:
    RecordingAccess(folder / "webots.db", folder).create()
    lease = "SELECT until_wall_time_s FROM lease WHERE name = 'maintainer'"
    arguments = [sys.executable, "-m", "webots_mcp", "serve", "--data-dir", str(folder)]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL}
    with subprocess.Popen(arguments, stderr=subprocess.DEVNULL, **pipes) as process:
        try:
            wait_for(lambda: states(folder) > 0)
            with closing(sqlite3.connect(folder / "webots.db")) as connection:
                before = connection.execute(lease).fetchall()
                wait_for(lambda: connection.execute(lease).fetchall() != before)
            taken_in = states(folder)
        finally:
            process.kill()
    assert 0 < taken_in < LINES


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("command", [["status"], ["export", "--format", "jsonl"], ["serve"]])
def test_sigterm_ends_a_command_that_ingests(longest: Path, command: list[str]) -> None:
    arguments = [sys.executable, "-m", "webots_mcp", *command, "--data-dir", str(longest)]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL}
    peaks_bytes = [0]
    with subprocess.Popen(arguments, stderr=subprocess.DEVNULL, **pipes) as process:

        def begun() -> bool:
            file = longest / "webots.db"
            return file.exists() and file.stat().st_size > 0

        def ended() -> bool:
            peaks_bytes.append(peak_memory_bytes(process))
            return process.poll() is not None

        wait_for(begun)
        process.send_signal(signal.SIGTERM)
        wait_for(ended)
    assert process.returncode == 143
    assert part(longest).exists()  # it ended before all of it was ingested
    assert max(peaks_bytes) < 700_000_000
