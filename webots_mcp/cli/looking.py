"""Commands that look at what is being recorded now."""

from __future__ import annotations

import argparse
import json
import select
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    JSON,
    ROBOT,
    argument,
    count,
    open_recording,
    question,
    reading,
)
from webots_mcp.cli.tables import printable
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.store.logs import Line
    from webots_mcp.store.recording import View


@question("status", DATA_DIR, DATABASE, JSON)
def status(arguments: argparse.Namespace) -> None:
    """Show the robots: whether they run, how old their data is, what could not be recorded."""
    import webots_mcp.store.recording as recordings
    from webots_mcp.store.retention.limits import described
    from webots_mcp.store.retention.usage import file_sizes
    from webots_mcp.store.robots import list_robots

    recording = open_recording(arguments)
    with recording.reader() as connection:
        now_s = time.time()
        views = [
            recordings.view_of(connection, robot, now_s) for robot in list_robots(connection, now_s)
        ]
        facts = {
            "database": str(recording.database),
            **recordings.storage(connection),
            "limits": described(connection),
            "file": file_sizes(connection),
            "robots": [_facts(view) for view in views],
        }
    print(json.dumps(facts, indent=2) if arguments.json else _as_text(facts))


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


def _facts(view: View) -> dict[str, Any]:
    from webots_mcp.store.run_rows import count_runs
    from webots_mcp.store.status import rows_waiting

    session = view.session
    return {
        **view.header(),
        "kind": view.robot.kind,
        "live": view.robot.live,
        "runs": count_runs(view.connection, view.robot.id),
        "rows": view.run.rows if view.run else 0,
        **rows_waiting(view.connection, session),
        "rows_dropped": session.rows_dropped if session else 0,
        "last_error": session.last_error if session else None,
        "controller": session.controller if session else None,
        "actions": session.actions if session else {},
    }


def _as_text(facts: dict[str, Any]) -> str:
    robots = "\n".join(_robot_as_text(robot) for robot in facts["robots"])
    where = "\n".join(facts[name] for name in ("database", "storage") if name in facts)
    kept = ", ".join(f"{kind} {text}" for kind, text in facts["limits"].items())
    sizes = ", ".join(_size_as_text(name, size) for name, size in facts["file"].items())
    return f"{where}\n{sizes}\nkept: {kept}\n{robots or 'no robot was recorded yet'}"


def _size_as_text(name: str, size_bytes: int) -> str:
    from webots_mcp.store.retention.notation import size_text

    return f"{name.removesuffix('_bytes').replace('_', ' ')} {size_text(size_bytes)}"


def _robot_as_text(robot: dict[str, Any]) -> str:
    time_text = "no data yet"
    if robot["sim_time_s"] is not None:
        time_text = f"simulation time {robot['sim_time_s']:.3f} s, {robot['age_s']:.1f} s old"
    where = f" (in {robot['waiting_in']})" if "waiting_in" in robot else ""
    lines = [
        f"{robot['robot']} ({robot['kind']}): {robot['status']}",
        f"  run {robot['run_id']} (recorded: {robot['runs']}), {robot['rows']} rows, {time_text}",
        f"  rows waiting {robot['rows_waiting']}{where}, dropped {robot['rows_dropped']}",
    ]
    why, error = robot["why"], robot["last_error"]
    lines += [f"  {why}"] if why else []
    lines += [f"  last error: {error}"] if error and not (why and error.startswith(why)) else []
    return "\n".join(map(printable, lines))


def _print_lines(lines: Sequence[Line]) -> None:
    for line in lines:
        clock = time.strftime("%H:%M:%S", time.localtime(line.wall_time_s))
        at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
        print(printable(f"{clock} {line.robot} {at:>11} {line.kind:<8} {line.text}"), flush=True)


def _newest_states_only(lines: Sequence[Line]) -> list[Line]:
    """A robot that publishes a hundred times a second would scroll all else away."""
    newest = {line.robot: line for line in lines if line.kind == "state"}
    return [line for line in lines if line.kind != "state" or newest[line.robot] is line]
