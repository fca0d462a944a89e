"""Commands that list what a recording holds: signals, log lines, rows of its tables."""

from __future__ import annotations

import argparse
import json
import subprocess
from dataclasses import asdict
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
from webots_mcp.cli.ranges import RUN, SIMULATION_TIMES
from webots_mcp.cli.tables import print_json, print_notes, print_table
from webots_mcp.contract import LOG_LEVELS

if TYPE_CHECKING:
    from webots_mcp.store.logs import LogFilter, LogLine
    from webots_mcp.store.recording import View
    from webots_mcp.store.signals.catalogue import SignalInfo

_SIGNAL_COLUMNS: Final = (
    "signal", "kind", "unit", "last", "min", "max", "first_s", "last_s", "missing",
)  # fmt: skip
_LOG_COLUMNS: Final = ("sim_time_s", "level", "run", "message")


@question(
    "signals", DATA_DIR, DATABASE, ROBOT, RUN, JSON,
    argument("pattern", nargs="?", default="*", metavar="PATTERN", help="only these, with '*'"),
    count("-n", "the first N by name", default=100),
)  # fmt: skip
def signals(arguments: argparse.Namespace) -> None:
    """List what was published in a run: kind, last value, range, rows without a value."""
    from webots_mcp.store.signals.catalogue import list_signals

    with reading(arguments) as connection:
        found = list_signals(
            connection, robot=arguments.robot, run_id=arguments.run_id,
            pattern=arguments.pattern, limit=arguments.limit,
        )  # fmt: skip
    if arguments.json:
        return print_json(found)
    print_table(_SIGNAL_COLUMNS, [_signal_row(info) for info in found.signals])
    left = found.total - len(found.signals)
    print_notes([*found.notes, *[f"{left} more signals: -n shows them"] * bool(left)])


def _signal_row(info: SignalInfo) -> list[Any]:
    last = bool(info.last) if info.kind == "bool" and info.last is not None else info.last
    figures = (info.min, info.max, info.first_s, info.last_s, info.missing or None)
    return [info.name, info.kind, info.unit, last, *figures]


@question(
    "logs", DATA_DIR, DATABASE, ROBOT, RUN, *SIMULATION_TIMES, JSON,
    argument("--level", choices=LOG_LEVELS, default="debug", help="this level and those above it"),
    argument("--text", default="", metavar="TEXT", help="only lines that contain this text"),
    count("-n", "the newest N lines", default=50),
)  # fmt: skip
def logs(arguments: argparse.Namespace) -> None:
    """Show the newest log lines of a robot, the oldest of them first.

    Those of all its runs; with --run or a range of simulation time those of that run, or the
    current one.
    """
    from webots_mcp.store.logs import count_lines, newest_lines
    from webots_mcp.store.recording import look

    with reading(arguments) as connection:
        asked = _filter_of(look(connection, arguments.robot, arguments.run_id), arguments)
        lines = newest_lines(connection, asked, arguments.limit)
        matching = count_lines(connection, asked)
    if arguments.json:
        told = {"lines": [asdict(line) for line in lines], "matching": matching}
        return print(json.dumps(told, ensure_ascii=False))
    print_table(_LOG_COLUMNS, [_log_row(line) for line in lines])
    left = matching - len(lines)
    older = f"{left} older lines or more: -n shows them" if left else None
    print_notes([older or "no line matches"] * (bool(left) or not lines))


def _filter_of(view: View, arguments: argparse.Namespace) -> LogFilter:
    from webots_mcp.store.logs import LogFilter
    from webots_mcp.store.reading.ranges import Scope
    from webots_mcp.store.window import window_of

    asked = ("robot", "run_id", "last_s", "start_s", "end_s")
    scope = Scope(**{name: getattr(arguments, name) for name in asked})
    run = view.require_run()
    return LogFilter(
        run_id=run.id if scope.in_one_run else None,
        window=window_of(scope, run.last_sim_time_s),
        text=arguments.text,
        lowest_level=arguments.level,
        robot_id=view.robot.id,
    )


def _log_row(line: LogLine) -> list[Any]:
    logger = f"[{line.logger}] " if line.logger is not None else ""
    source = "" if line.source == "controller" else f"{line.source}: "
    return [line.sim_time_s, line.level, line.run_id, f"{logger}{source}{line.message}"]


@question(
    "sql", DATA_DIR, DATABASE, JSON,
    argument("sql", metavar="STATEMENT", help="one SELECT, in quotes"),
    count("-n", "at most N rows, up to 1000", default=100, dest="max_rows"),
)  # fmt: skip
def sql(arguments: argparse.Namespace) -> None:
    """Read by SQL (SQLite) what the other commands do not cover; nothing but reading is allowed.

    It ends after some seconds, and values are cut to 200 characters; 'sqlite3 webots.db' has no
    such limits.

    webots-mcp sql 'SELECT id, rows, label FROM run'
    """
    from webots_mcp.store.questions.sql import MAX_BYTES, require_select
    from webots_mcp.store.questions.sql_process import FOLDER, LINE, Statement, as_file, decode
    from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S

    require_select(arguments.sql)
    with reading(arguments), as_file(open_recording(arguments).database) as file:
        asked = Statement(
            str(file), arguments.sql, arguments.max_rows, MAX_BYTES, QUESTION_DEADLINE_S
        )
        ended = subprocess.run(
            LINE, input=asked.encoded(), stdout=subprocess.PIPE, cwd=FOLDER, check=False
        )
        found = decode(ended.stdout, ended.returncode, asked)
    if arguments.json:
        return print_json(found)
    rows = [["NULL" if cell is None else cell for cell in row] for row in found.rows]
    print_table(found.columns, rows)
    cut = f"{found.shortened} long values are cut" if found.shortened else None
    print_notes([note for note in (found.truncated, cut, None if rows else "no row") if note])
