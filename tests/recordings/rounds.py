"""A rover that drives the same round of 120 s again and again: long enough for many chunks."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Final

from tests.recordings.rover import Recorder, rover_state, start_run
from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.store.chunk_making import make_chunks

ROWS: Final = 5200  # 1040 s: five groups of rows and some
PART: Final = (480.0, 720.0)  # within it, over the borders of groups


def record_rounds(file: Path, rows: int = ROWS) -> None:
    """Write run 1, in chunks, and run 2 of another robot, whose rows lie between its ids."""
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorder = start_run(connection)
        other = Recorder(connection)
        robot_id = other.robot("drone")
        other.run(other.session(robot_id, "b" * 64), robot_id)
        connection.execute("BEGIN")
        for step in range(rows):
            recorder.publish(step * 0.2, *rover_state(step * 0.2 % 120))
            if step % 500 == 0:
                other.publish(step * 0.2, {"height": step})
        for each in (recorder, other):
            each.end_run("finished")
        connection.execute("UPDATE session SET ended_wall_time_s = 2e9, end_reason = 'finished'")
        for table in ("session", "run"):
            for key in (1, 2):
                connection.execute(f"UPDATE {table} SET uuid = ? WHERE id = ?", (new_uuid(), key))
        connection.execute("COMMIT")
        assert make_chunks(connection, 100_000).done
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
