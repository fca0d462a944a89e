"""A pool of Parquet files: shipping to it, and reading it.

A `write` places files and then the progress, which makes their rows count. A shipper that is killed
in between leaves rows that do not count. The next one removes such rows of tables that never change
before it writes; rows that change are simply replaced.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.arrow_tables import as_arrow, encoded, matching_rows, whole_table
from webots_mcp.plugins.pool.duckdb_statement import ask
from webots_mcp.plugins.pool.parquet_files import (
    CHUNK,
    PROGRESS,
    RUNS,
    OpenPart,
    ShippedProgress,
    by_block,
    by_folder,
    decoded_progress,
    files_of,
    folder_of,
    is_cut,
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
from webots_mcp.plugins.pool.shipping_lease import ShippingLease
from webots_mcp.plugins.pool.storage import Storage, package
from webots_mcp.plugins.pool.value_columns import NameAndKind, chunks_of, columns_of
from webots_mcp.store.sql import SqlResult

# A part is closed when its file or its rows in memory are large, or when additions are so small in
# comparison that rewriting the file costs too much.
PART_BYTES: Final = 8_000_000
_HALF_WRITTEN_S: Final = 3600.0


@dataclass(frozen=True)
class PartSizes:
    """When a part of a table is closed. Rewriting it for small additions costs too much.

    Attributes:
        memory_bytes: Size of its rows in memory.
        small_bytes: Size from which small additions count.
        times: How many times larger than an addition the file may be.
    """

    memory_bytes: int = 64_000_000
    small_bytes: int = 1_000_000
    times: int = 16


_PARTS: Final = PartSizes()


class ParquetShipment:
    """The part of the pool of one recording; see `Shipment`."""

    def __init__(self, storage: Storage, recording_uuid: str, lease: ShippingLease) -> None:
        self._storage = storage
        self._uuid = recording_uuid
        self._lease = lease
        self._progress = read_progress(storage, recording_uuid)
        self._is_settled = False
        self._own_runs: set[str] = set()
        self._damaged = Counter[str]()  # Damaged chunks of one `write`.
        self._named: dict[int, NameAndKind] = {}

    def progress(self) -> dict[str, int]:
        """Return the numbers that `write` stored."""
        return dict(self._progress.numbers)

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Return the runs that another recording has shipped, with its UUID."""
        asked = {f"{RUNS}/{uuid}": uuid for uuid in {*run_uuids} - self._own_runs}
        found = self._storage.read_all(asked)
        owners = {asked[path]: owner.decode("utf-8", "replace") for path, owner in found}
        self._own_runs.update(uuid for uuid, owner in owners.items() if owner == self._uuid)
        return {uuid: owner for uuid, owner in owners.items() if owner not in ("", self._uuid)}

    def write_picture(self, path: str, content: bytes) -> None:
        """Store a picture under the path that its row names."""
        self._place(self._path(picture_file(path)), content)

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        """Write rows and then numbers of the progress; return the number of damaged chunks.

        Raises:
            PoolUnavailableError: A retry may succeed. Rows that were placed do not count.
            PoolError: A retry will not help.
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
        """Add rows to the open part of a table, and return the part after that."""
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
        """Return names and kinds of the signals of chunks, which were shipped before."""
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
        """Replace the rows that have changed."""
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
        return None if content is None else whole_table(content, path)

    def _place(self, path: str, content: bytes) -> None:
        self._lease.renew()
        self._storage.place(path, content)

    def _settle(self) -> None:
        """Remove rows that were placed but do not count."""
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
        """Claim runs for this recording, before any of their rows are written.

        Raises:
            PoolError: A run belongs to another recording.
        """
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
    """A folder on a disk or on a filesystem of fsspec as a pool; see `Pool`.

    Attributes:
        address: The URL without secrets.
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
        """Be the only shipper of a recording.

        Raises:
            PoolBusyError: Another process ships it.
        """
        lease = ShippingLease(self._storage, recording_uuid)
        lease.take()
        try:
            yield ParquetShipment(self._storage, recording_uuid, lease)
        finally:
            with suppress(PoolUnavailableError):  # The lease ends by itself.
                lease.give_back()

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """Yield the UUID of the recording and the columns `LISTED` of each row of a table."""
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
        """Return how far the recording was shipped."""
        return dict(read_progress(self._storage, recording_uuid).numbers)

    def rows(
        self, recording_uuid: str, table: ShippedTable, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Yield rows whose columns have one of some values, with one file in memory."""
        part = read_progress(self._storage, recording_uuid).part(table.name)
        for path in self._storage.find(files_of(table, recording_uuid)):
            counted, run_id = part.counted(path) if is_cut(table) else None, run_of(path)
            if counted == 0 or run_id not in (None, *where.get("run_id", (run_id,))):
                continue
            content = self._storage.read(path)  # At once: a larger file may replace it.
            if content is None:
                raise PoolUnavailableError(f"{path} is gone from {self.address}: ask again")
            if table.name == CHUNK:
                held = whole_table(content, path)
                counted = held.num_rows if counted is None else counted
                yield from batches(table, chunks_of(held.slice(0, counted), run_id))
            else:
                yield from batches(table, matching_rows(table, content, path, counted, where))

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """Return a picture by the path in its row; None if it was not shipped."""
        return self._storage.read(f"{folder_of(recording_uuid)}/{picture_file(path)}")

    def select(self, sql: str, max_rows: int) -> SqlResult:
        """Return the first rows of one SELECT of DuckDB.

        Raises:
            InvalidInputError: It is no single SELECT, is wrong, or takes too much time or memory.
            PoolError: DuckDB is not installed.
        """
        return ask(self._url, sql, max_rows)


def _replaced(table: ShippedTable, held: Any | None, rows: Iterable[PoolRow]) -> list[PoolRow]:
    """Return all rows of a table after some of them have changed, in the order of the key.

    A row replaces the row of its key, but null never replaces a value in `ShippedTable.lasting`.
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
    """Return whether the part of a file that had `rows_before` rows has to be closed."""
    added_share = 1 - rows_before / max(1, whole.num_rows)
    is_seldom_more = len(content) > _PARTS.small_bytes and added_share * _PARTS.times < 1
    return len(content) > PART_BYTES or whole.nbytes > _PARTS.memory_bytes or is_seldom_more


def _by_table(batches: Sequence[Batch]) -> Iterable[tuple[ShippedTable, list[PoolRow]]]:
    """Return the rows of each table, in the order of the batches, with chunks last."""
    found: dict[ShippedTable, list[PoolRow]] = {}
    for batch in batches:
        found.setdefault(batch.table, []).extend(batch.rows)
    # Columns of chunks are named after signals, which have to be written before.
    return sorted(found.items(), key=lambda each: each[0].name == CHUNK)
