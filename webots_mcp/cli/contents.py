"""Commands that list what a recording holds: signals, log lines, rows of its tables."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Final

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
from webots_mcp.cli.looking import wait
from webots_mcp.cli.ranges import RUN, SIMULATION_TIMES
from webots_mcp.cli.tables import print_notes, print_table
from webots_mcp.contract import LOG_LEVELS, LOG_SOURCES

if TYPE_CHECKING:
    import sqlite3

    from webots_mcp.store.logs import LogFilter, LogLine

_SIGNAL_COLUMNS: Final = (
    "signal", "kind", "unit", "last", "min", "max", "first_s", "last_s", "missing",
)  # fmt: skip
_LOG_COLUMNS: Final = ("sim_time_s", "level", "run", "message")
_LOOK_S: Final = 0.5
_MOST_AT_ONCE: Final = 500


@question(
    "logs", DATA_DIR, DATABASE, ROBOT, RUN, *SIMULATION_TIMES, JSON,
    argument("--level", choices=LOG_LEVELS, default="debug", help="this level and those above it"),
    argument("--text", default="", metavar="TEXT", help="only lines that contain this text"),
    argument("--source", choices=LOG_SOURCES, help="only lines of this one"),
    argument("--follow", action="store_true", help="go on with what comes, until Ctrl-C"),
    count("-n", "the newest N lines", default=50),
)  # fmt: skip
def logs(arguments: argparse.Namespace) -> None:
    """Show the newest log lines of a robot, the oldest of them first.

    Those of all its runs; with --run or a range of simulation time those of that run, or the
    current one. Those of Webots' console are recorded while 'webots-mcp serve' or
    'webots-mcp launch' runs: 'webots:' begins its own, 'console:' what a controller printed.
    """
    from webots_mcp.console.console_follower import console_state
    from webots_mcp.store.logs import OF_CONSOLE, count_lines
    from webots_mcp.store.recording import storage

    with reading(arguments) as connection:
        asked = _filter_of(connection, arguments)
        lines = _newest(connection, asked, arguments.limit)
        matching = count_lines(connection, asked)
        if arguments.json:
            told = {"lines": [asdict(line) for line in lines], "matching": matching}
            return print(json.dumps(told, ensure_ascii=False))
        print_table(_LOG_COLUMNS, [_log_row(line) for line in lines])
        left = matching - sum(line.run_id is not None for line in lines)
        notes = [f"{left} older lines or more: -n shows them"] * bool(left)
        notes += ["no line matches"] * (not lines)
        if arguments.source in OF_CONSOLE or not lines:
            notes.append(console_state(open_recording(arguments), connection))
        print_notes(notes)
        if arguments.follow and not storage(connection):
            _follow(connection, arguments, lines)


def _filter_of(connection: sqlite3.Connection, arguments: argparse.Namespace) -> LogFilter:
    """What is asked for; before the first run only what the console has said."""
    from webots_mcp.errors import NothingRecordedError
    from webots_mcp.store.logs import LogFilter, Window, waiting_lines, window_of
    from webots_mcp.store.reading.ranges import Scope
    from webots_mcp.store.recording import look

    asked = ("robot", "run_id", "last_s", "start_s", "end_s")
    scope = Scope(**{name: getattr(arguments, name) for name in asked})
    wanted = LogFilter(
        run_id=None,
        window=Window(-math.inf, math.inf),
        text=arguments.text,
        lowest_level=arguments.level,
        source=arguments.source,
    )
    try:
        view = look(connection, arguments.robot, arguments.run_id)
        run = view.require_run()
    except NothingRecordedError:
        if not waiting_lines(connection, wanted, 1):
            raise
        return wanted
    return replace(
        wanted,
        run_id=run.id if scope.in_one_run else None,
        window=window_of(scope, run.last_sim_time_s),
        robot_id=view.robot.id,
    )


def _newest(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """Recorded lines, and after them those of the console that wait for a run."""
    from webots_mcp.store.logs import newest_lines, waiting_lines

    recorded = newest_lines(connection, asked, limit)
    waiting = waiting_lines(connection, asked, limit) if asked.run_id is None else []
    return [*recorded, *waiting][-limit:]


def _follow(
    connection: sqlite3.Connection, arguments: argparse.Namespace, lines: list[LogLine]
) -> None:
    """Print what comes; of a flood the newest."""
    newest = _newest_ids(lines)
    while True:
        wait(_LOOK_S)
        found = _newest(connection, _filter_of(connection, arguments), _MOST_AT_ONCE)
        for line in found:
            if line.id > newest[line.run_id is None]:
                print(*("-" if each is None else each for each in _log_row(line)), flush=True)
        newest = {key: max(newest[key], each) for key, each in _newest_ids(found).items()}


def _newest_ids(lines: list[LogLine]) -> dict[bool, int]:
    """Of those that are recorded, and of those that wait, which have numbers of their own."""
    return {
        waits: max((line.id for line in lines if (line.run_id is None) == waits), default=0)
        for waits in (False, True)
    }


def _log_row(line: LogLine) -> list[Any]:
    logger = f"[{line.logger}] " if line.logger and line.source == "controller" else ""
    source = "" if line.source == "controller" else f"{line.source}: "
    return [line.sim_time_s, line.level, line.run_id, f"{logger}{source}{line.message}"]
