"""`webots-mcp.toml` of a project: what is expected of its robots, compiled into the database.

    [[expect]]
    name = "keeps its distance"
    condition = "front_m > 0.1"
    during = "mode == 'drive'"  # may be left out, as may the name
    robot = "rover"             # else all robots

Bridges read it from there, with each run. A file that is invalid changes nothing. `policy` reads
its table `[allow]`.
"""

from __future__ import annotations

import re
import sqlite3
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import MAX_BREAKPOINTS, PROJECT_FILE, recorded_name
from webots_mcp.database.connection import transaction
from webots_mcp.database.location import find_project
from webots_mcp.database.pauses import OF_PROJECT
from webots_mcp.errors import InvalidInputError, warn
from webots_mcp.signals.conditions.compiler import Expectation, parse_expectation

ALL: Final = "*"
_KEYS: Final = ("name", "condition", "during", "robot")
_HEADER: Final = re.compile(r"\s*\[\[\s*expect\s*\]\]")
_STORED: Final = (
    "SELECT name, expects, during, robot_name, id FROM breakpoint "
    f"WHERE created_by = '{OF_PROJECT}'"
)
_ADD: Final = (
    "INSERT INTO breakpoint (name, expects, during, robot_name, condition, action, "
    f"created_wall_time_s, created_by) VALUES (?, ?, ?, ?, ?, 'keep', ?, '{OF_PROJECT}')"
)


class Expected(NamedTuple):
    """An entry of the file; `robot` is a name, or `ALL`."""

    expectation: Expectation
    robot: str


def file_of(data_dir: Path) -> Path | None:
    """The file of the project that a data folder is of, or in that folder; None without one."""
    found = (each and each / PROJECT_FILE for each in (find_project(data_dir), data_dir))
    return next((file for file in found if file and file.is_file()), None)


def read_project(file: Path) -> list[Expected]:
    """What the file says.

    Raises:
        InvalidInputError: It cannot be read, or something in it is invalid: which line, and why.
    """
    text, content = load_toml(file)
    content.pop("allow", None)  # which `policy` reads: either holds while the other is invalid
    entries: list[Any] = content.pop("expect", [])
    is_list = type(entries) is list and all(type(each) is dict for each in entries)
    if content or not is_list:
        found = (
            f"{next(iter(content))!r} is unknown" if content else "'expect' is no list of tables"
        )
        raise InvalidInputError(f"{file}: {found}; it holds tables [[expect]], and [allow]")
    tables = cast("list[dict[str, Any]]", entries)
    if len(tables) > MAX_BREAKPOINTS:
        raise InvalidInputError(f"{file}: {len(tables)} expectations; at most {MAX_BREAKPOINTS}")
    return [_entry(file, text, number, table) for number, table in enumerate(tables)]


def load_toml(file: Path) -> tuple[str, dict[str, Any]]:
    """The text of a file, and what it says.

    Raises:
        InvalidInputError: It cannot be read, or is no TOML.
    """
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    try:
        text = file.read_text("utf-8-sig")  # with the mark that editors of Windows put before it
        return text, cast("dict[str, Any]", toml.loads(text))
    except (ValueError, RecursionError) as error:  # also what is not UTF-8
        raise InvalidInputError(f"{file} is no TOML: {error}") from error
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be read: {error.strerror}") from error


def _entry(file: Path, text: str, number: int, table: dict[str, Any]) -> Expected:
    try:
        for key, value in table.items():
            if key not in _KEYS:
                raise InvalidInputError(f"{key!r} is unknown; there is {', '.join(_KEYS)}")
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
    """That of the key that is wrong, else where its table begins."""
    lines = text.splitlines()
    starts = [at for at, line in enumerate(lines) if _HEADER.match(line)]
    if number >= len(starts):  # written as an array of inline tables
        return 1
    end = starts[number + 1] if number + 1 < len(starts) else len(lines)
    wrong = [key for key, value in table.items() if repr(key) in why or repr(value) in why]
    wrong += [key for key in table if re.search(rf"\b{re.escape(key)}\b", why)]
    for at in range(starts[number], end):
        if wrong and re.match(rf"\s*[\"']?{re.escape(wrong[0])}[\"']?\s*=", lines[at]):
            return at + 1
    return starts[number] + 1


def compile_project(connection: sqlite3.Connection, expected: Sequence[Expected]) -> None:
    """Let the database expect what the file says, and nothing that it does not say any more."""
    wanted = {(*each.expectation.asks, each.robot): each.expectation for each in expected}
    there = {tuple(row[:4]): row[4] for row in connection.execute(_STORED).fetchall()}
    gone = [(number,) for asks, number in there.items() if asks not in wanted]
    new = [asks for asks in wanted if asks not in there]
    if not (gone or new):
        return
    with transaction(connection):
        connection.executemany("DELETE FROM breakpoint WHERE id = ?", gone)
        rows = [(*asks, wanted[asks].violation.text, time.time()) for asks in new]
        connection.executemany(_ADD, rows)


class ProjectWatch:
    """Compiles the file of a recording's project again where it has changed."""

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
            compile_project(connection, read_project(file) if file else [])
        except InvalidInputError as error:
            warn(f"{error}. What was expected before stays")
