"""Read log lines of a run or a robot, follow a recording as lines, and store console lines.

Lines of Webots' console become log rows here.
"""

from __future__ import annotations

import math
import re
import sqlite3
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Final, NamedTuple

from webots_mcp.contract import LOG_CHARACTERS, LOG_LEVELS, LogLevel, LogSource
from webots_mcp.store.reading.ranges import Scope, moment_of
from webots_mcp.store.run_rows import columns_of

COUNT_LIMIT: Final = 10_000  # beyond it, counting would cost more than the count is worth
OF_CONSOLE: Final[tuple[LogSource, ...]] = ("console", "webots")
# If a simulation has several robots, Webots does not show which one printed a line. Such lines
# belong to no robot: they are stored in the run of any of them and shown for all.
_COMPANIONS: Final = (
    "SELECT id FROM session WHERE robot_id <> :robot_id "
    "AND instance IN (SELECT instance FROM session WHERE robot_id = :robot_id)"
)
_CONSOLE_OF: Final = f"(source IN {OF_CONSOLE} AND +run_id IN ({{}}))"
_ASKED: Final = "'#' || t.id, t.action"
_SETTLED_S: Final = "t.finished_wall_time_s"
MOST_WAITING: Final = 500  # lines of one Webots; the newest are kept
_NAMED: Final = re.compile(r"\[(.+?)\] (.*)", re.DOTALL)
_CONSOLE_COLUMNS: Final = "wall_time_s, level, source, message, logger"
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
_BESIDE_ROBOT: Final = (
    "FROM log WHERE (+run_id IN (SELECT id FROM run WHERE robot_id = :robot_id) OR "
    + _CONSOLE_OF.format(f"SELECT id FROM run WHERE session_id IN ({_COMPANIONS})")
    + f") {_MATCHING}"
)


@dataclass(frozen=True)
class ConsoleLimits:
    """How many lines of Webots' console are compared and kept, and for how long.

    Attributes:
        followed_characters: Length at which a followed text is cut; the database has all of it.
        followed_lines: Lines of one kind that one poll returns.
        waiting_s: Wall time for which a line may wait for the robot that it belongs to.
        early_s: A run may begin that long before the console reports its controller.
        runs: Newest runs to which a line may belong.
        sessions: Newest sessions whose runs are considered.
        recorded_rows: Newest rows of bridges with which a line is compared.
        logged_texts: Texts logged by a bridge with which a line is compared.
        compared_s: A line that is that much later is not the one that a bridge recorded.
        message_characters: Maximum length of a message, as in a row of the bridge.
    """

    followed_characters: int = 400
    followed_lines: int = 500
    waiting_s: float = 7 * 86_400.0
    early_s: float = 1.0
    runs: int = 50
    sessions: int = 500
    recorded_rows: int = 2_000
    logged_texts: int = 500
    compared_s: float = 60.0
    message_characters: int = LOG_CHARACTERS


_CONSOLE: Final = ConsoleLimits()


@dataclass(frozen=True)
class LogLine:
    """A line that the controller or the bridge logged, or a line of Webots' console.

    Attributes:
        run_id: None for a line of the console that waits for a run; the same holds for its time.
    """

    id: int
    run_id: int | None
    sim_time_s: float | None
    wall_time_s: float
    level: str
    source: str
    message: str
    logger: str | None


def _news_of(source: str, cursor: str, columns: str, text: str) -> str:
    """Return the query for rows after a cursor, of one robot or all, with time and text of each."""
    return (
        f"SELECT {cursor}, {columns}, {text} FROM {source} WHERE {cursor} > :after "
        f"AND (:robot_id IS NULL OR r.id = :robot_id) ORDER BY {cursor} DESC LIMIT :limit"
    )


def _news_in(table: str, kind: str, text: str) -> str:
    source = f"{table} t JOIN run ON run.id = t.run_id JOIN robot r ON r.id = run.robot_id"
    return _news_of(source, "t.id", f"t.wall_time_s, r.name, t.run_id, t.sim_time_s, {kind}", text)


def _news_of_commands(cursor: str, wall: str, sim: str, text: str) -> str:
    source = "command t JOIN robot r ON r.id = t.robot_id"
    return _news_of(source, cursor, f"{wall}, r.name, NULL, {sim}, 'command'", text)


def _cut(text: str) -> str:
    return f"substr({text}, 1, {_CONSOLE.followed_characters})"


_SAID: Final = f"iif(t.source IN {OF_CONSOLE}, t.source || ': ', '') || {_cut('t.message')}"
# By kind of news: the cursor that it moves, and the rows after that cursor.
_NEWS: Final = {
    "state": _news_in("state", "'state'", _cut("t.data")),
    "log": _news_in("log", "t.level", _SAID),
    "event": _news_in("event", "'event'", f"concat_text(t.kind, t.name, {_cut('t.data')})"),
    "asked": _news_of_commands(
        "t.id", "t.created_wall_time_s", "NULL", f"concat_text({_ASKED}, {_cut('t.params')})"
    ),
    "settled": _news_of_commands(
        _SETTLED_S,
        _SETTLED_S,
        "t.finished_sim_time_s",
        f"concat_text({_ASKED}, t.status, {_cut('coalesce(t.error, t.result)')})",
    ),
}


class LogWindow(NamedTuple):
    """The part of a run whose log lines are wanted: from `start_s` up to but excluding `end_s`.

    The bounds are simulation seconds, compared like those of the ranges of `store.reading.ranges`.
    Unlike ranges, a window is not bounded by state rows: the last lines of a controller often come
    after its last state, and some controllers only log.
    """

    start_s: float
    end_s: float


@dataclass(frozen=True)
class LogFilter:
    """Which lines are wanted.

    Args:
        run_id: The run; None for all runs of the robot.
        window: Simulation time.
        text: Part of the message; ASCII letters match in either case.
        lowest_level: Only this level and those above it.
        before_id: Only lines with smaller ids, to page towards older lines.
        robot_id: The robot, if no run is given.
        source: Only lines of this source.
    """

    run_id: int | None
    window: LogWindow
    text: str = ""
    lowest_level: str = "debug"
    before_id: int | None = None
    robot_id: int | None = None
    source: LogSource | None = None


def window_of(scope: Scope, newest_s: float) -> LogWindow:
    """Return the window that a scope means in simulation time; the whole run if it has no bounds.

    Args:
        scope: The scope; its `last_s` counts back from the newest row, which is included.
        newest_s: Simulation time of the newest row of the run.
    """
    if scope.last_s is not None:
        return LogWindow(moment_of(newest_s - scope.last_s), math.inf)
    start_s = -math.inf if scope.start_s is None else moment_of(scope.start_s)
    return LogWindow(start_s, math.inf if scope.end_s is None else moment_of(scope.end_s))


def newest_lines(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """Return the newest matching lines, oldest first; a limit of -1 returns all of them."""
    order = "id" if asked.run_id is None else "sim_time_s DESC, id"
    query = (
        f"SELECT {columns_of(LogLine)} {_rows_of(connection, asked)} "
        f"ORDER BY {order} DESC LIMIT :limit"
    )
    rows = connection.execute(query, {**_values(asked), "limit": limit}).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def waiting_lines(connection: sqlite3.Connection, asked: LogFilter, limit: int) -> list[LogLine]:
    """Return the newest lines of Webots' console that wait for a run, oldest first."""
    rows = connection.execute(
        "SELECT id, NULL, NULL, wall_time_s, level, source, message, logger FROM console_line "
        f"WHERE {_SAYING} ORDER BY id DESC LIMIT :limit",
        {**_values(asked), "limit": limit},
    ).fetchall()
    return [LogLine(*row) for row in reversed(rows)]


def count_lines(connection: sqlite3.Connection, asked: LogFilter) -> int:
    """Return the number of matching lines; `COUNT_LIMIT` stands for that many or more."""
    query = f"SELECT count(*) FROM (SELECT 1 {_rows_of(connection, asked)} LIMIT {COUNT_LIMIT})"
    return int(connection.execute(query, _values(asked)).fetchone()[0])


def _rows_of(connection: sqlite3.Connection, asked: LogFilter) -> str:
    # The newest lines are at the end of the table, so the query does not go run by run.
    query = (
        f"SELECT o.id FROM run r JOIN run o ON o.session_id IN ({_COMPANIONS}) "
        "WHERE r.id = :run_id AND o.started_wall_time_s <= coalesce(r.ended_wall_time_s, 9e99) "
        "AND coalesce(o.ended_wall_time_s, 9e99) >= r.started_wall_time_s"
    )
    alone, with_others = (
        (
            (
                "FROM log WHERE +run_id IN (SELECT id FROM run "
                f"WHERE robot_id = :robot_id) {_MATCHING}"
            ),
            _BESIDE_ROBOT,
        )
        if asked.run_id is None
        else (
            f"FROM log WHERE run_id = :run_id {_MATCHING}",
            f"FROM log WHERE (run_id = :run_id OR {_CONSOLE_OF.format(query)}) {_MATCHING}",
        )
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


class FollowedLine(NamedTuple):
    """A recorded item. `kind` is state, event, command, or the level of a log line."""

    wall_time_s: float
    robot: str
    run_id: int | None
    sim_time_s: float | None
    kind: str
    text: str


class Follower:
    """Read what was recorded since the last call.

    Args:
        connection: A reader connection.
        robot_id: Only this robot; None for all.
    """

    def __init__(self, connection: sqlite3.Connection, robot_id: int | None = None) -> None:
        connection.create_function("concat_text", -1, _joined)
        self._connection = connection
        self._robot_id = robot_id
        self._cursors = dict.fromkeys(_NEWS, 0.0)

    def read_new(self, limit: int = _CONSOLE.followed_lines) -> list[FollowedLine]:
        """Return the newest lines recorded since the last call, at most `limit`, oldest first."""
        lines = [line for news in _NEWS for line in self._read(news, limit)]
        return sorted(lines, key=lambda line: line.wall_time_s)[-limit:] if limit else []

    def _read(self, news: str, limit: int) -> list[FollowedLine]:
        values = {"after": self._cursors[news], "robot_id": self._robot_id, "limit": max(limit, 1)}
        rows: list[Any] = self._connection.execute(_NEWS[news], values).fetchall()
        if rows:
            self._cursors[news] = rows[0][0]
        return [FollowedLine(*row[1:]) for row in rows]


def _joined(*parts: object) -> str:
    return " ".join(str(part) for part in parts if part is not None)


# Lines of Webots' console as log rows: the run that each belongs to, and which are stored already.
# A line belongs to the newest run of that Webots that had begun when the line came. Lines between
# the start of Webots, or of a controller that records, and the next run wait in a table of their
# own. They are mostly what a controller printed before it recorded, or the reason why it never did.


class Said(NamedTuple):
    """A line of the console.

    Attributes:
        wall_time_s: When the line came.
        stream: `stdout` or `stderr`; None for a line about the lines.
        is_old: Whether it was printed at an unknown time before it came.
    """

    wall_time_s: float
    level: LogLevel
    source: LogSource
    message: str
    stream: str | None
    is_old: bool = False


class _Run(NamedTuple):
    id: int
    robot: str
    controller: str | None
    started_wall_time_s: float
    started_sim_time_s: float
    last_wall_time_s: float


class ConsoleRows:
    """Write what one Webots prints; only one process at a time does this, for all of them.

    Args:
        instance: The Webots, as its sessions name it.
        started_wall_time_s: When it started; runs that began before belong to another Webots.
    """

    def __init__(self, instance: str, started_wall_time_s: float) -> None:
        self.waits = True  # lines may wait for a run
        self._instance = instance
        self._started_s = started_wall_time_s
        # Runs since then may be those that the next lines belong to.
        self._runs_since_s = started_wall_time_s - _CONSOLE.early_s
        self._recorded = _Recorded(instance, started_wall_time_s)
        self._left_out = 0

    def begin(self, connection: sqlite3.Connection) -> None:
        """Drop lines that wait for runs that will not come."""
        past = (
            self._instance,
            self._started_s - _CONSOLE.early_s,
            time.time() - _CONSOLE.waiting_s,
        )
        connection.execute(
            "DELETE FROM console_line WHERE (instance = ? AND wall_time_s < ?) OR wall_time_s < ?",
            past,
        )

    def is_recorded(self, connection: sqlite3.Connection) -> bool:
        """Return whether lines of this Webots wait for a run; if so, a process follows it."""
        query = "SELECT EXISTS (SELECT 1 FROM console_line WHERE instance = ? AND wall_time_s >= ?)"
        return bool(connection.execute(query, (self._instance, self._started_s)).fetchone()[0])

    def write(self, connection: sqlite3.Connection, lines: Sequence[Said]) -> None:
        """Write lines that no bridge has recorded, and lines that have waited until now.

        Args:
            connection: A connection in a transaction.
            lines: The lines in order.
        """
        runs = self._runs(connection)
        self._recorded.catch_up(connection)
        if self.waits:
            self._write_waiting(connection, runs)
        for line in lines:
            self._notice_start(line, runs)
            if not self._recorded.take(line):
                self._write(connection, line, runs)

    def may_go_on(self, connection: sqlite3.Connection) -> bool:
        """Return whether lines wait and a run for them has begun."""
        return self.waits and bool(self._fitting(self._runs(connection)))

    def _runs(self, connection: sqlite3.Connection) -> list[_Run]:
        """Return the newest runs of this Webots, newest first."""
        since_s = self._started_s - _CONSOLE.early_s
        query = (
            "SELECT id, robot_id, controller FROM session WHERE instance = ? "
            f"AND id > coalesce((SELECT max(id) FROM session), 0) - {_CONSOLE.sessions}"
        )
        found = connection.execute(
            "SELECT r.id, b.name, s.controller, r.started_wall_time_s, r.started_sim_time_s, "
            f"r.last_wall_time_s FROM ({query}) s JOIN run r ON r.session_id = s.id JOIN "
            "robot b ON b.id = s.robot_id WHERE r.started_wall_time_s >= ? ORDER BY r.id DESC "
            f"LIMIT {_CONSOLE.runs}",
            (self._instance, since_s),
        ).fetchall()
        return [_Run(*row) for row in found]

    def _fitting(self, runs: list[_Run]) -> list[_Run]:
        """Return runs that began since, and running ones whose start was reported late."""
        since_s = self._runs_since_s
        return [
            run
            for run in runs
            if run.started_wall_time_s >= since_s
            or run.last_wall_time_s > since_s + _CONSOLE.early_s
        ]

    def _notice_start(self, line: Said, runs: list[_Run]) -> None:
        """Notice that a recording controller starts.

        The following lines belong to the run that it begins.
        """
        found = (
            None if line.is_old else re.match(r"INFO: (.+?): Starting controller: ", line.message)
        )
        if found and any(_is_called(run, found[1]) for run in runs):
            self._runs_since_s = line.wall_time_s - _CONSOLE.early_s

    def _write(self, connection: sqlite3.Connection, line: Said, runs: list[_Run]) -> None:
        fitting = runs if line.is_old else self._fitting(runs)
        line, fitting = _of_named(line, fitting)
        values = (
            line.wall_time_s,
            line.level,
            line.source,
            line.message[: _CONSOLE.message_characters],
            line.stream,
        )
        if not fitting:
            self._keep_waiting(connection, values)
            return
        begun = (run for run in fitting if run.started_wall_time_s <= line.wall_time_s)
        run = next(begun, fitting[-1])
        row = (run.id, _sim_time_s(connection, run, line.wall_time_s), *values)
        connection.execute(
            f"INSERT INTO log (run_id, sim_time_s, {_CONSOLE_COLUMNS}) "
            "VALUES (?, ?, ?, ?, ?, ?, ?)",
            row,
        )

    def _keep_waiting(self, connection: sqlite3.Connection, values: tuple[object, ...]) -> None:
        connection.execute(
            f"INSERT INTO console_line (instance, {_CONSOLE_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?)",
            (self._instance, *values),
        )
        query = (
            "DELETE FROM console_line WHERE instance = :instance AND id <= (SELECT id "
            "FROM console_line WHERE instance = :instance ORDER BY id DESC "
            f"LIMIT 1 OFFSET {MOST_WAITING})"
        )
        left_out = connection.execute(query, {"instance": self._instance}).rowcount
        self._left_out += left_out
        self.waits = True

    def _write_waiting(self, connection: sqlite3.Connection, runs: list[_Run]) -> None:
        rows = connection.execute(
            f"SELECT id, {_CONSOLE_COLUMNS} FROM console_line WHERE instance = ? ORDER BY id",
            (self._instance,),
        ).fetchall()
        self.waits = bool(rows)
        if not (rows and self._fitting(runs)):
            return
        self.waits = False
        for line_id, *values in rows:
            connection.execute("DELETE FROM console_line WHERE id = ?", (line_id,))
            line = Said(*values)
            if not self._recorded.take(line):
                self._write(connection, line, runs)
        if self._left_out:
            text = f"({self._left_out} lines before the first run are not recorded)"
            self._left_out = 0
            self._write(connection, Said(time.time(), "warning", "console", text, None), runs)


class _Recorded:
    """What bridges recorded of printed lines, each until the console shows it."""

    def __init__(self, instance: str, since_s: float) -> None:
        self._instance = instance
        self._since_s = since_s
        self._last_id = 0
        self._robots: dict[str, str] = {}  # by the name of the robot and of its controller
        self._texts: dict[str, _OfRobot] = {}

    def catch_up(self, connection: sqlite3.Connection) -> None:
        """Read what has been recorded since the last call."""
        asked = (self._last_id, self._since_s, self._instance)
        rows = connection.execute(
            "SELECT l.id, l.message, l.logger, b.name, s.controller FROM log l "
            "JOIN run r ON r.id = l.run_id JOIN session s ON s.id = r.session_id "
            "JOIN robot b ON b.id = r.robot_id WHERE l.id > ? AND l.wall_time_s >= ? "
            f"AND s.instance = ? AND l.source IN ('controller', 'bridge') "
            f"ORDER BY l.id DESC LIMIT {_CONSOLE.recorded_rows}",
            asked,
        ).fetchall()
        for log_id, message, logger, robot, controller in reversed(rows):
            self._last_id = log_id
            names = (robot, controller and PurePath(controller).stem)
            self._robots |= {name: robot for name in names if name}
            texts = self._texts.setdefault(robot, _OfRobot())
            first, *others = str(message).split("\n")
            # These names are not those of loggers.
            (texts.lines if logger in ("stdout", "stderr") else texts.logged).add(first.strip())
            for other in others:
                texts.lines.add(other.strip())

    def take(self, line: Said) -> bool:
        """Return whether a bridge recorded this line, and count it as shown.

        A line that begins with the name of a recording robot or controller is searched without it,
        among what that robot's bridge recorded.
        """
        if line.stream is None:
            return False
        named = _NAMED.fullmatch(line.message) if line.source == "console" else None
        robot = named and self._robots.get(named[1])
        if (
            named
            and robot
            and self._texts[robot].take(named[2][: _CONSOLE.message_characters].strip())
        ):
            return True
        text = line.message[: _CONSOLE.message_characters].strip()
        return any(texts.take(text) for texts in self._texts.values())


class _OfRobot:
    """What the bridge of one robot recorded of what its controller printed and logged."""

    def __init__(self) -> None:
        self.lines = _Texts(_CONSOLE.recorded_rows)
        self.logged = _Texts(_CONSOLE.logged_texts)

    def take(self, text: str) -> bool:
        """Return whether the bridge recorded this text, and count it as shown."""
        return self.lines.take(text) or self.logged.take(text) or self._take_handled(text)

    def _take_handled(self, text: str) -> bool:
        """Search a text as a handler of `logging` prints it: after time, level or name."""
        said = next((each for each in self.logged if _ends_with(text, each)), None)
        return said is not None and self.logged.take(said)


class _Texts:
    """The newest texts of the last minute; each can be taken once."""

    def __init__(self, most: int) -> None:
        self._added: deque[tuple[float, str]] = deque(maxlen=most)

    def __iter__(self) -> Iterator[str]:
        since_s = time.monotonic() - _CONSOLE.compared_s
        while self._added and self._added[0][0] < since_s:
            self._added.popleft()
        return iter(list(dict.fromkeys(text for _, text in self._added)))

    def add(self, text: str) -> None:
        self._added.append((time.monotonic(), text))

    def take(self, text: str) -> bool:
        if text not in iter(self):
            return False
        del self._added[[each for _, each in self._added].index(text)]
        return True


def _ends_with(text: str, said: str) -> bool:
    """Return whether a line is a logged text with a prefix of a handler: time, level or name."""
    if not said or not text.endswith(said):
        return False
    before = text[: -len(said)]
    return not before or not before[-1].isalnum()


def _of_named(line: Said, runs: list[_Run]) -> tuple[Said, list[_Run]]:
    """Return the runs of the controller or robot whose name begins the line."""
    found = _NAMED.fullmatch(line.message) if line.source == "console" else None
    named = [run for run in runs if found and _is_called(run, found[1])]
    if not (found and named):
        return line, runs
    return line._replace(source="controller", message=found[2]), named


def _is_called(run: _Run, name: str) -> bool:
    """Return whether a name that Webots printed is that of the run's robot or controller."""
    return name in (run.robot, run.controller and PurePath(run.controller).stem)


def _sim_time_s(connection: sqlite3.Connection, run: _Run, wall_time_s: float) -> float:
    """Return the simulation time of a run at a wall time, as far as its rows show it."""
    if wall_time_s <= run.started_wall_time_s:
        return run.started_sim_time_s
    query = (
        "SELECT coalesce((SELECT sim_time_s FROM state WHERE run_id = :run "
        "AND wall_time_s <= :wall ORDER BY sim_time_s DESC, id DESC "
        "LIMIT 1), iif(last_wall_time_s <= :wall, last_sim_time_s, started_sim_time_s)) FROM run "
        "WHERE id = :run"
    )
    found = connection.execute(query, {"run": run.id, "wall": wall_time_s}).fetchone()
    return float(found[0])
