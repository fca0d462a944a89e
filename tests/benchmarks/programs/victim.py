"""A controller that is going to be killed: it records, and tells what it recorded.

python -m tests.benchmarks.programs.victim bridge|files FOLDER NAME PAUSE_S

After each publish() it writes the row's number and how many rows wait to be written. The command
`tally` leaves its id in the file `tally`.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.benchmarks.rover import Rover
from tests.benchmarks.states import make_states
from tests.benchmarks.ways import JsonFiles
from webots_mcp import MCPBridge


def main(way: str, folder: Path, name: str, pause_s: float) -> None:
    """Record until the end."""
    state = make_states(1)[0]
    publish = _bridge(folder, name) if way == "bridge" else _files(folder)
    number = 0
    while True:
        waiting = publish({**state, "n": number})
        os.write(1, f"{number} {waiting}\n".encode())
        time.sleep(pause_s)
        number += 1


def _bridge(folder: Path, name: str) -> Callable[[dict[str, Any]], int]:
    robot = Rover(name)
    bridge = MCPBridge(robot, folder, throttle_interval=1)
    tally = os.open(folder / "tally", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    bridge.register_command("tally", lambda command: os.write(tally, b"%d\n" % command["id"]))

    def publish(state: dict[str, Any]) -> int:
        robot.step(8)
        bridge.get_command()
        bridge.publish(state)
        return bridge.stats().rows_waiting

    return publish


def _files(folder: Path) -> Callable[[dict[str, Any]], int]:
    files = JsonFiles(folder)
    return lambda state: files.publish(state) or 0


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3], float(sys.argv[4]))
