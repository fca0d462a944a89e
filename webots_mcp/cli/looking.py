"""Commands that look at what is being recorded now."""

from __future__ import annotations

import argparse
import select
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    ROBOT,
    argument,
    count,
    question,
    reading,
)
from webots_mcp.cli.tables import printable
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.store.logs import Line


@question(
    "tail",
    DATA_DIR,
    DATABASE,
    ROBOT,
    count("-n", "begin with the last N lines", default=10, least=0),
    argument(
        "--interval", type=float, default=0.5, metavar="S", help="seconds between looks (0.5)"
    ),
    argument("--no-follow", action="store_true", help="print the last lines and end"),
)
def tail(arguments: argparse.Namespace) -> None:
    """Follow what is being recorded: states, log lines, events, commands. Ctrl-C ends it.

    Of the states that came since the last look the newest of each robot is shown. Where nothing
    can be written, nothing can come, and it ends after the last lines.
    """
    from webots_mcp.store.logs import Follower
    from webots_mcp.store.recording import storage
    from webots_mcp.store.robots import resolve_robot

    if arguments.interval <= 0:
        raise InvalidInputError("--interval must be greater than 0")
    with reading(arguments) as connection:
        robot = arguments.robot and resolve_robot(connection, arguments.robot, time.time())
        follower = Follower(connection, robot.id if robot else None)
        _print_lines(follower.look(arguments.limit))
        following = not arguments.no_follow and not storage(connection)
        while following:
            wait(arguments.interval)
            _print_lines(_newest_states_only(follower.look()))


def wait(seconds: float) -> None:
    """Wait for the next look, or end where nobody reads a pipe any more (`tail | head`).

    Raises:
        BrokenPipeError: The reader is gone; printing would tell only when there is a line.
    """
    try:
        output = sys.stdout.fileno()
        watch = select.poll()  # not on Windows
    except (AttributeError, OSError):
        return time.sleep(seconds)
    watch.register(output, 0)
    if watch.poll(seconds * 1000):
        raise BrokenPipeError


def _print_lines(lines: Sequence[Line]) -> None:
    for line in lines:
        clock = time.strftime("%H:%M:%S", time.localtime(line.wall_time_s))
        at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
        print(printable(f"{clock} {line.robot} {at:>11} {line.kind:<8} {line.text}"), flush=True)


def _newest_states_only(lines: Sequence[Line]) -> list[Line]:
    """A robot that publishes a hundred times a second would scroll all else away."""
    newest = {line.robot: line for line in lines if line.kind == "state"}
    return [line for line in lines if line.kind != "state" or newest[line.robot] is line]
