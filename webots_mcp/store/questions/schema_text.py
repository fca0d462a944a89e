"""The schema in few words, as the database itself tells it."""

from __future__ import annotations

import re
import sqlite3
from typing import Final

_OBJECTS: Final = (
    "SELECT name, type, sql FROM sqlite_master WHERE type IN ('table', 'view') "
    "AND name NOT LIKE 'sqlite_%' AND name <> 'alembic_version' ORDER BY type, rowid"
)
_COLUMNS: Final = "SELECT name FROM pragma_table_info(?) ORDER BY cid"
_COMMENT: Final = re.compile(r'^\s*"?(\w+)"?\s[^\n]*?/\* (.*?) \*/', re.MULTILINE)
_RULES: Final = (
    "Times are seconds: sim_time_s of the simulation, wall_time_s Unix. state.data is JSON: "
    "json_extract(data, '$.pose[0]'); signal.path has the path of each name. A range of a run is "
    "fast by run_id and sim_time_s; for a long one use all_rollup (10 s buckets) "
    "or coarse_rollup (500 s)."
)


def columns_by_table(connection: sqlite3.Connection) -> dict[str, list[str]]:
    """The columns of each table and view."""
    return {
        name: [column for (column,) in connection.execute(_COLUMNS, (name,))]
        for name, _, _ in connection.execute(_OBJECTS).fetchall()
    }


def describe_schema(connection: sqlite3.Connection) -> str:
    """One line per table and view: its columns, with their comments in brackets.

    What is said of a column is not repeated for one of the same name in a later table.
    """
    columns = columns_by_table(connection)
    lines, told = [_RULES], set[tuple[str, str]]()
    for name, kind, sql in connection.execute(_OBJECTS).fetchall():
        found = dict.fromkeys(_COMMENT.findall(sql) if kind == "table" else ())
        comments = dict(each for each in found if each not in told)
        told.update(found)
        listed = (
            f"{column} [{comments[column]}]" if column in comments else column
            for column in columns[name]
        )
        lines.append(f"{kind} {name}: {', '.join(listed)}")
    return "\n".join(lines)
