"""Rows as Parquet, through the extra `parquet` (pyarrow)."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from itertools import islice
from typing import Any, BinaryIO, Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.requirements import install_line
from webots_mcp.store.export_rows import Column, ColumnKind, Row, Table, as_text

_GROUP_ROWS: Final = 10_000  # about 10 MB of rows in memory at a time


def write_parquet(source: Table, sink: BinaryIO) -> None:
    """One column per dotted name: int64, double (NaN where a value was not a number), bool, text.

    A long array of numbers is a list of doubles; a column of several kinds is text.

    Raises:
        InvalidInputError: pyarrow is not installed.
    """
    arrow, parquet = _pyarrow()
    columns = source.columns()
    types = {
        "null": arrow.null(), "bool": arrow.bool_(), "int": arrow.int64(),
        "num": arrow.float64(), "text": arrow.string(), "numbers": arrow.list_(arrow.float64()),
    }  # fmt: skip
    schema = arrow.schema(
        [(column.name, types[column.kind]) for column in (*source.head, *columns)]
    )
    rows = source.rows(pass_number=2)
    with parquet.ParquetWriter(sink, schema, compression="zstd") as writer:
        while group := list(islice(rows, _GROUP_ROWS)):
            arrays = [*zip(*(row.head for row in group), strict=True)]
            arrays += [_values(group, column) for column in columns]
            writer.write_table(arrow.table(arrays, schema=schema))


def _pyarrow() -> tuple[Any, Any]:
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise InvalidInputError(
            f"a Parquet file needs pyarrow: {install_line(['pyarrow'])}; or export as csv or jsonl"
        ) from error


def _values(group: list[Row], column: Column) -> list[Any]:
    convert = _CONVERSIONS.get(column.kind)
    values = [row.values.get(column.name) for row in group]
    return values if convert is None else [v if v is None else convert(v) for v in values]


# Arrow refuses an integer that a double cannot hold exactly.
_CONVERSIONS: Final[dict[ColumnKind, Callable[[Any], object]]] = {
    "text": as_text,
    "num": float,
    "numbers": lambda items: [*map(float, items)],
}
