"""Define the command `status`: what each robot does, since when, and what is wrong.

With `--storage` it also shows the limits and sizes of the recording.
"""

from __future__ import annotations

import json
import sqlite3
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final

from webots_mcp.cli.options import HERE, Json, Parameter, Where
from webots_mcp.cli.terminal import (
    is_verbose,
    print_answer,
    print_table,
    printable,
    terminal_width,
)
from webots_mcp.store.reading.segment import shown_time

_MOST_MODES: Final = 10  # robots whose mode is read: each takes a query
_MOST_ROWS: Final = 5000  # newest rows of a run in which the last change of `mode` is searched
_MODES: Final = (
    "SELECT sim_time_s, data -> '$.mode' FROM state WHERE run_id = ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
_COLUMNS: Final = ("robot", "status", "run_id", "sim_time_s", "mode", "mode_since_s", "kind")


def status(
    *,
    storage: Annotated[
        bool,
        Parameter(
            "--storage", negative=(), help="Also show the sizes and limits of the recording."
        ),
    ] = False,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Show what each robot is doing, since when, and any warnings."""
    from webots_mcp.cli.question_commands import ask, show
    from webots_mcp.questions.list_robots import webots_list_robots

    reply = ask(webots_list_robots, {}, recorded)
    answer = reply.data or {}
    if json or "robots" not in answer:
        return show(webots_list_robots, reply, recorded, as_json=json)
    robots = _rows_of(answer["robots"])
    print_answer({"summary": answer["summary"]})
    modeless = _without_mode(recorded)
    shown = [
        row if row["robot"] in modeless else row | _mode_of(row, recorded)
        for row in robots[:_MOST_MODES]
    ]
    shown += robots[_MOST_MODES:]
    print()
    print_table(_COLUMNS, [[row.get(name) for name in _COLUMNS] for row in shown])
    warnings = [*_warnings(robots)]
    if warnings:
        print()
    for warning in warnings:
        _print_wrapped(warning)
    print()
    _print_wrapped(f"recording: {answer.get('database')}")
    details = ("robots", "summary", "database", "retention")
    rest = {name: value for name, value in answer.items() if name not in details}
    if storage or is_verbose():
        rest["retention"] = answer.get("retention")
    elif "not_in_force" in (answer.get("retention") or {}):
        rest["retention"] = {"not_in_force": answer["retention"]["not_in_force"]}
    if rest:
        print_answer(rest)


def _rows_of(table: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    return [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]


def _without_mode(recorded: Where) -> frozenset[str]:
    """Return the robots that have registered signals, but none named `mode`.

    Reading a signal imports numpy, so these robots are skipped.
    """
    with recorded.recording().reader() as connection:
        return frozenset(
            name
            for (name,) in connection.execute(
                "SELECT robot.name FROM robot JOIN signal ON signal.robot_id = robot.id "
                "GROUP BY robot.id HAVING sum(signal.name = 'mode') = 0"
            )
        )


def _mode_of(robot: Mapping[str, Any], recorded: Where) -> dict[str, Any]:
    """Return the value of the robot's signal `mode` and since when, if it has such a signal."""
    if robot.get("run_id") is None:
        return {}
    with recorded.recording().reader() as connection:
        newest = _mode_in_newest_rows(connection, robot["run_id"])
    return _mode_by_trends(robot, recorded) if newest is None else newest


def _mode_in_newest_rows(connection: sqlite3.Connection, run_id: int) -> dict[str, Any] | None:
    """Return the mode and its start from the newest rows; None if these do not show it."""
    is_kept = "SELECT EXISTS (SELECT 1 FROM kept_stretch WHERE run_id = ?)"
    if connection.execute(is_kept, (run_id,)).fetchone()[0]:
        return None  # full-rate rows may show an earlier change
    last, since_s = None, 0.0
    try:
        rows = connection.execute(_MODES, (run_id, _MOST_ROWS))
        for sim_time_s, mode in rows:
            if last is None:
                last = mode
            if mode is None or mode != last:
                break
            since_s = sim_time_s
        else:
            return None
    except sqlite3.Error:  # a row is no JSON
        return None
    known = None if last is None else json.loads(last)
    is_mode = isinstance(known, (str, bool))
    return {"mode": known, "mode_since_s": shown_time(since_s)} if is_mode else None


def _mode_by_trends(robot: Mapping[str, Any], recorded: Where) -> dict[str, Any]:
    from webots_mcp.cli.question_commands import ask
    from webots_mcp.errors import WebotsMCPError
    from webots_mcp.questions.query_history import webots_get_trends

    try:
        asked = {"robot": robot["robot"], "signals": ["mode"]}
        (run,) = (ask(webots_get_trends, asked, recorded).data or {})["runs"]
        states = _rows_of(run["states"])
    except (WebotsMCPError, KeyError, ValueError):
        return {}  # no such signal in this run
    return {"mode": states[0].get("last"), "mode_since_s": states[0].get("since_s")}


def _warnings(robots: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield what is wrong or slow with each robot, in a sentence."""
    for robot in robots:
        name = robot["robot"]
        if why := robot.get("why"):
            yield f"{name}: {why}"
        if error := robot.get("last_error"):
            yield f"warning: {name}: last error: {error}"
        if dropped := robot.get("rows_dropped"):
            yield f"warning: {name}: {dropped} rows could not be recorded"
        if waiting := robot.get("rows_waiting"):
            yield f"warning: {name}: {waiting} rows wait in {robot.get('waiting_in')}"
        if is_verbose() and robot.get("pace"):
            yield str(robot["pace"])


def _print_wrapped(text: str) -> None:
    width = terminal_width(sys.stdout)
    for line in textwrap.wrap(printable(text), width, subsequent_indent="  "):
        print(line)
