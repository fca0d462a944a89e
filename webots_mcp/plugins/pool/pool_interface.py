"""The interface of pools: the tables that are shipped, batches of rows and protocols.

The key of a row is the UUID of its recording plus its key there.
"""

from __future__ import annotations

import math
import re
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias
from urllib.parse import parse_qsl

from webots_mcp.database.schema import create_schema
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.store.sql import SqlResult

SQLValue: TypeAlias = "int | float | str | bytes | None"
ValueType: TypeAlias = type[int] | type[float] | type[str] | type[bytes]
PoolRow = tuple[SQLValue, ...]

BATCH_BYTES: Final = 4_000_000
BATCH_ROWS: Final = 20_000
_VALUE_BYTES: Final = 8
_DATED: Final = ("state", "kept_state", "log", "event", "image", "parameter_value")
CHUNKS: Final = ("row_group", "chunk")
# Columns that are not shipped: about ids, rows that wait for chunks and space on the disk.
_LOCAL_COLUMNS: Final = {
    "recording": ("reserved_state_id",),
    "run": ("is_chunked",),
    "command": ("request_id",),
    "row_group": ("stored_row_count", "stored_row_bytes", "chunk_bytes", "is_complete"),
}
_TYPES: Final[dict[str, ValueType]] = {
    "INTEGER": int, "BIGINT": int, "FLOAT": float, "TEXT": str, "VARCHAR": str, "BLOB": bytes,
}  # fmt: skip
# The columns that are needed to list the runs and trial sets of a pool.
LISTED: Final[dict[str, tuple[str, ...]]] = {
    "robot": ("id", "name"),
    "run": (
        "id", "robot_id", "uuid", "label", "world", "started_wall_time_s", "last_wall_time_s",
        "started_sim_time_s", "last_sim_time_s", "end_reason", "row_count",
    ),
    "trial_set": ("id", "uuid", "created_wall_time_s"),
    "trial": ("id", "trial_set_id", "run_id"),
}  # fmt: skip
_WHOLE: Final = "run.whole:{}"  # A bit for each of `_RUNS_IN_NUMBER` runs.
_RUNS_IN_NUMBER: Final = 60
_COMMENT: Final = re.compile(r'(?m)^\s*"?(\w+)"? .*/\* (.*) \*/')  # of a column, by its name
_SECRET: Final = re.compile(
    "password|passwd|secret|token|credential|signature|authorization|(access|api|account)[_-]?key|"
    "^(pass|key|sig|pwd)$",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class ShippedTable:
    """A table that is shipped.

    Attributes:
        key: Primary key in a recording. In a pool, the UUID of the recording precedes it.
        columns: All shipped columns by their names in the recording, in the order of batches.
        types: Types of the columns in the model. SQLite may hold values of other types.
        json_columns: Columns that hold JSON as text.
        json_values: JSON columns whose value may be any JSON value, not only an object.
        nullable: Columns that may be null.
        lasting: References that retention sets to null when it deletes their target. Null does not
            replace a value in the pool.
        is_appended: Whether rows have rising ids and never change. Otherwise a row replaces the
            row of its key.
        time_column: Column of the wall time by which a pool may divide an appended table.
        run_column: Column with the id of the row's run, if any.
        session_column: Column with the id of the row's session, if any.
        outlasts_runs: Whether rows are shipped even if their run or session is not.
    """

    name: str
    key: tuple[str, ...]
    columns: tuple[str, ...]
    types: tuple[ValueType, ...]
    json_columns: frozenset[str]
    json_values: frozenset[str]
    nullable: frozenset[str]
    lasting: frozenset[str]
    is_appended: bool
    time_column: str | None
    run_column: str | None
    session_column: str | None
    outlasts_runs: bool


@cache
def tables() -> tuple[ShippedTable, ...]:
    """Return all shipped tables, each after the tables it refers to.

    They are read from the schema of a database: the models from which it is generated import
    libraries that take a second to load.
    """
    # These tables hold for one machine or moment. Console lines become log lines later.
    local = ("lease", "watermark", "retention_limit", "console_line", "request", "alembic_version")
    with closing(sqlite3.connect(":memory:")) as connection:
        create_schema(connection)
        created = connection.execute(
            "SELECT name, sql FROM sqlite_master "
            "WHERE type = 'table' AND name NOT LIKE 'sqlite_%' ORDER BY rowid"
        ).fetchall()
        return tuple(_table(connection, name, sql) for name, sql in created if name not in local)


def table(name: str) -> ShippedTable:
    """Return the shipped table with this name.

    Raises:
        KeyError: There is none.
    """
    return {each.name: each for each in tables()}[name]


def _table(connection: sqlite3.Connection, name: str, sql: str) -> ShippedTable:
    """Return a table of the schema.

    Args:
        connection: A database with the schema.
        name: The name of the table.
        sql: The statement that creates it, with the comments of its columns.
    """
    local = _LOCAL_COLUMNS.get(name, ())
    found = connection.execute(f"PRAGMA table_info({name})").fetchall()
    # Each row is (position, name, type, is not null, default, position in the key or 0).
    shipped = [row for row in found if row[1] not in local]
    columns = tuple(str(row[1]) for row in shipped)
    comments = dict(_COMMENT.findall(sql))
    json_values = [each for each in columns if comments.get(each, "").startswith("JSON value")]
    json_columns = [each for each in columns if comments.get(each, "").startswith("JSON")]
    references = connection.execute(f"PRAGMA foreign_key_list({name})").fetchall()

    def column_of(owner: str) -> str | None:
        named = "id" if name == owner else f"{owner}_id"
        return named if named in columns else None

    return ShippedTable(
        name=name,
        key=tuple(str(row[1]) for row in sorted(found, key=itemgetter(5)) if row[5]),
        columns=columns,
        types=tuple(_TYPES[row[2].partition("(")[0]] for row in shipped),
        json_columns=frozenset([*json_columns, *({"replaced"} & {*columns})]),
        json_values=frozenset(json_values),
        nullable=frozenset(str(row[1]) for row in shipped if not row[3]),
        lasting=frozenset(
            str(row[3]) for row in references if row[6] == "SET NULL" and row[3] in columns
        ),
        is_appended=name in _DATED + CHUNKS,
        time_column="wall_time_s" if name in _DATED else None,
        run_column=column_of("run"),
        session_column=column_of("session"),
        outlasts_runs=name in ("trial_set", "trial"),
    )


@dataclass(frozen=True)
class Batch:
    """Rows with values in the order of the table's columns: JSON is text, a flag 0 or 1."""

    table: ShippedTable
    rows: Sequence[PoolRow]


def batches(table: ShippedTable, rows: Iterable[PoolRow]) -> Iterator[Batch]:
    """Yield rows in batches of limited size. A row that exceeds it is a batch of its own."""
    held: list[PoolRow] = []
    size = 0
    for row in rows:
        added = row_bytes(row)
        if held and (size + added > BATCH_BYTES or len(held) >= BATCH_ROWS):
            yield Batch(table, held)
            held, size = [], 0
        held.append(row)
        size += added
    if held:
        yield Batch(table, held)


def row_bytes(row: PoolRow) -> int:
    """Return about the bytes of memory that a row's values take."""
    sized = sum([len(value) for value in row if isinstance(value, (str, bytes))])
    return sized + _VALUE_BYTES * len(row)


def fitted(batch: Batch, replaced: Counter[str]) -> Batch:
    """Convert the values of rows to the types of their columns. SQLite may hold any type.

    Args:
        batch: The rows as they were read.
        replaced: Counts the values that were converted, by column (`log.message`).
    """
    columns: list[Sequence[SQLValue]] = [*zip(*batch.rows, strict=True)]
    described = zip(batch.table.columns, batch.table.types, columns, strict=True)
    others = [
        (at, name, kind)
        for at, (name, kind, values) in enumerate(described)
        if not set(map(type, values)) <= {kind, type(None)}
    ]
    for at, name, kind in others:
        values, nullable = columns[at], name in batch.table.nullable
        columns[at] = [_nearest(value, kind, nullable=nullable) for value in values]
        pairs = zip(columns[at], values, strict=True)
        replaced[f"{batch.table.name}.{name}"] += sum(new != old for new, old in pairs)
    return Batch(batch.table, [*zip(*columns, strict=True)]) if others else batch


def _nearest(value: SQLValue, kind: ValueType, *, nullable: bool) -> SQLValue:
    """Return the value of a type that is nearest to a value of SQLite."""
    empty = None if nullable else kind()
    if value is None or isinstance(value, kind):
        return value
    if kind is str:
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    if kind is bytes:
        return empty
    try:
        number = float(value)
    except ValueError:
        return empty
    if kind is float:
        return number
    return int(number) if math.isfinite(number) and abs(number) < 2**63 else empty


def whole_runs(run_ids: Iterable[int]) -> dict[str, int]:
    """Return numbers of the progress that mark runs as ended and completely shipped."""
    numbers: dict[str, int] = {}
    for run_id in run_ids:
        name = _WHOLE.format(run_id // _RUNS_IN_NUMBER)
        numbers[name] = numbers.get(name, 0) | 1 << run_id % _RUNS_IN_NUMBER
    return numbers


def is_whole(progress: Mapping[str, int], run_id: int) -> bool:
    """Return whether the progress marks a run as ended and completely shipped."""
    number = progress.get(_WHOLE.format(run_id // _RUNS_IN_NUMBER), 0)
    return bool(number >> run_id % _RUNS_IN_NUMBER & 1)


class Shipment(Protocol):
    """The part of a pool of one recording, which one shipper at a time writes."""

    def progress(self) -> dict[str, int]:
        """Return the numbers that `write` stored, by names that the shipper chose.

        Empty at first.
        """
        ...

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Return the runs that another recording has shipped, with its UUID."""
        ...

    def write_picture(self, path: str, content: bytes) -> None:
        """Store a picture under the path of its row in `image`, replacing another.

        It is completely stored, at the latest, when the next `write` has returned.
        """
        ...

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Mapping[str, int]:
        """Write fitted rows and numbers of the progress: all or nothing.

        Rows of appended tables come once. A row of another table replaces the row of its key, but
        where a column of `ShippedTable.lasting` is null, the value stays. Rows that are missing
        from the batch stay too, since retention at the edge deletes what a pool keeps. Batches may
        name a table twice; what a row refers to comes before it.

        Returns:
            The number of values that the pool cannot hold, by column (`log.message`). It stores the
            nearest value, or null.

        Raises:
            PoolUnavailableError: A retry may succeed. Nothing was written.
            PoolError: A retry will not help.
        """
        ...


class Pool(Protocol):
    """A pool to ship to or to read: a context manager, connected as long as it is open.

    `run.purged_rows` is the last value of the recording. Missing states are counted.

    Attributes:
        address: The URL without secrets, for messages and logs.
    """

    address: str

    def __enter__(self) -> Pool:
        """Connect. To ship, create the tables if there are none.

        Raises:
            PoolUnavailableError: The pool does not answer.
            PoolError: The pool cannot be used, or has another version.
        """
        ...

    def __exit__(self, *exception: object) -> None:
        """Disconnect. Data that was not written is lost."""
        ...

    def shipment(self, recording_uuid: str) -> AbstractContextManager[Shipment]:
        """Be the only shipper of a recording, to a pool that was opened for shipping.

        Raises:
            PoolBusyError: Another process ships it.
        """
        ...

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """Yield the UUID of the recording and the columns `LISTED` of each row of a table."""
        ...

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """Return how far the recording was shipped, like `Shipment.progress`."""
        ...

    def rows(
        self, recording_uuid: str, table: ShippedTable, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Yield rows whose columns have one of some values, in any order."""
        ...

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """Return a picture by the path in its row; None if it was not shipped."""
        ...

    def select(self, sql: str, max_rows: int) -> SqlResult:
        """Return the first rows of one SELECT, which cannot write and has a deadline."""
        ...


def redacted(url: str) -> str:
    """Return a URL without a password and without parameters that look like secrets."""
    scheme, sign, rest = url.partition("://")
    if not sign:
        return url
    place, question, query = _place_and_query(rest)
    user, at, host = place.rpartition("@")
    shown = "&".join(
        f"{name}=***" if _SECRET.search(name) else f"{name}={value}"
        for name, value in parse_qsl(query, keep_blank_values=True)
    )
    return f"{scheme}://{user.partition(':')[0]}{at}{host}{question}{shown}"


def _place_and_query(rest: str) -> tuple[str, str, str]:
    """Split at the question mark of the query, which is not one in a password."""
    user, at, _ = rest.partition("@")
    end = rest.find("?", len(user) if at and "/" not in user else 0)
    return (rest, "", "") if end < 0 else (rest[:end], "?", rest[end + 1 :])


def require_no_secret(url: str) -> None:
    """Refuse a URL that contains a password or a key.

    Raises:
        InvalidInputError: It contains one.
    """
    place, _, query = _place_and_query(url.partition("://")[2])
    user, _, _ = place.rpartition("@")
    named = [name for name, _ in parse_qsl(query) if _SECRET.search(name)]
    if ":" in user or named:
        what = named[0] if named else "a password"
        raise InvalidInputError(
            f"the URL {redacted(url)} holds {what}, which every process on this machine can see: "
            "leave it out, and give it in PGPASSWORD, ~/.pgpass or a service file (PostgreSQL), or "
            "in the environment or the configuration of the storage"
        )
