"""What a pool says of itself, and what it holds of a recording: small objects of JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError
from webots_mcp.plugins.pool.parquet.layout import POOL, PROGRESS, folder_of, part_of
from webots_mcp.plugins.pool.parquet.storage import Storage

FORMAT: Final = 1


@dataclass(frozen=True)
class Part:
    """The part of a table that is open: of a table whose rows never change.

    Attributes:
        number: Of the part; those before it are over.
        rows: By the folder of its files, how many rows of each count.
    """

    number: int = 1
    rows: Mapping[str, int] = field(default_factory=dict[str, int])

    def counted(self, path: str) -> int | None:
        """How many rows of a file count; None where all do."""
        folder, number = part_of(path)
        if number < self.number:
            return None
        return self.rows.get(folder, 0) if number == self.number else 0


@dataclass(frozen=True)
class Progress:
    """What the pool holds of a recording.

    Attributes:
        numbers: As the shipper gave them.
        parts: By table.
    """

    numbers: Mapping[str, int] = field(default_factory=dict[str, int])
    parts: Mapping[str, Part] = field(default_factory=dict[str, Part])

    def part(self, table: str) -> Part:
        """Of a table, the first where it has no rows yet."""
        return self.parts.get(table, Part())

    def with_part(self, table: str, part: Part) -> Progress:
        """After rows of a table have come."""
        return replace(self, parts={**self.parts, table: part})


def read_progress(storage: Storage, recording_uuid: str) -> Progress:
    """What the pool holds of a recording: nothing where it is new.

    Raises:
        PoolError: It cannot be read.
    """
    path = f"{folder_of(recording_uuid)}/{PROGRESS}"
    content = storage.read(path)
    if content is None:
        return Progress()
    try:
        told: dict[str, Any] = json.loads(content)
        parts = {str(name): Part(**part) for name, part in told["parts"].items()}
        return Progress({str(name): int(n) for name, n in told["numbers"].items()}, parts)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise PoolError(f"{path} in {storage.address} cannot be read: {error}") from error


def place_progress(storage: Storage, recording_uuid: str, progress: Progress) -> None:
    """Say what is there: rows count from now on."""
    content = json.dumps(asdict(progress)).encode()
    storage.place(f"{folder_of(recording_uuid)}/{PROGRESS}", content)


def require_pool(storage: Storage) -> None:
    """Raise unless a pool of exactly this version is there.

    Raises:
        PoolError: There is none, or an older or a newer one.
    """
    content = storage.read(POOL)
    if content is None:
        raise PoolError(f"there is no pool in {storage.address}: ship a recording to it first")
    try:
        told: dict[str, Any] = json.loads(content)
        its_format, schema = int(told["format"]), int(told["schema"])
    except (ValueError, TypeError, KeyError) as error:
        raise PoolError(f"{POOL} in {storage.address} cannot be read: {error}") from error
    if its_format > FORMAT or schema > SCHEMA_VERSION:
        raise PoolError(
            f"the pool in {storage.address} has format {its_format} and schema {schema}, this "
            f"webots-mcp knows {FORMAT} and {SCHEMA_VERSION}: update webots-mcp"
        )
    if schema < SCHEMA_VERSION:
        raise PoolError(
            f"the pool in {storage.address} has schema {schema}, of an older webots-mcp: ship the "
            "recordings anew, into another folder"
        )


def make_pool(storage: Storage) -> None:
    """Make a pool where there is nothing.

    Raises:
        PoolError: Other things are there, or another version made it.
    """
    if storage.read(POOL) is None:
        if not storage.is_empty():
            raise PoolError(
                f"{storage.address} holds other things and is no pool: name a new or empty folder"
            )
        about = {"format": FORMAT, "schema": SCHEMA_VERSION}
        return storage.place(POOL, json.dumps(about).encode())
    require_pool(storage)
