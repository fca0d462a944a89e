"""Stopping a process at a moment at which others can write."""

from __future__ import annotations

import os
import signal
import sqlite3
from contextlib import closing
from pathlib import Path


def stop_between_writes(pid: int, file: Path) -> None:
    """Stop a process where it does not hold the write lock of that database."""
    while True:
        os.kill(pid, signal.SIGSTOP)
        with closing(sqlite3.connect(file, timeout=0.2, isolation_level=None)) as connection:
            try:
                connection.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError:
                os.kill(pid, signal.SIGCONT)
            else:
                return
