"""What is shipped to a pool, and what the two kinds of pools do: tables, batches, protocols.

Each row is keyed by its recording's UUID and the key that it has there.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias, cast
from urllib.parse import parse_qsl

from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.store.sql import Result

SQLValue: TypeAlias = "int | float | str | bytes | None"
ValueType: TypeAlias = type[int] | type[float] | type[str] | type[bytes]
PoolRow = tuple[SQLValue, ...]

BATCH_BYTES: Final = 4_000_000
BATCH_ROWS: Final = 20_000
_VALUE_BYTES: Final = 8
_DATED: Final = ("state", "kept_state", "log", "event", "image", "parameter_value")
CHUNKS: Final = ("row_group", "chunk")
# Of one machine or one moment: who maintains it, what is kept there, console lines that wait to
# become log lines, and who asked for what.
_LOCAL: Final = ("lease", "watermark", "retention_limit", "console_line", "request")
# How many rows wait for chunks there, how many of a group are left, and what they take on the disk.
_LOCAL_COLUMNS: Final = {
    "run": ("is_chunked",),
    "command": ("request_id",),
    "row_group": ("stored_row_count", "stored_row_bytes", "chunk_bytes", "is_complete"),
}
_OF_TRIALS: Final = ("trial_set", "trial")
_TYPES: Final[dict[str, ValueType]] = {
    "INTEGER": int, "BIGINT": int, "FLOAT": float, "TEXT": str, "VARCHAR": str, "BLOB": bytes,
}  # fmt: skip
# What is needed to list the runs and trial sets of a pool: of few tables few columns.
LISTED: Final[dict[str, tuple[str, ...]]] = {
    "robot": ("id", "name"),
    "run": (
        "id", "robot_id", "uuid", "label", "world", "started_wall_time_s", "last_wall_time_s",
        "started_sim_time_s", "last_sim_time_s", "end_reason", "row_count",
    ),
    "trial_set": ("id", "uuid", "created_wall_time_s"),
    "trial": ("id", "trial_set_id", "run_id"),
}  # fmt: skip
_WHOLE: Final = "run.whole:{}"  # a bit for each of so many runs
_RUNS_IN_NUMBER: Final = 60
_SECRET: Final = re.compile(
    "password|passwd|secret|token|credential|signature|authorization|(access|api|account)[_-]?key|"
    "^(pass|key|sig|pwd)$",
    re.IGNORECASE,
)


# -- what is shipped --------------------------------------------------------------------------


@dataclass(frozen=True)
class ShippedTable:
    """A table that is shipped; its columns in the order in which a batch has their values.

    Attributes:
        key: Its primary key in a recording; in a pool the recording's UUID stands before it.
        columns: Those of the key and all others that are shipped, by their names in the recording.
        types: Of the columns, as the model declares them; SQLite may hold others.
        json_columns: Those that hold JSON as text.
        json_values: Of them, those in which a text is as good as an object.
        nullable: Those that may be null.
        lasting: References that retention sets to null where it deletes what they name: a null
            does not replace the value that the pool has.
        is_appended: Rows come with rising ids and never change; otherwise a row replaces the one
            of the same key.
        time_column: The wall time by which a pool may cut it into parts, of appended tables but
            row groups and chunks.
        run_column: The column that names the row's run, where it belongs to one.
        session_column: The column that names its session.
        outlasts_runs: It stays where the run or session that it names is not shipped.
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
    """All that are shipped, each after those that it refers to. Importing the models costs."""
    from webots_mcp.store import models

    ordered: list[Any] = cast("Any", models).SQLModel.metadata.sorted_tables
    return tuple(_table(each) for each in ordered if each.name not in _LOCAL)


def table(name: str) -> ShippedTable:
    """The table of that name.

    Raises:
        KeyError: None of that name is shipped.
    """
    return {each.name: each for each in tables()}[name]


def _table(model: Any) -> ShippedTable:
    name: str = model.name
    local = _LOCAL_COLUMNS.get(name, ())
    shipped: list[Any] = [column for column in model.columns if column.name not in local]
    columns = tuple(str(column.name) for column in shipped)
    comments: dict[str, str] = {column.name: column.comment or "" for column in shipped}

    def column_of(owner: str) -> str | None:
        named = "id" if name == owner else f"{owner}_id"
        return named if named in columns else None

    return ShippedTable(
        name=name,
        key=tuple(column.name for column in model.primary_key.columns),
        columns=columns,
        types=tuple(_TYPES[str(column.type)] for column in shipped),
        json_columns=frozenset(
            each for each in columns if comments[each].startswith("JSON") or each == "replaced"
        ),
        json_values=frozenset(each for each in columns if comments[each].startswith("JSON value")),
        nullable=frozenset(column.name for column in shipped if column.nullable),
        lasting=frozenset(
            column.name
            for column in shipped
            if any(key.ondelete == "SET NULL" for key in column.foreign_keys)
        ),
        is_appended=name in _DATED + CHUNKS,
        time_column="wall_time_s" if name in _DATED else None,
        run_column=column_of("run"),
        session_column=column_of("session"),
        outlasts_runs=name in _OF_TRIALS,
    )


@dataclass(frozen=True)
class Batch:
    """Rows in the order of the table's columns: JSON is text, a flag 0 or 1."""

    table: ShippedTable
    rows: Sequence[PoolRow]


def batches(table: ShippedTable, rows: Iterable[PoolRow]) -> Iterator[Batch]:
    """Rows as batches of bounded size; a row that is larger by itself is a batch of its own."""
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
    """About how many bytes of memory a row's values take."""
    sized = sum([len(value) for value in row if isinstance(value, (str, bytes))])
    return sized + _VALUE_BYTES * len(row)


def fitted(batch: Batch, replaced: Counter[str]) -> Batch:
    """The rows with values of the types of their columns, where SQLite may hold any.

    Args:
        batch: As it was read.
        replaced: Counts by column (`log.message`) the values in whose place is what comes nearest.
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
    """The value of a type that comes nearest to one that SQLite holds."""
    least = None if nullable else kind()
    if value is None or isinstance(value, kind):
        return value
    if kind is str:
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    if kind is bytes:
        return least
    try:
        number = float(value)
    except ValueError:
        return least
    if kind is float:
        return number
    return int(number) if math.isfinite(number) and abs(number) < 2**63 else least


# -- how far ----------------------------------------------------------------------------------


def whole_runs(run_ids: Iterable[int]) -> dict[str, int]:
    """Numbers of the progress that say of these runs: they are over, and all of them is there."""
    numbers: dict[str, int] = {}
    for run_id in run_ids:
        name = _WHOLE.format(run_id // _RUNS_IN_NUMBER)
        numbers[name] = numbers.get(name, 0) | 1 << run_id % _RUNS_IN_NUMBER
    return numbers


def is_whole(progress: Mapping[str, int], run_id: int) -> bool:
    """Whether the progress says so of a run."""
    number = progress.get(_WHOLE.format(run_id // _RUNS_IN_NUMBER), 0)
    return bool(number >> run_id % _RUNS_IN_NUMBER & 1)


# -- what an engine does ----------------------------------------------------------------------


class Shipment(Protocol):
    """One recording's part of a pool, which one shipper at a time writes."""

    def progress(self) -> dict[str, int]:
        """The numbers that `write` left, by names that the shipper chose; empty at first."""
        ...

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Of these runs, those that another recording has shipped, with that one's UUID."""
        ...

    def write_picture(self, path: str, content: bytes) -> None:
        """Keep a picture under the path that its row in `image` names, in the place of another.

        It is whole and there, at the latest, when the `write` that follows has returned.
        """
        ...

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Mapping[str, int]:
        """Write fitted rows, and change these numbers of the progress: all of it or nothing.

        Rows of appended tables come once. A row of another table replaces the row of its key, but
        where a column of `ShippedTable.lasting` is null, the value stays. Rows that are missing
        from the batch stay too, since retention at the edge deletes what a pool keeps. Batches may
        name a table twice; what a row refers to comes before it.

        Returns:
            By column (`log.message`), how many values the pool cannot hold as they are: it has what
            comes nearest, or null.

        Raises:
            PoolUnavailableError: Worth trying again; nothing was written.
            PoolError: It will not be better by itself.
        """
        ...


class Pool(Protocol):
    """A pool, shipped to or read; a context manager, connected as long as it is open.

    `run.purged_rows` is as the edge last said it: how many states a pool lacks is counted.

    Attributes:
        address: Its URL without secrets: for messages, logs and the file of what was shipped.
    """

    address: str

    def __enter__(self) -> Pool:
        """Connect; who ships makes the tables where there are none.

        Raises:
            PoolUnavailableError: Nobody answers there now.
            PoolError: It is no pool that can be used, or of another version.
        """
        ...

    def __exit__(self, *exception: object) -> None:
        """Disconnect; what was not written is gone."""
        ...

    def shipment(self, recording_uuid: str) -> AbstractContextManager[Shipment]:
        """Be the one who ships this recording, to a pool that was opened for it.

        Raises:
            PoolBusyError: Another does.
        """
        ...

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """The columns `LISTED` of all rows of such a table, behind their recording's UUID."""
        ...

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped, as `Shipment.progress` tells it."""
        ...

    def rows(
        self, recording_uuid: str, table: ShippedTable, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows whose columns have one of these values, in any order."""
        ...

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """A picture that was shipped, by the path in its row."""
        ...

    def select(self, sql: str, max_rows: int) -> Result:
        """The first rows of one SELECT, which cannot write, before a deadline; see `query_sql`."""
        ...


# -- what may be shown of a URL ---------------------------------------------------------------


def redacted(url: str) -> str:
    """A URL as it may be shown: without a password and without whatever looks like a secret."""
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
    """What comes before and after the question mark, which is not the one of a password."""
    user, at, _ = rest.partition("@")
    end = rest.find("?", len(user) if at and "/" not in user else 0)
    return (rest, "", "") if end < 0 else (rest[:end], "?", rest[end + 1 :])


def require_no_secret(url: str) -> None:
    """Refuse a URL with a password or a key in it.

    Raises:
        InvalidInputError: It holds one.
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
