"""Every question that is asked of each recording, by what it asks and not by the name of a tool."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import sqlite3
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager, closing, redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final, cast
from unittest.mock import patch

import anyio
import httpx2
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from mcp.server import MCPServer

from tests.golden.drawing import Kind
from tests.plugins.report.conftest import Shown
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.errors import WebotsMCPError
from webots_mcp.plotting.signals import compose_signals
from webots_mcp.plotting.trajectory import compose_trajectory
from webots_mcp.plotting.trials import compose_trials
from webots_mcp.plugins.report.making import make_report
from webots_mcp.questions import all_questions
from webots_mcp.questions.declaring import MergedQuestion
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.export import TrialTable, export, export_for_viewers
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline

Answers = dict[str, Any]

_VIEWS: Final = (
    "robot_run", "robot_command", "robot_event", "robot_period", "robot_log", "robot_parameter",
    "robot_kept", "robot_now", "robot_trajectory",
)  # fmt: skip
_IN_A_BUNDLE: Final = ("run", "state", "log", "event", "image", "kept_stretch", "kept_state")
OVER_HTTP: Final = ", over HTTP"  # behind the name of a question that was asked so once more
_WALL_TIME: Final = "wall time"  # in a report; how long follows
_ROWS_SHOWN: Final = 12
_POINTS_SHOWN: Final = 6  # of a curve, evenly from it
_NOT_MEASURED: Final = ("wall_time_s", "id", "run_id")  # columns of an export

# question: (tool, arguments). A tool that is renamed or merged is changed here, and no answer.
TOOLS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "robots": ("webots_list_robots", {}),
    "world": ("webots_get_world_info", {}),
    "state": ("webots_get_robot_state", {}),
    "sensors": ("webots_get_sensors", {}),
    "full state": ("webots_get_full_state", {}),
    "a part of the full state": ("webots_get_full_state", {"path": "pose"}),
    "newest logs": ("webots_get_logs", {}),
    "warnings": ("webots_get_logs", {"level": "warning", "lines": 5}),
    "what just happened": ("webots_monitor", {"lookback_wall_s": 60}),
    "signals": ("webots_list_signals", {}),
    "signals of a pattern": ("webots_list_signals", {"pattern": "pose*"}),
    "history": ("webots_query_history", {"signals": ["*"], "max_points": 6}),
    "history of the mode": ("webots_query_history", {"signals": ["mode"]}),
    "history in rows": ("webots_query_history", {"signals": ["pose*"], "raw": True}),
    "trends": ("webots_get_trends", {}),
    "trends of the mode": ("webots_get_trends", {"signals": ["mode"]}),
    "events": ("webots_find_events", {}),
    "events one by one": ("webots_find_events", {"group": False, "limit": 30}),
    **{
        f"events: {kind}": ("webots_find_events", {"kinds": [kind]})
        for kind in (
            "stuck",
            "standstill",
            "gap",
            "jump",
            "flat",
            "missing",
            "oscillation",
            "change",
        )
    },
    "events where a condition held": ("webots_find_events", {"where": "X > 0.2 for 0.5"}),
    "events where it never held": ("webots_find_events", {"where": "X > 1e6"}),
    "timeline": ("webots_get_timeline", {"limit": 20}),
    "runs": ("webots_list_runs", {}),
    "comparison": ("webots_compare_runs", {}),
    "parameters": ("webots_get_parameters", {}),
    "trials": ("webots_get_trials", {}),
    "commands": ("webots_list_commands", {}),
    "breakpoints": ("webots_list_breakpoints", {}),
    "SELECT": ("webots_query_sql", {"sql": "SELECT count(*) AS n, max(sim_time_s) FROM state"}),
}
_OF_A_PART: Final = ("newest logs", "history", "trends", "events", "timeline")


def ask_all(kind: Kind, folder: Path) -> Answers:
    """All answers of a recording, each as plain data; of a refusal its text.

    Questions have a clock that stands still: none is cut short on a slow machine.
    """
    with patch.object(Deadline.__init__, "__defaults__", (QUESTION_DEADLINE_S, lambda: 0.0)):
        return _ask_all(kind, folder)


def _ask_all(kind: Kind, folder: Path) -> Answers:
    file = folder / "webots.db"
    found = anyio.run(ask_tools, kind, file)
    with closing(connect(file, "reader")) as connection:
        found |= {f"view {name}": _view(connection, name) for name in _VIEWS}
        found |= dict(_plots(connection, kind))
        found["report"] = _report(connection, kind, folder)
        found |= dict(_exports(connection, kind, folder))
    return found


async def ask_tools(kind: Kind, file: Path) -> Answers:
    """What the tools answer of the recording in that file; of a refusal its texts."""
    found: Answers = {}
    asked = dict(TOOLS)
    part = {"start_s": kind.part[0], "end_s": kind.part[1]}
    for name in _OF_A_PART:
        tool, arguments = TOOLS[name]
        asked[f"{name} of a part"] = (tool, arguments | part)
    single = [each for each in all_questions() if not isinstance(each, MergedQuestion)]
    known = {each.name: each.arguments.model_fields for each in single}
    server = create_server(file, file.parent, read_only=True)
    async with Client(server) as client, _client_over_http(server) as other:
        for name, (tool, arguments) in asked.items():
            subject = {"robot": kind.robot, "run_id": kind.run_id, "where": _where(kind, arguments)}
            taken = {key: subject[key] for key in subject if key in known[tool] and subject[key]}
            for asker, addition in ((client, ""), (other, OVER_HTTP)):
                result = await asker.call_tool(tool, arguments | taken)
                texts = [block.text for block in result.content if block.type == "text"]
                found[name + addition] = result.structured_content or texts
                assert result.is_error == (result.structured_content is None), name
    return found


@asynccontextmanager
async def _client_over_http(server: MCPServer) -> AsyncGenerator[Client]:
    """A client of the handshake that most have, on the server's HTTP application."""
    app = server.streamable_http_app()
    carrier = httpx2.AsyncClient(transport=httpx2.ASGITransport(app), timeout=60)
    async with carrier, server.session_manager.run():
        transport = streamable_http_client("http://localhost:8000/mcp", http_client=carrier)
        async with Client(transport, mode="legacy") as client:
            yield client


def _where(kind: Kind, arguments: dict[str, Any]) -> str | None:
    condition = arguments.get("where")
    return condition and condition.replace("X", kind.x)


def _view(connection: sqlite3.Connection, name: str) -> Any:
    """How many rows a view has, and the first of them."""
    (count,) = connection.execute(f"SELECT count(*) FROM {name}").fetchone()
    cursor = connection.execute(f"SELECT * FROM {name} ORDER BY 1, 2, 3, 4")
    columns = [column for column, *_ in cursor.description]
    rows = [dict(zip(columns, row, strict=True)) for row in cursor.fetchmany(_ROWS_SHOWN)]
    return {"rows": count, "first": rows}


def _plots(connection: sqlite3.Connection, kind: Kind) -> Iterator[tuple[str, Any]]:
    """What plots of the run, of a part of it and of trials are painted from."""
    scope = Scope(robot=kind.robot, run_id=kind.run_id)
    whole = [find_range(connection, scope)]
    part = [find_range(connection, replace(scope, start_s=kind.part[0], end_s=kind.part[1]))]
    for name, ranges in (("", whole), (" of a part", part)):
        yield f"plot of signals{name}", _composed(compose_signals, connection, ranges, ["*"])
        yield f"plot of the trajectory{name}", _composed(compose_trajectory, connection, ranges)
    yield "plot of trials", _composed(compose_trials, connection, 1, ())


def _composed(compose: Any, *arguments: Any) -> Any:
    try:
        return _data(compose(*arguments))
    except WebotsMCPError as error:
        return str(error)


def _data(value: Any) -> Any:
    """Dataclasses and tuples as plain data; of a long list of points some, evenly from it."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _data(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {str(key): _data(each) for key, each in cast("dict[Any, Any]", value).items()}
    if isinstance(value, list | tuple):
        each_of = [_data(each) for each in cast("list[Any]", value)]
        if len(each_of) <= 2 * _POINTS_SHOWN:
            return each_of
        every = len(each_of) // _POINTS_SHOWN
        return {"count": len(each_of), "some": each_of[::every]}
    return value


def _report(connection: sqlite3.Connection, kind: Kind, folder: Path) -> Any:
    """The words of a report of the run, line by line, and what it holds."""
    run_id = find_range(connection, Scope(robot=kind.robot, run_id=kind.run_id)).segments[0].run_id
    report = make_report(connection, [run_id], folder)
    words = [*filter(None, (" ".join(each.split()) for each in Shown(report.html).words))]
    if not kind.clock and (before := words.index(_WALL_TIME)):
        words[before + 1] = "CLOCK"
    return {"holds": report.holds, "left out": report.left_out, "text": words}


def _exports(connection: sqlite3.Connection, kind: Kind, folder: Path) -> Iterator[tuple[str, Any]]:
    whole = find_range(connection, Scope(robot=kind.robot, run_id=kind.run_id))
    for form in ("csv", "jsonl"):
        sink = io.BytesIO()
        rows = export(connection, whole, form, sink)
        yield f"export as {form}", {"rows": rows, **_content(form, sink.getvalue())}
    for form in ("mcap", "rrd"):
        file = folder / f"golden.{form}"
        yield f"export as {form}", export_for_viewers(connection, folder, whole, form, file).counts
    yield "export as bundle", _imported_again(whole.segments[0].run_id, folder)
    try:
        sink = io.BytesIO()
        export(connection, TrialTable.of(connection, 1), "csv", sink)
        columns, *rows = csv.reader(sink.getvalue().decode().splitlines())
        yield "export of trials", {"columns": columns, "rows": rows}
    except WebotsMCPError as error:
        yield "export of trials", str(error)


def _imported_again(run_id: int, folder: Path) -> dict[str, int]:
    """How many rows of each kind come back from a run that was exported and imported."""
    bundle, back = folder / "golden.zip", folder / "golden_back"
    for command in (
        ["export", "--run", str(run_id), "-o", str(bundle), "--data-dir", str(folder)],
        ["import", str(bundle), "--data-dir", str(back)],
    ):
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            status = main(command)
        assert status == 0, command
    with closing(connect(back / "webots.db", "reader")) as connection:
        counts = [(of, connection.execute(f"SELECT count(*) FROM {of}")) for of in _IN_A_BUNDLE]
        return {of: found.fetchone()[0] for of, found in counts}


def _content(form: str, content: bytes) -> dict[str, Any]:
    """The columns of an export, and a digest of the values in it that no clock has made."""
    lines = content.decode().splitlines()
    if form == "csv":
        return {"columns": lines[0].split(",")}
    rows = [json.loads(line) for line in lines]
    names = dict.fromkeys(name for row in rows for name in row)
    told = [{name: row[name] for name in row if name not in _NOT_MEASURED} for row in rows]
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    return {"columns": list(names), "values": digest[:16]}
