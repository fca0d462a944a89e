"""The tool that reads log lines."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Annotated, Final

from pydantic import Field

from webots_mcp.answers.answer_models import AnswerTable, LogsAnswer
from webots_mcp.answers.budget import fitting
from webots_mcp.answers.shortening import cut_text, is_for_a_person
from webots_mcp.contract import LogLevel, LogSource
from webots_mcp.errors import AmbiguousRobotError, NothingRecordedError
from webots_mcp.questions.arguments import Cursor, EndS, Id, LastS, RobotName, StartS, TimeOfDay
from webots_mcp.questions.declaration import READS, question
from webots_mcp.simulator.console import console_state
from webots_mcp.store.logs import (
    COUNT_LIMIT,
    OF_CONSOLE,
    LogFilter,
    LogLine,
    LogWindow,
    count_lines,
    newest_lines,
    waiting_lines,
    window_of,
)
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.relative_times import wall_clock
from webots_mcp.store.robots import list_robots

_ANY_LINE: Final = LogFilter(None, LogWindow(-math.inf, math.inf), "", "debug")
_NO_RUN_YET: Final = (
    "lines without a run_id came from Webots' console before a run began: a controller that never "
    "began one may have failed there"
)


@question(
    "Get log lines",
    READS,
    command="logs",
    options={"lines": "-n", "filter_text": "--text", "cursor": "--before"},
    quotes=True,
    follows="lines",
    tier="core",
)
def webots_get_logs(
    recording: RecordingAccess,
    lines: Annotated[int, Field(ge=1, le=1000, description="Maximum number of lines.")] = 50,
    filter_text: Annotated[
        str, Field(max_length=200, description="Only lines that contain this text.")
    ] = "",
    level: Annotated[
        LogLevel | None,
        Field(
            description="Only lines of at least this level. Printed text is info; "
            "on stderr, warning."
        ),
    ] = None,
    source: Annotated[LogSource | None, Field(description="Only lines from this source.")] = None,
    last_s: LastS = None,
    start_s: StartS = None,
    end_s: EndS = None,
    cursor: Cursor = None,
    robot: RobotName = None,
    run_id: Annotated[
        Id | None, Field(description="Only lines of this run. Default: all runs.")
    ] = None,
    time_of_day: TimeOfDay = False,
) -> LogsAnswer:
    """Read what the controller printed and logged: the newest lines, oldest first.

    Covers all runs, unless run_id is given; a time range alone means the newest run. A line of
    this robot's controller begins with the name of its logger, if any; other lines begin with
    their source: 'bridge:', 'webots:' or 'console:' (printed by an unknown controller). For
    faults in the robot's behaviour use webots_find_events.
    """
    scope = Scope(robot=robot, run_id=run_id, last_s=last_s, start_s=start_s, end_s=end_s)
    lowest = level or "debug"
    try:
        with recording.view(robot, run_id) as view:
            run = view.require_run()
            window = window_of(scope, run.last_sim_time_s)
            one_run = run.id if scope.in_one_run else None
            asked = LogFilter(one_run, window, filter_text, lowest, cursor, view.robot.id, source)
            return _answer(recording, view, asked, lines, time_of_day=time_of_day)
    except (NothingRecordedError, AmbiguousRobotError):
        asked = replace(_ANY_LINE, text=filter_text, lowest_level=lowest, source=source)
        with recording.reader() as connection:
            is_any_live = any(each.live for each in list_robots(connection, time.time()))
            waiting = [] if is_any_live else waiting_lines(connection, asked, lines)
            if not waiting and (is_any_live or not waiting_lines(connection, _ANY_LINE, 1)):
                raise
            # What a controller prints as it fails has no level of its own.
            any_level = replace(asked, lowest_level=_ANY_LINE.lowest_level)
            shown = waiting or waiting_lines(connection, any_level, lines)
        below_level = (
            "no robot has recorded yet, and no line of Webots' console has the level {} or "
            "above: these have a lower one"
        )
        hint = (
            below_level.format(lowest)
            if shown
            else (
                "no robot has recorded yet, and no line of Webots' console matches: leave out the "
                "level, the text and the source to see all of its lines"
            )
        )
        return LogsAnswer(
            lines=_table(_newest_fitting(shown), time_of_day=time_of_day) if shown else None,
            total=len(waiting),
            hint=_NO_RUN_YET if waiting else hint,
        )


def _row(line: LogLine) -> dict[str, object]:
    message = line.message
    if line.source == "controller" and line.logger is not None:
        message = f"[{line.logger}] {message}"
    if line.source != "controller":
        message = f"{line.source}: {message}"
    return {
        "id": line.id,
        "sim_time_s": None if line.sim_time_s is None else round(line.sim_time_s, 3),
        "level": line.level,
        "message": message if is_for_a_person() else cut_text(message, 500),
        "run_id": line.run_id,
    }


def _table(lines: list[LogLine], *, time_of_day: bool) -> AnswerTable:
    columns: list[str] = [
        *(
            ("id", "sim_time_s", "level", "run_id", "message")
            if is_for_a_person()
            else ("sim_time_s", "level", "message", "run_id")
        )
    ]
    if time_of_day:
        columns.insert(columns.index("sim_time_s") + 1, "wall_time")
    rows = [_row(line) | {"wall_time": wall_clock(line.wall_time_s)} for line in lines]
    return AnswerTable(columns=columns, rows=[[row[name] for name in columns] for row in rows])


def _answer(
    recording: RecordingAccess, view: RobotView, asked: LogFilter, limit: int, *, time_of_day: bool
) -> LogsAnswer:
    newest = newest_lines(view.connection, asked, limit)
    matching = count_lines(view.connection, asked)
    waiting = list[LogLine]()
    if asked.run_id is None and asked.before_id is None:
        waiting = waiting_lines(view.connection, asked, limit)
    shown = _newest_fitting([*newest, *waiting][-limit:])
    recorded = [line for line in shown if line.run_id is not None]
    older = matching > len(recorded)
    hints = [_hint(asked, matching, len(recorded))] * bool(older or not waiting)
    hints += [_NO_RUN_YET] * bool(waiting)
    if asked.source in OF_CONSOLE or not shown:
        hints.append(console_state(recording, view.connection))
    return LogsAnswer(
        **view.header(),
        lines=_table(shown, time_of_day=time_of_day),
        total=matching,
        cursor=recorded[0].id if older and recorded else None,
        hint="; ".join(hint for hint in hints if hint) or None,
    )


def _newest_fitting(lines: list[LogLine]) -> list[LogLine]:
    """Return the newest ones that fit a model's budget, at least one."""
    if is_for_a_person():
        return lines
    rows = [[*_row(line).values()] for line in reversed(lines)]
    return lines[len(lines) - len(fitting(rows, 1_500)) :]


def _hint(asked: LogFilter, matching: int, shown: int) -> str | None:
    if matching > shown:
        most = f"{COUNT_LIMIT} or more" if matching >= COUNT_LIMIT else str(matching)
        return f"the newest {shown} of {most}: ask again with cursor for older ones"
    return None if shown else _why_empty(asked)


def _why_empty(asked: LogFilter) -> str:
    if asked.before_id is not None:
        return "no older lines match"
    if asked.text or asked.source or asked.lowest_level != "debug":
        return (
            "no line matches: leave out filter_text, level, source or the time range to see others"
        )
    return (
        "no lines in this run or time range: bridge.log('text', level='info') records one, "
        "capture_output=True what a controller prints"
    )
