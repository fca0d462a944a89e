"""What a pool can do, and how its URL may be shown."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol
from urllib.parse import parse_qsl

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.pool.row_batch import Batch
from webots_mcp.plugins.pool.shipped_tables import Table

if TYPE_CHECKING:
    from webots_mcp.store.questions.sql import Result

_SECRET: Final = re.compile(
    "password|passwd|secret|token|credential|signature|authorization|(access|api|account)[_-]?key|"
    "^(pass|key|sig|pwd)$",
    re.IGNORECASE,
)
_WHOLE: Final = "run.whole:{}"  # a bit for each of so many runs
_RUNS_TOLD: Final = 60


class Shipment(Protocol):
    """One recording's part of a pool, which one shipper at a time writes."""

    def progress(self) -> dict[str, int]:
        """The numbers that `write` left, by names that the shipper chose; empty at first."""
        ...

    def foreign_runs(self, run_uuids: Collection[str]) -> dict[str, str]:
        """Of these runs, those that another recording has shipped, with that one's UUID."""
        ...

    def write_picture(self, path: str, content: bytes) -> None:
        """Keep a picture under the path that its row in `image` names, in the place of another.

        It is whole and there, at the latest, when the `write` that follows has returned.
        """
        ...

    def write(self, batches: Sequence[Batch], progress: Mapping[str, int]) -> Mapping[str, int]:
        """Write rows, and change these numbers of the progress: all of it or nothing.

        Rows of appended tables that are there already are left alone. A row of the others replaces
        the one of its key, but where a column of `Table.lasting` is null, the value stays; rows
        that are not in the batch stay too, since retention at the edge deletes what a pool keeps.
        Batches may name a table twice; what a row refers to comes before it.

        Returns:
            By column (`log.message`), how many values the pool cannot hold as they are: it has what
            comes nearest, or null.

        Raises:
            PoolUnavailableError: Worth trying again; nothing was written.
            PoolError: It will not be better by itself.
        """
        ...


class Target(Protocol):
    """A pool that recordings are shipped to; a context manager, connected as long as it is open.

    Attributes:
        address: Its URL without secrets: for messages, logs and the file of what was shipped.
    """

    address: str

    def __enter__(self) -> Target:
        """Connect.

        Raises:
            PoolUnavailableError: Nobody answers there now.
            PoolError: It is no pool that can be written, or an extra is missing.
        """
        ...

    def __exit__(self, *exception: object) -> None:
        """Disconnect; what was not written is gone."""
        ...

    def prepare(self) -> None:
        """Make the tables, or bring them to this version.

        Raises:
            PoolError: They are newer, none of ours, or cannot be written.
        """
        ...

    def shipment(self, recording_uuid: str) -> AbstractContextManager[Shipment]:
        """Be the one who ships this recording.

        Raises:
            PoolBusyError: Another does.
        """
        ...


@dataclass(frozen=True)
class PooledRun:
    """A run in a pool, with what is needed to choose it and to fetch it.

    The UUID is empty where an old version recorded it.
    """

    recording_uuid: str
    run_id: int
    uuid: str
    robot: str
    label: str | None
    world: str | None
    started_wall_time_s: float
    last_wall_time_s: float
    started_sim_time_s: float
    last_sim_time_s: float
    end_reason: str | None
    row_count: int


@dataclass(frozen=True)
class PooledTrialSet:
    """A trial set in a pool; `runs` are those of its trials, as (recording's UUID, run's id)."""

    recording_uuid: str
    trial_set_id: int
    uuid: str
    created_wall_time_s: float
    trials: int
    runs: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class PooledSize:
    """How much of a table is in a pool; bytes where the pool can tell."""

    table: str
    rows: int
    size_bytes: int | None


class Pool(Protocol):
    """A pool as it is read; a context manager, connected as long as it is open.

    `run.purged_rows` is as the edge last said it: how many states a pool lacks is counted.

    Attributes:
        address: Its URL without secrets.
        keeps_order: Whether the keys of JSON objects come in the order in which they were shipped.
    """

    address: str
    keeps_order: bool

    def __enter__(self) -> Pool: ...
    def __exit__(self, *exception: object) -> None: ...

    def records(self, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """All rows of a table that changes, each behind its recording's UUID."""
        ...

    def sizes(self) -> Iterator[PooledSize]:
        """How much of each table there is."""
        ...

    def progress(self, recording_uuid: str) -> dict[str, int]:
        """How far the recording was shipped, as `Shipment.progress` tells it."""
        ...

    def rows(
        self, recording_uuid: str, table: Table, where: Mapping[str, Collection[int]]
    ) -> Iterator[Batch]:
        """Rows whose columns have one of these values, in any order."""
        ...

    def picture(self, recording_uuid: str, path: str) -> bytes | None:
        """A picture that was shipped, by the path in its row."""
        ...

    def select(self, sql: str, max_rows: int) -> Result:
        """The first rows of one SELECT, which cannot write, before a deadline; see `query_sql`."""
        ...


def whole_runs(run_ids: Iterable[int]) -> dict[str, int]:
    """Numbers of the progress that say of these runs: they are over, and all of them is there."""
    told: dict[str, int] = {}
    for run_id in run_ids:
        name = _WHOLE.format(run_id // _RUNS_TOLD)
        told[name] = told.get(name, 0) | 1 << run_id % _RUNS_TOLD
    return told


def is_whole(progress: Mapping[str, int], run_id: int) -> bool:
    """Whether the progress says so of a run."""
    return bool(progress.get(_WHOLE.format(run_id // _RUNS_TOLD), 0) >> run_id % _RUNS_TOLD & 1)


def redacted(url: str) -> str:
    """A URL as it may be shown: without a password and without whatever looks like a secret."""
    scheme, sign, rest = url.partition("://")
    if not sign:
        return url
    place, question, query = _place_and_query(rest)
    user, at, host = place.rpartition("@")
    shown = "&".join(
        f"{name}=***" if _SECRET.search(name) else f"{name}={value}"
        for name, value in parse_qsl(query, keep_blank_values=True)
    )
    return f"{scheme}://{user.partition(':')[0]}{at}{host}{question}{shown}"


def _place_and_query(rest: str) -> tuple[str, str, str]:
    """What comes before and after the question mark, which is not the one of a password."""
    user, at, _ = rest.partition("@")
    end = rest.find("?", len(user) if at and "/" not in user else 0)
    return (rest, "", "") if end < 0 else (rest[:end], "?", rest[end + 1 :])


def require_no_secret(url: str) -> None:
    """Refuse a URL with a password or a key in it.

    Raises:
        InvalidInputError: It holds one.
    """
    place, _, query = _place_and_query(url.partition("://")[2])
    user, _, _ = place.rpartition("@")
    named = [name for name, _ in parse_qsl(query) if _SECRET.search(name)]
    if ":" in user or named:
        what = named[0] if named else "a password"
        raise InvalidInputError(
            f"the URL {redacted(url)} holds {what}, which every process on this machine can see: "
            "leave it out, and give it in PGPASSWORD, ~/.pgpass or a service file (PostgreSQL), or "
            "in the environment or the configuration of the storage"
        )
