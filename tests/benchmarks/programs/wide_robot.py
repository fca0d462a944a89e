"""One of several robots with wide states: drives a block in 16 ms steps whenever it is told.

python -m tests.benchmarks.programs.wide_robot FOLDER NUMBER
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Final

from tests.benchmarks.processes import say
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import make_wide_states
from webots_mcp import MCPBridge

STEP_S: Final = 0.016


def main(folder: Path, number: int) -> None:
    """Answer a number of steps with how long each publish() took, and what waited after it."""
    robot, states = Rover(f"rover {number}", STEP_S), make_wide_states()
    with MCPBridge(robot, folder, throttle_interval=1) as bridge:
        say("ready")
        for line in sys.stdin:
            waiting, in_memory, durations = list[int](), list[int](), list[float]()
            for i in range(int(line)):
                robot.pace()
                started = time.perf_counter()
                bridge.publish(states[i % len(states)])
                durations.append(time.perf_counter() - started)
                waiting.append(bridge.stats().rows_waiting)
                in_memory.append(bridge._session.recorder._backlog.rows_in_memory)  # pyright: ignore[reportPrivateUsage]
                bridge.get_command()
            say({"durations": durations, "waiting": waiting, "in_memory": in_memory})


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
