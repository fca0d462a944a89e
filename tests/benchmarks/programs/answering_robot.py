"""A robot that answers commands in an 8 ms loop until its stdin is closed.

python -m tests.benchmarks.programs.answering_robot FOLDER
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from tests.benchmarks.processes import say
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import make_states
from tests.benchmarks.ways import BridgeWay


def main(folder: Path) -> None:
    """Say "ready", then drive."""
    robot, states = Rover(), make_states()
    way = BridgeWay(robot, folder)
    way.begin()
    way.bridge.register_command("echo", lambda command: command["params"])
    over = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
    way.publish(states[0])
    way.get_command()
    say("ready")
    step = 0
    while not over.is_set():
        robot.pace()
        way.publish(states[step % len(states)])
        way.get_command()
        step += 1
    way.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
