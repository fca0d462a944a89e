"""The files of a pool of Parquet, in a folder or on any filesystem that fsspec knows.

    _pool                                       what this is, and of which version
    _runs/UUID                                  the recording that a run belongs to
    recording=UUID/_progress                    written last: what it says is there, is there
    recording=UUID/_lease                       who ships this recording
    recording=UUID/_pictures/PATH
    recording=UUID/table=NAME/day=YYYY-MM-DD/part-NUMBER.parquet    rows that never change
    recording=UUID/table=NAME/part-BLOCK.parquet                    rows that change
    recording=UUID/table=value/run=ID/part-NUMBER.parquet           a column for each signal

A file is replaced as a whole, by itself with more rows. So whoever reads `*.parquet` while somebody
ships sees each row once or, for a moment, not yet. Engines pass over names that begin with `_`.

Rows that never change are in the part that was open when they came, and stay there: a part is over
once it is large. The progress says which one is open and how many rows of its files count: rows
beyond are those of a shipper that was killed. Rows that change are in blocks of ids. The progress
lists the runs and trial sets as well: to list those of a pool, one small file of each recording is
read.
"""

from __future__ import annotations

import errno
import json
import os
import posixpath
import time
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timedelta, timezone
from glob import escape
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import Any, Final, cast
from uuid import uuid4

from webots_mcp.contract import SCHEMA_VERSION, host_name
from webots_mcp.database.files import make_folder
from webots_mcp.database.liveness import process_identity
from webots_mcp.errors import (
    InvalidInputError,
    PoolBusyError,
    PoolError,
    PoolUnavailableError,
    WebotsMCPError,
)
from webots_mcp.extras.requirements import explain_extra, install_line
from webots_mcp.plugins.pool.pool_interface import PoolRow, ShippedTable, SQLValue, redacted

FORMAT: Final = 2
POOL: Final = "_pool"
RUNS: Final = "_runs"
PROGRESS: Final = "_progress"
LEASE: Final = "_lease"
CHUNK: Final = "chunk"
VALUES: Final = "value"  # in the place of chunks a table with a column for each signal
NO_DAY: Final = "__HIVE_DEFAULT_PARTITION__"  # read as null by engines
LEASE_S: Final = 60.0

_AT_ONCE: Final = 16
_EXTRA: Final = ("pyarrow", "fsspec")
_PUT_WHOLE: Final = frozenset(
    {"memory", "s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oci", "oss", "hf"}
)
_INCOMING: Final = "_incoming"  # what is written, before it is moved to its place
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSED: Final = (errno.EACCES, errno.EPERM, errno.EROFS)
_NOT_A_FOLDER: Final = (errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)
# One that ends later was taken before a clock was set back. It is not one lease from now: it may
# be renewed after this host looked at its clock, and the clock of the other host may be ahead.
_LATEST_S: Final = 2 * LEASE_S
_RENEW_AFTER_S: Final = 15.0
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=timezone.utc)
_IDS_IN_BLOCK: Final = 4096


def package(name: str) -> Any:
    """A module of a package of the extra `parquet`, or of DuckDB; they have no types.

    Raises:
        PoolError: It is not installed; the text says what to install.
    """
    try:
        return import_module(name)
    except ImportError as error:
        whose = name.partition(".")[0]
        if whose in _EXTRA:
            raise PoolError(explain_extra("a pool of Parquet files", "parquet")) from error
        asked = f"a SELECT over a pool of Parquet files needs {whose}"
        raise PoolError(f"{asked}: {install_line([whose])}") from error


# -- storage ----------------------------------------------------------------------------------


class Storage:
    """Objects below the root, placed as a whole or not at all; paths are relative to it, with `/`.

    In a folder an object is written beside and moved to its place; object stores do as much with a
    single put. Other filesystems are as atomic as their rename is.

    Each method raises PoolUnavailableError where the filesystem does not answer or has no room,
    and PoolError where it refuses.

    Attributes:
        address: The root without secrets.
        files: The filesystem, as other libraries take it.
        root: The root as that filesystem names it.
        is_local: Whether it is a folder of this machine.
    """

    def __init__(self, url: str) -> None:
        self.files, self.root = _filesystem(url)
        named: str | tuple[str, ...] = self.files.protocol
        protocols = {named} if isinstance(named, str) else set(named)
        self.is_local = bool({"file", "local"} & protocols)
        self.address = self.root if self.is_local else redacted(url)
        self._puts_whole = bool(_PUT_WHOLE & protocols)

    def full(self, path: str) -> str:
        """A path as the filesystem names it."""
        return f"{self.root.rstrip('/')}/{path}" if path else self.root

    def url_of(self, path: str) -> str:
        """An object as other libraries name it."""
        full = self.full(path)
        return full if self.is_local else str(self.files.unstrip_protocol(full))

    def read(self, path: str) -> bytes | None:
        """The content of an object; None where there is none."""
        with self._answering(path):
            try:
                return self.files.cat_file(self.full(path))
            except FileNotFoundError:
                return None

    def read_all(self, paths: Iterable[str]) -> Iterator[tuple[str, bytes]]:
        """Those of the objects that are there; most of it is waiting, so several at a time."""
        listed = [*paths]
        with ThreadPoolExecutor(_AT_ONCE) as workers:
            contents = map(self.read, listed) if self.is_local else workers.map(self.read, listed)
            for path, content in zip(listed, contents, strict=True):
                if content is not None:
                    yield path, content

    def place(self, path: str, content: bytes) -> None:
        """Put an object, in the place of another of that path."""
        with self._answering(path):
            full = self.full(path)
            if self.is_local:
                with self._written(content) as written:
                    self._make_folder(Path(full).parent)
                    written.replace(full)
            elif self._puts_whole:
                self.files.pipe_file(full, content)
            else:
                beside = self.full(f"{_INCOMING}/{uuid4().hex}")
                self.files.makedirs(posixpath.dirname(beside), exist_ok=True)
                self.files.makedirs(posixpath.dirname(full), exist_ok=True)
                self.files.pipe_file(beside, content)
                self.files.mv(beside, full)

    def create(self, path: str, content: bytes) -> bool:
        """Put an object where there is none; whether there was none.

        Of two that do so at once in a folder one is told so; elsewhere, as a rule.
        """
        if not self.is_local:
            if self.read(path) is not None:
                return False
            self.place(path, content)
            return self.read(path) == content
        with self._answering(path), self._written(content) as written:
            full = Path(self.full(path))
            self._make_folder(full.parent)
            try:
                full.hardlink_to(written)
            except FileExistsError:
                return False
            except OSError:  # no hard links there
                if full.exists():
                    return False
                written.rename(full)
        return True

    def remove(self, path: str) -> None:
        """Remove an object, which may be gone already."""
        with self._answering(path), suppress(FileNotFoundError):
            self.files.rm_file(self.full(path))

    def find(self, pattern: str) -> list[str]:
        """The paths that match, `*` being any part of one name, in their order."""
        with self._answering(pattern):
            if self.is_local:
                found = Path(self.root).glob(pattern)
                return sorted(each.relative_to(self.root).as_posix() for each in found)
            full = f"{escape(self.root.rstrip('/'))}/{pattern}"
            return sorted(map(self._relative, self.files.glob(full)))

    def names(self) -> list[str]:
        """What is right below the root."""
        with self._answering(""), suppress(FileNotFoundError):
            found = [self._relative(each) for each in self.files.ls(self.root, detail=False)]
            return [each for each in found if each not in ("", ".", _INCOMING)]
        return []

    def clear(self, older_than_s: float) -> None:
        """Remove what killed processes left half written."""
        for file in Path(self.full(_INCOMING)).glob("*") if self.is_local else ():
            with suppress(OSError):
                if file.stat().st_mtime < older_than_s:
                    file.unlink()

    def _relative(self, full: str) -> str:
        root = str(self.root).strip("/")
        return str(PurePosixPath(full.strip("/").removeprefix(root).lstrip("/")))

    def _make_folder(self, folder: Path) -> None:
        """That of the pool is its owner's alone, unless it was there."""
        if not Path(self.root).is_dir():
            make_folder(Path(self.root))
        folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def _written(self, content: bytes) -> Generator[Path]:
        """The content in a file beside the others, which is gone afterwards."""
        file = Path(self.full(f"{_INCOMING}/{uuid4().hex}"))
        self._make_folder(file.parent)
        try:
            with file.open("xb") as sink:
                sink.write(content)
                sink.flush()
                os.fsync(sink.fileno())
            yield file
        finally:
            file.unlink(missing_ok=True)

    @contextmanager
    def _answering(self, path: str) -> Generator[None]:
        where = f"{self.address} ({path})" if path else self.address
        try:
            yield
        except WebotsMCPError:  # from inside the block
            raise
        except OSError as error:
            what = error.strerror or str(error) or type(error).__name__
            if error.errno in _NO_ROOM:
                raise PoolUnavailableError(f"there is no room in {where}: {what}") from error
            if error.errno in _REFUSED or isinstance(error, PermissionError):
                raise PoolError(f"{where} cannot be used by this user: {what}") from error
            if error.errno in _NOT_A_FOLDER or isinstance(error, NotADirectoryError):
                raise PoolError(f"{where} cannot be a pool: {what}") from error
            raise PoolUnavailableError(f"{where} does not answer: {what}") from error
        except Exception as error:  # each client of an object store has its own
            raise PoolUnavailableError(f"{where} does not answer: {error}") from error


def _filesystem(url: str) -> tuple[Any, str]:
    """Of a URL or a folder.

    Raises:
        PoolError: A package is missing; the text names it.
        InvalidInputError: No filesystem is known by that name.
    """
    core = package("fsspec.core")
    try:
        # What was listed before may have changed since: others ship to the same pool.
        files, root = core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise PoolError(f"{redacted(url)} needs another package: {error}") from error
    except ValueError as error:
        raise InvalidInputError(
            f"{redacted(url)} is on no filesystem that fsspec knows: {error}"
        ) from error
    except OSError as error:
        raise PoolUnavailableError(f"{redacted(url)} does not answer: {error}") from error
    return files, str(root)


# -- which file a row is in -------------------------------------------------------------------


def folder_of(recording_uuid: str) -> str:
    """Where a recording is in the pool."""
    return f"recording={recording_uuid}"


def uuid_in(path: str) -> str:
    """The recording of a path."""
    return path.partition("/")[0].removeprefix("recording=")


def picture_file(path: str) -> str:
    """A picture, by the path in its row.

    Raises:
        PoolError: The path leads out of the folder of pictures.
    """
    parts = PurePosixPath(path).parts
    if not parts or ".." in parts or path.startswith(("/", "\\")) or "\\" in path:
        raise PoolError(f"{path!r} is no path of a picture: it leads out of the recording")
    return f"_pictures/{'/'.join(parts)}"


def name_of(table: ShippedTable) -> str:
    """What a table is called in a pool of files."""
    return VALUES if table.name == CHUNK else table.name


def is_cut(table: ShippedTable) -> bool:
    """Whether its rows never change and are in parts, of a day or of a run."""
    return table.name == CHUNK or table.time_column is not None


def part_file(table: ShippedTable, folder: str, number: int) -> str:
    """A part of a table whose rows never change."""
    return f"table={name_of(table)}/{folder}/part-{number:06}.parquet"


def files_of(table: ShippedTable, recording_uuid: str = "*") -> str:
    """The pattern of all files of a table, of one recording or of all."""
    cut = "day=*/" if table.time_column else "run=*/" if table.name == CHUNK else ""
    return f"{folder_of(recording_uuid)}/table={name_of(table)}/{cut}part-*.parquet"


def run_of(path: str) -> int | None:
    """The run of a part, where it has the rows of one only."""
    name, _, run_id = path.rpartition("/")[0].rpartition("/")[2].partition("=")
    return int(run_id) if name == "run" else None


def by_folder(table: ShippedTable, rows: Iterable[PoolRow]) -> Mapping[str, list[PoolRow]]:
    """Rows that never change by their folders: those of a day, chunks of a run."""
    place = table.columns.index(table.time_column or "run_id")
    found: dict[str, list[PoolRow]] = defaultdict(list)
    for row in rows:
        name = f"day={day_of(row[place])}" if table.time_column else f"run={row[place]}"
        found[name].append(row)
    return found


def day_of(wall_time_s: SQLValue) -> str:
    """The day in UTC, as it stands in a path; `NO_DAY` where the time is none."""
    try:
        return (_EPOCH + timedelta(seconds=cast("float", wall_time_s))).date().isoformat()
    except (TypeError, OverflowError, ValueError):  # null, or no year from 1 to 9999
        return NO_DAY


def by_block(table: ShippedTable, rows: Iterable[PoolRow]) -> Mapping[str, list[PoolRow]]:
    """Rows of a table that changes, by the files in which they are."""
    found: dict[str, list[PoolRow]] = defaultdict(list)
    for row in rows:
        block = cast("int", row[0]) // _IDS_IN_BLOCK if table.key == ("id",) else 0
        found[f"table={table.name}/part-{block:09}.parquet"].append(row)
    return found


# -- what the pool holds ----------------------------------------------------------------------


@dataclass(frozen=True)
class OpenPart:
    """The part of a table that is open: of a table whose rows never change.

    Attributes:
        number: Of the part; those before it are over.
        rows: By the folder of its files, how many rows of each count.
    """

    number: int = 1
    rows: Mapping[str, int] = field(default_factory=dict[str, int])

    def counted(self, path: str) -> int | None:
        """How many rows of a file count; None where all do."""
        folder, _, name = path.rpartition("/part-")
        number = int(name.removesuffix(".parquet"))
        if number < self.number:
            return None
        return self.rows.get(folder.rpartition("/")[2], 0) if number == self.number else 0


@dataclass(frozen=True)
class ShippedProgress:
    """What the pool holds of a recording.

    Attributes:
        numbers: As the shipper gave them.
        parts: By table.
        listed: By table and the row's id, the columns `LISTED`.
    """

    numbers: Mapping[str, int] = field(default_factory=dict[str, int])
    parts: Mapping[str, OpenPart] = field(default_factory=dict[str, OpenPart])
    listed: Mapping[str, Mapping[str, list[Any]]] = field(
        default_factory=dict[str, Mapping[str, list[Any]]]
    )

    def part(self, table: str) -> OpenPart:
        """Of a table, the first where it has no rows yet."""
        return self.parts.get(table, OpenPart())

    def with_part(self, table: str, part: OpenPart) -> ShippedProgress:
        """After rows of a table have come."""
        return replace(self, parts={**self.parts, table: part})

    def with_listed(self, table: str, rows: Mapping[str, list[Any]]) -> ShippedProgress:
        """After rows of a table that is listed have changed."""
        return replace(self, listed={**self.listed, table: {**self.listed.get(table, {}), **rows}})


def read_progress(storage: Storage, recording_uuid: str) -> ShippedProgress:
    """What the pool holds of a recording: nothing where it is new.

    Raises:
        PoolError: It cannot be read.
    """
    path = f"{folder_of(recording_uuid)}/{PROGRESS}"
    content = storage.read(path)
    return ShippedProgress() if content is None else decoded_progress(storage, path, content)


def decoded_progress(storage: Storage, path: str, content: bytes) -> ShippedProgress:
    """The progress in a file.

    Raises:
        PoolError: It cannot be read.
    """
    try:
        found: dict[str, Any] = json.loads(content)
        parts = {str(name): OpenPart(**part) for name, part in found["parts"].items()}
        numbers = {str(name): int(number) for name, number in found["numbers"].items()}
        return ShippedProgress(numbers, parts, found["listed"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise PoolError(f"{path} in {storage.address} cannot be read: {error}") from error


def place_progress(storage: Storage, recording_uuid: str, progress: ShippedProgress) -> None:
    """Say what is there: rows count from now on."""
    content = json.dumps(asdict(progress)).encode()
    storage.place(f"{folder_of(recording_uuid)}/{PROGRESS}", content)


def require_pool(storage: Storage, *, make: bool) -> None:
    """Raise unless a pool of exactly this version is there, or can be made where nothing is.

    Raises:
        PoolError: There is none, one of another version, or other things are there.
    """
    content = storage.read(POOL)
    if content is None and not make:
        raise PoolError(f"there is no pool in {storage.address}: ship a recording to it first")
    if content is None and storage.names():
        raise PoolError(
            f"{storage.address} holds other things and is no pool: name a new or empty folder"
        )
    wanted = {"format": FORMAT, "schema": SCHEMA_VERSION}
    if content is None:
        return storage.place(POOL, json.dumps(wanted).encode())
    try:
        found: dict[str, int] = {name: int(json.loads(content)[name]) for name in wanted}
    except (ValueError, TypeError, KeyError) as error:
        raise PoolError(f"{POOL} in {storage.address} cannot be read: {error}") from error
    if found != wanted:
        has, knows = (f"format {x['format']} and schema {x['schema']}" for x in (found, wanted))
        raise PoolError(
            f"the pool in {storage.address} has {has}, this webots-mcp {knows}: use one version "
            "of it, or ship the recordings anew, into another folder"
        )
    return None


# -- one shipper at a time --------------------------------------------------------------------


@dataclass(frozen=True)
class _Holder:
    """Who ships, and until when nobody else may."""

    host: str
    pid: int
    process: str | None
    token: str
    until_wall_time_s: float

    def is_gone(self, now_s: float) -> bool:
        """Whether another may take over: this host knows that the process ended, or it is silent.

        A shipper of this host that waits for long between two looks is not gone.
        """
        if self.host == host_name() and self.process is not None:
            return process_identity(self.pid) != self.process
        return not now_s < self.until_wall_time_s <= now_s + _LATEST_S


class ShippingLease:
    """The lease of a recording, held from `take` to `give_back`, as long as it is renewed."""

    def __init__(self, storage: Storage, recording_uuid: str) -> None:
        self._storage = storage
        self._path = f"{folder_of(recording_uuid)}/{LEASE}"
        self._token = os.urandom(8).hex()
        self._until_s = 0.0

    def take(self) -> None:
        """Become the one who ships.

        Raises:
            PoolBusyError: Another does.
        """
        now_s = time.time()
        if self._storage.create(self._path, self._mine(now_s)):
            return
        holder = self._holder()
        if holder is not None and not holder.is_gone(now_s):
            raise self._taken(holder)
        self._storage.place(self._path, self._mine(now_s))
        self.require_mine()

    def renew(self) -> None:
        """Before each thing that only the holder may do: see that this one still is.

        Raises:
            PoolBusyError: It had not renewed its lease for too long, and another has it.
        """
        now_s = time.time()
        if LEASE_S - _RENEW_AFTER_S < self._until_s - now_s <= LEASE_S:
            return
        self.require_mine()
        self._storage.place(self._path, self._mine(now_s))

    def give_back(self) -> None:
        """Let others take it at once."""
        holder = self._holder()
        if holder is not None and holder.token == self._token:
            self._storage.remove(self._path)

    def require_mine(self) -> None:
        """See in the pool that nobody else has taken it.

        Raises:
            PoolBusyError: Another has.
        """
        holder = self._holder()
        if holder is None or holder.token != self._token:
            raise self._taken(holder)

    def _mine(self, now_s: float) -> bytes:
        self._until_s, pid = now_s + LEASE_S, os.getpid()
        mine = _Holder(host_name(), pid, process_identity(pid), self._token, self._until_s)
        return json.dumps(asdict(mine)).encode()

    def _holder(self) -> _Holder | None:
        try:
            return _Holder(**json.loads(self._storage.read(self._path) or b""))
        except (ValueError, TypeError):  # nobody's: it is taken over
            return None

    def _taken(self, holder: _Holder | None) -> PoolBusyError:
        by = f"process {holder.pid} on {holder.host}" if holder else "another process"
        return PoolBusyError(
            f"{by} ships this recording to {self._storage.address}: end it, or wait "
            f"{LEASE_S:g} s after it is gone"
        )
