"""The robot that records, its states, and the ways to record that are compared."""

from __future__ import annotations

import json
import random
import sqlite3
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from tests.benchmarks.core import NotMeasurableError
from webots_mcp import MCPBridge
from webots_mcp.bridge import encoding

ORJSON: Final[Any] = encoding.orjson


class BridgeWay:
    """The bridge; it records one call in `every`, and may hold the last seconds in memory."""

    def __init__(
        self, robot: Rover, folder: Path, *, every: int = 1, keep_last_s: float = 0.0
    ) -> None:
        self.bridge = MCPBridge(
            robot, data_dir=folder, throttle_interval=every, keep_last_s=keep_last_s
        )
        self.publish = self.bridge.publish
        self.get_command = self.bridge.get_command
        self.close = self.bridge.close


@contextmanager
def encoder(*, orjson: bool) -> Generator[str]:
    """Let the bridges of this process use orjson or the standard library; gives its name.

    Raises:
        NotMeasurableError: orjson is wanted and not installed.
    """
    if orjson and ORJSON is None:
        raise NotMeasurableError("orjson is not installed")
    encoding.orjson = ORJSON if orjson else None
    try:
        yield "orjson" if orjson else "standard library JSON"
    finally:
        encoding.orjson = ORJSON


class RawSqlite:
    """sqlite3 by hand: one prepared INSERT with `json.dumps`, a time index, WAL, no bridge."""

    def __init__(self, folder: Path) -> None:
        self._connection = sqlite3.connect(folder / "raw.db", isolation_level=None)
        self._connection.executescript(
            "PRAGMA journal_mode=WAL; PRAGMA synchronous=NORMAL;"
            "CREATE TABLE state (id INTEGER PRIMARY KEY, run_id INTEGER NOT NULL, "
            "sim_time_s REAL NOT NULL, wall_time_s REAL NOT NULL, data TEXT NOT NULL);"
            "CREATE INDEX state_time ON state (run_id, sim_time_s);"
            "CREATE TABLE command (id INTEGER PRIMARY KEY, status TEXT, action TEXT);"
            "CREATE INDEX command_pending ON command (id) WHERE status = 'pending';"
        )

    def publish(self, state: State) -> None:
        """Insert the state."""
        now = time.time()
        self._connection.execute(
            "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)",
            (1, now, now, json.dumps(state)),
        )

    def get_command(self) -> object:
        """Look for a pending command, by the index."""
        sql = "SELECT id, action FROM command WHERE status = 'pending' ORDER BY id LIMIT 1"
        return self._connection.execute(sql).fetchone()

    def close(self) -> None:
        """Close the file."""
        self._connection.close()


STEP_S: Final = 0.008


class Rover:
    """What a bridge asks of a Webots `Robot`, without a simulator.

    `step` only counts simulation time; `pace` also lets the wall time of a step pass, asleep, as a
    controller does that waits for Webots.
    """

    def __init__(self, name: str = "rover", step_s: float = STEP_S) -> None:
        self.devices: dict[str, Any] = {}
        self._name = name
        self._step_s = step_s
        self._time_s = 0.0
        self._due_s = time.perf_counter()

    def step(self, duration_ms: int) -> int:
        """Let simulation time pass."""
        self._time_s += duration_ms / 1000
        return 0

    def reset(self) -> None:
        """Simulation time begins again."""
        self._time_s = 0.0

    def pace(self) -> None:
        """Let one step pass in real time."""
        self._time_s += self._step_s
        now = time.perf_counter()
        self._due_s = max(self._due_s + self._step_s, now)  # a late step is not caught up with
        time.sleep(self._due_s - now)

    def getTime(self) -> float:
        return self._time_s

    def getName(self) -> str:
        return self._name

    def getBasicTimeStep(self) -> float:
        return self._step_s * 1000

    def getWorldPath(self) -> str:
        return ""

    def getSupervisor(self) -> bool:
        return False


STATES: Final = 64

State = dict[str, Any]


def make_states(count: int = STATES) -> list[State]:
    """States of 39 leaves, about 740 bytes of compact JSON; all numbers differ between them."""
    numbers = random.Random(7)
    return [_state(numbers) for _ in range(count)]


def _state(numbers: random.Random) -> State:
    def some(count: int, digits: int) -> list[float]:
        return [round(numbers.uniform(-9.99, 9.99), digits) for _ in range(count)]

    return {
        "mode": "following_wall",
        "goal_reached": False,
        "pose": dict(zip(("x_m", "y_m", "yaw_rad"), some(3, 8), strict=True)),
        "velocity": dict(zip(("linear_m_s", "angular_rad_s"), some(2, 8), strict=True)),
        "imu": dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), some(3, 8), strict=True)),
        "accelerometer": some(3, 8),
        "gyro": some(3, 8),
        "wheels": {"left_rad": some(1, 8)[0], "right_rad": some(1, 8)[0]},
        "motors": {"left_rad_s": some(1, 6)[0], "right_rad_s": some(1, 6)[0]},
        "distance": {f"ds{i}": value for i, value in enumerate(some(8, 6))},
        "lidar": {"min_m": some(1, 6)[0], "sectors_m": some(8, 6)},
        "battery_j": round(numbers.uniform(1e4, 9e4), 3),
        "step": numbers.randrange(10_000, 99_999),
    }
