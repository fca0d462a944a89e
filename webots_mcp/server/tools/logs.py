"""The tool that reads log lines."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field

from webots_mcp.contract import LogLevel
from webots_mcp.server.declaring import READS, tool
from webots_mcp.server.parameters import Cursor, EndS, LastS, RobotName, RunId, StartS
from webots_mcp.server.results import LogsAnswer, Table
from webots_mcp.server.shortening import cut_text
from webots_mcp.store.logs import COUNT_LIMIT, LogFilter, LogLine, count_lines, newest_lines
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.recording import Recording, View
from webots_mcp.store.window import window_of

LOG_COLUMNS: Final = ("sim_time_s", "level", "message", "run_id")
_LONGEST_MESSAGE: Final = 500
_BUDGET: Final = 6_000


@tool("Get log lines", READS)
def webots_get_logs(
    recording: Recording,
    lines: Annotated[int, Field(ge=1, le=1000, description="The most lines.")] = 50,
    filter_text: Annotated[
        str, Field(max_length=200, description="Only lines that contain this text.")
    ] = "",
    level: Annotated[LogLevel | None, Field(description="This level and those above it.")] = None,
    last_s: LastS = None,
    start_s: StartS = None,
    end_s: EndS = None,
    cursor: Cursor = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> LogsAnswer:
    """The newest log lines, oldest first, each with its run.

    Of all runs of the robot, so also from before a reset; with a run_id or a range of time of
    that run, or the current one. Lines of the bridge begin with 'bridge:', those of Python's
    logging with '[name of the logger]'.
    """
    scope = Scope(robot=robot, run_id=run_id, last_s=last_s, start_s=start_s, end_s=end_s)
    with recording.view(robot, run_id) as view:
        run = view.require_run()
        lowest = level or "debug"
        window = window_of(scope, run.last_sim_time_s)
        one_run = run.id if scope.in_one_run else None
        asked = LogFilter(one_run, window, filter_text, lowest, cursor, view.robot.id)
        return _answer(view, asked, lines)


def _log_row(line: LogLine) -> list[object]:
    """A line as a row under `LOG_COLUMNS`."""
    message = line.message if line.source == "controller" else f"{line.source}: {line.message}"
    if line.logger is not None:
        message = f"[{line.logger}] {message}"
    text = cut_text(message, _LONGEST_MESSAGE)
    return [round(line.sim_time_s, 3), line.level, text, line.run_id]


def _answer(view: View, asked: LogFilter, limit: int) -> LogsAnswer:
    newest = newest_lines(view.connection, asked, limit)
    shown = _fitting(newest)
    matching = count_lines(view.connection, asked)
    older = matching > len(shown)
    return LogsAnswer(
        **view.header(),
        lines=Table(columns=list(LOG_COLUMNS), rows=[_log_row(line) for line in shown]),
        matching=matching,
        cursor=shown[0].id if older and shown else None,
        hint=_hint(asked, matching, len(shown)),
    )


def _fitting(lines: list[LogLine]) -> list[LogLine]:
    """The newest ones whose text fits the budget, at least one."""
    room = _BUDGET
    for number, line in enumerate(reversed(lines)):
        room -= min(len(line.message), _LONGEST_MESSAGE) + 30
        if room < 0 and number:
            return lines[-number:]
    return lines


def _hint(asked: LogFilter, matching: int, shown: int) -> str | None:
    if matching > shown:
        most = f"{COUNT_LIMIT} or more" if matching >= COUNT_LIMIT else str(matching)
        return f"the newest {shown} of {most}: ask again with cursor for older ones"
    return None if shown else _why_empty(asked)


def _why_empty(asked: LogFilter) -> str:
    if asked.before_id is not None:
        return "no older lines match"
    if asked.text or asked.lowest_level != "debug":
        return "no line matches: leave out filter_text, level or the time range to see others"
    return (
        "no lines in this run or time range: bridge.log('text', level='info') records one; what a "
        "controller only prints is not recorded"
    )
