"""The rows of an export as a Parquet file, through the extra `parquet` (pyarrow)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from itertools import islice
from typing import Any, BinaryIO, Final

from webots_mcp.analysis.arrays import np
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.requirements import install_line
from webots_mcp.store.chunk_table import ColumnCells
from webots_mcp.store.export import (
    Column,
    ColumnKind,
    ExportTable,
    FlatRow,
    StateTable,
    as_text,
)

_GROUP_ROWS: Final = 10_000  # About 10 MB of rows in memory at a time.


def write_parquet(source: ExportTable, sink: BinaryIO) -> None:
    """Write one column per dotted name: int64, double (NaN for invalid numbers), bool or text.

    A long array of numbers is a list of doubles. A column of several types is text.

    Raises:
        InvalidInputError: pyarrow is not installed.
    """
    arrow, parquet = _pyarrow()
    by_column = source.by_column() if isinstance(source, StateTable) else None
    columns = [each for _, each in by_column.columns] if by_column else source.columns()
    types = {
        "null": arrow.null(), "bool": arrow.bool_(), "int": arrow.int64(),
        "num": arrow.float64(), "text": arrow.string(), "numbers": arrow.list_(arrow.float64()),
    }  # fmt: skip
    schema = arrow.schema(
        [(column.name, types[column.kind]) for column in (*source.head, *columns)]
    )
    with parquet.ParquetWriter(sink, schema, compression="zstd") as writer:
        if by_column is not None:
            for head, cells in by_column.slices(_GROUP_ROWS):
                arrays = [*head, *map(partial(_array, arrow), cells, columns)]
                writer.write_table(arrow.table(arrays, schema=schema))
            return
        rows = source.rows(pass_number=2)
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


def _array(arrow: Any, cells: ColumnCells, column: Column) -> Any:
    """Return the cells of a column as an Arrow array."""
    if column.kind == "null":
        return arrow.nulls(len(cells.is_null))
    if column.kind == "text":
        texts = arrow.array(cells.labels or [""], arrow.string())
        places = arrow.array(cells.values.astype(np.int32), mask=cells.is_null)
        return arrow.DictionaryArray.from_arrays(places, texts).cast(arrow.string())
    return arrow.array(cells.values, mask=cells.is_null)


def _values(group: list[FlatRow], column: Column) -> list[Any]:
    convert = _CONVERSIONS.get(column.kind)
    values = [row.values.get(column.name) for row in group]
    return values if convert is None else [v if v is None else convert(v) for v in values]


# Arrow refuses an integer that a double cannot hold exactly.
_CONVERSIONS: Final[dict[ColumnKind, Callable[[Any], object]]] = {
    "text": as_text,
    "num": float,
    "numbers": lambda items: [*map(float, items)],
}
