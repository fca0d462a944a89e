"""Rows as Arrow and as files of Parquet: one schema for each table, whatever its rows hold."""

from __future__ import annotations

import io
import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any, Final

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.naming import unit_in
from webots_mcp.plugins.pool.duckdb_statement import ask
from webots_mcp.plugins.pool.parquet_files import (
    CHUNK,
    LEASE,
    RUNS,
    Lease,
    Part,
    Progress,
    Storage,
    appended_file,
    by_block,
    by_folder,
    files_of,
    folder_of,
    is_cut,
    make_pool,
    name_of,
    package,
    picture_file,
    place_progress,
    read_progress,
    require_pool,
    run_of,
    uuid_in,
)
from webots_mcp.plugins.pool.pool_interface import (
    Batch,
    PooledSize,
    Row,
    SQLValue,
    Table,
    batches,
    nearest,
    table,
    tables,
)
from webots_mcp.plugins.pool.value_columns import NameAndKind, chunks_of, columns_of
from webots_mcp.store.questions.sql import Result

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


# Shipping to a pool of Parquet files.
#
# A `write` places files, and the progress after them: with that its rows count. Whoever is killed
# between leaves rows that do not count. The next shipper takes those that never change out again
# before it writes any, and those that change are replaced by themselves.


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


# Reading a pool of Parquet files: what is there, and the rows of a run to bring back.


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
