"""The rows of a pool as Arrow tables, and those as Parquet files."""

from __future__ import annotations

import io
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError
from webots_mcp.plugins.pool.parquet_files import (
    CHUNK,
)
from webots_mcp.plugins.pool.pool_interface import (
    PoolRow,
    ShippedTable,
)
from webots_mcp.plugins.pool.storage import package
from webots_mcp.signals.naming import unit_in


@dataclass(frozen=True)
class ParquetLayout:
    """The layout of Parquet files.

    Attributes:
        appended_group_rows: Rows of a group in tables that only grow.
        changing_group_rows: Rows of a group in other tables; groups of many files are read in
            parallel.
        values_level: Level of zstd: 97 bytes for a row of 39 numbers instead of 128, in 6 us.
        rows_at_once: Rows in memory while a file is searched.
    """

    appended_group_rows: int = 20_000
    changing_group_rows: int = 4_000
    values_level: int = 9
    rows_at_once: int = 1000


_LAYOUT: Final = ParquetLayout()


@cache
def schema_of(table: ShippedTable) -> Any:
    """Return the Arrow schema of a table. Its fields hold comments and units of the columns.

    A column has its type in each file even without a value, so that engines can combine files.
    """
    from webots_mcp.store.models import SQLModel

    arrow = package("pyarrow")
    types = {int: arrow.int64(), float: arrow.float64(), str: arrow.string(), bytes: arrow.binary()}
    columns = SQLModel.metadata.tables[table.name].columns
    fields: list[Any] = []
    for name, kind in zip(table.columns, table.types, strict=True):
        unit = unit_in(name) if kind is float else None
        holds = "json" if name in table.json_columns else None
        about = {"comment": columns[name].comment, "unit": unit, "holds": holds}
        metadata = {key: str(text) for key, text in about.items() if text}
        nullable = name not in table.key
        fields.append(arrow.field(name, types[kind], nullable=nullable, metadata=metadata))
    about = {"webots_mcp.table": table.name, "webots_mcp.schema": str(SCHEMA_VERSION)}
    return arrow.schema(fields, metadata=about)


def as_arrow(table: ShippedTable, rows: Sequence[PoolRow]) -> Any:
    """Return fitted rows as an Arrow table."""
    arrow, schema = package("pyarrow"), schema_of(table)
    columns = [*zip(*rows, strict=True)] or [()] * len(table.columns)
    arrays = [arrow.array(each, field.type) for each, field in zip(columns, schema, strict=True)]
    return arrow.table(arrays, schema=schema)


def encoded(table: ShippedTable, arrow_table: Any) -> bytes:
    """Return the rows as one Parquet file.

    JSON and measured values differ from row to row, so they are stored without a dictionary.
    """
    sink = io.BytesIO()
    options: dict[str, Any] = {"use_dictionary": False, "compression_level": _LAYOUT.values_level}
    if table.name != CHUNK:
        alike = [name for name in table.columns if name not in table.json_columns]
        group_rows = (
            _LAYOUT.appended_group_rows if table.time_column else _LAYOUT.changing_group_rows
        )
        options = {"use_dictionary": alike, "row_group_size": group_rows}
    package("pyarrow.parquet").write_table(arrow_table, sink, compression="zstd", **options)
    return sink.getvalue()


def whole_table(content: bytes, path: str) -> Any:
    """Return all rows of a file.

    Raises:
        PoolError: The file is damaged.
    """
    with _clear_damage(path):
        buffer = package("pyarrow").BufferReader(content)
        return package("pyarrow.parquet").ParquetFile(buffer).read()


def matching_rows(
    table: ShippedTable,
    content: bytes,
    path: str,
    count: int | None,
    where: Mapping[str, Collection[int]],
) -> Iterator[PoolRow]:
    """Yield rows whose columns have one of some values, of the first `count` rows or of all.

    Raises:
        PoolError: The file is damaged.
    """
    arrow, dataset = package("pyarrow"), package("pyarrow.dataset")
    chosen = dataset.scalar(True)
    for name, values in where.items():
        chosen &= dataset.field(name).isin(arrow.array(values, arrow.int64()))
    with _clear_damage(path):
        fragment = dataset.ParquetFileFormat().make_fragment(arrow.BufferReader(content))
        options = {"batch_size": _LAYOUT.rows_at_once, "filter": chosen if count is None else None}
        for batch in fragment.to_batches(schema=schema_of(table), **options):
            piece = arrow.Table.from_batches([batch])
            if count is not None:
                piece, count = piece.slice(0, count), max(0, count - piece.num_rows)
                piece = piece.filter(chosen)
            columns = [piece.column(name).to_pylist() for name in table.columns]
            yield from zip(*columns, strict=True)
            if count == 0:
                return


@contextmanager
def _clear_damage(path: str) -> Generator[None]:
    try:
        yield
    except package("pyarrow").ArrowException as error:
        raise PoolError(f"{path} is damaged ({error}): restore or remove it") from error
