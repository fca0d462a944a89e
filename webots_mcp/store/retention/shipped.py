"""What pools hold of a recording: a small file next to the database, written by `webots-mcp ship`.

The progress itself is at the pool. This file only spares what is not there yet: where it is lost or
cannot be written, rows are kept that need not be, within the limit of `--keep-until-shipped`.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from webots_mcp.contract import PRIVATE_FILE

_NAME: Final = "{}-shipped.json"
_FILE: Final = "SELECT file FROM pragma_database_list WHERE name = 'main'"
_UUID: Final = "SELECT uuid FROM recording"


@dataclass(frozen=True)
class Shipped:
    """What one pool holds of a recording.

    Attributes:
        recording: Its UUID.
        last_ids: By table, up to which row it was shipped; what is not in it is not shipped.
        complete_wall_time_s: All that was recorded before was shipped; 0 before the first time.
        wall_time_s: When this was so.
    """

    recording: str
    last_ids: Mapping[str, int]
    complete_wall_time_s: float
    wall_time_s: float


def last_shipped(pools: Sequence[Shipped], table: str) -> float:
    """Up to which row all pools hold a table; infinite where none wants it."""
    if not pools:
        return 0.0
    return min(each.last_ids.get(table, math.inf) for each in pools)


def complete_until_s(pools: Sequence[Shipped]) -> float:
    """All that was recorded before is in all pools."""
    return min((each.complete_wall_time_s for each in pools), default=0.0)


def shipped_of(connection: sqlite3.Connection) -> list[Shipped]:
    """What each pool holds of the recording; nothing where none was shipped to."""
    (name,) = connection.execute(_FILE).fetchone()
    row = connection.execute(_UUID).fetchone()
    return list(read_shipped(Path(name), row[0]).values()) if name and row else []


def read_shipped(database: Path, recording: str) -> dict[str, Shipped]:
    """The same by the pools' addresses; a damaged file says nothing."""
    return {
        address: shipped
        for address, shipped in _read(_file_of(database)).items()
        if shipped.recording == recording
    }


def write_shipped(database: Path, address: str, shipped: Shipped) -> None:
    """Say what a pool holds now.

    Raises:
        OSError: The folder cannot be written.
    """
    file = _file_of(database)
    stored = {**_read(file), address: shipped}
    aside = file.with_name(f".{file.name}.{os.getpid()}.part")
    try:
        aside.touch(PRIVATE_FILE)
        aside.write_text(json.dumps({key: asdict(each) for key, each in stored.items()}, indent=1))
        aside.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise


def _file_of(database: Path) -> Path:
    return database.with_name(_NAME.format(database.name))


def _read(file: Path) -> dict[str, Shipped]:
    try:
        stored: Any = json.loads(file.read_text("utf-8"))
        return {str(address): _shipped(each) for address, each in stored.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}


def _shipped(stored: Any) -> Shipped:
    return Shipped(
        str(stored["recording"]),
        {str(name): int(last) for name, last in stored["last_ids"].items()},
        float(stored["complete_wall_time_s"]),
        float(stored["wall_time_s"]),
    )
