"""The schema as a short text, read from the database itself."""

from __future__ import annotations

import re
import sqlite3
from typing import Final

from webots_mcp.connection import shipped_objects

_OBJECTS: Final = (
    "SELECT name, type, sql FROM sqlite_master WHERE type IN ('table', 'view') "
    "AND name NOT LIKE 'sqlite_%' AND name <> 'alembic_version' ORDER BY type, rowid"
)
# What serves the recording itself: a question needs the names at most.
_BOOKKEEPING: Final = (
    "console_line",
    "lease",
    "watermark",
    "recording",
    "retention_limit",
    "kept_state",
    "row_group",
    "chunk",
)
_BOOKKEEPING_COLUMNS: Final = (
    "uuid",
    "process",
    "last_adopted_entry",
    "last_seen_monotonic_s",
    "mode_before_pause",
    "is_chunked",
)
_COLUMNS: Final = "SELECT name FROM pragma_table_info(?) ORDER BY cid"
_COMMENT: Final = re.compile(r'^\s*"?(\w+)"?\s[^\n,]*?/\* (.*?) \*/', re.MULTILINE)
_RULES: Final = (
    "Times are seconds: sim_time_s of the simulation, wall_time_s Unix. state.data is JSON: "
    "json_extract(data, '$.pose[0]'); signal.path has the path of each name. A range of a run is "
    "fast by run_id and sim_time_s; for a long one use robot_statistics (min, max, mean of about "
    "1,024 rows each, also of purged ones; not of rows in no chunk: the newest of a run that goes "
    "on, up to 1,023, and the last of an ended one where they are fewer than 256)."
)


def columns_by_table(connection: sqlite3.Connection) -> dict[str, list[str]]:
    """The columns of each table and view of ours; those of a person are not looked into."""
    return {
        name: [column for (column,) in connection.execute(_COLUMNS, (name,))]
        for name, _, _ in connection.execute(_OBJECTS).fetchall()
        if name in shipped_objects()
    }


def describe_schema(connection: sqlite3.Connection) -> str:
    """One line for tables and views with the same columns: those of the first, with comments.

    What is said of a column is not repeated for one of the same name in a later table. Bookkeeping
    is named only.
    """
    columns = columns_by_table(connection)
    names: dict[frozenset[str], list[str]] = {}
    listed: dict[frozenset[str], str] = {}
    listed_before = set[tuple[str, str]]()
    for name, kind, sql in connection.execute(_OBJECTS).fetchall():
        if name in _BOOKKEEPING or name not in columns:
            continue
        same = frozenset(columns[name]).difference(_BOOKKEEPING_COLUMNS)
        names.setdefault(same, []).append(f"{kind} {name}")
        if same not in listed:
            found = dict.fromkeys(_COMMENT.findall(sql) if kind == "table" else ())
            listed[same] = _listed(
                columns[name], dict(each for each in found if each not in listed_before)
            )
            listed_before.update(found)
    lines = (f"{', '.join(alike)}: {listed[same]}" for same, alike in names.items())
    return "\n".join((_RULES, *lines, _bookkeeping()))


def _listed(columns: list[str], comments: dict[str, str]) -> str:
    return ", ".join(
        f"{name} [{comments[name]}]" if name in comments else name
        for name in columns
        if name not in _BOOKKEEPING_COLUMNS
    )


def _bookkeeping() -> str:
    tables, columns = ", ".join(_BOOKKEEPING), ", ".join(_BOOKKEEPING_COLUMNS)
    return f"bookkeeping, not listed: tables {tables}; columns {columns}"
