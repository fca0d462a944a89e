"""The console commands.

A command is one function under `@command`; what it needs is imported inside it, so that
`webots-mcp --help` answers at once. Our own errors end it with one line on stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from webots_mcp.errors import InvalidInputError, WebotsMCPError

if TYPE_CHECKING:
    from webots_mcp.store.follow import Line
    from webots_mcp.store.recording import Recording, View

EXIT_BAD_INPUT: Final = 2
_DESCRIPTION: Final = (
    "Flight recorder and remote control for Webots simulations: controllers record into one "
    "SQLite database, an AI assistant reads it and steers the simulation over MCP."
)
_EPILOG: Final = "'webots-mcp COMMAND --help' explains a command. Try 'webots-mcp demo' first."


class Argument(NamedTuple):
    """What `add_argument` takes."""

    flags: tuple[str, ...]
    options: dict[str, Any]


class Command(NamedTuple):
    """A subcommand: its name, its function (whose docstring is its help), its arguments."""

    name: str
    run: Callable[[argparse.Namespace], None]
    arguments: tuple[Argument, ...]


COMMANDS: Final[list[Command]] = []


def argument(*flags: str, **options: Any) -> Argument:
    """An argument of a command, as `argparse` takes it."""
    return Argument(flags, options)


def command(
    name: str, *arguments: Argument
) -> Callable[[Callable[[argparse.Namespace], None]], Callable[[argparse.Namespace], None]]:
    """Make a function a subcommand."""

    def register(run: Callable[[argparse.Namespace], None]) -> Callable[..., None]:
        COMMANDS.append(Command(name, run, arguments))
        return run

    return register


DATA_DIR: Final = argument(
    "--data-dir",
    metavar="DIR",
    help="folder of the database and the pictures (default: mcp_data/ in the nearest Webots "
    "project, else ~/.webots-mcp/data; also WEBOTS_MCP_DATA_DIR)",
)
DATABASE: Final = argument("--database", metavar="FILE", help="the database file itself")
ROBOT: Final = argument("--robot", metavar="NAME", help="only this robot")


@command(
    "serve",
    DATA_DIR,
    DATABASE,
    argument(
        "--read-only", action="store_true", help="leave out the tools that change the simulation"
    ),
)
def serve(arguments: argparse.Namespace) -> None:
    """Serve a recording to an MCP client over stdin and stdout.

    Starts whether or not anything was recorded yet. Connect Claude Code with:
    claude mcp add webots -- webots-mcp serve --data-dir /path/to/project/mcp_data
    """
    import logging

    from webots_mcp.contract import resolve_database

    logging.basicConfig(level=logging.WARNING, stream=sys.stderr)
    database, data_dir = resolve_database(arguments.database, arguments.data_dir)
    if sys.stdin.isatty():
        print(
            f"webots-mcp: serving {database} to an MCP client on stdin and stdout; Ctrl-C ends it. "
            "Clients start this command themselves, see 'webots-mcp serve --help'.",
            file=sys.stderr,
        )
    from webots_mcp.server import create_server

    create_server(database, data_dir, read_only=arguments.read_only).run()


@command(
    "status", DATA_DIR, DATABASE, argument("--json", action="store_true", help="print it as JSON")
)
def status(arguments: argparse.Namespace) -> None:
    """Show the robots: whether they run, how old their data is, what could not be recorded."""
    import webots_mcp.store.recording as recordings
    from webots_mcp.store.robots import list_robots

    recording = _recording(arguments)
    with recording.reader() as connection:
        now_s = time.time()
        views = [
            recordings.view_of(connection, robot, None, now_s)
            for robot in list_robots(connection, now_s)
        ]
        facts = {"database": str(recording.database), "robots": [_facts(view) for view in views]}
    print(json.dumps(facts, indent=2) if arguments.json else _as_text(facts))


@command(
    "tail",
    DATA_DIR,
    DATABASE,
    ROBOT,
    argument("-n", type=int, default=10, metavar="N", help="begin with the last N lines (10)"),
    argument(
        "--interval", type=float, default=0.5, metavar="S", help="seconds between looks (0.5)"
    ),
    argument("--no-follow", action="store_true", help="print the last lines and end"),
)
def tail(arguments: argparse.Namespace) -> None:
    """Follow what is being recorded: states, log lines, events, commands. Ctrl-C ends it.

    Of the states that came since the last look the newest of each robot is shown.
    """
    from webots_mcp.store.follow import Follower
    from webots_mcp.store.robots import resolve_robot

    if arguments.n < 0 or arguments.interval <= 0:
        raise InvalidInputError("-n must not be negative, and --interval must be greater than 0")
    with _recording(arguments).reader() as connection:
        robot = arguments.robot and resolve_robot(connection, arguments.robot, time.time())
        follower = Follower(connection, robot.id if robot else None)
        _print_lines(follower.look(arguments.n))
        while not arguments.no_follow:
            time.sleep(arguments.interval)
            _print_lines(_newest_states_only(follower.look()))


@command(
    "migrate",
    DATA_DIR,
    DATABASE,
    argument("--revision", default="head", help="an Alembic revision (default: the newest)"),
)
def migrate(arguments: argparse.Namespace) -> None:
    """Bring a database to the schema of this version; its data is kept."""
    from alembic.util import CommandError

    from webots_mcp.contract import MemoryDatabase, resolve_database
    from webots_mcp.store.migrate import upgrade

    database, _ = resolve_database(arguments.database, arguments.data_dir)
    if isinstance(database, MemoryDatabase) or not database.exists():
        raise InvalidInputError(f"no database at {database}: give --data-dir or --database")
    try:
        before, after = upgrade(database, arguments.revision)
    except CommandError as error:
        raise InvalidInputError(f"--revision {arguments.revision}: {error}") from error
    print(f"{database}: schema {before}, now {after}" if before != after else f"schema {after}")


@command(
    "demo",
    argument("--data-dir", metavar="DIR", help="where to record (default: ~/.webots-mcp/demo)"),
    argument("--keep", action="store_true", help="leave the robot running until Ctrl-C"),
)
def demo(arguments: argparse.Namespace) -> None:
    """Run a robot on the stand-in simulator and talk to it: no Webots needed, under 30 s."""
    from webots_mcp.demo import DEFAULT_DATA_DIR, run

    chosen = Path(arguments.data_dir).expanduser().resolve() if arguments.data_dir else None
    run(chosen or DEFAULT_DATA_DIR, keep=arguments.keep)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, or 2 for bad input and our own errors."""
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except WebotsMCPError as error:
        print(f"webots-mcp: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _parser() -> argparse.ArgumentParser:
    from webots_mcp import __version__

    parser = argparse.ArgumentParser("webots-mcp", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("--version", action="version", version=f"webots-mcp {__version__}")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, run, arguments in COMMANDS:
        text = run.__doc__ or ""
        subparser = subparsers.add_parser(
            name, help=text.partition("\n")[0].rstrip("."), description=_unindented(text)
        )
        subparser.set_defaults(run=run)
        for flags, options in arguments:
            subparser.add_argument(*flags, **options)
    return parser


def _unindented(text: str) -> str:
    return " ".join(text.split())


def _recording(arguments: argparse.Namespace) -> Recording:
    """The recording that a command reads; commands that only look never migrate it."""
    from webots_mcp.contract import resolve_database
    from webots_mcp.store.recording import Recording

    return Recording(*resolve_database(arguments.database, arguments.data_dir), read_only=True)


def _facts(view: View) -> dict[str, Any]:
    from webots_mcp.store.runs import count_runs

    session = view.session
    return {
        **view.header(),
        "kind": view.robot.kind,
        "live": view.robot.live,
        "runs": count_runs(view.connection, view.robot.id),
        "rows": view.run.rows if view.run else 0,
        "rows_waiting": session.rows_waiting if session else 0,
        "rows_dropped": session.rows_dropped if session else 0,
        "last_error": session.last_error if session else None,
        "controller": session.controller if session else None,
    }


def _as_text(facts: dict[str, Any]) -> str:
    robots = "\n".join(_robot_as_text(robot) for robot in facts["robots"])
    return f"{facts['database']}\n{robots or 'no robot was recorded yet'}"


def _robot_as_text(robot: dict[str, Any]) -> str:
    time_text = "no data yet"
    if robot["sim_time_s"] is not None:
        time_text = f"simulation time {robot['sim_time_s']:.3f} s, {robot['age_s']:.1f} s old"
    lines = [
        f"{robot['robot']} ({robot['kind']}): {robot['status']}",
        f"  run {robot['run_id']} of {robot['runs']} runs, {robot['rows']} rows, {time_text}",
        f"  rows waiting {robot['rows_waiting']}, dropped {robot['rows_dropped']}",
    ]
    lines += [f"  {robot['why']}"] if robot["why"] else []
    lines += [f"  last error: {robot['last_error']}"] if robot["last_error"] else []
    return "\n".join(lines)


def _print_lines(lines: Sequence[Line]) -> None:
    for line in lines:
        clock = time.strftime("%H:%M:%S", time.localtime(line.wall_time_s))
        at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
        text = line.text.replace("\n", "\\n")
        print(f"{clock} {line.robot} {at:>11} {line.kind:<8} {text}", flush=True)


def _newest_states_only(lines: Sequence[Line]) -> list[Line]:
    """A robot that publishes a hundred times a second would scroll all else away."""
    newest = {line.robot: line for line in lines if line.kind == "state"}
    return [line for line in lines if line.kind != "state" or newest[line.robot] is line]


if __name__ == "__main__":
    sys.exit(main())
