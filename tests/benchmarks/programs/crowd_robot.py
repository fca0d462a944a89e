"""One of several robots that record at once: drives a block in 8 ms steps whenever it is told.

python -m tests.benchmarks.programs.crowd_robot FOLDER NUMBER
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from tests.benchmarks.processes import say
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import State, make_states
from tests.benchmarks.ways import BridgeWay, JsonFiles, Way


class EncodeOnly:
    """`json.dumps` and nothing else: what the machine's business alone does to the figures."""

    def begin(self) -> None:
        """Nothing to prepare."""

    def publish(self, state: State) -> None:
        """Encode the state."""
        json.dumps(state)

    def get_command(self) -> None:
        """Nothing to look at."""

    def close(self) -> None:
        """Nothing is open."""


def main(folder: Path, number: int) -> None:
    """Answer `NAME STEPS` with the durations of the calls of publish() in seconds."""
    robot, states = Rover(f"rover {number}"), make_states()
    files = folder / f"files {number}"
    files.mkdir()
    bridge = BridgeWay(robot, folder)
    ways: dict[str, Way] = {"bridge": bridge, "files": JsonFiles(files), "noise": EncodeOnly()}
    say("ready")
    for line in sys.stdin:
        name, steps = line.split()
        ways[name].begin()
        put_off, durations = 0, list[float]()
        for i in range(int(steps)):
            durations.append(_step(ways[name], robot, states[i % len(states)]))
            put_off += bridge.bridge.stats().rows_waiting > 0
        say({"durations": durations, "put_off": put_off / int(steps)})
    bridge.close()


def _step(way: Way, robot: Rover, state: State) -> float:
    robot.pace()
    started = time.perf_counter()
    way.publish(state)
    took = time.perf_counter() - started
    way.get_command()
    return took


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
