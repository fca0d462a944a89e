"""Rows as Arrow and as files of Parquet: one schema for each table, whatever its rows hold."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Final

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError
from webots_mcp.naming import unit_in
from webots_mcp.plugins.pool.parquet.layout import CHUNK
from webots_mcp.plugins.pool.parquet.packages import package
from webots_mcp.plugins.pool.row_batch import Row, nearest
from webots_mcp.plugins.pool.shipped_tables import SQLValue, Table

_APPENDED_GROUP_ROWS: Final = 20_000
_CHANGING_GROUP_ROWS: Final = 4_000  # those of many files are read side by side
_VALUES_LEVEL: Final = 9  # of zstd: 97 bytes a row of 39 numbers instead of 128, in 6 us
_ROWS_AT_ONCE: Final = 1000
_MOST_BYTES: Final = 1_000_000_000  # in memory, of a file that is read as a whole
_FINE: Final[dict[type, frozenset[type]]] = {
    int: frozenset({int, type(None)}),
    float: frozenset({int, float, type(None)}),
    str: frozenset({str, type(None)}),
    bytes: frozenset({bytes, type(None)}),
}


@cache
def schema_of(table: Table) -> Any:
    """The Arrow schema of a table: what its columns mean, and their units, is in the fields.

    A column without a value has its type in each file, so that engines can put files together.
    """
    arrow = package("pyarrow")

    types = {int: arrow.int64(), float: arrow.float64(), str: arrow.string(), bytes: arrow.binary()}
    comments = _comments(table.name)
    fields = [
        arrow.field(
            name, types[kind], nullable=name not in table.key, metadata=_told(table, name, comments)
        )
        for name, kind in zip(table.columns, table.types, strict=True)
    ]
    about = {"webots_mcp.table": table.name, "webots_mcp.connection": str(SCHEMA_VERSION)}
    return arrow.schema(fields, metadata=about)


def _comments(table: str) -> dict[str, str]:
    from webots_mcp.store.models import SQLModel

    columns = SQLModel.metadata.tables[table].columns
    return {str(each.name): str(each.comment) for each in columns if each.comment}


def _told(table: Table, name: str, comments: Mapping[str, str]) -> dict[str, str]:
    unit = unit_in(name) if table.types[table.columns.index(name)] is float else None
    holds = "json" if name in table.json_columns else None
    told = {"comment": comments.get(name), "unit": unit, "holds": holds}
    return {key: value for key, value in told.items() if value is not None}


def as_arrow(table: Table, rows: Sequence[Row], altered: Counter[str]) -> Any:
    """Rows as an Arrow table. What its column cannot hold becomes what comes nearest, or null.

    Args:
        table: Of the rows.
        rows: With whatever SQLite holds.
        altered: Counts the values of which that is so, by column (`log.message`).
    """
    arrow = package("pyarrow")

    schema = schema_of(table)
    columns = [*zip(*rows, strict=True)] or [()] * len(table.columns)
    kinds = zip(columns, table.types, schema, strict=True)
    arrays = [_array(table, values, kind, field, altered) for values, kind, field in kinds]
    return arrow.table(arrays, schema=schema)


def _array(
    table: Table, values: Sequence[SQLValue], kind: type, field: Any, altered: Counter[str]
) -> Any:
    arrow = package("pyarrow")

    if set(map(type, values)) <= _FINE[kind]:
        try:
            return arrow.array(values, type=field.type)
        except (ValueError, OverflowError):  # a lone surrogate; an integer no double has
            pass
    held = [nearest(value, kind, nullable=True) for value in values]
    pairs = zip(held, values, strict=True)
    altered[f"{table.name}.{field.name}"] += sum(
        new is not old and new != old for new, old in pairs
    )
    return arrow.array(held, type=field.type)


def encoded(table: Table, arrow_table: Any) -> bytes:
    """The rows as one file of Parquet.

    JSON differs from row to row, and so do measured values: a dictionary is no use for either.
    """
    sink = io.BytesIO()
    options: dict[str, Any] = {"use_dictionary": False, "compression_level": _VALUES_LEVEL}
    if table.name != CHUNK:
        alike = [name for name in table.columns if name not in table.json_columns]
        group_rows = _APPENDED_GROUP_ROWS if table.time_column else _CHANGING_GROUP_ROWS
        options = {"use_dictionary": alike, "row_group_size": group_rows}
    package("pyarrow.parquet").write_table(arrow_table, sink, compression="zstd", **options)
    return sink.getvalue()


def decoded(table: Table, content: bytes, path: str, count: int | None = None) -> Any:
    """The first rows of a file, or all; columns that it lacks are null.

    Raises:
        PoolError: The file is none, is damaged, or holds more than a shipper writes into one.
    """
    pieces: list[Any] = []
    rows = size = 0
    for piece in pieces_of(table, content, path):
        pieces.append(piece)
        rows, size = rows + piece.num_rows, size + piece.nbytes
        if size > _MOST_BYTES:
            raise PoolError(
                f"{path} unpacks to more than {_MOST_BYTES:,} bytes, which no file that was "
                "shipped does: restore or remove it"
            )
        if count is not None and rows >= count:
            break
    held = package("pyarrow").concat_tables(pieces)
    return held if count is None else held.slice(0, count)


def footer_of(file: Any, path: str) -> Any:
    """What the end of a file tells of its rows.

    Raises:
        PoolError: The file is none, or is damaged.
    """
    with _clear_damage(path):
        return package("pyarrow.parquet").read_metadata(file)


@contextmanager
def _clear_damage(path: str) -> Generator[None]:
    try:
        yield
    except package("pyarrow").ArrowException as error:
        raise PoolError(f"{path} is damaged ({error}): restore or remove it") from error


def conformed(table: Table, held: Any) -> Any:
    """The columns of the table, in their order; those of signals are what they are."""
    if table.name == CHUNK:
        return held
    arrow = package("pyarrow")
    schema = schema_of(table)
    arrays = [
        held.column(field.name).cast(field.type)
        if field.name in held.column_names
        else arrow.nulls(held.num_rows, field.type)
        for field in schema
    ]
    return arrow.table(arrays, schema=schema)


def joined(first: Any, second: Any) -> Any:
    """The rows of both, one after the other."""
    arrow = package("pyarrow")

    return arrow.concat_tables([first, second], promote_options="default").combine_chunks()


def replaced(table: Table, held: Any | None, rows: Iterable[Row], altered: Counter[str]) -> Any:
    """What a table that changes holds when these rows have come, in the order of its key.

    A row replaces the one of its key, but a null of `Table.lasting` does not replace a value.
    `altered` is that of `as_arrow`.
    """
    new = _newest(table, held, rows)
    added = as_arrow(table, new, altered)
    if held is not None:
        keys = added.select(list(table.key))
        kept = held.join(keys, keys=list(table.key), join_type="left anti")
        added = joined(conformed(table, kept), added)
    return added.sort_by([(name, "ascending") for name in table.key])


def _newest(table: Table, held: Any | None, rows: Iterable[Row]) -> list[Row]:
    """The last row of each key, with the values that last."""
    key = [table.columns.index(name) for name in table.key]
    lasting = [table.columns.index(name) for name in table.lasting]
    found: dict[Row, Row] = {}
    if lasting and held is not None:
        columns = [held.column(name).to_pylist() for name in table.columns]
        found = {tuple(row[at] for at in key): row for row in zip(*columns, strict=True)}
    new: dict[Row, Row] = {}
    for row in rows:
        named = tuple(row[at] for at in key)
        before = new.get(named) or found.get(named)
        new[named] = _lasting(row, before, lasting) if before else row
    return list(new.values())


def _lasting(row: Row, before: Row, lasting: Collection[int]) -> Row:
    kept = {at: before[at] for at in lasting if row[at] is None}
    return tuple(kept.get(at, value) for at, value in enumerate(row)) if kept else row


def span(footer: Any, name: str) -> tuple[int, int] | None:
    """The least and the largest value of a column of whole numbers; None where it is not told."""
    names: list[str] = footer.schema.names
    if name not in names:
        return None
    groups = [footer.row_group(number) for number in range(footer.num_row_groups)]
    told = [group.column(names.index(name)).statistics for group in groups]
    if not told or not all(each is not None and each.has_min_max for each in told):
        return None
    return min(each.min for each in told), max(each.max for each in told)


def pieces_of(table: Table, content: bytes, path: str) -> Iterator[Any]:
    """The rows of a file, so many at a time: the others stay compressed. First none of them.

    Raises:
        PoolError: As `decoded`.
    """
    arrow, parquet = package("pyarrow"), package("pyarrow.parquet")
    with _clear_damage(path):
        file = parquet.ParquetFile(arrow.BufferReader(content))
        yield conformed(table, file.schema_arrow.empty_table())
        for piece in file.iter_batches(batch_size=_ROWS_AT_ONCE):
            yield conformed(table, arrow.Table.from_batches([piece]))


def as_rows(table: Table, held: Any) -> Iterator[Row]:
    """Rows with the values that SQLite holds."""
    for first in range(0, held.num_rows, _ROWS_AT_ONCE):
        some = held.slice(first, _ROWS_AT_ONCE)
        yield from zip(*(some.column(name).to_pylist() for name in table.columns), strict=True)
