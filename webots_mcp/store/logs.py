"""Log lines of a run, or of all runs of a robot; and all that is recorded, as lines to follow."""

from __future__ import annotations

import math
import sqlite3
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from webots_mcp.contract import LOG_LEVELS, LogSource
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.reading.segment import moment_of
from webots_mcp.store.run_rows import columns_of

COUNT_LIMIT: Final = 10_000  # beyond it a count would cost more than it is worth
OF_CONSOLE: Final[tuple[LogSource, ...]] = ("console", "webots")


@dataclass(frozen=True)
class LogLine:
    """A line that the controller or the bridge logged, or of Webots' console.

    Attributes:
        run_id: None for a line of the console that waits for a run, as is its time.
    """

    id: int
    run_id: int | None
    sim_time_s: float | None
    wall_time_s: float
    level: str
    source: str
    message: str
    logger: str | None


_COLUMNS: Final = columns_of(LogLine)
_RANKS: Final = " ".join(f"WHEN '{level}' THEN {rank}" for rank, level in enumerate(LOG_LEVELS))
_SAYING: Final = (
    "(:text = '' OR instr(lower(message), :text) > 0) "
    "AND (:source IS NULL OR source = :source) "
    f"AND CASE level {_RANKS} ELSE {LOG_LEVELS.index('error')} END >= :lowest"
)
_MATCHING: Final = (
    "AND sim_time_s >= :start_s AND sim_time_s < :end_s "
    f"AND (:before_id IS NULL OR id < :before_id) AND {_SAYING}"
)
_OF_RUN: Final = f"FROM log WHERE run_id = :run_id {_MATCHING}"
# The newest lines are wanted: from the end of the table, not run by run.
_OF_ROBOT: Final = (
    f"FROM log WHERE +run_id IN (SELECT id FROM run WHERE robot_id = :robot_id) {_MATCHING}"
)
# Of several robots in a simulation Webots does not show which one printed a line. Its lines
# belong to none of them: they stand in the run of any of them, and are shown for all.
_COMPANIONS: Final = (
    "SELECT id FROM session WHERE robot_id <> :robot_id "
    "AND instance IN (SELECT instance FROM session WHERE robot_id = :robot_id)"
)
_RUNS_BESIDE: Final = (
    f"SELECT o.id FROM run r JOIN run o ON o.session_id IN ({_COMPANIONS}) WHERE r.id = :run_id "
    "AND o.started_wall_time_s <= coalesce(r.ended_wall_time_s, 9e99) "
    "AND coalesce(o.ended_wall_time_s, 9e99) >= r.started_wall_time_s"
)
_CONSOLE_OF: Final = f"(source IN {OF_CONSOLE} AND +run_id IN ({{}}))"
_BESIDE_RUN: Final = (
    f"FROM log WHERE (run_id = :run_id OR {_CONSOLE_OF.format(_RUNS_BESIDE)}) {_MATCHING}"
)
_BESIDE_ROBOT: Final = (
    "FROM log WHERE (+run_id IN (SELECT id FROM run WHERE robot_id = :robot_id) OR "
    + _CONSOLE_OF.format(f"SELECT id FROM run WHERE session_id IN ({_COMPANIONS})")
    + f") {_MATCHING}"
)
_WAITING: Final = (
    "SELECT id, NULL, NULL, wall_time_s, level, source, message, logger FROM console_line "
    f"WHERE {_SAYING} ORDER BY id DESC LIMIT :limit"
)
_LONGEST_FOLLOWED_TEXT: Final = 400  # of a state, log line or result; the database has it whole
_MOST_FOLLOWED_LINES: Final = 500  # of one kind in one look

_NEWS_OF_ROBOT: Final = (
    "AND (:robot_id IS NULL OR r.id = :robot_id) ORDER BY {order} DESC LIMIT :limit"
)
_NEWS_ROW: Final = (
    "SELECT t.id, t.wall_time_s, r.name, t.run_id, t.sim_time_s, {kind}, {text} FROM {table} t "
    "JOIN run ON run.id = t.run_id JOIN robot r ON r.id = run.robot_id WHERE t.id > :after "
)
_NEWS_COMMAND: Final = (
    "SELECT {cursor}, {wall}, r.name, NULL, {sim}, 'command', {text} FROM command t "
    "JOIN robot r ON r.id = t.robot_id WHERE {cursor} > :after "
)
# Kind of news: which cursor it moves, and the rows after that cursor.
_NEWS: Final[dict[str, str]] = {
    "state": _NEWS_ROW.format(
        table="state", kind="'state'", text=f"substr(t.data, 1, {_LONGEST_FOLLOWED_TEXT})"
    )
    + _NEWS_OF_ROBOT.format(order="t.id"),
    "log": _NEWS_ROW.format(
        table="log",
        kind="t.level",
        text=(
            "iif(t.source IN ('console', 'webots'), t.source || ': ', '') || "
            f"substr(t.message, 1, {_LONGEST_FOLLOWED_TEXT})"
        ),
    )
    + _NEWS_OF_ROBOT.format(order="t.id"),
    "event": _NEWS_ROW.format(
        table="event",
        kind="'event'",
        text=f"concat_text(t.kind, t.name, substr(t.data, 1, {_LONGEST_FOLLOWED_TEXT}))",
    )
    + _NEWS_OF_ROBOT.format(order="t.id"),
    "asked": _NEWS_COMMAND.format(
        cursor="t.id",
        wall="t.created_wall_time_s",
        sim="NULL",
        text=f"concat_text('#' || t.id, t.action, substr(t.params, 1, {_LONGEST_FOLLOWED_TEXT}))",
    )
    + _NEWS_OF_ROBOT.format(order="t.id"),
    "settled": _NEWS_COMMAND.format(
        cursor="t.finished_wall_time_s",
        wall="t.finished_wall_time_s",
        sim="t.finished_sim_time_s",
        text=(
            "concat_text('#' || t.id, t.action, t.status, "
            f"substr(coalesce(t.error, t.result), 1, {_LONGEST_FOLLOWED_TEXT}))"
        ),
    )
    + _NEWS_OF_ROBOT.format(order="t.finished_wall_time_s"),
}


class Window(NamedTuple):
    """The part of a run whose log lines are asked for: from `start_s`, up to and without `end_s`.

    Its bounds are simulation seconds, compared as those of the ranges of `store.reading.ranges`.
    Unlike them it is not bounded by the state rows: the last lines of a controller often come after
    its last state, and some controllers only log.
    """

    start_s: float
    end_s: float


@dataclass(frozen=True)
class LogFilter:
    """Which lines are asked for.

    Args:
        run_id: The run; None for all runs of the robot.
        window: Simulation time.
        text: Part of the message; ASCII letters match in either case.
        lowest_level: This level and those above it.
        before_id: Only lines with smaller ids, to page towards older ones.
        robot_id: The robot, where no run is given.
        source: Only lines of this one.
    """

    run_id: int | None
    window: Window
    text: str = ""
    lowest_level: str = "debug"
    before_id: int | None = None
    robot_id: int | None = None
    source: LogSource | None = None


def window_of(scope: Scope, newest_s: float) -> Window:
    """The window that was asked for in simulation time; without any bound the whole run.

    Args:
        scope: Its `last_s` counts back from the newest row, which is included.
        newest_s: Simulation time of the newest row of the run.
    """
    if scope.last_s is not None:
        return Window(moment_of(newest_s - scope.last_s), math.inf)
    start_s = -math.inf if scope.start_s is None else moment_of(scope.start_s)
    return Window(start_s, math.inf if scope.end_s is None else moment_of(scope.end_s))


def newest_lines(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """The newest lines that match, oldest first; with a limit of -1 all of them."""
    order = "id" if asked.run_id is None else "sim_time_s DESC, id"
    query = f"SELECT {_COLUMNS} {_rows_of(connection, asked)} ORDER BY {order} DESC LIMIT :limit"
    rows = connection.execute(query, {**_values(asked), "limit": limit}).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def waiting_lines(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """The newest lines of Webots' console that wait for a run, oldest first; of no run or time."""
    rows = connection.execute(_WAITING, {**_values(asked), "limit": limit}).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def count_lines(connection: sqlite3.Connection, asked: LogFilter) -> int:
    """How many lines match; `COUNT_LIMIT` stands for that many or more."""
    query = f"SELECT count(*) FROM (SELECT 1 {_rows_of(connection, asked)} LIMIT {COUNT_LIMIT})"
    return int(connection.execute(query, _values(asked)).fetchone()[0])


def _rows_of(connection: sqlite3.Connection, asked: LogFilter) -> str:
    alone, with_others = (
        (_OF_ROBOT, _BESIDE_ROBOT) if asked.run_id is None else (_OF_RUN, _BESIDE_RUN)
    )
    if asked.robot_id is None:
        return alone
    found = connection.execute(f"SELECT EXISTS ({_COMPANIONS})", {"robot_id": asked.robot_id})
    return with_others if found.fetchone()[0] else alone


def _values(asked: LogFilter) -> dict[str, object]:
    return {
        "run_id": asked.run_id,
        "robot_id": asked.robot_id,
        "start_s": asked.window.start_s,
        "end_s": asked.window.end_s,
        "text": asked.text.lower(),
        "lowest": LOG_LEVELS.index(asked.lowest_level),
        "before_id": asked.before_id,
        "source": asked.source,
    }


class Line(NamedTuple):
    """Something recorded. `kind` is state, event, command, or a log line's level."""

    wall_time_s: float
    robot: str
    run_id: int | None
    sim_time_s: float | None
    kind: str
    text: str


class Follower:
    """Reads what was recorded since it last looked.

    Args:
        connection: A reader connection.
        robot_id: Only this robot; None for all.
    """

    def __init__(self, connection: sqlite3.Connection, robot_id: int | None = None) -> None:
        connection.create_function("concat_text", -1, _joined)
        self._connection = connection
        self._robot_id = robot_id
        self._cursors = dict.fromkeys(_NEWS, 0.0)

    def look(self, limit: int = _MOST_FOLLOWED_LINES) -> list[Line]:
        """The newest lines recorded since the last look, at most `limit`, oldest first."""
        lines = [line for news in _NEWS for line in self._read(news, limit)]
        return sorted(lines, key=lambda line: line.wall_time_s)[-limit:] if limit else []

    def _read(self, news: str, limit: int) -> list[Line]:
        values = {"after": self._cursors[news], "robot_id": self._robot_id, "limit": max(limit, 1)}
        rows: list[Any] = self._connection.execute(_NEWS[news], values).fetchall()
        if rows:
            self._cursors[news] = rows[0][0]
        return [Line(*row[1:]) for row in rows]


def _joined(*parts: object) -> str:
    return " ".join(str(part) for part in parts if part is not None)
