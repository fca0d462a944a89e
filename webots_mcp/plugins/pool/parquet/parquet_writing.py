"""Shipping to a pool of Parquet files.

A `write` places files, and the progress after them: with that its rows count. Whoever is killed
between leaves rows that do not count. The next shipper takes those that never change out again
before it writes any, and those that change are replaced by themselves.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any, Final

from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.parquet.arrow_rows import (
    as_arrow,
    decoded,
    encoded,
    joined,
    replaced,
)
from webots_mcp.plugins.pool.parquet.layout import (
    CHUNK,
    LEASE,
    RUNS,
    appended_file,
    by_block,
    by_folder,
    files_of,
    folder_of,
    is_cut,
    picture_file,
)
from webots_mcp.plugins.pool.parquet.lease import Lease
from webots_mcp.plugins.pool.parquet.packages import package
from webots_mcp.plugins.pool.parquet.pool_state import (
    Part,
    Progress,
    make_pool,
    place_progress,
    read_progress,
    require_pool,
)
from webots_mcp.plugins.pool.parquet.storage import Storage
from webots_mcp.plugins.pool.parquet.value_columns import NameAndKind, columns_of
from webots_mcp.plugins.pool.row_batch import Batch, Row
from webots_mcp.plugins.pool.shipped_tables import Table, table, tables

# A part is over when its file is so large, or its rows in memory are, or when what comes at a time
# is so little beside it that it would be written again for almost nothing.
PART_BYTES: Final = 8_000_000
_PART_MEMORY_BYTES: Final = 64_000_000
_SMALL_PART_BYTES: Final = 1_000_000
_MOST_TIMES: Final = 16
_AT_ONCE: Final = 16  # small objects: most of it is waiting
_HALF_WRITTEN_S: Final = 3600.0


class ParquetTarget:
    """A folder, or a place on a filesystem of fsspec, that recordings are shipped to.

    Attributes:
        address: Without secrets.
    """

    def __init__(self, url: str) -> None:
        package("pyarrow")
        self._storage = Storage(url)
        self.address = self._storage.address

    def __enter__(self) -> ParquetTarget:
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def prepare(self) -> None:
        """Make the pool where there is nothing, or bring it to this version.

        Raises:
            PoolError: Other things are there, a newer version made it, or it cannot be written.
        """
        make_pool(self._storage)
        self._storage.clear(older_than_s=time.time() - _HALF_WRITTEN_S)

    @contextmanager
    def shipment(self, recording_uuid: str) -> Generator[ParquetShipment]:
        """Be the one who ships this recording.

        Raises:
            PoolBusyError: Another does.
        """
        require_pool(self._storage)
        lease = Lease(self._storage, f"{folder_of(recording_uuid)}/{LEASE}")
        lease.take()
        try:
            yield ParquetShipment(self._storage, recording_uuid, lease)
        finally:
            with suppress(PoolUnavailableError):  # it runs out by itself
                lease.give_back()


class ParquetShipment:
    """One recording's part of the pool."""

    def __init__(self, storage: Storage, recording_uuid: str, lease: Lease) -> None:
        self._storage = storage
        self._uuid = recording_uuid
        self._lease = lease
        self._progress = read_progress(storage, recording_uuid)
        self._is_settled = False
        self._own_runs: set[str] = set()
        self._altered = Counter[str]()  # in one `write`, by column
        self._named: dict[int, NameAndKind] = {}

    def progress(self) -> dict[str, int]:
        """The numbers that `write` left."""
        return dict(self._progress.numbers)

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Of these runs, those that another recording has shipped, with that one's UUID."""
        asked = [uuid for uuid in run_uuids if uuid not in self._own_runs]
        with ThreadPoolExecutor(_AT_ONCE) as workers:
            owners = dict(zip(asked, workers.map(self._owner, asked), strict=True))
        self._own_runs.update(uuid for uuid, owner in owners.items() if owner == self._uuid)
        return {uuid: owner for uuid, owner in owners.items() if owner not in ("", self._uuid)}

    def write_picture(self, path: str, content: bytes) -> None:
        """Keep a picture under the path that its row names."""
        self._lease.renew()
        self._storage.place(self._path(picture_file(path)), content)

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Counter[str]:
        """Write rows, and then these numbers of the progress; returns what was altered, by column.

        Raises:
            PoolUnavailableError: Worth trying again; rows that were placed do not count.
            PoolError: It will not be better by itself.
        """
        self._lease.renew()
        self._altered = Counter[str]()
        if not self._is_settled:
            self._settle()
        self._is_settled = False
        told = Progress({**self._progress.numbers, **progress}, self._progress.parts)
        for each, rows in _by_table(batches):
            if each.name == "run":
                self._claim(each, rows)
            if is_cut(each):
                told = told.with_part(each.name, self._append(each, rows))
            else:
                self._replace(each, rows)
        if told != self._progress:
            self._lease.require_mine()
            place_progress(self._storage, self._uuid, told)
        self._progress = told
        self._is_settled = True
        return +self._altered

    def _append(self, table: Table, rows: Iterable[Row]) -> Part:
        """Add rows to the open part of a table; what it is then."""
        part = self._progress.part(table.name)
        counts, is_over = dict(part.rows), False
        for folder, added in by_folder(table, rows).items():
            path = self._path(appended_file(table, folder, part.number))
            held = self._held(table, path) if folder in counts else None
            if table.name == CHUNK:
                whole = columns_of(added, self._signals(added), self._altered, held)
            else:
                whole = as_arrow(table, added, self._altered)
                whole = whole if held is None else joined(held, whole)
            content = encoded(table, whole)
            self._place(path, content)
            is_over |= _is_over(content, whole, counts.get(folder, 0))
            counts[folder] = whole.num_rows
        return Part(part.number + 1) if is_over else Part(part.number, counts)

    def _signals(self, chunks: Iterable[Row]) -> Mapping[int, NameAndKind]:
        """How the signals of chunks are called, which were shipped before them."""
        at = table(CHUNK).columns.index("signal_id")
        if not self._named.keys() >= {row[at] for row in chunks if int(str(row[at])) > 0}:
            signals = table("signal")
            for path in self._storage.find(files_of(signals, self._uuid)):
                held: Any = self._held(signals, path)
                rows: list[dict[str, Any]] = held.to_pylist()
                self._named |= {row["id"]: (row["name"], row["kind"]) for row in rows}
        return self._named

    def _replace(self, table: Table, rows: Iterable[Row]) -> None:
        for name, changed in by_block(table, rows).items():
            path = self._path(name)
            held = self._held(table, path)
            whole = replaced(table, held, changed, self._altered)
            if held is None or not whole.equals(held):
                self._place(path, encoded(table, whole))

    def _held(self, table: Table, path: str) -> Any | None:
        content = self._storage.read(path)
        return None if content is None else decoded(table, content, path)

    def _place(self, path: str, content: bytes) -> None:
        self._lease.renew()
        self._storage.place(path, content)

    def _settle(self) -> None:
        """Take out what was placed and never counted."""
        for each in filter(is_cut, tables()):
            part = self._progress.part(each.name)
            for path in self._storage.find(self._path(appended_file(each, "*", part.number))):
                count = part.counted(path) or 0
                held = self._held(each, path) if count else None
                if held is None:
                    self._storage.remove(path)
                elif held.num_rows > count:
                    self._place(path, encoded(each, held.slice(0, count)))

    def _claim(self, table: Table, rows: Iterable[Row]) -> None:
        """Say that the runs are this recording's, before any row of them is there."""
        at = table.columns.index("uuid")
        new = {str(row[at]) for row in rows if row[at]} - self._own_runs
        with ThreadPoolExecutor(_AT_ONCE) as workers:
            list(workers.map(self._claim_run, new))
        self._own_runs |= new

    def _claim_run(self, run_uuid: str) -> None:
        path, mine = f"{RUNS}/{run_uuid}", self._uuid.encode()
        if self._storage.create(path, mine):
            return
        owner = self._owner(run_uuid)
        if not owner:
            self._storage.place(path, mine)
        elif owner != self._uuid:
            raise PoolError(
                f"run {run_uuid} is in {self._storage.address} as one of recording {owner}: it is "
                "there once"
            )

    def _owner(self, run_uuid: str) -> str:
        return (self._storage.read(f"{RUNS}/{run_uuid}") or b"").decode("utf-8", "replace")

    def _path(self, name: str) -> str:
        return f"{folder_of(self._uuid)}/{name}"


def _is_over(content: bytes, whole: Any, rows_before: int) -> bool:
    """Whether the part that a file is in is over; so many rows were in the file before."""
    added_share = 1 - rows_before / max(1, whole.num_rows)
    is_seldom_more = len(content) > _SMALL_PART_BYTES and added_share * _MOST_TIMES < 1
    return len(content) > PART_BYTES or whole.nbytes > _PART_MEMORY_BYTES or is_seldom_more


def _by_table(batches: Sequence[Batch]) -> Iterable[tuple[Table, list[Row]]]:
    """The rows of each table, in the order in which the tables come."""
    found: dict[Table, list[Row]] = {}
    for batch in batches:
        found.setdefault(batch.table, []).extend(batch.rows)
    # Chunks at last: their columns are called as the signals, which are there then.
    return sorted(found.items(), key=lambda each: each[0].name == CHUNK)
