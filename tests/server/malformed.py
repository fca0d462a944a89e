"""Recordings in which one value is of a wrong kind, as other programs may leave it."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from PIL import Image

from tests.store.recorded import Recorded, insert
from webots_mcp.store.history.rollup import roll

ROWS: Final = 60
JSON_COLUMNS: Final = {
    ("robot", "devices"), ("session", "versions"), ("session", "actions"), ("state", "data"),
    ("state", "odd"), ("event", "data"), ("command", "params"), ("command", "result"),
}  # fmt: skip
_BLOB: Final = b"\x00\xff\x01"
_NOT_UTF8: Final = "CAST(x'7b22ff41227d' AS TEXT)"
_WRONG_BY_TYPE: Final[dict[str, tuple[Any, ...]]] = {
    "INTEGER": ("yesterday", _BLOB, 2**63 - 1, -(2**63), 1e300, float("inf")),
    "FLOAT": ("yesterday", _BLOB, 2**63 - 1, 1e300, float("inf"), float("-inf"), -1e18),
    "TEXT": (_BLOB, _NOT_UTF8, "", "x" * 100_000, "a\0b"),
}
_WRONG_JSON: Final = (
    '{"x": ', "nonsense", "[1, 2]", "7", "null", '"text"', '{"x": NaN}', '{"x": 1e999}',
    '{"x": ' + "9" * 5000 + "}", '{"x": ' + "9" * 400 + "}", '{"x": "\\ud800"}',
    '{"\\udfff": {"mode": [1]}}',
    '{"x": ' + "[" * 900 + "]" * 900 + "}", '{"x": ' + '{"y": ' * 5000 + "1" + "}" * 5001,
    '{"mode": {"mode": {}}, "pose": "here", "steps": [{}, null, "x", true]}',
)  # fmt: skip


class Damage(NamedTuple):
    """One value of a wrong kind in the newest row of a table."""

    table: str
    column: str
    value: Any

    def apply(self, connection: sqlite3.Connection) -> None:
        row = "(SELECT max(rowid) FROM {0})" if self.table not in KEYED else "{1}"
        where = f"WHERE rowid = (SELECT max(rowid) FROM {self.table})"
        if self.table in KEYED:  # WITHOUT ROWID
            where = "WHERE (run_id, signal_id) = (SELECT max(run_id), max(signal_id) FROM {0})"
        del row
        new, values = ("?", (self.value,)) if self.value is not _NOT_UTF8 else (_NOT_UTF8, ())
        connection.execute("PRAGMA foreign_keys=OFF")
        connection.execute(
            f"UPDATE {self.table} SET {self.column} = {new} {where.format(self.table)}", values
        )

    def __str__(self) -> str:
        return f"{self.table}.{self.column} = {self.value!r:.40}"


KEYED: Final = ("rollup", "change")


def record(file: Path, *, live: bool) -> None:
    """A robot with something in every table; `live` as if its controller were running."""
    recorded = Recorded(file)
    robot = recorded.robot("rover", actions='{"dance": "Dance."}')
    _fill(robot, file.parent)
    if not live:
        robot.end_run("finished")
        robot.beat(ended_wall_time_s=robot.now, end_reason="finished")
    roll(recorded.connection)
    recorded.connection.execute("INSERT INTO lease VALUES ('maintenance', 'x', 1.0)")
    recorded.close()


def _fill(robot: Any, folder: Path) -> None:
    began = robot.now
    for step in range(ROWS):
        robot.now = began + step * 0.1 - ROWS * 0.1
        mode = "cruise" if step // 20 % 2 else "turn"
        pose = [step * 0.1, 0.0, 0.1]
        odd = {"lidar.0": "inf"} if step == ROWS - 1 else None
        data = {"pose": pose, "mode": mode, "battery_v": 12 - step * 0.01, "front": 1.0}
        robot.state(step * 0.1, data | {"lidar": [None, 1.0] if odd else [1.0, 1.0]}, odd)
        if step % 20 == 0:
            robot.log(step * 0.1, "hello", "warning")
            robot.event(step * 0.1, "change", "mode", {"from": "turn", "to": mode})
    Image.new("RGB", (32, 24)).save(folder / "eye.png")
    robot.image(2.0, "eye.png")
    now = time.time()
    for status in ("done", "claimed", "pending"):
        insert(robot.connection, "command", {
            "robot_id": robot.id, "action": "dance", "params": '{"speed": 1}', "status": status,
            "created_wall_time_s": now, "expires_wall_time_s": now + 10,
            "claimed_wall_time_s": now if status != "pending" else None,
            "claimed_sim_time_s": 1.0, "session_id": robot.session_id,
            "finished_wall_time_s": now if status == "done" else None,
            "finished_sim_time_s": 2.0, "result": '{"ok": true}' if status == "done" else None,
        })  # fmt: skip


def damages(file: Path) -> Iterator[Damage]:
    """Each column of each table with each kind of wrong value, but for keys that cannot be."""
    connection = sqlite3.connect(file)
    tables = connection.execute(
        "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%' "
        "AND name <> 'alembic_version' ORDER BY name"
    ).fetchall()
    for (table,) in tables:
        columns = connection.execute("SELECT name, type, pk FROM pragma_table_info(?)", (table,))
        for column, kind, key in columns.fetchall():
            if key and column in ("id", "name"):
                continue
            yield from (Damage(table, column, value) for value in _WRONG_BY_TYPE[kind])
            if (table, column) in JSON_COLUMNS:
                yield from (Damage(table, column, value) for value in _WRONG_JSON)
    connection.close()
