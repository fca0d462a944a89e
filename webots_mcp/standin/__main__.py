"""Runs a world in the foreground: `python -m webots_mcp.standin WORLD`."""

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
from webots_mcp.standin.simulation import ConsoleRecorder

_ALL_ENDED_S = 1.0  # without a controller; a reload is without one for milliseconds


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until the time or the last controller ends, a supervisor quits, or Ctrl-C or SIGTERM.

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
        duration_s: It ends after so much simulated time; None: with its last controller.
        controllers: Files that control robots, by name, instead of what the world says.
        recorder: Keeps what is printed.

    Returns:
        The exit status: that of `simulationQuit`, else that of the first controller that ended with
        an error (128 and the number for a signal), else 0; 2 for a world that cannot be used.
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
    led_s = time.monotonic()  # when a controller was last seen that can act

    def is_over() -> bool:
        nonlocal led_s
        if stopped.is_set() or not simulation.is_running:
            return True
        if duration_s is not None:
            return simulation.time_s >= duration_s
        if simulation.can_go_on:
            led_s = time.monotonic()
        return time.monotonic() - led_s > _ALL_ENDED_S

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
