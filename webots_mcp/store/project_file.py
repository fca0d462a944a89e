"""`webots-mcp.toml` of a project: what is expected of its robots and what their signals mean.

Both are compiled into the database.

    tape = true                    # record each call of Webots' API; "images" with the pictures

    [[expect]]
    name = "keeps its distance"
    condition = "front_m > 0.1"
    during = "mode == 'drive'"  # may be left out, as may the name
    robot = "rover"             # else all robots

    [signals]                      # what signals mean, of every robot
    "motors.left" = {quantity = "wheel speed", role = "commanded", side = "left"}

    [signals.rover]                # of this robot alone
    u = {quantity = "speed", role = "commanded", unit = "m/s"}

Bridges read expectations from there, with each run. A file that is invalid changes nothing.
`policy` reads its table `[allow]`, and the bridge the line `tape` at its top.
"""

from __future__ import annotations

import re
import sqlite3
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import MAX_BREAKPOINTS, PROJECT_FILE, recorded_name
from webots_mcp.database.location import find_project
from webots_mcp.database.secret_names import TABLE, check_table
from webots_mcp.database.stored_breakpoints import OF_PROJECT
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import InvalidInputError, warn
from webots_mcp.signals.conditions.expectation import Expectation, parse_expectation
from webots_mcp.signals.meaning import MEANING_FIELDS, DeclaredMeaning, declare_meaning

ALL: Final = "*"
_KEYS: Final = ("name", "condition", "during", "robot")


_OF_MEANING: Final = ("robot_name", "name", *MEANING_FIELDS)


class Expected(NamedTuple):
    """An entry of the file; `robot` is a name or `ALL`."""

    expectation: Expectation
    robot: str


class DescribedSignal(NamedTuple):
    """An entry of the table `[signals]`; `robot` is a name or `ALL`."""

    meaning: DeclaredMeaning
    robot: str


class ProjectFile(NamedTuple):
    """What the file of a project declares about its robots."""

    expected: list[Expected]
    signals: list[DescribedSignal]


NO_PROJECT: Final = ProjectFile([], [])  # stands for a missing file


def file_of(data_dir: Path) -> Path | None:
    """Return the project file that belongs to a data folder, or lies in it.

    None if there is none.
    """
    found = (each and each / PROJECT_FILE for each in (find_project(data_dir), data_dir))
    return next((file for file in found if file and file.is_file()), None)


def read_project(file: Path) -> ProjectFile:
    """Read expectations and signals from the file.

    Raises:
        InvalidInputError: The file cannot be read or has an invalid entry; the error names the line
            and the reason.
    """
    text, content = load_toml(file)
    content.pop("allow", None)  # Read by `policy`: each part is valid while the other is invalid.
    check_table(file, content.pop(TABLE, {}))  # keys that bridges read themselves
    signals = content.pop("signals", {})
    if (tape := content.pop("tape", False)) not in (True, False, "images"):
        raise InvalidInputError(f'{file}: tape must be true, false or "images", not {tape!r:.80}')
    entries: list[Any] = content.pop("expect", [])
    is_list = type(entries) is list and all(type(each) is dict for each in entries)
    if content or not is_list:
        found = (
            f"{next(iter(content))!r} is unknown" if content else "'expect' is no list of tables"
        )
        raise InvalidInputError(
            f"{file}: {found}; it holds tables [[expect]], [signals], [inspect] and [allow], "
            "and a line tape = true"
        )
    tables = cast("list[dict[str, Any]]", entries)
    if len(tables) > MAX_BREAKPOINTS:
        raise InvalidInputError(f"{file}: {len(tables)} expectations; at most {MAX_BREAKPOINTS}")
    expected = [_entry(file, text, number, table) for number, table in enumerate(tables)]
    return ProjectFile(expected, _signals_in(file, text, signals))


def _signals_in(file: Path, text: str, table: Any) -> list[DescribedSignal]:
    """Return the entries of the table [signals].

    A nested table belongs to the robot of that name.
    """
    if not isinstance(table, dict):
        raise InvalidInputError(
            f"{file}, line {_signal_line(text)}: signals must be a table: [signals]"
        )
    found: list[DescribedSignal] = []
    for name, entry in cast("dict[str, Any]", table).items():
        of_robot = _is_table(entry) and entry and all(map(_is_table, entry.values()))
        own: dict[str, Any] = entry if of_robot else {name: entry}
        robot = recorded_name(name) if of_robot else ALL
        for signal, said in own.items():
            found.append(DescribedSignal(_signal(file, text, signal, said), robot))
    return found


def _signal(file: Path, text: str, name: str, said: Any) -> DeclaredMeaning:
    try:
        if not _is_table(said):
            example = '{quantity = "speed", role = "commanded"}'
            raise ValueError(f"signal {name!r} must be a table such as {example}, not {said!r:.80}")
        return declare_meaning(name, **said)
    except ValueError as error:
        line = _signal_line(text, name)
        raise InvalidInputError(f"{file}, line {line}: {error}") from error


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


def _signal_line(text: str, signal: str = "") -> int:
    """Return the first line of the table, or the first line after it that has the signal's name."""
    lines = text.splitlines()
    starts = (at for at, line in enumerate(lines) if re.match(r"\s*\[?\s*signals\b", line))
    start = next(starts, 0)
    key = re.compile(rf"(^|[\s\"'{{,.]){re.escape(signal)}[\"']?\s*[=\]]")
    named = (at for at in range(start, len(lines)) if signal and key.search(lines[at]))
    return next(named, start) + 1


def load_toml(file: Path) -> tuple[str, dict[str, Any]]:
    """Return the text of a file and its parsed content.

    Raises:
        InvalidInputError: It cannot be read, or is not TOML.
    """
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    try:
        text = file.read_text("utf-8-sig")  # with the byte order mark that editors of Windows write
        return text, cast("dict[str, Any]", toml.loads(text))
    except (ValueError, RecursionError) as error:  # also for text that is not UTF-8
        raise InvalidInputError(f"{file} is not valid TOML: {error}") from error
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be read: {error.strerror}") from error


def _entry(file: Path, text: str, number: int, table: dict[str, Any]) -> Expected:
    try:
        for key, value in table.items():
            if key not in _KEYS:
                raise InvalidInputError(f"unknown key {key!r}. Keys: {', '.join(_KEYS)}")
            if not isinstance(value, str):
                raise InvalidInputError(f"{key} must be a text, not {value!r:.80}")
        if "condition" not in table:
            raise InvalidInputError("condition is missing")
        asked = (table["condition"], table.get("during"), table.get("name"))
        return Expected(parse_expectation(*asked), recorded_name(table.get("robot", ALL)))
    except InvalidInputError as error:
        line = _line_of(text, number, str(error), table)
        raise InvalidInputError(f"{file}, line {line}: {error}") from error


def _line_of(text: str, number: int, why: str, table: dict[str, Any]) -> int:
    """Return the line of the invalid key, else the line where its table begins."""
    lines = text.splitlines()
    starts = [at for at, line in enumerate(lines) if re.match(r"\s*\[\[\s*expect\s*\]\]", line)]
    if number >= len(starts):  # written as an array of inline tables
        return 1
    end = starts[number + 1] if number + 1 < len(starts) else len(lines)
    wrong = [key for key, value in table.items() if repr(key) in why or repr(value) in why]
    wrong += [key for key in table if re.search(rf"\b{re.escape(key)}\b", why)]
    for at in range(starts[number], end):
        if wrong and re.match(rf"\s*[\"']?{re.escape(wrong[0])}[\"']?\s*=", lines[at]):
            return at + 1
    return starts[number] + 1


def compile_project(connection: sqlite3.Connection, project: ProjectFile) -> None:
    """Replace what the database holds of the project file by its current content."""
    wanted = {(*each.expectation.asks, each.robot): each.expectation for each in project.expected}
    there = {
        tuple(row[:4]): row[4]
        for row in connection.execute(
            "SELECT name, expects, during, robot_name, id FROM breakpoint "
            f"WHERE created_by = '{OF_PROJECT}'"
        ).fetchall()
    }
    gone = [(number,) for asks, number in there.items() if asks not in wanted]
    new = [asks for asks in wanted if asks not in there]
    meanings = {(each.robot, *each.meaning) for each in project.signals}
    stored = {
        tuple(row[:-1]): row[-1]
        for row in connection.execute(
            f"SELECT {', '.join(_OF_MEANING)}, id FROM meaning WHERE robot_id IS NULL "
            f"AND set_by = '{OF_PROJECT}'"
        ).fetchall()
    }
    old_meanings = [(stored[each],) for each in stored if each not in meanings]
    new_meanings = sorted(meanings - stored.keys(), key=repr)
    if not (gone or new or old_meanings or new_meanings):
        return
    now_s = time.time()
    with transaction(connection):
        connection.executemany("DELETE FROM breakpoint WHERE id = ?", gone)
        rows = [(*asks, wanted[asks].violation.text, now_s) for asks in new]
        connection.executemany(
            "INSERT INTO breakpoint (name, expects, during, robot_name, condition, action, "
            f"created_wall_time_s, created_by) VALUES (?, ?, ?, ?, ?, 'keep', ?, '{OF_PROJECT}')",
            rows,
        )
        connection.executemany("DELETE FROM meaning WHERE id = ?", old_meanings)
        connection.executemany(
            f"INSERT INTO meaning ({', '.join(_OF_MEANING)}, source, set_wall_time_s, set_by) "
            f"VALUES ({', '.join('?' * len(_OF_MEANING))}, 'declared', ?, '{OF_PROJECT}')",
            [(*each, now_s) for each in new_meanings],
        )


class ProjectWatch:
    """Compile the file of a recording's project again when it changes."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._seen: tuple[Path | None, int] | None = None

    def recompile_if_changed(self, connection: sqlite3.Connection) -> None:
        """Compile the file if it has changed since the last call; warn once if it is invalid."""
        file = file_of(self._data_dir)
        seen = (file, file.stat().st_mtime_ns if file else 0)
        if seen == self._seen:
            return
        self._seen = seen
        try:
            compile_project(connection, read_project(file) if file else NO_PROJECT)
        except InvalidInputError as error:
            warn(f"{error}. What was expected before stays")
