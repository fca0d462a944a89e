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
_PURGED: Final = "SELECT purged_rows FROM run WHERE id = ?"
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
    return newest if "mode_since_s" in newest else _mode_by_trends(robot, recorded) or newest


def _mode_in_newest_rows(connection: sqlite3.Connection, run_id: int) -> dict[str, Any]:
    """Return the mode, and its start where the newest rows show that; without numpy."""
    is_kept = "SELECT EXISTS (SELECT 1 FROM kept_stretch WHERE run_id = ?)"
    if connection.execute(is_kept, (run_id,)).fetchone()[0]:
        return {}  # full-rate rows may show an earlier change
    (purged,) = connection.execute(_PURGED, (run_id,)).fetchone() or (None,)
    newest: Any = None
    since_s, read = 0.0, 0
    try:
        for sim_time_s, text in connection.execute(_MODES, (run_id, _MOST_ROWS)):
            mode = None if text is None else json.loads(text)
            if not isinstance(mode, (str, bool)) or (read and mode != newest):
                break
            newest, since_s, read = mode, sim_time_s, read + 1
        else:
            if read and (purged or read == _MOST_ROWS):
                return {"mode": newest}  # older rows may have the same one
    except sqlite3.Error:  # a row is no JSON
        return {}
    return {"mode": newest, "mode_since_s": shown_time(since_s)} if read else {}


def _mode_by_trends(robot: Mapping[str, Any], recorded: Where) -> dict[str, Any]:
    from webots_mcp.cli.question_commands import ask
    from webots_mcp.errors import WebotsMCPError
    from webots_mcp.questions.query_history import webots_get_trends

    try:
        asked = {"robot": robot["robot"], "signals": ["mode"]}
        (run,) = (ask(webots_get_trends, asked, recorded).data or {})["runs"]
        (state,) = _rows_of(run["states"])
    except (WebotsMCPError, KeyError, ValueError):
        return {}  # no such signal in this run, or it never changed in rows that are left
    is_known = state.get("last") is not None
    return {"mode": state["last"], "mode_since_s": state.get("since_s")} if is_known else {}


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
