"""A pool of Parquet files: shipping to it, and reading it.

A `write` places files, and the progress after them: with that its rows count. Whoever is killed
between leaves rows that do not count. The next shipper takes those that never change out again
before it writes any, and those that change are replaced by themselves.
"""

from __future__ import annotations

import io
import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from itertools import chain
from typing import Any, Final

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.duckdb_statement import ask
from webots_mcp.plugins.pool.parquet_files import (
    CHUNK,
    PROGRESS,
    RUNS,
    OpenPart,
    ShippedProgress,
    ShippingLease,
    Storage,
    by_block,
    by_folder,
    decoded_progress,
    files_of,
    folder_of,
    is_cut,
    package,
    part_file,
    picture_file,
    place_progress,
    read_progress,
    require_pool,
    run_of,
    uuid_in,
)
from webots_mcp.plugins.pool.pool_interface import (
    LISTED,
    Batch,
    PoolRow,
    ShippedTable,
    batches,
    table,
    tables,
)
from webots_mcp.plugins.pool.value_columns import NameAndKind, chunks_of, columns_of
from webots_mcp.signals.naming import unit_in
from webots_mcp.store.sql import Result

# A part is over when its file is so large, or its rows in memory are, or when what comes at a time
# is so little beside it that it would be written again for almost nothing.
PART_BYTES: Final = 8_000_000
_PART_MEMORY_BYTES: Final = 64_000_000
_SMALL_PART_BYTES: Final = 1_000_000
_MOST_TIMES: Final = 16
_HALF_WRITTEN_S: Final = 3600.0
_APPENDED_GROUP_ROWS: Final = 20_000
_CHANGING_GROUP_ROWS: Final = 4_000  # those of many files are read side by side
_VALUES_LEVEL: Final = 9  # of zstd: 97 bytes a row of 39 numbers instead of 128, in 6 us
_ROWS_AT_ONCE: Final = 1000


class ParquetShipment:
    """One recording's part of the pool."""

    def __init__(self, storage: Storage, recording_uuid: str, lease: ShippingLease) -> None:
        self._storage = storage
        self._uuid = recording_uuid
        self._lease = lease
        self._progress = read_progress(storage, recording_uuid)
        self._is_settled = False
        self._own_runs: set[str] = set()
        self._damaged = Counter[str]()  # in one `write`
        self._named: dict[int, NameAndKind] = {}

    def progress(self) -> dict[str, int]:
        """The numbers that `write` left."""
        return dict(self._progress.numbers)

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Of these runs, those that another recording has shipped, with that one's UUID."""
        asked = {f"{RUNS}/{uuid}": uuid for uuid in {*run_uuids} - self._own_runs}
        found = self._storage.read_all(asked)
        owners = {asked[path]: owner.decode("utf-8", "replace") for path, owner in found}
        self._own_runs.update(uuid for uuid, owner in owners.items() if owner == self._uuid)
        return {uuid: owner for uuid, owner in owners.items() if owner not in ("", self._uuid)}

    def write_picture(self, path: str, content: bytes) -> None:
        """Keep a picture under the path that its row names."""
        self._place(self._path(picture_file(path)), content)

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        """Write rows, and then these numbers of the progress; returns how many chunks are damaged.

        Raises:
            PoolUnavailableError: Worth trying again; rows that were placed do not count.
            PoolError: It will not be better by itself.
        """
        self._lease.renew()
        self._damaged = Counter[str]()
        if not self._is_settled:
            self._settle()
        self._is_settled = False
        before = self._progress
        after = ShippedProgress({**before.numbers, **progress}, before.parts, before.listed)
        for each, rows in _by_table(batches):
            if each.name == "run":
                self._claim(each, rows)
            if is_cut(each):
                after = after.with_part(each.name, self._append(each, rows))
            else:
                after = self._replace(each, rows, after)
        if after != before:
            self._lease.require_mine()
            place_progress(self._storage, self._uuid, after)
        self._progress = after
        self._is_settled = True
        return self._damaged

    def _append(self, table: ShippedTable, rows: Iterable[PoolRow]) -> OpenPart:
        """Add rows to the open part of a table; what it is then."""
        part = self._progress.part(table.name)
        counts, is_over = dict(part.rows), False
        for folder, added in by_folder(table, rows).items():
            path = self._path(part_file(table, folder, part.number))
            held = self._held(path) if folder in counts else None
            if table.name == CHUNK:
                whole = columns_of(added, self._signals(added), self._damaged, held)
            else:
                whole = as_arrow(table, added)
                if held is not None:
                    whole = package("pyarrow").concat_tables([held, whole])
            content = encoded(table, whole)
            self._place(path, content)
            is_over |= _is_over(content, whole, counts.get(folder, 0))
            counts[folder] = whole.num_rows
        return OpenPart(part.number + 1) if is_over else OpenPart(part.number, counts)

    def _signals(self, chunks: Iterable[PoolRow]) -> Mapping[int, NameAndKind]:
        """How the signals of chunks are called, which were shipped before them."""
        at = table(CHUNK).columns.index("signal_id")
        if not self._named.keys() >= {row[at] for row in chunks if int(str(row[at])) > 0}:
            signals = table("signal")
            for path in self._storage.find(files_of(signals, self._uuid)):
                held: Any = self._held(path)
                for row in held.select(["id", "name", "kind"]).to_pylist():
                    self._named[row["id"]] = (row["name"], row["kind"])
        return self._named

    def _replace(
        self, table: ShippedTable, rows: Iterable[PoolRow], after: ShippedProgress
    ) -> ShippedProgress:
        """Put rows that change in the place of those of their keys."""
        for name, changed in by_block(table, rows).items():
            path = self._path(name)
            held = self._held(path)
            whole = as_arrow(table, _replaced(table, held, changed))
            if held is None or not whole.equals(held):
                self._place(path, encoded(table, whole))
            if table.name in LISTED:
                columns = [whole.column(each).to_pylist() for each in LISTED[table.name]]
                rows = zip(*columns, strict=True)
                after = after.with_listed(table.name, {str(row[0]): [*row] for row in rows})
        return after

    def _held(self, path: str) -> Any | None:
        content = self._storage.read(path)
        return None if content is None else _whole(content, path)

    def _place(self, path: str, content: bytes) -> None:
        self._lease.renew()
        self._storage.place(path, content)

    def _settle(self) -> None:
        """Take out what was placed and never counted."""
        for each in filter(is_cut, tables()):
            part = self._progress.part(each.name)
            for path in self._storage.find(self._path(part_file(each, "*", part.number))):
                count = part.counted(path) or 0
                held = self._held(path) if count else None
                if held is None:
                    self._storage.remove(path)
                elif held.num_rows > count:
                    self._place(path, encoded(each, held.slice(0, count)))

    def _claim(self, table: ShippedTable, rows: Iterable[PoolRow]) -> None:
        """Say that the runs are this recording's, before any row of them is there."""
        at = table.columns.index("uuid")
        for uuid in {str(row[at]) for row in rows if row[at]} - self._own_runs:
            path, mine = f"{RUNS}/{uuid}", self._uuid.encode()
            if not self._storage.create(path, mine):
                owner = (self._storage.read(path) or mine).decode("utf-8", "replace")
                if owner != self._uuid:
                    raise PoolError(
                        f"run {uuid} is in {self._storage.address} as one of recording {owner}: "
                        "it is there once"
                    )
            self._own_runs.add(uuid)

    def _path(self, name: str) -> str:
        return f"{folder_of(self._uuid)}/{name}"


class ParquetPool:
    """A folder, or a place on a filesystem of fsspec, as a pool; see `Pool`.

    Attributes:
        address: Without secrets.
    """

    def __init__(self, url: str, *, ships: bool = False) -> None:
        package("pyarrow")
        self._storage, self._ships = Storage(url), ships
        self._url = self._storage.root if self._storage.is_local else url
        self.address = self._storage.address
        self._all: dict[str, ShippedProgress] | None = None

    def __enter__(self) -> ParquetPool:
        require_pool(self._storage, make=self._ships)
        if self._ships:
            self._storage.clear(older_than_s=time.time() - _HALF_WRITTEN_S)
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    @contextmanager
    def shipment(self, recording_uuid: str) -> Generator[ParquetShipment]:
        """Be the one who ships this recording.

        Raises:
            PoolBusyError: Another does.
        """
        lease = ShippingLease(self._storage, recording_uuid)
        lease.take()
        try:
            yield ParquetShipment(self._storage, recording_uuid, lease)
        finally:
            with suppress(PoolUnavailableError):  # it runs out by itself
                lease.give_back()

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """The columns `LISTED` of all rows of such a table, behind their recording's UUID."""
        if self._all is None:
            folders = [each for each in self._storage.names() if each.startswith("recording=")]
            contents = self._storage.read_all(f"{folder}/{PROGRESS}" for folder in folders)
            self._all = {
                uuid_in(path): decoded_progress(self._storage, path, content)
                for path, content in contents
            }
        for uuid, progress in self._all.items():
            yield from ((uuid, row) for row in progress.listed.get(name, {}).values())

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped."""
        return dict(read_progress(self._storage, recording_uuid).numbers)

    def rows(
        self, recording_uuid: str, table: ShippedTable, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows whose columns have one of these values; a file is held, and a few rows of it."""
        part = read_progress(self._storage, recording_uuid).part(table.name)
        for path in self._storage.find(files_of(table, recording_uuid)):
            counted, run_id = part.counted(path) if is_cut(table) else None, run_of(path)
            if counted == 0 or run_id not in (None, *where.get("run_id", (run_id,))):
                continue
            content = self._storage.read(path)  # whole: it may be replaced by a larger one
            if content is None:
                raise PoolUnavailableError(f"{path} is gone from {self.address}: ask again")
            if table.name == CHUNK:
                held = _whole(content, path)
                counted = held.num_rows if counted is None else counted
                yield from batches(table, chunks_of(held.slice(0, counted), run_id))
            else:
                yield from batches(table, _rows(table, content, path, counted, where))

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


# -- rows as Arrow, and as files --------------------------------------------------------------


@cache
def schema_of(table: ShippedTable) -> Any:
    """The Arrow schema of a table: what its columns mean, and their units, is in the fields.

    A column without a value has its type in each file, so that engines can put files together.
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
    """Fitted rows as an Arrow table."""
    arrow, schema = package("pyarrow"), schema_of(table)
    columns = [*zip(*rows, strict=True)] or [()] * len(table.columns)
    arrays = [arrow.array(each, field.type) for each, field in zip(columns, schema, strict=True)]
    return arrow.table(arrays, schema=schema)


def encoded(table: ShippedTable, arrow_table: Any) -> bytes:
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


def _whole(content: bytes, path: str) -> Any:
    """All rows of a file.

    Raises:
        PoolError: The file is none, or is damaged.
    """
    with _clear_damage(path):
        buffer = package("pyarrow").BufferReader(content)
        return package("pyarrow.parquet").ParquetFile(buffer).read()


def _rows(
    table: ShippedTable,
    content: bytes,
    path: str,
    count: int | None,
    where: Mapping[str, Collection[int]],
) -> Iterator[PoolRow]:
    """Of the first rows of a file, or of all, those whose columns have one of these values.

    Raises:
        PoolError: As `_whole`.
    """
    arrow, dataset = package("pyarrow"), package("pyarrow.dataset")
    chosen = dataset.scalar(True)
    for name, values in where.items():
        chosen &= dataset.field(name).isin(arrow.array(values, arrow.int64()))
    with _clear_damage(path):
        fragment = dataset.ParquetFileFormat().make_fragment(arrow.BufferReader(content))
        options = {"batch_size": _ROWS_AT_ONCE, "filter": chosen if count is None else None}
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


def _replaced(table: ShippedTable, held: Any | None, rows: Iterable[PoolRow]) -> list[PoolRow]:
    """What a table that changes holds when these rows have come, in the order of its key.

    A row replaces the one of its key, but null never replaces a value in `ShippedTable.lasting`.
    """
    key = [table.columns.index(name) for name in table.key]
    lasting = [name in table.lasting for name in table.columns]
    before = [] if held is None else [held.column(name).to_pylist() for name in table.columns]
    found: dict[Any, PoolRow] = {}
    for row in chain(zip(*before, strict=True), rows):
        named = tuple(row[at] for at in key)
        old = found.get(named, row)
        pairs = zip(row, old, lasting, strict=True)
        found[named] = tuple(was if lasts and new is None else new for new, was, lasts in pairs)
    return [found[named] for named in sorted(found)]


def _is_over(content: bytes, whole: Any, rows_before: int) -> bool:
    """Whether the part that a file is in is over; so many rows were in the file before."""
    added_share = 1 - rows_before / max(1, whole.num_rows)
    is_seldom_more = len(content) > _SMALL_PART_BYTES and added_share * _MOST_TIMES < 1
    return len(content) > PART_BYTES or whole.nbytes > _PART_MEMORY_BYTES or is_seldom_more


def _by_table(batches: Sequence[Batch]) -> Iterable[tuple[ShippedTable, list[PoolRow]]]:
    """The rows of each table, in the order in which the tables come."""
    found: dict[ShippedTable, list[PoolRow]] = {}
    for batch in batches:
        found.setdefault(batch.table, []).extend(batch.rows)
    # Chunks at last: their columns are called as the signals, which are there then.
    return sorted(found.items(), key=lambda each: each[0].name == CHUNK)
