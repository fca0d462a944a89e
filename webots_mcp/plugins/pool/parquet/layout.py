"""Which file of a pool a row is in: one of them, at any moment.

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
beyond are those of a shipper that was killed. Rows that change are in blocks of ids.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from datetime import datetime, timedelta, timezone
from pathlib import PurePosixPath
from typing import Final

from webots_mcp.errors import PoolError
from webots_mcp.plugins.pool.row_batch import Row
from webots_mcp.plugins.pool.shipped_tables import SQLValue, Table

POOL: Final = "_pool"
RUNS: Final = "_runs"
PROGRESS: Final = "_progress"
LEASE: Final = "_lease"
CHUNK: Final = "chunk"
VALUES: Final = "value"  # in the place of chunks a table with a column for each signal
NO_DAY: Final = "__HIVE_DEFAULT_PARTITION__"  # read as null by engines

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=timezone.utc)
_IDS_IN_BLOCK: Final = 4096


def folder_of(recording_uuid: str) -> str:
    """Where a recording is in the pool."""
    return f"recording={recording_uuid}"


def day_of(wall_time_s: SQLValue) -> str:
    """The day in UTC, as it stands in a path; `NO_DAY` where the time is none."""
    if not isinstance(wall_time_s, int | float):
        return NO_DAY
    try:
        return (_EPOCH + timedelta(seconds=wall_time_s)).date().isoformat()
    except (OverflowError, ValueError):  # NaN, or no year from 1 to 9999
        return NO_DAY


def picture_file(path: str) -> str:
    """A picture, by the path in its row.

    Raises:
        PoolError: The path leads out of the folder of pictures.
    """
    parts = PurePosixPath(path).parts
    if not parts or ".." in parts or path.startswith(("/", "\\")) or "\\" in path:
        raise PoolError(f"{path!r} is no path of a picture: it leads out of the recording")
    return f"_pictures/{'/'.join(parts)}"


def name_of(table: Table) -> str:
    """What a table is called in a pool of files."""
    return VALUES if table.name == CHUNK else table.name


def is_cut(table: Table) -> bool:
    """Whether its rows never change and are in parts, of a day or of a run."""
    return table.name == CHUNK or table.time_column is not None


def appended_file(table: Table, folder: str, number: int | str) -> str:
    """The part of a table whose rows never change."""
    part = f"{number:06}" if isinstance(number, int) else number
    return f"table={name_of(table)}/{folder}/part-{part}.parquet"


def files_of(table: Table, recording_uuid: str = "*") -> str:
    """The pattern of all files of a table, of one recording or of all."""
    cut = "day=*/" if table.time_column else "run=*/" if table.name == CHUNK else ""
    return f"{folder_of(recording_uuid)}/table={name_of(table)}/{cut}part-*.parquet"


def uuid_in(path: str) -> str:
    """The recording of a path."""
    return path.partition("/")[0].removeprefix("recording=")


def part_of(path: str) -> tuple[str, int]:
    """The folder (`day=...`, `run=...`) and the number of a part."""
    folder, _, name = path.rpartition("/part-")
    return folder.rpartition("/")[2], int(name.removesuffix(".parquet"))


def run_of(path: str) -> int | None:
    """The run of a part, where it has the rows of one only."""
    name, _, run_id = path.rpartition("/")[0].rpartition("/")[2].partition("=")
    return int(run_id) if name == "run" else None


def by_folder(table: Table, rows: Iterable[Row]) -> Mapping[str, list[Row]]:
    """Rows that never change by their folders: those of a day, chunks of a run."""
    place = table.columns.index(table.time_column or "run_id")
    found: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        name = f"day={day_of(row[place])}" if table.time_column else f"run={row[place]}"
        found[name].append(row)
    return found


def by_block(table: Table, rows: Iterable[Row]) -> Mapping[str, list[Row]]:
    """Rows of a table that changes, by the files in which they are."""
    found: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        found[f"table={table.name}/part-{_block(table, row)}.parquet"].append(row)
    return found


def _block(table: Table, row: Row) -> str:
    if table.key == ("id",):
        return f"{_whole(row[table.columns.index('id')]) // _IDS_IN_BLOCK:09}"
    return f"{0:09}"


def _whole(value: SQLValue) -> int:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return 0
    return math.floor(value)
