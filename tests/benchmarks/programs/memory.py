"""How much memory a process holds, with a bridge or without.

python -m tests.benchmarks.programs.memory bare STATES
python -m tests.benchmarks.programs.memory bridge|orjson STATES FOLDER ROWS ROWS_PER_S

STATES is a JSON file of states to publish. What this module imports counts, so it imports little.
"""

from __future__ import annotations

import json
import os
import sqlite3
import sys
import time

_STEP_MS = 32


def main(kind: str, states: str, *order: str) -> None:
    """Print the figures as a JSON object."""
    with open(states) as file:  # noqa: PTH123
        loaded = json.load(file)
    if kind != "orjson":  # as if it were not installed
        sys.modules["orjson"] = None  # pyright: ignore[reportArgumentType]
    if kind == "bare":
        print(json.dumps({**memory(), "sqlite": sqlite3.sqlite_version}))
    else:
        folder, rows, rows_per_s = order
        print(json.dumps(_record(loaded, folder, int(rows), int(rows_per_s))))


def _record(
    states: list[dict[str, object]], folder: str, rows: int, rows_per_s: int
) -> dict[str, float]:
    """Publish so many rows; after a tenth of them everything is warm."""
    from tests.benchmarks.rover import Rover
    from webots_mcp import MCPBridge

    robot = Rover()
    bridge = MCPBridge(robot, folder, throttle_interval=1)
    warm, log_bytes, started_s = {}, 0, time.perf_counter()
    for i in range(rows):
        robot.step(_STEP_MS)
        bridge.publish(states[i % len(states)])
        if i % 50 == 0:
            log_bytes = max(log_bytes, _size(f"{bridge.database}-wal"))
            time.sleep(max(0.0, started_s + i / rows_per_s - time.perf_counter()))
        if i == rows // 10:
            warm = memory()
    figures = memory()
    bridge.close()
    grown = figures["private"] - warm["private"]
    return {**figures, "grown": grown, "log": log_bytes}


def memory() -> dict[str, float]:
    """Resident and private (unique) bytes of this process; {} where the system does not tell."""
    try:
        with open("/proc/self/smaps_rollup") as file:  # noqa: PTH123
            lines = [line.split() for line in file if line.endswith("kB\n")]
    except OSError:
        return {}
    sizes = {words[0]: int(words[1]) * 1024 for words in lines}
    private = sizes["Private_Clean:"] + sizes["Private_Dirty:"]
    return {"resident": sizes["Rss:"], "private": private}


def _size(file: str) -> int:
    try:
        return os.stat(file).st_size  # noqa: PTH116
    except OSError:
        return 0


if __name__ == "__main__":
    main(*sys.argv[1:])
