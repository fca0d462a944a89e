"""Every question that is asked of each recording, by what it asks and not by the name of a tool.

All is asked in this process: tools by a client in memory, the rest by a call.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, redirect_stderr, redirect_stdout
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final, cast
from unittest.mock import patch

import anyio
from mcp import Client

from tests.golden.recordings import GoldenRecording
from tests.plugins.report.conftest import Shown
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.errors import WebotsMCPError
from webots_mcp.extras.plugin_registry import export_formats
from webots_mcp.plotting.run_scores import compose_run_scores
from webots_mcp.plotting.signal_plot import compose_signals
from webots_mcp.plotting.trajectory import compose_trajectory
from webots_mcp.plotting.trials import compose_trials
from webots_mcp.plugins.report.make_report import make_report
from webots_mcp.questions import all_questions
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.export import TrialTable, export, export_for_viewers
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline

Answers = dict[str, Any]

IN_A_BUNDLE: Final = ("run", "state", "log", "event", "image", "kept_stretch", "kept_state")
ROWS_SHOWN: Final = 4
POINTS_SHOWN: Final = 6  # of a curve, evenly from it
NOT_MEASURED: Final = ("wall_time_s", "id", "run_id")  # columns of an export

OF_THE_MACHINE: Final = ("frames", "width_px", "height_px", "size_bytes")  # of a clip: its pace

PART_OF_STATE: Final = "part_of_state"  # in arguments: the first name of the signal X
PICTURE_S: Final = "picture_s"  # in arguments: when the recording has a picture

# question: (tool, arguments). A tool that is renamed or merged is changed here, and no answer.
TOOLS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "robots": ("webots_list_robots", {}),
    "world": ("webots_get_world_info", {}),
    "state": ("webots_get_robot_state", {}),
    "sensors": ("webots_get_sensors", {}),
    "full state": ("webots_get_full_state", {}),
    "a part of the full state": ("webots_get_full_state", {"path": PART_OF_STATE}),
    "newest logs": ("webots_get_logs", {}),
    "warnings": ("webots_get_logs", {"level": "warning", "lines": 5}),
    "what just happened": ("webots_monitor", {"lookback_wall_s": 60}),
    "signals": ("webots_list_signals", {}),
    "signals of a pattern": ("webots_list_signals", {"pattern": "X"}),
    "meanings": ("webots_list_meanings", {}),
    "history": ("webots_query_history", {"signals": ["*"], "max_points": 6}),
    "history of the mode": ("webots_query_history", {"signals": ["mode"]}),
    "history in rows": ("webots_query_history", {"signals": ["X"], "raw": True, "last_s": 0.3}),
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
    "score of all runs": ("webots_compare_runs", {"score": "max(X)", "goal": "X > 1"}),
    "runs with a score": ("webots_list_runs", {"score": "max(X)"}),
    "parameters": ("webots_get_parameters", {}),
    "trials": ("webots_get_trials", {}),
    "commands": ("webots_list_commands", {}),
    "SELECT": ("webots_query_sql", {"sql": "SELECT count(*) AS n, max(sim_time_s) FROM state"}),
    "pictures": ("webots_get_camera", {"at_s": PICTURE_S}),
    "plot": ("webots_plot", {}),
    "clip": ("webots_get_clip", {}),
    "check": ("webots_check_run", {}),
    "check of an expectation": ("webots_check_run", {"expect": ["X > -100"]}),
    "variables of the controller": ("webots_inspect_controller", {}),
    "outcome of a command": ("webots_wait_for_command", {"command_id": 1, "timeout_wall_s": 1}),
    "diagnosis": ("webots_diagnose_setup", {}),
    "faults of a world that is not there": ("webots_lint_world", {"world": "none/w.wbt"}),
    "scene": ("webots_get_scene", {}),
    "field of a node": ("webots_get_field", {"path": "ROBOT.translation"}),
}
NEEDS_A_SIMULATION: Final = ("scene", "field of a node", "faults of a world that is not there")
"""Questions that read a running simulation or a world file, and no recording."""

# What changes something is asked last. A recording alone takes labels and gives reports; what needs
# a running simulation says that there is none.
ACTIONS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "label a run": ("webots_annotate_run", {"label": "golden", "note": "asked in a test"}),
    "write a report": ("webots_report", {"file": "report.html"}),
    "say what a signal means": (
        "webots_describe_signals",
        {"signals": ["X"], "quantity": "x"},
    ),
    "run new code on an old run": ("webots_rerun_controller", {}),
    "set a breakpoint": ("webots_breakpoint", {"condition": "X > 1e6"}),
    "breakpoints": ("webots_list_breakpoints", {}),
    "remove a breakpoint": ("webots_remove_breakpoint", {"breakpoint_id": 1}),
    "send a command": ("webots_send_command", {"action": "blink", "timeout_wall_s": 1}),
    "set parameters": ("webots_set_parameters", {"values": {"speed": 0.3}, "timeout_wall_s": 1}),
    "watch a variable": ("webots_watch", {"path": "self.speed", "timeout_wall_s": 1}),
    "run on": ("webots_run", {"for_s": 1.0, "timeout_wall_s": 1}),
    "run trials": (
        "webots_run_trials",
        {"parameters": [{"speed": 0.3}], "score": "max(X)", "for_s": 1.0},
    ),
    "branch a run": (
        "webots_branch_run",
        {"parameters": [{"speed": 0.3}], "score": "max(X)", "for_s": 1.0},
    ),
    "film the scene": ("webots_record_scene", {"action": "start", "timeout_wall_s": 1}),
    "take a screenshot": ("webots_take_screenshot", {"timeout_wall_s": 1}),
    "pause": ("webots_simulation_control", {"command": "pause", "timeout_wall_s": 1}),
    "reset the world": ("webots_world_reset", {"timeout_wall_s": 1}),
    "reload the world": ("webots_world_reload", {"timeout_wall_s": 1}),
    "reset the controller": ("webots_reset_controller_state", {"timeout_wall_s": 1}),
    "load a world": ("webots_load_world", {"world": "worlds/absent.wbt", "timeout_wall_s": 1}),
    "launch a world": ("webots_launch_world", {"world": "worlds/absent.wbt", "timeout_wall_s": 1}),
    "quit Webots": ("webots_quit", {"timeout_wall_s": 1}),
    "set a field": ("webots_set_field", {"path": "BALL.translation", "value": [0, 0, 1]}),
    "add a node": ("webots_add_node", {"vrml": "Solid { }"}),
    "remove a node": ("webots_remove_node", {"path": "BALL"}),
    "edit the scene": ("webots_remove_node", {"path": "BALL"}),
}
_OF_A_PART: Final = ("newest logs", "history", "trends", "events", "timeline")


def ask_all(recording: GoldenRecording, folder: Path) -> Answers:
    """All answers about a recording, each as plain data; of a refusal its text.

    Questions have a clock that stands still: none is cut short on a slow machine.
    """
    with patch.object(Deadline.__init__, "__defaults__", (QUESTION_DEADLINE_S, lambda: 0.0)):
        return _ask_all(recording, folder)


def _ask_all(recording: GoldenRecording, folder: Path) -> Answers:
    file = folder / "webots.db"
    found = anyio.run(ask_tools, recording, file, TOOLS | _parts_of(recording))
    found["diagnosis"] = _checks_of(found["diagnosis"])
    if not recording.has_own_clock:  # the machine's pace is a check too
        for name in ("check", "check of an expectation"):
            del found[name]["outcome"]
    with closing(connect(file, "reader")) as connection:
        found |= dict(_views(connection))
        found |= dict(_plots(connection, recording))
        found["report"] = _report(connection, recording, folder)
        found |= dict(_exports(connection, recording, folder))
    return found | anyio.run(ask_tools, recording, file, ACTIONS)


def _checks_of(diagnosis: Any) -> list[str]:
    """The names of the checks of a diagnosis; what they found is this machine's."""
    names = [each["check"] for each in diagnosis.get("failed", [])]
    names += diagnosis.get("passed", "").split(", ")
    for checks in diagnosis.get("not_checked", {}).values():
        names += checks.split(", ")
    return sorted(filter(None, names))


def _parts_of(recording: GoldenRecording) -> dict[str, tuple[str, dict[str, Any]]]:
    """The questions about an interval of the recording."""
    start_s, end_s = recording.part
    return {
        f"{name} of a part": (tool, arguments | {"start_s": start_s, "end_s": end_s})
        for name, (tool, arguments) in TOOLS.items()
        if name in _OF_A_PART
    }


async def ask_tools(
    recording: GoldenRecording, file: Path, asked: dict[str, tuple[str, dict[str, Any]]]
) -> Answers:
    """What the tools answer about the recording in that file; of a refusal its texts."""
    found: Answers = {}
    known = {each.name: each.arguments.model_fields for each in all_questions()}
    async with Client(create_server(file, file.parent)) as client:
        for name, (tool, arguments) in asked.items():
            given = {"robot": recording.robot, "run_id": recording.run_id} | {
                key: _about(recording, value) for key, value in arguments.items()
            }
            taken = {
                key: value
                for key, value in given.items()
                if key in known[tool] and value is not None
            }
            result = await client.call_tool(tool, taken)
            texts = [block.text for block in result.content if block.type == "text"]
            found[name] = result.structured_content or [_read(text) for text in texts]
    for caption in found.get("clip", ()):
        for key in OF_THE_MACHINE if isinstance(caption, dict) else ():
            cast("dict[str, Any]", caption).pop(key, None)
    return found


def _read(text: str) -> Any:
    """What a picture's caption says as data; of a refusal its text."""
    if text.startswith("{"):
        return json.loads(text)
    return re.sub(r"^Error executing tool \w+: ", "", text)


def _about(recording: GoldenRecording, value: Any) -> Any:
    """An argument with the recording's own signal and time in it."""
    if value == PICTURE_S:
        return recording.picture_s
    if value == PART_OF_STATE:
        return recording.x.partition(".")[0]
    if isinstance(value, list):
        return [_about(recording, each) for each in cast("list[Any]", value)]
    return re.sub(r"\bX\b", recording.x, value) if isinstance(value, str) else value


def _views(connection: sqlite3.Connection) -> Iterator[tuple[str, Any]]:
    """Of each view how many rows it has, and the first of them."""
    named = connection.execute("SELECT name FROM sqlite_master WHERE type = 'view' ORDER BY name")
    for (name,) in named.fetchall():
        (count,) = connection.execute(f"SELECT count(*) FROM {name}").fetchone()
        cursor = connection.execute(f"SELECT * FROM {name} ORDER BY 1, 2, 3, 4")
        columns = [column for column, *_ in cursor.description]
        rows = [dict(zip(columns, row, strict=True)) for row in cursor.fetchmany(ROWS_SHOWN)]
        yield f"view {name}", {"rows": count, "first": rows}


def _plots(connection: sqlite3.Connection, recording: GoldenRecording) -> Iterator[tuple[str, Any]]:
    """What plots of the run, of a part of it and of trials are painted from."""
    scope = Scope(robot=recording.robot, run_id=recording.run_id)
    whole = [find_range(connection, scope)]
    part = [
        find_range(connection, replace(scope, start_s=recording.part[0], end_s=recording.part[1]))
    ]
    for name, ranges in (("", whole), (" of a part", part)):
        yield f"plot of signals{name}", _composed(compose_signals, connection, ranges, ["*"])
        yield f"plot of the trajectory{name}", _composed(compose_trajectory, connection, ranges)
    score = f"max({recording.x})"
    yield "plot of runs", _composed(compose_run_scores, connection, score, scope)
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
        if len(each_of) <= 2 * POINTS_SHOWN:
            return each_of
        every = len(each_of) // POINTS_SHOWN
        return {"count": len(each_of), "some": each_of[::every]}
    return value


def _report(connection: sqlite3.Connection, recording: GoldenRecording, folder: Path) -> Any:
    """The headings of a report of the run and what it holds; its words are those of the answers."""
    scope = Scope(robot=recording.robot, run_id=recording.run_id)
    report = make_report(connection, [find_range(connection, scope).segments[0].run_id], folder)
    headings = re.findall(
        r"<(?:h[1-3]|summary)[^>]*>(.*?)</(?:h[1-3]|summary)>", report.html.decode(), re.DOTALL
    )
    texts = [" ".join(Shown(each.encode()).text.split()) for each in headings]
    return {"holds": report.holds, "left out": report.left_out, "headings": texts}


def _exports(
    connection: sqlite3.Connection, recording: GoldenRecording, folder: Path
) -> Iterator[tuple[str, Any]]:
    whole = find_range(connection, Scope(robot=recording.robot, run_id=recording.run_id))
    for form in ("csv", "jsonl"):
        sink = io.BytesIO()
        rows = export(connection, whole, form, sink)
        yield f"export as {form}", {"rows": rows, **_content(form, sink.getvalue())}
    for each in export_formats():
        file = folder / f"golden.{each.name}"
        if each.for_viewers:
            exported = export_for_viewers(connection, folder, whole, each.name, file)
            yield f"export as {each.name}", exported.counts
        else:
            with file.open("wb") as sink:
                yield f"export as {each.name}", {"rows": export(connection, whole, each.name, sink)}
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
        counts = [(of, connection.execute(f"SELECT count(*) FROM {of}")) for of in IN_A_BUNDLE]
        return {of: found.fetchone()[0] for of, found in counts}


def _content(form: str, content: bytes) -> dict[str, Any]:
    """The columns of an export, and a digest of the values in it that no clock has made."""
    lines = content.decode().splitlines()
    if form == "csv":
        return {"columns": lines[0].split(",")}
    rows = [json.loads(line) for line in lines]
    names = dict.fromkeys(name for row in rows for name in row)
    told = [{name: row[name] for name in row if name not in NOT_MEASURED} for row in rows]
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
    return {"columns": list(names), "values": digest[:16]}
