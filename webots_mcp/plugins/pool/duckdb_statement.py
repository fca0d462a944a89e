"""One SELECT over a pool of Parquet files by DuckDB, and the limits of answers of any pool.

Each table is a view of its name, with `recording_uuid` before its columns. A statement cannot do
harm: it is one SELECT, DuckDB can only read files below the root of the pool, and answers have the
limits of `query_sql`. It runs in its own process, which is killed at the deadline or when it takes
too much memory. DuckDB's own limits do not suffice: one function call may take any time and memory.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Any, Final

import psutil

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.pool.parquet_files import CHUNK, files_of, name_of
from webots_mcp.plugins.pool.pool_interface import ShippedTable, tables
from webots_mcp.plugins.pool.storage import Storage, package
from webots_mcp.store.sql import (
    FOLDER,
    MAX_BYTES,
    MAX_COLUMNS,
    MAX_TEXT,
    Budget,
    Cell,
    SqlResult,
    Statement,
    decode,
    fetch_rows,
    main,
    require_max_rows,
)

DEADLINE_S: Final = 20.0
"""Time limit, including the start of the process: the command ends within 30 s."""
_MEMORY: Final = "800MB"
"""Memory limit of DuckDB, which counts only a part of what it takes."""
_MOST_RESIDENT_BYTES: Final = 1_100_000_000
"""Limit of the resident memory of the process."""
_MOST_MORE_BYTES: Final = 1_000_000_000
"""Limit of what a statement can allocate, where the system supports it."""
_MOST_THREADS: Final = 4
"""Each thread has its own buffers."""
_POLL_S: Final = 0.02
"""Time between two checks of the memory. A machine fills about 50 MB in that time."""
_TOO_LARGE: Final = (
    f"more than {_MOST_MORE_BYTES / 1e9:g} GB of memory would be needed: narrow it by "
    "recording_uuid and by day, and make shorter values"
)
_LINE: Final = (sys.executable, "-m", __name__)
_AS_THEY_ARE: Final = re.compile("BOOLEAN|U?(TINY|SMALL|BIG|HUGE)INT|U?INTEGER|FLOAT|DOUBLE|BLOB")
_TYPES: Final = {int: "BIGINT", float: "DOUBLE", str: "VARCHAR", bytes: "BLOB"}


def ask(url: str, sql: str, max_rows: int) -> SqlResult:
    """Return the first rows of one SELECT over the pool.

    Raises:
        InvalidInputError: It is no single SELECT, is wrong, or takes too long or too much memory.
        PoolError: DuckDB is not installed.
    """
    require_max_rows(max_rows)
    package("duckdb")
    asked = Statement(url, sql, max_rows, MAX_BYTES, DEADLINE_S)
    slow = f"no answer within {DEADLINE_S:g} s: narrow it by recording_uuid and by day"
    end_s = time.monotonic() + DEADLINE_S
    with subprocess.Popen(
        _LINE, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=FOLDER
    ) as process:
        request: bytes | None = asked.encoded()
        try:
            while True:
                try:
                    answer, _ = process.communicate(request, timeout=_POLL_S)
                    return decode(answer, process.returncode, asked, slow)
                except subprocess.TimeoutExpired:
                    request = None  # The rest is sent by the next call.
                if time.monotonic() > end_s:
                    raise InvalidInputError(slow)
                if _resident_bytes(process.pid) > _MOST_RESIDENT_BYTES:
                    raise InvalidInputError(_TOO_LARGE)
        finally:
            process.kill()  # Does nothing if it has ended.


def _resident_bytes(pid: int) -> int:
    try:
        return int(psutil.Process(pid).memory_info().rss)
    except psutil.Error:  # The process has just ended.
        return 0


def select(storage: Storage, sql: str, max_rows: int) -> SqlResult:
    """Return the same as `ask`, within this process and without a deadline."""
    duckdb = package("duckdb")
    threads = min(_MOST_THREADS, os.cpu_count() or 1)
    with closing(duckdb.connect(config={"threads": threads})) as connection:
        _prepare(connection, storage, sql)
        try:
            # Relations of DuckDB hold the interpreter's lock while they read files, so that a
            # filesystem written in Python could never answer. SQL does not.
            asked = f"FROM ({_only_select(duckdb, connection, sql)}\n)"
            columns = connection.execute(f"DESCRIBE {asked}").fetchall()
            shown = ", ".join(_shown(at, kind) for at, (_, kind, *_) in enumerate(columns, 1))
            rows = connection.execute(f"SELECT {shown} {asked} LIMIT {max_rows + 1}").fetchall()
            return answered([name for name, *_ in columns], rows, max_rows)
        except (duckdb.OutOfMemoryException, MemoryError) as error:
            raise InvalidInputError(_TOO_LARGE) from error
        except duckdb.Error as error:
            raise InvalidInputError(f"DuckDB says: {error}") from error


def answered(names: Sequence[str], rows: Sequence[Sequence[Any]], max_rows: int) -> SqlResult:
    """Return the first rows, with long values cut.

    Args:
        names: Names of the columns.
        rows: Up to `max_rows` + 1 rows. Values are numbers, bytes or texts.
        max_rows: Maximum of returned rows.

    Raises:
        InvalidInputError: There are too many columns.
    """
    if len(names) > MAX_COLUMNS:
        raise InvalidInputError(
            f"{len(names)} columns are too many: name at most {MAX_COLUMNS} of them"
        )
    budget, taken = Budget(MAX_BYTES), list[tuple[Cell, ...]]()
    why = fetch_rows((map(_cut, row) for row in rows), taken, max_rows, budget)
    shortened = sum(value is not _cut(value) for row in rows[: len(taken)] for value in row)
    return SqlResult(tuple(names), tuple(taken), why, shortened)


def _cut(value: Any) -> Any:
    if not isinstance(value, str) or len(value) <= MAX_TEXT:
        return value
    return f"{value[:MAX_TEXT]}... ({len(value)} characters)"


def _prepare(connection: Any, storage: Storage, sql: str) -> None:
    """Create the views, and set the limits, which cannot be changed afterwards."""
    if not storage.is_local:
        connection.register_filesystem(storage.files)
    for table in tables():
        is_named = re.search(rf"\b{name_of(table)}\b", sql, re.IGNORECASE)
        paths = storage.find(files_of(table)) if is_named else []
        connection.execute(_view(table, [storage.url_of(path) for path in paths]))
    connection.execute(f"SET memory_limit = '{_MEMORY}'")
    connection.execute("SET temp_directory = ''")  # Never spill to the disk.
    connection.execute("SET TimeZone = 'UTC'")
    connection.execute(f"SET allowed_directories = [{_quoted(storage.url_of('') + '/')}]")
    connection.execute("SET enable_external_access = false")
    connection.execute("SET lock_configuration = true")


def _shown(at: int, kind: str) -> str:
    """Return the expression of a column (the first is 1) as a number, bytes or text."""
    if kind.startswith("DECIMAL"):
        return f"CAST(#{at} AS DOUBLE) AS c{at}"
    return f"#{at} AS c{at}" if _AS_THEY_ARE.fullmatch(kind) else f"CAST(#{at} AS VARCHAR) AS c{at}"


def _view(table: ShippedTable, paths: list[str]) -> str:
    """Return the statement of a view over the files of a table; without files it has no rows."""
    columns = dict(zip(table.columns, (_TYPES[kind] for kind in table.types), strict=True))
    shown, cut = ", ".join(f'"{name}"' for name in columns), ""
    if table.name == CHUNK:  # A column for each signal of any run.
        columns = {"run_id": "BIGINT", "sim_time_s": "DOUBLE", "wall_time_s": "DOUBLE"}
        shown, cut = 'run AS run_id, * EXCLUDE (recording, run, "table")', ", 'run': BIGINT"
    elif table.time_column:
        columns["day"] = "DATE"
        shown, cut = f"{shown}, day", ", 'day': DATE"
    made = f'CREATE VIEW "{name_of(table)}" AS SELECT'
    if not paths:
        columns = {"recording_uuid": "VARCHAR", **columns}
        nothing = [f'CAST(NULL AS {kind}) AS "{name}"' for name, kind in columns.items()]
        return f"{made} {', '.join(nothing)} WHERE false"
    files = ", ".join(map(_quoted, paths))
    return (
        f"{made} recording AS recording_uuid, {shown} FROM read_parquet([{files}], "
        "union_by_name = true, hive_partitioning = true, "
        f"hive_types = {{'recording': VARCHAR, 'table': VARCHAR{cut}}})"
    )


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _only_select(duckdb: Any, connection: Any, sql: str) -> str:
    """Return the statement without its semicolon.

    Raises:
        InvalidInputError: It is not one SELECT.
    """
    statements = connection.extract_statements(sql)
    kinds = [statement.type for statement in statements]
    if kinds != [duckdb.StatementType.SELECT]:
        raise InvalidInputError(
            "only one SELECT is allowed, this has "
            + (", ".join(kind.name for kind in kinds) or "no statement")
        )
    return str(statements[0].query).rstrip().rstrip(";")


def _ask(asked: Statement) -> SqlResult:
    package("duckdb")  # Its own memory does not count.
    if sys.platform == "linux":
        import resource

        most = psutil.Process().memory_info().data + _MOST_MORE_BYTES
        with suppress(ValueError, OSError):  # A lower limit is set.
            resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    return select(Storage(asked.database), asked.sql, asked.max_rows)


if __name__ == "__main__":
    main(_ask)
