"""A recording of any length: 39 leaves a row at 31.25 Hz, modes, stuck places, noise, a spike."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from tests.recordings.rover import WALL_START_S, start_run
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.store.chunk_making import make_chunks

INTERVAL_S: Final = 0.032
CYCLE_S: Final = 100.0  # 70 s cruise, 6 s stuck within it, 10 s back up, 20 s turn
_INSERT: Final = "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)"


def build(file: Path, rows: int, *, chunked: bool = True) -> None:
    """Make the file: one robot, one run of that many rows."""
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorder = start_run(connection)
        connection.execute("BEGIN IMMEDIATE")
        connection.executemany(_INSERT, _rows(recorder.run_id, rows))
        recorder.wall_s = WALL_START_S + rows * INTERVAL_S
        recorder.end_run("finished")
        connection.execute("COMMIT")
        while chunked and not make_chunks(connection, 100_000).done:
            pass
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()


def _rows(run_id: int, rows: int) -> Iterator[tuple[Any, ...]]:
    noise = random.Random(1)
    x = 0.0
    for step in range(rows):
        time_s = round(step * INTERVAL_S, 3)
        mode, speed_m_s = _doing(time_s % CYCLE_S)
        x += speed_m_s * INTERVAL_S
        state = _state(time_s, mode, speed_m_s, x, noise)
        if step == rows // 2:
            state["battery_v"] = 3.0
        yield run_id, time_s, WALL_START_S + time_s, json.dumps(state, separators=(",", ":"))


def _doing(phase_s: float) -> tuple[str, float]:
    if 40 <= phase_s < 46:
        return "cruise", 0.0  # stuck
    if phase_s < 70:
        return "cruise", 0.2
    return ("back_up", -0.1) if phase_s < 80 else ("turn", 0.0)


def _state(
    time_s: float, mode: str, speed_m_s: float, x: float, noise: random.Random
) -> dict[str, Any]:
    phase = time_s * 0.7
    return {
        "mode": mode,
        "stuck": mode == "cruise" and speed_m_s == 0,
        "time_s": time_s,
        "pose": [round(x, 5), round(math.sin(x), 5), round(math.sin(x * 3), 5)],
        "wheels": {"left": round(5 * speed_m_s, 3), "right": round(5 * speed_m_s + 0.1, 3)},
        "ds": [round(0.5 + 0.4 * math.sin(phase + i) + noise.gauss(0, 0.01), 5) for i in range(8)],
        "imu": {axis: round(noise.gauss(0, 0.1), 5) for axis in ("roll", "pitch", "yaw")},
        "accel": [round(noise.gauss(0, 1), 5) for _ in range(3)],
        "gyro": [round(noise.gauss(0, 0.2), 5) for _ in range(3)],
        "encoders": [round(time_s * 2.1, 5), round(time_s * 2.2, 5)],
        "target": {"x": 1.5, "y": -2.0, "index": int(time_s / CYCLE_S)},
        "battery_v": round(12.6 - time_s * 1e-5, 5),
        "errors": [round(noise.gauss(0, 0.05), 5) for _ in range(4)],
        "gains": {"p": 1.2, "i": 0.1, "d": 0.05},
        "commanded_m_s": 0.2 if mode == "cruise" else 0.0,
    }
