"""Read past rows that hold values no bridge writes.

Other programs may write to a recording, and SQLite accepts any value in any column. Checking every
value would double the cost of every question, so a question runs without checks first. If it fails
because of a value, it runs again on temporary views that have the names of the tables. They leave
out invalid rows, or show null instead of an invalid value if null is allowed. The answer names what
was left out.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Final, cast

from webots_mcp.database.schema import shipped_statements

MAX_DEPTH: Final = 100  # nesting of JSON: the bridge records 20 levels
_SHOWN: Final = 5
_OBJECTS: Final = frozenset(
    {"robot.devices", "session.versions", "session.actions", "state.data", "state.replaced",
     "kept_state.data", "kept_state.replaced",
     "event.data", "command.params", "trial_set.plan", "trial_set.former_values",
     "trial.parameters", "request.arguments"}
)  # fmt: skip
_PLAIN: Final = (bool, int, float, str)
_OF_TEXTS: Final = frozenset(
    {"robot.devices", "session.actions", "state.replaced", "kept_state.replaced"}
)
_SHAPES: Final = {  # Values of JSON that is no object.
    "command.result": "any", "request.purged_commands": "any",
    "parameter.choices": "values", "parameter.default_value": "value",
    "parameter.next_value": "value", "parameter_value.value": "value",
}  # fmt: skip
# Following a row that refers to an invalid one would fail.
_REFERENCES: Final = {
    "session": (("robot_id", "robot"),),
    "run": (("session_id", "session"), ("robot_id", "robot")),
    "trial": (("trial_set_id", "trial_set"),),
}
_TABLES: Final = ("robot", "session", "run", "state", "log", "event", "image", "command",
                  "signal", "watermark",
                  "retention_limit", "parameter", "parameter_value", "breakpoint", "trial_set",
                  "trial", "kept_stretch", "kept_state", "console_line",
                  "row_group", "chunk", "request")  # fmt: skip


@dataclass(frozen=True)
class ValidRange:
    """The range of values that a bridge writes.

    Attributes:
        max_sim_time_s: Maximum simulation time.
        max_wall_time_s: Maximum Unix time: the end of the year 9999.
        max_integer: No id or count is larger, and a float holds it exactly.
        max_float: Maximum absolute value of a number.
    """

    max_sim_time_s: float = 1e10
    max_wall_time_s: float = 253_402_300_799.0
    max_integer: int = 2**53
    max_float: float = 1.7e308


_VALID: Final = ValidRange()


class InvalidValues:
    """The invalid values that a question met and left out, in order."""

    def __init__(self) -> None:
        self._met: dict[str, None] = {}

    def note(self, table: str, row: object, column: str, kind: str) -> None:
        """Note an invalid value.

        SQLite calls this, and the reader does not see its row or value.
        """
        self._met[f"{table} {row}: {column} holds no valid {kind}"] = None

    def described(self) -> list[str]:
        """Return the first few values and the number of the others."""
        more = len(self._met) - _SHOWN
        return [*list(self._met)[:_SHOWN], *([f"and {more} more"] if more > 0 else [])]


_reading: ContextVar[InvalidValues | None] = ContextVar("reading past invalid rows", default=None)


@contextmanager
def past_invalid_rows() -> Generator[InvalidValues]:
    """Hide invalid rows and values from readers that are opened inside this context."""
    invalid = InvalidValues()
    token = _reading.set(invalid)
    try:
        yield invalid
    finally:
        _reading.reset(token)


def left_out_so_far() -> list[str]:
    """Return what readers opened inside `past_invalid_rows` have left out so far."""
    invalid = _reading.get()
    return invalid.described() if invalid is not None else []


def is_past_invalid_rows() -> bool:
    """Return whether the caller is inside `past_invalid_rows`."""
    return _reading.get() is not None


def shadow_if_asked(connection: sqlite3.Connection) -> None:
    """Give a reader views of the valid rows under the tables' names, inside `past_invalid_rows`."""
    if (invalid := _reading.get()) is None:
        return
    # A view of `main` reads the tables of `main`, even if several recordings are read as one.
    if (
        connection.execute("SELECT 1 FROM sqlite_temp_master WHERE name = 'robot'").fetchone()
        is None
    ):
        _shadow(connection, invalid)
    else:  # by an earlier question on a connection that stays open
        connection.create_function("note_invalid", 4, invalid.note)


def _shadow(connection: sqlite3.Connection, invalid: InvalidValues) -> None:
    connection.execute("PRAGMA query_only=OFF")  # a view of this connection alone
    _show_valid(connection, invalid)
    for sql in shipped_statements():
        if sql.startswith("CREATE VIEW"):
            connection.execute(sql.replace("CREATE VIEW", "CREATE TEMP VIEW", 1))
    connection.execute("PRAGMA query_only=ON")


def _show_valid(connection: sqlite3.Connection, invalid: InvalidValues) -> None:
    connection.text_factory = _as_text
    connection.create_function("note_invalid", 4, invalid.note)
    connection.create_function("valid_json", 2, _is_valid_json, deterministic=True)
    for table in _TABLES:
        connection.execute(_view(connection, table))


def _as_text(stored: bytes) -> str:
    return stored.decode("utf-8", "replace")


def _view(connection: sqlite3.Connection, table: str) -> str:
    columns = connection.execute(
        'SELECT name, type, "notnull", dflt_value, pk FROM pragma_table_info(?)', (table,)
    ).fetchall()
    keys = [name for name, _, _, _, key in columns if key]
    row = " || '/' || ".join(keys)
    shown: list[str] = []
    needed: list[str] = []
    for name, kind, required, default, key in columns:
        check, said = _check(table, name, kind)
        left_out = f"note_invalid('{table}', {row}, '{name}', '{said}')"
        if key and len(keys) == 1:
            shown.append(name)
        elif required and default is None:
            shown.append(name)
            needed.append(f"CASE WHEN {check} THEN 1 ELSE {left_out} END")
        else:
            whole = check if required else f"{name} IS NULL OR {check}"
            shown.append(
                f"CASE WHEN {whole} THEN {name} "
                f"ELSE coalesce({left_out}, {default or 'NULL'}) END AS {name}"
            )
    for name, other in _REFERENCES.get(table, ()):
        there = f"EXISTS (SELECT 1 FROM temp.{other} AS other WHERE other.id = {table}.{name})"
        left_out = f"note_invalid('{table}', {row}, '{name}', 'reference')"
        needed.append(f"CASE WHEN {there} THEN 1 ELSE {left_out} END")
    where = " AND ".join(needed) or "1"
    rows = f"SELECT {', '.join(shown)} FROM main.{table} WHERE {where}"
    return f"CREATE TEMP VIEW {table} AS {rows}"


def _check(table: str, name: str, kind: str) -> tuple[str, str]:
    """Return an SQL condition that valid values meet, and the description of an invalid one."""
    place = f"{table}.{name}"
    if place in _OBJECTS or place in _SHAPES:
        what = "texts" if place in _OF_TEXTS else _SHAPES.get(place, "object")
        checked = f"valid_json(CAST({name} AS BLOB), '{what}')"  # the value may not be UTF-8
        return f"CASE typeof({name}) WHEN 'text' THEN {checked} ELSE 0 END", "JSON"
    if kind == "TEXT":
        return f"typeof({name}) = 'text'", "text"
    if kind == "BLOB":
        return f"typeof({name}) = 'blob'", "bytes"
    if "INT" in kind:
        return (
            f"typeof({name}) = 'integer' AND abs({name} / 2) <= {_VALID.max_integer // 2}",
            "integer",
        )
    limit = _VALID.max_float
    if name.endswith("time_s"):
        limit = _VALID.max_wall_time_s if name.endswith("wall_time_s") else _VALID.max_sim_time_s
    return f"typeof({name}) IN ('real', 'integer') AND abs({name}) <= {limit!r}", "number"


def _is_valid_json(stored: bytes, what: str) -> int:
    """Return whether SQLite, Python and clients read a text as the same JSON of the right shape."""
    try:
        value: Any = json.loads(stored.decode(), parse_constant=_refuse)
        json.dumps(value, ensure_ascii=False).encode()
        _require_plain(value, MAX_DEPTH)
    except (ValueError, RecursionError, OverflowError):
        return 0
    return int(_has_shape(value, what))


def _has_shape(value: Any, what: str) -> bool:
    """Return whether a value has the shape.

    Anything, an object, texts, a parameter value or a list.
    """
    if what in ("object", "texts"):
        members = cast("dict[str, Any]", value).values() if isinstance(value, dict) else None
        return members is not None and (
            what == "object" or all(isinstance(member, str) for member in members)
        )
    if what == "values":
        listed = cast("list[Any]", value) if isinstance(value, list) else [None]
        return all(isinstance(each, _PLAIN) for each in listed)
    return what == "any" or isinstance(value, _PLAIN)


def _refuse(constant: str) -> None:
    raise ValueError(constant)


def _require_plain(value: Any, levels: int) -> None:
    """Raise an error if a value is nested too deeply or holds a number that is no finite float."""
    if isinstance(value, (dict, list)):
        if not levels:
            raise ValueError("too deep")
        each = cast("dict[str, Any] | list[Any]", value)
        for member in each.values() if isinstance(each, dict) else each:
            _require_plain(member, levels - 1)
    elif isinstance(value, (int, float)) and not math.isfinite(value):
        raise ValueError("not finite")
