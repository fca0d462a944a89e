"""Recordings of a known size, to lose rows of."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

from tests.recordings.rover import Recorder
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention

ROW_S = 0.5  # simulated and wall time between two rows of these recordings


class Recorded(Recorder):
    """Runs with a known number of rows of each kind, one after the other."""

    def __init__(self, connection: sqlite3.Connection, folder: Path) -> None:
        super().__init__(connection)
        self.folder = folder
        self.robot_id = self.robot("rover")

    def add_run(self, rows: int, end: str | None = "reset", robot_id: int | None = None) -> int:
        """A run with that many states, half as many events, log lines, a picture, a command."""
        owner = robot_id or self.robot_id
        session_id = self.session(owner, "a" * 64)
        run_id = self.run(session_id, owner)
        self.add_command(session_id, owner)
        for i in range(rows):
            time_s = i * ROW_S
            self.publish(time_s, {"x": i, "mode": "ab"[i % 2]})
            if i % 2:
                change = json.dumps({"from": "a", "to": "b"})
                self.insert("event", **self.at(time_s), kind="change", name="mode", data=change)
                self.insert(
                    "log", **self.at(time_s), level="info", source="controller", message="line"
                )
        self.add_picture(run_id)
        self.insert(
            "parameter_value", **self.at(0.0), name="kp", value="2.0", is_default=1, set_by="code"
        )
        self.at(rows * ROW_S * 2)
        if end:
            self.connection.execute(
                "UPDATE run SET end_reason = ?, ended_wall_time_s = ?, last_wall_time_s = ?, "
                "last_sim_time_s = ?, row_count = ? WHERE id = ?",
                (end, self.wall_s, self.wall_s, rows * ROW_S, rows, run_id),
            )
            self.connection.execute(
                "UPDATE session SET ended_wall_time_s = ?, end_reason = 'finished' WHERE id = ?",
                (self.wall_s, session_id),
            )
        return run_id

    def add_command(self, session_id: int, robot_id: int) -> None:
        self.insert(
            "command", robot_id=robot_id, action="a", params="{}", status="done",
            created_wall_time_s=self.wall_s + 0.01, expires_wall_time_s=self.wall_s + 10,
            session_id=session_id,
        )  # fmt: skip

    def add_picture(self, run_id: int) -> None:
        path = f"camera/{run_id}.png"
        file = self.folder / path
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"picture")
        self.insert(
            "image", **self.at(1.0), kind="camera", device="c", path=path, width=1, height=1,
            size_bytes=1000,
        )  # fmt: skip

    def rows(self) -> dict[int, int]:
        sql = "SELECT run_id, count(*) FROM state GROUP BY run_id"
        return dict(self.connection.execute(sql).fetchall())

    def count(self, table: str) -> int:
        return int(self.connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0])

    def of_runs(self, run_ids: list[int]) -> list[Any]:
        """Everything that is recorded of these runs."""
        marks = ",".join(map(str, run_ids)) or "NULL"
        tables = ("state", "row_group", "chunk", "log", "event", "image", "parameter_value")
        found: list[Any] = [
            self.connection.execute(f"SELECT * FROM {table} WHERE run_id IN ({marks})").fetchall()
            for table in tables
        ]
        found += self.connection.execute(f"SELECT * FROM run WHERE id IN ({marks})").fetchall()
        return found

    def prune(self, retention: Retention, now_s: float | None = None):
        return prune(
            self.connection, self.folder, retention, now_s=now_s or self.wall_s, rest=False
        )


def states(**limits: Any) -> Retention:
    """Only state rows are limited."""
    return Retention(Limit(**limits), Limit(), Limit(), Limit(), Limit(), outlive=0)
