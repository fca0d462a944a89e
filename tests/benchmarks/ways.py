"""The ways to record that are compared: the bridge, JSON files, and sqlite3 by hand."""

from __future__ import annotations

import json
import sqlite3
import time
from pathlib import Path
from typing import Any, Final, Protocol

from tests.benchmarks.registry import NotMeasurableError
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import State
from webots_mcp import MCPBridge
from webots_mcp.bridge import encoding

ORJSON: Final[Any] = encoding.orjson


class Way(Protocol):
    """What a controller's loop calls."""

    def begin(self) -> None:
        """The next calls are this way's."""
        ...

    def publish(self, state: State) -> object:
        """Record a state."""
        ...

    def get_command(self) -> object:
        """Look for a command."""
        ...

    def close(self) -> None:
        """No more calls."""
        ...


class BridgeWay:
    """The bridge, with the standard library's JSON or with orjson.

    Raises:
        NotMeasurableError: orjson is wanted and not installed.
    """

    def __init__(
        self,
        robot: Rover,
        folder: Path,
        *,
        orjson: bool = False,
        every: int = 1,
        keep_last_s: float = 0.0,
    ) -> None:
        if orjson and ORJSON is None:
            raise NotMeasurableError("orjson is not installed")
        self._encoder = ORJSON if orjson else None
        self.bridge = MCPBridge(
            robot, data_dir=folder, throttle_interval=every, keep_last_s=keep_last_s
        )
        self.publish = self.bridge.publish
        self.get_command = self.bridge.get_command

    def begin(self) -> None:
        """Set the encoder, which bridges of one process share."""
        use_encoder(self._encoder)

    def close(self) -> None:
        """Close the bridge, and set the encoder back."""
        self.bridge.close()
        use_encoder(ORJSON)


def use_encoder(orjson: Any) -> None:
    """Let the bridges of this process use the module orjson, or None: the standard library."""
    encoding.orjson = orjson


class JsonFiles:
    """The JSON-file way: a file written anew for each state, a file read for each look.

    It is what a controller does that shares its state by files: `open`, `json.dump` with an
    indent, `close`; and `exists`, `open`, `json.load` to see whether a command is there.
    """

    def __init__(self, folder: Path, *, every: int = 1) -> None:
        self._status = folder / "status.json"
        self._commands = folder / "commands.json"
        self._commands.write_text(json.dumps({"id": 3, "action": "resume", "params": {}}))
        self._done = 3
        self._every = every
        self._calls = 0

    def begin(self) -> None:
        """Nothing to prepare."""

    def publish(self, state: State) -> None:
        """Write the state, every so many calls."""
        self._calls += 1
        if self._calls % self._every:
            return
        with open(self._status, "w") as file:  # noqa: PTH123
            json.dump(state, file, indent=2)

    def get_command(self) -> dict[str, Any] | None:
        """Read the command; None if it is the one that was done already."""
        if not self._commands.exists():
            return None
        with open(self._commands) as file:  # noqa: PTH123
            command = json.load(file)
        return command if command["id"] > self._done else None

    def close(self) -> None:
        """Nothing is open."""


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

    def begin(self) -> None:
        """Nothing to prepare."""

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
