"""Claims the commands of robot 1 until none is left, and says which it got.

python -m tests.benchmarks.programs.claimer DATABASE
"""

from __future__ import annotations

import sqlite3
import sys
import time
from pathlib import Path

from tests.benchmarks.processes import say
from webots_mcp.connection import connect, never_wait
from webots_mcp.queue import CLAIM, PEEK


def main(database: Path) -> None:
    """Say "ready", wait for a line, claim."""
    connection = connect(database, "loop")
    never_wait(connection)
    say("ready")
    sys.stdin.readline()
    claimed: list[int] = []
    while connection.execute(PEEK, (1, time.time())).fetchone():
        claimed += _claim(connection)
    say(claimed)


def _claim(connection: sqlite3.Connection) -> list[int]:
    """Nothing where another claimer holds the lock at this instant."""
    values = {"session": None, "now": time.time(), "sim_time": 0.0, "robot": 1}
    try:
        return [row[0] for row in connection.execute(CLAIM, values).fetchall()]
    except sqlite3.OperationalError as error:
        if "locked" not in str(error):
            raise
        return []


if __name__ == "__main__":
    main(Path(sys.argv[1]))
