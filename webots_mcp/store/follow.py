"""What is being recorded, as lines in order of wall time: for a terminal that follows along."""

from __future__ import annotations

import sqlite3
from typing import Any, Final, NamedTuple

_LONGEST_TEXT: Final = 400  # of a state, log line or result; the database has it whole
_MOST_LINES: Final = 500  # of one kind in one look

_OF_ROBOT: Final = "AND (:robot_id IS NULL OR r.id = :robot_id) ORDER BY {order} DESC LIMIT :limit"
_ROW: Final = (
    "SELECT t.id, t.wall_time_s, r.name, t.run_id, t.sim_time_s, {kind}, {text} FROM {table} t "
    "JOIN run ON run.id = t.run_id JOIN robot r ON r.id = run.robot_id WHERE t.id > :after "
)
_COMMAND: Final = (
    "SELECT {cursor}, {wall}, r.name, NULL, {sim}, 'command', {text} FROM command t "
    "JOIN robot r ON r.id = t.robot_id WHERE {cursor} > :after "
)
# Kind of news: which cursor it moves, and the rows after that cursor.
_NEWS: Final[dict[str, str]] = {
    "state": _ROW.format(table="state", kind="'state'", text=f"substr(t.data, 1, {_LONGEST_TEXT})")
    + _OF_ROBOT.format(order="t.id"),
    "log": _ROW.format(
        table="log",
        kind="t.level",
        text=(
            "iif(t.source IN ('console', 'webots'), t.source || ': ', '') || "
            f"substr(t.message, 1, {_LONGEST_TEXT})"
        ),
    )
    + _OF_ROBOT.format(order="t.id"),
    "event": _ROW.format(
        table="event",
        kind="'event'",
        text=f"concat_text(t.kind, t.name, substr(t.data, 1, {_LONGEST_TEXT}))",
    )
    + _OF_ROBOT.format(order="t.id"),
    "asked": _COMMAND.format(
        cursor="t.id",
        wall="t.created_wall_time_s",
        sim="NULL",
        text=f"concat_text('#' || t.id, t.action, substr(t.params, 1, {_LONGEST_TEXT}))",
    )
    + _OF_ROBOT.format(order="t.id"),
    "settled": _COMMAND.format(
        cursor="t.finished_wall_time_s",
        wall="t.finished_wall_time_s",
        sim="t.finished_sim_time_s",
        text=(
            "concat_text('#' || t.id, t.action, t.status, "
            f"substr(coalesce(t.error, t.result), 1, {_LONGEST_TEXT}))"
        ),
    )
    + _OF_ROBOT.format(order="t.finished_wall_time_s"),
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

    def look(self, limit: int = _MOST_LINES) -> list[Line]:
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
