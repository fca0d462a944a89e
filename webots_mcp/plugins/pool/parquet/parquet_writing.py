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
    footer_of,
    joined,
    replaced,
    span,
)
from webots_mcp.plugins.pool.parquet.layout import (
    LEASE,
    RUNS,
    appended_file,
    by_block,
    by_day,
    files_of,
    folder_of,
    picture_file,
    values_file,
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
from webots_mcp.plugins.pool.parquet.value_columns import (
    Named,
    columns_of,
    encoded_columns,
    read_columns,
)
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
        self._spans: dict[str, tuple[int, int] | None] = {}
        self._named: dict[int, Named] = {}

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
        for table, rows in _by_table(batches):
            if table.name == "run":
                self._claim(table, rows)
            if table.name == "chunk":
                told = told.with_part(table.name, self._append_values(rows))
            elif table.time_column:
                told = told.with_part(table.name, self._append(table, rows))
            else:
                self._replace(table, rows)
        if told != self._progress:
            self._lease.require_mine()
            place_progress(self._storage, self._uuid, told)
        self._progress = told
        self._is_settled = True
        return +self._altered

    def _append(self, table: Table, rows: Iterable[Row]) -> Part:
        """Add the rows that are not there yet to the open part; what it is then."""
        part = self._progress.part(table.name)
        new = self._absent(table, {int(str(row[0])): row for row in rows}, part)
        counts, is_over = dict(part.rows), False
        for day, added in by_day(table, (new[row_id] for row_id in sorted(new))).items():
            path = self._path(appended_file(table, day, part.number))
            held = self._held(table, path) if day in counts else None
            is_over |= self._place_part(table, path, held, added)
            counts[day] = counts.get(day, 0) + len(added)
        last_id = max(part.last_id, *new) if new else part.last_id
        if is_over:
            return Part(part.number + 1, {}, last_id)
        return Part(part.number, counts, last_id)

    def _append_values(self, chunks: Iterable[Row]) -> Part:
        """Add whole groups of chunks to the open part, as columns; what it is then."""
        part = self._progress.part("chunk")
        counts, is_over = dict(part.rows), False
        for run_id, of_run in _by_run(chunks).items():
            path = self._path(values_file(run_id, part.number))
            content = self._storage.read(path) if str(run_id) in counts else None
            held = None if content is None else read_columns(content, path)
            whole = columns_of(of_run, self._signals(of_run), self._altered, held)
            if whole is None:
                continue
            content = encoded_columns(whole)
            self._place(path, content)
            share = 1 - counts.get(str(run_id), 0) / max(1, whole.num_rows)
            is_over |= _is_over(len(content), whole.nbytes, share)
            counts[str(run_id)] = whole.num_rows
        return Part(part.number + 1) if is_over else Part(part.number, counts)

    def _signals(self, chunks: Iterable[Row]) -> Mapping[int, Named]:
        """How the signals of chunks are called, which were shipped before them."""
        at = table("chunk").columns.index("signal_id")
        if any(int(str(row[at])) not in self._named for row in chunks if int(str(row[at])) > 0):
            signals = table("signal")
            for path in self._storage.find(files_of(signals, self._uuid)):
                held = self._held(signals, path)
                for row in [] if held is None else held.to_pylist():
                    self._named[row["id"]] = Named(str(row["name"]), str(row["kind"]))
        return self._named

    def _absent(self, table: Table, rows: dict[int, Row], part: Part) -> dict[int, Row]:
        """Without the rows that are there: those of a kept stretch come before the others."""
        late = [row_id for row_id in rows if row_id <= part.last_id]
        if not late:
            return rows
        first, last = min(late), max(late)
        for path in self._storage.find(files_of(table, self._uuid)):
            ids = self._span(path)
            if ids is None or (ids[0] <= last and first <= ids[1]):
                for row_id in self._ids(path):
                    rows.pop(row_id, None)
        return rows

    def _span(self, path: str) -> tuple[int, int] | None:
        if path not in self._spans:
            with self._storage.opened(path) as file:
                self._spans[path] = span(footer_of(file, path), "id")
        return self._spans[path]

    def _ids(self, path: str) -> list[int]:
        with self._storage.opened(path) as file:
            held = package("pyarrow.parquet").ParquetFile(file).read(columns=["id"])
            return held.column("id").to_pylist()

    def _place_part(self, table: Table, path: str, held: Any | None, added: list[Row]) -> bool:
        """Put a file in its own place with these rows behind its own; whether it is large."""
        whole = as_arrow(table, added, self._altered)
        whole = whole if held is None else joined(held, whole)
        content = encoded(table, whole)
        self._place(path, content)
        return _is_over(len(content), whole.nbytes, len(added) / whole.num_rows)

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
        self._spans.pop(path, None)
        self._storage.place(path, content)

    def _settle(self) -> None:
        """Take out what was placed and never counted."""
        for table in tables():
            if table.time_column:
                part = self._progress.part(table.name)
                for path in self._storage.find(self._path(appended_file(table, "*", part.number))):
                    self._settle_file(table, path, part.counted(path) or 0)
        part = self._progress.part("chunk")
        for path in self._storage.find(self._path(values_file("*", part.number))):
            self._settle_values(path, part.counted(path) or 0)

    def _settle_file(self, table: Table, path: str, count: int) -> None:
        if count == 0:
            self._storage.remove(path)
            return
        held = self._held(table, path)
        if held is not None and held.num_rows > count:
            self._place(path, encoded(table, held.slice(0, count)))

    def _settle_values(self, path: str, count: int) -> None:
        content = self._storage.read(path) if count else None
        if content is None:
            return self._storage.remove(path)
        held = read_columns(content, path)
        if held.num_rows > count:
            self._place(path, encoded_columns(held.slice(0, count)))

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


def _is_over(file_bytes: int, memory_bytes: int, added_share: float) -> bool:
    is_seldom_more = file_bytes > _SMALL_PART_BYTES and added_share * _MOST_TIMES < 1
    return file_bytes > PART_BYTES or memory_bytes > _PART_MEMORY_BYTES or is_seldom_more


def _by_table(batches: Sequence[Batch]) -> Iterable[tuple[Table, list[Row]]]:
    """The rows of each table, in the order in which the tables come."""
    found: dict[Table, list[Row]] = {}
    for batch in batches:
        found.setdefault(batch.table, []).extend(batch.rows)
    # Chunks at last: their columns are called as the signals, which are there then.
    return sorted(found.items(), key=lambda each: each[0].name == "chunk")


def _by_run(chunks: Iterable[Row]) -> Mapping[int, list[Row]]:
    at, found = table("chunk").columns.index("run_id"), dict[int, list[Row]]()
    for row in chunks:
        found.setdefault(int(str(row[at])), []).append(row)
    return found
