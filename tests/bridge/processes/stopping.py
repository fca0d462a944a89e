"""Stopping a process at a moment at which others can write."""

from __future__ import annotations

import os
import signal
import sqlite3
from contextlib import closing
from pathlib import Path

import psutil

from tests.waiting import wait_for


def stop_between_writes(pid: int, file: Path) -> None:
    """Stop a process where it does not hold the write lock of that database."""
    while True:
        os.kill(pid, signal.SIGSTOP)
        wait_for(lambda: _is_stopped(pid), pause_s=0.001)
        with closing(sqlite3.connect(file, timeout=0.2, isolation_level=None)) as connection:
            try:
                connection.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError:
                os.kill(pid, signal.SIGCONT)
            else:
                return


def _is_stopped(pid: int) -> bool:
    """Whether no thread still ends a call of the system, in which it might take the lock."""
    threads = [*Path(f"/proc/{pid}/task").glob("*/stat")]
    if not threads:  # another system than Linux
        return psutil.Process(pid).status() == psutil.STATUS_STOPPED
    states = (each.read_text().rpartition(")")[2].split()[0] for each in threads)
    return all(state == "T" for state in states)
