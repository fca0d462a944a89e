"""Lines of Webots' console as log rows: to whose run each belongs, and which are there already.

A line belongs to the newest run of that Webots that had begun when the line came. What comes after
Webots has started, or has started a controller that records, and before the next run begins, waits
in a table of its own: it is most often what a controller printed before it recorded, or why it
never did.
"""

from __future__ import annotations

import re
import sqlite3
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import Final, NamedTuple

from webots_mcp.contract import LogLevel, LogSource

MOST_WAITING: Final = 500  # of one Webots; the newest are kept
_KEPT_WAITING_S: Final = 7 * 86_400.0
_EARLY_S: Final = 1.0  # a run may begin before the line that its controller starts
_MOST_RUNS: Final = 50
_MOST_SESSIONS: Final = 500
_MOST_RECORDED: Final = 2_000  # newest rows of bridges that a line is compared with
_MOST_LOGGED: Final = 500
_COMPARED_S: Final = 60.0  # a line that is as late is not taken for what a bridge recorded
_MESSAGE: Final = 10_000  # characters, as of a bridge's row
_PRINTED: Final = ("stdout", "stderr")  # loggers that are none
_STARTING: Final = re.compile(r"INFO: (.+?): Starting controller: ")
_NAMED: Final = re.compile(r"\[(.+?)\] (.*)", re.DOTALL)

_SESSIONS: Final = (
    "SELECT id, robot_id, controller FROM session WHERE instance = ? "
    f"AND id > coalesce((SELECT max(id) FROM session), 0) - {_MOST_SESSIONS}"
)
_RUNS: Final = (
    "SELECT r.id, b.name, s.controller, r.started_wall_time_s, r.started_sim_time_s, "
    "r.last_wall_time_s "
    f"FROM ({_SESSIONS}) s JOIN run r ON r.session_id = s.id JOIN robot b ON b.id = s.robot_id "
    f"WHERE r.started_wall_time_s >= ? ORDER BY r.id DESC LIMIT {_MOST_RUNS}"
)
_SIM_TIME: Final = (
    "SELECT coalesce((SELECT sim_time_s FROM state WHERE run_id = :run AND wall_time_s <= :wall "
    "ORDER BY sim_time_s DESC, id DESC LIMIT 1), "
    "iif(last_wall_time_s <= :wall, last_sim_time_s, started_sim_time_s)) FROM run WHERE id = :run"
)
_RECORDED: Final = (
    "SELECT l.id, l.message, l.logger FROM log l JOIN run r ON r.id = l.run_id "
    "JOIN session s ON s.id = r.session_id WHERE l.id > ? AND l.wall_time_s >= ? "
    f"AND s.instance = ? AND l.source IN ('controller', 'bridge') "
    f"ORDER BY l.id DESC LIMIT {_MOST_RECORDED}"
)
_COLUMNS: Final = "wall_time_s, level, source, message, logger"
_ADD: Final = f"INSERT INTO log (run_id, sim_time_s, {_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?)"
_WAIT: Final = f"INSERT INTO console_line (instance, {_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?)"
_WAITING: Final = f"SELECT id, {_COLUMNS} FROM console_line WHERE instance = ? ORDER BY id"
_IS_FOLLOWED: Final = (
    "SELECT EXISTS (SELECT 1 FROM console_line WHERE instance = ? AND wall_time_s >= ?)"
)
_FORGET: Final = "DELETE FROM console_line WHERE id = ?"
_FORGET_OLDEST: Final = (
    "DELETE FROM console_line WHERE instance = :instance AND id <= (SELECT id FROM console_line "
    f"WHERE instance = :instance ORDER BY id DESC LIMIT 1 OFFSET {MOST_WAITING})"
)
_FORGET_PAST: Final = (
    "DELETE FROM console_line WHERE (instance = ? AND wall_time_s < ?) OR wall_time_s < ?"
)


class Said(NamedTuple):
    """A line of the console.

    Attributes:
        wall_time_s: When it came.
        stream: `stdout` or `stderr`; None for a line about the lines.
        is_old: It was said at an unknown time before it came.
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
    """Writes what one Webots says; a process at a time does, for all of them.

    Args:
        instance: As its sessions name it.
        started_wall_time_s: When it started: runs that began before are of another.
    """

    def __init__(self, instance: str, started_wall_time_s: float) -> None:
        self.waits = True  # lines may wait for a run
        self._instance = instance
        self._started_s = started_wall_time_s
        self._runs_since_s = started_wall_time_s - _EARLY_S  # of which what comes now may be
        self._recorded = _Recorded(instance, started_wall_time_s)
        self._left_out = 0

    def begin(self, connection: sqlite3.Connection) -> None:
        """Forget what waits for runs that will not come."""
        past = (self._instance, self._started_s - _EARLY_S, time.time() - _KEPT_WAITING_S)
        connection.execute(_FORGET_PAST, past)

    def is_recorded(self, connection: sqlite3.Connection) -> bool:
        """Whether lines of this Webots wait for a run: then a process follows its console."""
        return bool(
            connection.execute(_IS_FOLLOWED, (self._instance, self._started_s)).fetchone()[0]
        )

    def write(self, connection: sqlite3.Connection, lines: Sequence[Said]) -> None:
        """Write lines that no bridge has recorded, and those that have waited until now.

        Args:
            connection: In a transaction.
            lines: In their order.
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
        """Whether lines wait and a run has begun for them."""
        return self.waits and bool(self._fitting(self._runs(connection)))

    def _runs(self, connection: sqlite3.Connection) -> list[_Run]:
        """The newest runs of this Webots, the newest of them first."""
        since_s = self._started_s - _EARLY_S
        found = connection.execute(_RUNS, (self._instance, since_s)).fetchall()
        return [_Run(*row) for row in found]

    def _fitting(self, runs: list[_Run]) -> list[_Run]:
        """Runs that began since, and those still running, whose start was reported late."""
        since_s = self._runs_since_s
        return [
            run
            for run in runs
            if run.started_wall_time_s >= since_s or run.last_wall_time_s > since_s + _EARLY_S
        ]

    def _notice_start(self, line: Said, runs: list[_Run]) -> None:
        """A controller that records is started: what follows is of the run that it begins."""
        found = None if line.is_old else _STARTING.match(line.message)
        if found and any(_is_called(run, found[1]) for run in runs):
            self._runs_since_s = line.wall_time_s - _EARLY_S

    def _write(self, connection: sqlite3.Connection, line: Said, runs: list[_Run]) -> None:
        fitting = runs if line.is_old else self._fitting(runs)
        line, fitting = _of_named(line, fitting)
        values = (line.wall_time_s, line.level, line.source, line.message[:_MESSAGE], line.stream)
        if not fitting:
            self._keep_waiting(connection, values)
            return
        begun = (run for run in fitting if run.started_wall_time_s <= line.wall_time_s)
        run = next(begun, fitting[-1])
        row = (run.id, _sim_time_s(connection, run, line.wall_time_s), *values)
        connection.execute(_ADD, row)

    def _keep_waiting(self, connection: sqlite3.Connection, values: tuple[object, ...]) -> None:
        connection.execute(_WAIT, (self._instance, *values))
        left_out = connection.execute(_FORGET_OLDEST, {"instance": self._instance}).rowcount
        self._left_out += left_out
        self.waits = True

    def _write_waiting(self, connection: sqlite3.Connection, runs: list[_Run]) -> None:
        rows = connection.execute(_WAITING, (self._instance,)).fetchall()
        self.waits = bool(rows)
        if not (rows and self._fitting(runs)):
            return
        self.waits = False
        for line_id, *values in rows:
            connection.execute(_FORGET, (line_id,))
            line = Said(*values)
            if not self._recorded.take(line):
                self._write(connection, line, runs)
        if self._left_out:
            text = f"({self._left_out} lines before the first run are not recorded)"
            self._left_out = 0
            self._write(connection, Said(time.time(), "warning", "console", text, None), runs)


class _Recorded:
    """What bridges recorded of what is printed, each line until it is met in the console."""

    def __init__(self, instance: str, since_s: float) -> None:
        self._instance = instance
        self._since_s = since_s
        self._last_id = 0
        self._lines = _Texts(_MOST_RECORDED)
        self._logged = _Texts(_MOST_LOGGED)

    def catch_up(self, connection: sqlite3.Connection) -> None:
        """Look at what has been recorded since the last time."""
        asked = (self._last_id, self._since_s, self._instance)
        for log_id, message, logger in reversed(connection.execute(_RECORDED, asked).fetchall()):
            self._last_id = log_id
            first, *others = str(message).split("\n")
            (self._lines if logger in _PRINTED else self._logged).add(first.strip())
            for other in others:
                self._lines.add(other.strip())

    def take(self, line: Said) -> bool:
        """Whether a bridge recorded this line; it is then met no more."""
        text = line.message[:_MESSAGE].strip()
        if line.stream is None:
            return False
        return self._lines.take(text) or self._logged.take(text) or self._take_handled(text)

    def _take_handled(self, text: str) -> bool:
        """As a handler of Python's `logging` prints it: time, level or name before the message."""
        said = next((each for each in self._logged if _ends_with(text, each)), None)
        return said is not None and self._logged.take(said)


class _Texts:
    """The newest texts of the last minute, from which they can be taken."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._added: deque[tuple[float, str]] = deque()
        self._left: Counter[str] = Counter()
        self._taken: Counter[str] = Counter()

    def __iter__(self) -> Iterator[str]:
        self._forget()
        return iter(list(self._left))

    def add(self, text: str) -> None:
        self._added.append((time.monotonic(), text))
        self._left[text] += 1
        self._forget()

    def take(self, text: str) -> bool:
        self._forget()
        if text not in self._left:
            return False
        self._taken[text] += 1
        _take_one(self._left, text)
        return True

    def _forget(self) -> None:
        since_s = time.monotonic() - _COMPARED_S
        while self._added and (len(self._added) > self._most or self._added[0][0] < since_s):
            _, text = self._added.popleft()
            _take_one(self._taken if text in self._taken else self._left, text)


def _take_one(counter: Counter[str], text: str) -> None:
    counter[text] -= 1
    if not counter[text]:
        del counter[text]


def _ends_with(text: str, said: str) -> bool:
    """Whether a handler printed what was logged, with something before it: time, level, name."""
    if not said or not text.endswith(said):
        return False
    before = text[: -len(said)]
    return not before or not before[-1].isalnum()


def _of_named(line: Said, runs: list[_Run]) -> tuple[Said, list[_Run]]:
    """Where a line begins with the name of a controller or robot, it is of that one's runs."""
    found = _NAMED.fullmatch(line.message) if line.source == "console" else None
    named = [run for run in runs if found and _is_called(run, found[1])]
    if not (found and named):
        return line, runs
    return line._replace(source="controller", message=found[2]), named


def _is_called(run: _Run, name: str) -> bool:
    """Whether that is the run's robot or its controller, which Webots names in the line."""
    return name in (run.robot, run.controller and PurePath(run.controller).stem)


def _sim_time_s(connection: sqlite3.Connection, run: _Run, wall_time_s: float) -> float:
    """Simulation time of a run at that wall time, as far as rows tell it."""
    if wall_time_s <= run.started_wall_time_s:
        return run.started_sim_time_s
    found = connection.execute(_SIM_TIME, {"run": run.id, "wall": wall_time_s}).fetchone()
    return float(found[0])
