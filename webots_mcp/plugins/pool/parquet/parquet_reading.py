"""Reading a pool of Parquet files: what is there, and the rows of a run to bring back."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

from webots_mcp.errors import PoolUnavailableError
from webots_mcp.plugins.pool.parquet.arrow_rows import as_rows, decoded, footer_of, span
from webots_mcp.plugins.pool.parquet.duckdb_statement import ask
from webots_mcp.plugins.pool.parquet.layout import (
    CHUNK,
    files_of,
    folder_of,
    is_cut,
    name_of,
    picture_file,
    run_of,
    uuid_in,
)
from webots_mcp.plugins.pool.parquet.packages import package
from webots_mcp.plugins.pool.parquet.pool_state import read_progress, require_pool
from webots_mcp.plugins.pool.parquet.storage import Storage
from webots_mcp.plugins.pool.parquet.value_columns import chunks_of
from webots_mcp.plugins.pool.row_batch import Batch, batches
from webots_mcp.plugins.pool.shipped_tables import Table, table, tables
from webots_mcp.plugins.pool.target import PooledSize
from webots_mcp.store.questions.sql import Result

_AT_ONCE: Final = 16  # footers that are read at the same time: most of it is waiting

Record = dict[str, Any]


class ParquetPool:
    """A pool in a folder, or on a filesystem of fsspec.

    Attributes:
        address: Without secrets.
    """

    keeps_order = True  # JSON is held as the text that it was

    def __init__(self, url: str) -> None:
        package("pyarrow")
        self._storage = Storage(url)
        self._url = self._storage.root if self._storage.is_local else url
        self.address = self._storage.address

    def __enter__(self) -> ParquetPool:
        require_pool(self._storage)
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def records(self, name: str) -> Iterator[tuple[str, Record]]:
        """All rows of a table that changes, each behind its recording's UUID."""
        each = table(name)
        paths = self._storage.find(files_of(each))
        with ThreadPoolExecutor(_AT_ONCE) as workers:
            for path, content in zip(paths, workers.map(self._storage.read, paths), strict=True):
                held: list[Record] = []
                if content is not None:
                    held = decoded(each, content, path).to_pylist()
                yield from ((uuid_in(path), row) for row in held)

    def sizes(self) -> Iterator[PooledSize]:
        """How much of each table there is; the end of each file is read for it."""
        for each in tables():
            files = self._storage.sizes(files_of(each))
            with ThreadPoolExecutor(_AT_ONCE) as workers:
                rows = sum(workers.map(self._row_count, files))
            yield PooledSize(name_of(each), rows, sum(files.values()))

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped."""
        return dict(read_progress(self._storage, recording_uuid).numbers)

    def rows(
        self, recording_uuid: str, table: Table, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows whose columns have one of these values."""
        part = read_progress(self._storage, recording_uuid).part(table.name)
        paths = self._storage.find(files_of(table, recording_uuid))
        with ThreadPoolExecutor(_AT_ONCE) as workers:
            footers = [*zip(paths, workers.map(self._footer, paths), strict=True)]
        for path, footer in footers:
            counted = part.counted(path) if is_cut(table) else None
            if counted != 0 and footer.num_rows and _may_hold(path, footer, where):
                content = self._storage.read(path)  # whole: it may be replaced by a larger one
                if content is None:
                    raise PoolUnavailableError(f"{path} is gone from {self.address}: ask again")
                held = decoded(table, content, path, counted)
                if table.name == CHUNK:
                    yield from batches(table, chunks_of(held, run_of(path)))
                else:
                    yield from batches(table, as_rows(table, held.filter(_filter(where))))

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """A picture that was shipped, by the path in its row."""
        return self._storage.read(f"{folder_of(recording_uuid)}/{picture_file(path)}")

    def select(self, sql: str, max_rows: int) -> Result:
        """The first rows of one SELECT of DuckDB.

        Raises:
            InvalidInputError: As `ask`.
            PoolError: DuckDB is not installed.
        """
        return ask(self._url, sql, max_rows)

    def _row_count(self, path: str) -> int:
        return int(self._footer(path).num_rows)

    def _footer(self, path: str) -> Any:
        with self._storage.opened(path) as file:
            return footer_of(file, path)


def _may_hold(path: str, footer: Any, where: Mapping[str, Collection[int]]) -> bool:
    """Whether a file may have rows with these values, by its path and what its end tells."""
    run_id = run_of(path)
    if run_id is not None and run_id not in where.get("run_id", (run_id,)):
        return False
    for name, values in where.items():
        ends = span(footer, name)
        if ends and not any(ends[0] <= value <= ends[1] for value in values):
            return False
    return True


def _filter(where: Mapping[str, Collection[int]]) -> Any:
    arrow, compute = package("pyarrow"), package("pyarrow.compute")
    chosen = compute.scalar(True)
    for name, values in where.items():
        chosen &= compute.field(name).isin(arrow.array(values, arrow.int64()))
    return chosen
