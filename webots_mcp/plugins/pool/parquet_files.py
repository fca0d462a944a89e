"""The files of a pool of Parquet, in a folder or on any filesystem that fsspec knows.

    _pool                                       format and version of the pool
    _runs/UUID                                  the recording that a run belongs to
    recording=UUID/_progress                    written last: the rows that it counts are complete
    recording=UUID/_lease                       the process that ships this recording
    recording=UUID/_pictures/PATH
    recording=UUID/table=NAME/day=YYYY-MM-DD/part-NUMBER.parquet    rows that never change
    recording=UUID/table=NAME/part-BLOCK.parquet                    rows that change
    recording=UUID/table=value/run=ID/part-NUMBER.parquet           a column for each signal

A file is replaced as a whole by a file with more rows. A reader of `*.parquet` therefore sees each
row once, or not yet, while a process ships. Engines ignore names that begin with `_`.

Rows that never change are added to the open part, and stay there. A part is closed once it is
large. The progress says which part is open and how many rows of its files count; further rows are
those of a shipper that was killed. Rows that change are in blocks of ids. The progress also lists
runs and trial sets, so that listing those of a pool reads one small file of each recording.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timedelta, timezone
from pathlib import PurePosixPath
from typing import Any, Final, cast

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import (
    PoolError,
)
from webots_mcp.plugins.pool.pool_interface import PoolRow, ShippedTable, SQLValue
from webots_mcp.plugins.pool.storage import Storage

FORMAT: Final = 2
POOL: Final = "_pool"
RUNS: Final = "_runs"
PROGRESS: Final = "_progress"
CHUNK: Final = "chunk"
VALUES: Final = "value"  # Table with a column for each signal, instead of chunks.

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=timezone.utc)
_IDS_IN_BLOCK: Final = 4096


def folder_of(recording_uuid: str) -> str:
    """Return the folder of a recording in the pool."""
    return f"recording={recording_uuid}"


def uuid_in(path: str) -> str:
    """Return the UUID of the recording in a path."""
    return path.partition("/")[0].removeprefix("recording=")


def picture_file(path: str) -> str:
    """Return the file of a picture, by the path in its row.

    Raises:
        PoolError: The path leads out of the folder of pictures.
    """
    parts = PurePosixPath(path).parts
    if not parts or ".." in parts or path.startswith(("/", "\\")) or "\\" in path:
        raise PoolError(f"{path!r} is no path of a picture: it leads out of the recording")
    return f"_pictures/{'/'.join(parts)}"


def name_of(table: ShippedTable) -> str:
    """Return the name of a table in a pool of files."""
    return VALUES if table.name == CHUNK else table.name


def is_cut(table: ShippedTable) -> bool:
    """Return whether a table's rows never change, and are in parts of a day or of a run."""
    return table.name == CHUNK or table.time_column is not None


def part_file(table: ShippedTable, folder: str, number: int) -> str:
    """Return the file of a part of a table whose rows never change."""
    return f"table={name_of(table)}/{folder}/part-{number:06}.parquet"


def files_of(table: ShippedTable, recording_uuid: str = "*") -> str:
    """Return the pattern of all files of a table, of one recording or of all."""
    cut = "day=*/" if table.time_column else "run=*/" if table.name == CHUNK else ""
    return f"{folder_of(recording_uuid)}/table={name_of(table)}/{cut}part-*.parquet"


def run_of(path: str) -> int | None:
    """Return the run of a part, if it has rows of one run only."""
    name, _, run_id = path.rpartition("/")[0].rpartition("/")[2].partition("=")
    return int(run_id) if name == "run" else None


def by_folder(table: ShippedTable, rows: Iterable[PoolRow]) -> Mapping[str, list[PoolRow]]:
    """Group rows that never change by folder: one for each day, or for chunks each run."""
    place = table.columns.index(table.time_column or "run_id")
    found: dict[str, list[PoolRow]] = defaultdict(list)
    for row in rows:
        name = f"day={day_of(row[place])}" if table.time_column else f"run={row[place]}"
        found[name].append(row)
    return found


def day_of(wall_time_s: SQLValue) -> str:
    """Return the day in UTC as in a path; `NO_DAY` for an invalid time."""
    try:
        return (_EPOCH + timedelta(seconds=cast("float", wall_time_s))).date().isoformat()
    except (TypeError, OverflowError, ValueError):  # Null, or a year outside 1 to 9999.
        no_day = "__HIVE_DEFAULT_PARTITION__"  # Engines read it as null.
        return no_day


def by_block(table: ShippedTable, rows: Iterable[PoolRow]) -> Mapping[str, list[PoolRow]]:
    """Group rows that change by file."""
    found: dict[str, list[PoolRow]] = defaultdict(list)
    for row in rows:
        block = cast("int", row[0]) // _IDS_IN_BLOCK if table.key == ("id",) else 0
        found[f"table={table.name}/part-{block:09}.parquet"].append(row)
    return found


@dataclass(frozen=True)
class OpenPart:
    """The open part of a table whose rows never change.

    Attributes:
        number: Number of the part. Earlier parts are closed.
        rows: Number of rows that count, by folder of the file.
    """

    number: int = 1
    rows: Mapping[str, int] = field(default_factory=dict[str, int])

    def counted(self, path: str) -> int | None:
        """Return the number of rows of a file that count; None for all."""
        folder, _, name = path.rpartition("/part-")
        number = int(name.removesuffix(".parquet"))
        if number < self.number:
            return None
        return self.rows.get(folder.rpartition("/")[2], 0) if number == self.number else 0


@dataclass(frozen=True)
class ShippedProgress:
    """What the pool holds of a recording.

    Attributes:
        numbers: Numbers that the shipper stored.
        parts: Open parts by table.
        listed: The columns `LISTED` of rows, by table and id.
    """

    numbers: Mapping[str, int] = field(default_factory=dict[str, int])
    parts: Mapping[str, OpenPart] = field(default_factory=dict[str, OpenPart])
    listed: Mapping[str, Mapping[str, list[Any]]] = field(
        default_factory=dict[str, Mapping[str, list[Any]]]
    )

    def part(self, table: str) -> OpenPart:
        """Return the open part of a table; the first if it has no rows yet."""
        return self.parts.get(table, OpenPart())

    def with_part(self, table: str, part: OpenPart) -> ShippedProgress:
        """Return the progress after rows of a table were added."""
        return replace(self, parts={**self.parts, table: part})

    def with_listed(self, table: str, rows: Mapping[str, list[Any]]) -> ShippedProgress:
        """Return the progress after rows of a listed table have changed."""
        return replace(self, listed={**self.listed, table: {**self.listed.get(table, {}), **rows}})


def read_progress(storage: Storage, recording_uuid: str) -> ShippedProgress:
    """Return what the pool holds of a recording: nothing if it is new.

    Raises:
        PoolError: It cannot be read.
    """
    path = f"{folder_of(recording_uuid)}/{PROGRESS}"
    content = storage.read(path)
    return ShippedProgress() if content is None else decoded_progress(storage, path, content)


def decoded_progress(storage: Storage, path: str, content: bytes) -> ShippedProgress:
    """Return the progress in a file.

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
    """Store the progress. Its rows count from now on."""
    content = json.dumps(asdict(progress)).encode()
    storage.place(f"{folder_of(recording_uuid)}/{PROGRESS}", content)


def require_pool(storage: Storage, *, make: bool) -> None:
    """Require a pool of exactly this version, or make one in an empty folder.

    Raises:
        PoolError: There is no pool, one of another version, or other files exist.
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
