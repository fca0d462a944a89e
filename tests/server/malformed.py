"""Recordings in which one value is of a wrong kind, as other programs may leave it.

`python -m tests.server.malformed [table[.column]]` damages each column of each table with each kind
of wrong value, asks every tool, and prints how many calls gave no usable answer.
"""

from __future__ import annotations

import logging
import shutil
import sqlite3
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import anyio
from mcp import Client
from PIL import Image

from tests.recordings.rows import Recorded, RecordedRobot, insert
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.retention_limits import Limit, set_limits

ROWS: Final = 60
JSON_COLUMNS: Final = {
    ("robot", "devices"), ("session", "versions"), ("session", "actions"), ("state", "data"),
    ("state", "replaced"), ("kept_state", "data"), ("kept_state", "replaced"), ("event", "data"),
    ("command", "params"), ("command", "result"),
    ("trial_set", "plan"), ("trial_set", "former_values"), ("trial", "parameters"),
    ("parameter", "default_value"), ("parameter", "choices"), ("parameter", "next_value"),
    ("parameter_value", "value"), ("chunk", "labels"),
    ("request", "arguments"),
}  # fmt: skip
_BLOB: Final = b"\x00\xff\x01"
NOT_UTF8: Final = "CAST(x'7b22ff41227d' AS TEXT)"
_WRONG_BY_TYPE: Final[dict[str, tuple[Any, ...]]] = {
    "INTEGER": ("yesterday", _BLOB, 2**63 - 1, -(2**63), 1e300, float("inf")),
    "FLOAT": ("yesterday", _BLOB, 2**63 - 1, 1e300, float("inf"), float("-inf"), -1e18),
    "BLOB": (_BLOB, b"", "text", 7, b"\x00" * 100_000),
    "TEXT": (_BLOB, NOT_UTF8, "", "x" * 100_000, "a\0b"),
}
_WRONG_JSON: Final = (
    '{"x": ', "nonsense", "[1, 2]", "7", "null", '"text"', '{"x": NaN}', '{"x": 1e999}',
    '{"x": ' + "9" * 5000 + "}", '{"x": ' + "9" * 400 + "}", '{"x": "\\ud800"}',
    '{"\\udfff": {"mode": [1]}}',
    '{"x": ' + "[" * 900 + "]" * 900 + "}", '{"x": ' + '{"y": ' * 5000 + "1" + "}" * 5001,
    '{"mode": {"mode": {}}, "pose": "here", "steps": [{}, null, "x", true]}',
)  # fmt: skip


READING: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("webots_list_robots", {}),
    ("webots_get_world_info", {}),
    ("webots_get_robot_state", {}),
    ("webots_get_sensors", {}),
    ("webots_get_full_state", {}),
    ("webots_get_camera", {}),
    ("webots_get_camera", {"at_s": 1.0}),
    ("webots_get_logs", {}),
    ("webots_monitor", {"lookback_wall_s": 3600}),
    ("webots_list_commands", {}),
    ("webots_get_parameters", {}),
    ("webots_list_signals", {}),
    ("webots_query_history", {"signals": ["*"]}),
    ("webots_query_history", {"signals": ["*"], "raw": True}),
    ("webots_get_trends", {}),
    ("webots_find_events", {}),
    ("webots_get_timeline", {}),
    ("webots_list_runs", {}),
    ("webots_list_breakpoints", {}),
    ("webots_get_trials", {}),
    ("webots_compare_runs", {"trial_set": 1}),
    ("webots_compare_runs", {"run_ids": [1, 2]}),
)
DRAWING: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("webots_plot", {}),
    ("webots_plot", {"kind": "trajectory"}),
)
ACTING: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("webots_annotate_run", {"note": "x"}),
    ("webots_send_command", {"action": "dance", "timeout_wall_s": 0.1}),
    ("webots_simulation_control", {"command": "pause", "timeout_wall_s": 0.1}),
)
_ACTED_ON: Final = ("robot", "session", "run", "command")
_DRAWN: Final = ("state", "chunk", "run", "signal", "row_group")
_UNUSABLE: Final = ("a defect of webots-mcp", "is damaged", "cannot be used", "cannot be read")


class Damage(NamedTuple):
    """One value of a wrong kind in the newest row of a table."""

    table: str
    column: str
    value: Any

    def apply(self, connection: sqlite3.Connection) -> None:
        where = f"rowid = (SELECT max(rowid) FROM {self.table})"
        new, values = ("?", (self.value,)) if self.value is not NOT_UTF8 else (NOT_UTF8, ())
        connection.execute("PRAGMA foreign_keys=OFF")
        sql = f"UPDATE {self.table} SET {self.column} = {new} WHERE {where}"
        if self.table == "request":  # whose rows cannot be changed: one more row
            listed = connection.execute("SELECT name FROM pragma_table_info('request')")
            row = {name: name for (name,) in listed.fetchall()} | {"id": "NULL", "uuid": "'s'"}
            values_of = ", ".join((row | {self.column: new}).values())
            sql = f"INSERT INTO request ({', '.join(row)}) SELECT {values_of} FROM request"
        assert connection.execute(sql, values).rowcount > 0, f"{self.table} has no row"

    def __str__(self) -> str:
        return f"{self.table}.{self.column} = {self.value!r:.40}"


def record(file: Path) -> None:
    """Two runs of a robot that seems to live, with something in every table."""
    recorded = Recorded(file)
    robot = recorded.robot("rover", actions='{"dance": "Dance."}')
    for reason in ("reset", None):
        _fill(robot, file.parent)
        if reason:
            robot.end_run(reason)
            robot.begin_run(reason)
    _add_trials(recorded.connection, robot)
    make_chunks(recorded.connection)
    for run_id in (1, 2):
        assert chunk_whole_run(recorded.connection, run_id)
    recorded.connection.execute("INSERT INTO lease VALUES ('maintenance', 'x', 1.0)")
    set_limits(recorded.connection, {"log": Limit(rows=5)}, "retain")
    insert(recorded.connection, "meaning", {
        "robot_id": 1, "name": "pose.0", "source": "declared", "quantity": "x", "role": "measured",
        "unit": "m", "target_of": "target.x", "same_as": "pose.1", "side": "left", "low": -1.0,
        "high": 1.0, "set_wall_time_s": 1000.0, "set_by": "mcp", "why": "because",
    })  # fmt: skip
    insert(recorded.connection, "console_line", {
        "instance": "webots-1", "wall_time_s": time.time(), "level": "error", "source": "console",
        "message": "it waits for a run", "logger": "stderr",
    })  # fmt: skip
    insert(recorded.connection, "request", {
        "uuid": "r", "wall_time_s": time.time(), "client": "c", "client_version": "1",
        "transport": "cli", "tool": "webots_quit", "arguments": "{}", "run_id": 2,
        "sim_time_s": 1.0, "rule": "x", "outcome": "refused",
    })  # fmt: skip
    recorded.close()


def _add_trials(connection: sqlite3.Connection, robot: RecordedRobot) -> None:
    """A set of which a killed server has left the second trial."""
    now = time.time()
    plan = '{"score": "max(pose.0)", "best": "highest"}'
    number = insert(connection, "trial_set", {
        "uuid": "s", "plan": plan, "created_wall_time_s": now, "host": "h", "pid": 1,
        "process": "p", "robot_id": robot.id, "session_id": robot.session_id,
        "former_values": '{"kp": 1.0}',
    })  # fmt: skip
    for run_id, status, score in ((1, "done", 5.0), (2, "running", None), (2, "failed", None)):
        insert(connection, "trial", {
            "trial_set_id": number, "uuid": status, "number": len(status), "parameters":
            '{"kp": 2.0}', "status": status, "run_id": run_id, "score": score, "ended_by": "for_s",
            "ended_sim_time_s": 5.0, "error": "late" if status == "failed" else None,
            "started_wall_time_s": now, "finished_wall_time_s": now if score else None,
        })  # fmt: skip


def _fill(robot: RecordedRobot, folder: Path) -> None:
    began = robot.now
    for step in range(ROWS):
        robot.now = began + step * 0.1 - ROWS * 0.1
        mode = "cruise" if step // 20 % 2 else "turn"
        pose = [step * 0.1, 0.0, 0.1]
        replaced = {"lidar.0": "inf"} if step == ROWS - 1 else None
        data = {"pose": pose, "mode": mode, "battery_v": 12 - step * 0.01, "front": 1.0}
        robot.state(step * 0.1, data | {"lidar": [None, 1.0] if replaced else [1.0, 1.0]}, replaced)
        if step % 20 == 0:
            robot.log(step * 0.1, "hello", "warning")
            robot.event(step * 0.1, "change", "mode", {"from": "turn", "to": mode})
    _set_parameter(robot)
    Image.new("RGB", (32, 24)).save(folder / "eye.png")
    robot.image(2.0, "eye.png")
    robot.kept(1.0, 2.0, "a look")
    robot.kept_state(1.05, {"pose": [0.1, 0.0, 0.1], "mode": "turn", "front": 0.9})
    now = time.time()
    insert(robot.connection, "breakpoint", {
        "robot_id": robot.id, "condition": "front < 0.5", "action": "log", "hit_count": 1,
        "created_wall_time_s": now, "created_by": "mcp",
    })  # fmt: skip
    for status in ("done", "claimed", "pending"):
        insert(robot.connection, "command", {
            "robot_id": robot.id, "action": "dance", "params": '{"speed": 1}', "status": status,
            "created_wall_time_s": now, "expires_wall_time_s": now + 10,
            "claimed_wall_time_s": now if status != "pending" else None,
            "claimed_sim_time_s": 1.0, "session_id": robot.session_id,
            "finished_wall_time_s": now if status == "done" else None,
            "finished_sim_time_s": 2.0, "result": '{"ok": true}' if status == "done" else None,
        })  # fmt: skip


def _set_parameter(robot: RecordedRobot) -> None:
    """Declare one, as a controller does, with the values that it had in this run."""
    declared = {
        "robot_id": robot.id, "session_id": robot.session_id, "name": "kp", "kind": "float",
        "default_value": "1.0", "low": 0.0, "high": 9.0, "choices": "[1.0, 2.0]", "doc": "Gain.",
        "unit": "V", "next_value": "2.0", "declared_wall_time_s": robot.now,
    }  # fmt: skip
    robot.connection.execute("DELETE FROM parameter")
    insert(robot.connection, "parameter", declared)
    for sim_time_s, value in ((0.0, "1.0"), (3.0, "2.0")):
        insert(robot.connection, "parameter_value", {
            "run_id": robot.run_id, "name": "kp", "sim_time_s": sim_time_s, "value": value,
            "wall_time_s": robot.now, "is_default": value == "1.0", "set_by": "code",
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
            yield from (
                Damage(table, column, value)
                for value in _WRONG_BY_TYPE[kind.replace("BIGINT", "INTEGER")]
            )
            if (table, column) in JSON_COLUMNS:
                yield from (Damage(table, column, value) for value in _WRONG_JSON)
    connection.close()


class Damaged:
    """A copy of a recording on which one server answers, damaged anew for each question."""

    def __init__(self, base: Path, folder: Path) -> None:
        shutil.copytree(base, folder)
        self._sound, self._file = base / "webots.db", folder / "webots.db"
        self.client = Client(create_server(self._file, folder))

    def damage(self, damage: Damage) -> bool:
        """Bring the copy back to what it was and do this to it; False if the schema keeps it out.

        Every call of a tool opens the database anew, so that nothing is left of the damage before.
        """
        sound, copy = sqlite3.connect(self._sound), sqlite3.connect(self._file)
        with closing(sound), closing(copy), copy:
            sound.backup(copy)
            try:
                damage.apply(copy)
            except sqlite3.IntegrityError:
                return False
        return True

    async def unusable_answers(
        self, damage: Damage, part: slice = slice(None)
    ) -> tuple[int, list[str]]:
        """How many calls were made after this damage, and those that gave nothing usable.

        Args:
            damage: Done to a sound copy.
            part: Which of the calls are made; all take half a second of processor time.
        """
        if not self.damage(damage):
            return 0, []
        bad: list[str] = []
        calls = (*READING, *(DRAWING if damage.table in _DRAWN else ()),
                 *(ACTING if damage.table in _ACTED_ON else ()))[part]  # fmt: skip
        for tool, arguments in calls:
            with anyio.fail_after(60):
                answer = await self.client.call_tool(tool, arguments)
            said = "".join(block.text for block in answer.content if block.type == "text")
            rest = said.removeprefix(f"Error executing tool {tool}").strip(": ")
            if answer.is_error and (not rest or any(words in rest for words in _UNUSABLE)):
                bad.append(f"{tool} after {damage}: {rest or 'plain'}"[:400])
        return len(calls), bad


async def _survey(only: str) -> None:
    made, bad = 0, list[str]()
    with TemporaryDirectory() as folder:
        base = Path(folder) / "base"
        base.mkdir()
        record(base / "webots.db")
        wanted = [damage for damage in damages(base / "webots.db") if only in str(damage)]
        damaged = Damaged(base, Path(folder) / "copy")
        async with damaged.client:
            for damage in wanted:
                calls, unusable = await damaged.unusable_answers(damage)
                made += calls
                bad += unusable
    print(*bad, sep="\n")
    print(f"{len(wanted)} damages, {made} calls, {len(bad)} without a usable answer")


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    anyio.run(_survey, "".join(sys.argv[1:]))
