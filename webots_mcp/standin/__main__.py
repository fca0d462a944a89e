"""The command that runs a world in the foreground: `python -m webots_mcp.standin WORLD`."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType

from webots_mcp.standin import Simulation, StandInError
from webots_mcp.standin.stand_in_simulation import ConsoleRecorder

_ALL_ENDED_S = 1.0
"""How long no controller may run before the simulation ends. A reload takes milliseconds."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until the time is over, the last controller ends, a supervisor quits, or Ctrl-C.

    Returns:
        The exit status of `run_world`.
    """
    options = _parser().parse_args(arguments)
    return run_world(options.world, options.mode, options.duration, dict(options.robot))


def run_world(
    world: str | Path,
    mode: str = "realtime",
    duration_s: float | None = None,
    controllers: Mapping[str, str] | None = None,
    recorder: ConsoleRecorder | None = None,
) -> int:
    """Run a world in the foreground.

    Args:
        world: A .wbt file.
        mode: pause, realtime or fast.
        duration_s: Simulated time after which it ends; None to end with the last controller.
        controllers: Controller files by robot name, instead of those that the world names.
        recorder: Stores the lines of the console.

    Returns:
        The status given to `simulationQuit`, else the exit status of the first controller that
        ended with an error (for a signal 128 plus its number), else 0; 2 for a world that cannot
        be used.
    """
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        simulation = Simulation(
            world,
            mode=mode,
            console=_show,
            recorder=recorder,
            controllers=dict(controllers or {}),
        )
    except StandInError as error:
        print(f"webots_mcp.standin: {error}", file=sys.stderr)  # noqa: T201 - a command
        return 2
    with simulation:
        _wait(simulation, stopped, duration_s)
    return simulation.exit_status or simulation.failure or 0


def _wait(simulation: Simulation, stopped: threading.Event, duration_s: float | None) -> None:
    active_s = time.monotonic()  # The last time at which a controller ran or could connect.

    def is_over() -> bool:
        nonlocal active_s
        if stopped.is_set() or not simulation.is_running:
            return True
        if duration_s is not None:
            return simulation.time_s >= duration_s
        if simulation.can_go_on:
            active_s = time.monotonic()
        return time.monotonic() - active_s > _ALL_ENDED_S

    simulation.wait_for(is_over, timeout_s=float("inf"))


def _show(line: str) -> None:
    print(line, flush=True)  # noqa: T201 - the console


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m webots_mcp.standin",
        description="Runs a world on a small stand-in for Webots, with its controllers.",
    )
    parser.add_argument("world", help="a .wbt file, best in worlds/ of a project")
    parser.add_argument(
        "--mode", choices=("pause", "realtime", "fast"), default="realtime", help="as for Webots"
    )
    parser.add_argument(
        "--duration", type=float, metavar="S", help="end after S seconds of simulated time"
    )
    parser.add_argument(
        "--robot",
        type=_robot,
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="run this file as the controller of a robot, instead of what the world says",
    )
    return parser


def _robot(text: str) -> tuple[str, str]:
    name, equals, file = text.partition("=")
    if not (name and equals and file):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=FILE")
    return name, file


if __name__ == "__main__":
    sys.exit(main())
