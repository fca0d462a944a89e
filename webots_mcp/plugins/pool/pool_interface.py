"""What is shipped to a pool, and what the two kinds of pools do: tables, batches, protocols.

Each row is keyed by its recording's UUID and the key that it has there.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Final, Protocol, TypeAlias, cast
from urllib.parse import parse_qsl

from webots_mcp.cli.options import Parameter
from webots_mcp.errors import InvalidInputError, PoolError
from webots_mcp.naming import nearest_first
from webots_mcp.requirements import explain_extra
from webots_mcp.store.reading.ranges import parse_wall_time

if TYPE_CHECKING:
    from webots_mcp.store.questions.sql import Result


SQLValue: TypeAlias = "int | float | str | bytes | None"
Kind: TypeAlias = type[int] | type[float] | type[str] | type[bytes]
Row = tuple[SQLValue, ...]

BATCH_BYTES: Final = 4_000_000
BATCH_ROWS: Final = 20_000
_VALUE_BYTES: Final = 8
_DATED: Final = ("state", "kept_state", "log", "event", "image", "parameter_value")
CHUNKS: Final = ("row_group", "chunk")
# Of one machine or one moment: who maintains it, what is kept there, and console lines that wait
# to become log lines.
_LOCAL: Final = ("lease", "watermark", "retention_limit", "console_line")
# How many rows wait for chunks there, how many of a group are left, and what they take on the disk.
_LOCAL_COLUMNS: Final = {
    "run": ("is_chunked",),
    "row_group": ("stored_row_count", "stored_row_bytes", "chunk_bytes", "is_complete"),
}
_OF_TRIALS: Final = ("trial_set", "trial")
_TYPES: Final[dict[str, Kind]] = {
    "INTEGER": int, "BIGINT": int, "FLOAT": float, "TEXT": str, "VARCHAR": str, "BLOB": bytes,
}  # fmt: skip
# What is needed to list the runs and trial sets of a pool: of few tables few columns.
LISTED: Final[dict[str, tuple[str, ...]]] = {
    "robot": ("id", "name"),
    "run": (
        "id", "robot_id", "uuid", "label", "world", "started_wall_time_s", "last_wall_time_s",
        "started_sim_time_s", "last_sim_time_s", "end_reason", "row_count",
    ),
    "trial_set": ("id", "uuid", "created_wall_time_s"),
    "trial": ("id", "trial_set_id", "run_id"),
}  # fmt: skip
_WHOLE: Final = "run.whole:{}"  # a bit for each of so many runs
_RUNS_IN_NUMBER: Final = 60
_SECRET: Final = re.compile(
    "password|passwd|secret|token|credential|signature|authorization|(access|api|account)[_-]?key|"
    "^(pass|key|sig|pwd)$",
    re.IGNORECASE,
)


# -- what is shipped --------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """A table that is shipped; its columns in the order in which a batch has their values.

    Attributes:
        key: Its primary key in a recording; in a pool the recording's UUID stands before it.
        columns: Those of the key and all others that are shipped, by their names in the recording.
        types: Of the columns, as the model declares them; SQLite may hold others.
        json_columns: Those that hold JSON as text.
        json_values: Of them, those in which a text is as good as an object.
        nullable: Those that may be null.
        lasting: References that retention sets to null where it deletes what they name: a null
            does not replace the value that the pool has.
        is_appended: Rows come with rising ids and never change; otherwise a row replaces the one
            of the same key.
        time_column: The wall time by which a pool may cut it into parts, of appended tables but
            row groups and chunks.
        run_column: The column that names the row's run, where it belongs to one.
        session_column: The column that names its session.
        outlasts_runs: It stays where the run or session that it names is not shipped.
    """

    name: str
    key: tuple[str, ...]
    columns: tuple[str, ...]
    types: tuple[Kind, ...]
    json_columns: frozenset[str]
    json_values: frozenset[str]
    nullable: frozenset[str]
    lasting: frozenset[str]
    is_appended: bool
    time_column: str | None
    run_column: str | None
    session_column: str | None
    outlasts_runs: bool


@cache
def tables() -> tuple[Table, ...]:
    """All that are shipped, each after those that it refers to. Importing the models costs."""
    from webots_mcp.store import models

    ordered: list[Any] = cast("Any", models).SQLModel.metadata.sorted_tables
    return tuple(_table(each) for each in ordered if each.name not in _LOCAL)


def table(name: str) -> Table:
    """The table of that name.

    Raises:
        KeyError: None of that name is shipped.
    """
    return {each.name: each for each in tables()}[name]


def _table(model: Any) -> Table:
    name: str = model.name
    local = _LOCAL_COLUMNS.get(name, ())
    shipped: list[Any] = [column for column in model.columns if column.name not in local]
    columns = tuple(str(column.name) for column in shipped)
    comments: dict[str, str] = {column.name: column.comment or "" for column in shipped}

    def column_of(owner: str) -> str | None:
        named = "id" if name == owner else f"{owner}_id"
        return named if named in columns else None

    return Table(
        name=name,
        key=tuple(column.name for column in model.primary_key.columns),
        columns=columns,
        types=tuple(_TYPES[str(column.type)] for column in shipped),
        json_columns=frozenset(
            each for each in columns if comments[each].startswith("JSON") or each == "replaced"
        ),
        json_values=frozenset(each for each in columns if comments[each].startswith("JSON value")),
        nullable=frozenset(column.name for column in shipped if column.nullable),
        lasting=frozenset(
            column.name
            for column in shipped
            if any(key.ondelete == "SET NULL" for key in column.foreign_keys)
        ),
        is_appended=name in _DATED + CHUNKS,
        time_column="wall_time_s" if name in _DATED else None,
        run_column=column_of("run"),
        session_column=column_of("session"),
        outlasts_runs=name in _OF_TRIALS,
    )


@dataclass(frozen=True)
class Batch:
    """Rows in the order of the table's columns: JSON is text, a flag 0 or 1."""

    table: Table
    rows: Sequence[Row]


def batches(table: Table, rows: Iterable[Row]) -> Iterator[Batch]:
    """Rows as batches of bounded size; a row that is larger by itself is a batch of its own."""
    held: list[Row] = []
    size = 0
    for row in rows:
        added = row_bytes(row)
        if held and (size + added > BATCH_BYTES or len(held) >= BATCH_ROWS):
            yield Batch(table, held)
            held, size = [], 0
        held.append(row)
        size += added
    if held:
        yield Batch(table, held)


def row_bytes(row: Row) -> int:
    """About how many bytes of memory a row's values take."""
    sized = sum([len(value) for value in row if isinstance(value, (str, bytes))])
    return sized + _VALUE_BYTES * len(row)


def fitted(batch: Batch, replaced: Counter[str]) -> Batch:
    """The rows with values of the types of their columns, where SQLite may hold any.

    Args:
        batch: As it was read.
        replaced: Counts by column (`log.message`) the values in whose place is what comes nearest.
    """
    columns: list[Sequence[SQLValue]] = [*zip(*batch.rows, strict=True)]
    described = zip(batch.table.columns, batch.table.types, columns, strict=True)
    others = [
        (at, name, kind)
        for at, (name, kind, values) in enumerate(described)
        if not set(map(type, values)) <= {kind, type(None)}
    ]
    for at, name, kind in others:
        values, nullable = columns[at], name in batch.table.nullable
        columns[at] = [_nearest(value, kind, nullable=nullable) for value in values]
        pairs = zip(columns[at], values, strict=True)
        replaced[f"{batch.table.name}.{name}"] += sum(new != old for new, old in pairs)
    return Batch(batch.table, [*zip(*columns, strict=True)]) if others else batch


def _nearest(value: SQLValue, kind: Kind, *, nullable: bool) -> SQLValue:
    """The value of a type that comes nearest to one that SQLite holds."""
    least = None if nullable else kind()
    if value is None or isinstance(value, kind):
        return value
    if kind is str:
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    if kind is bytes:
        return least
    try:
        number = float(value)
    except ValueError:
        return least
    if kind is float:
        return number
    return int(number) if math.isfinite(number) and abs(number) < 2**63 else least


# -- how far ----------------------------------------------------------------------------------


def whole_runs(run_ids: Iterable[int]) -> dict[str, int]:
    """Numbers of the progress that say of these runs: they are over, and all of them is there."""
    numbers: dict[str, int] = {}
    for run_id in run_ids:
        name = _WHOLE.format(run_id // _RUNS_IN_NUMBER)
        numbers[name] = numbers.get(name, 0) | 1 << run_id % _RUNS_IN_NUMBER
    return numbers


def is_whole(progress: Mapping[str, int], run_id: int) -> bool:
    """Whether the progress says so of a run."""
    number = progress.get(_WHOLE.format(run_id // _RUNS_IN_NUMBER), 0)
    return bool(number >> run_id % _RUNS_IN_NUMBER & 1)


# -- what an engine does ----------------------------------------------------------------------


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
        """Write fitted rows, and change these numbers of the progress: all of it or nothing.

        Rows of appended tables come once. A row of the others replaces the one of its key, but
        where a column of `Table.lasting` is null, the value stays; rows that are not in the batch
        stay too, since retention at the edge deletes what a pool keeps. Batches may name a table
        twice; what a row refers to comes before it.

        Returns:
            By column (`log.message`), how many values the pool cannot hold as they are: it has what
            comes nearest, or null.

        Raises:
            PoolUnavailableError: Worth trying again; nothing was written.
            PoolError: It will not be better by itself.
        """
        ...


class Pool(Protocol):
    """A pool, shipped to or read; a context manager, connected as long as it is open.

    `run.purged_rows` is as the edge last said it: how many states a pool lacks is counted.

    Attributes:
        address: Its URL without secrets: for messages, logs and the file of what was shipped.
    """

    address: str

    def __enter__(self) -> Pool:
        """Connect; who ships makes the tables where there are none.

        Raises:
            PoolUnavailableError: Nobody answers there now.
            PoolError: It is no pool that can be used, or of another version.
        """
        ...

    def __exit__(self, *exception: object) -> None:
        """Disconnect; what was not written is gone."""
        ...

    def shipment(self, recording_uuid: str) -> AbstractContextManager[Shipment]:
        """Be the one who ships this recording, to a pool that was opened for it.

        Raises:
            PoolBusyError: Another does.
        """
        ...

    def rows_of(self, name: str) -> Iterator[tuple[str, Sequence[Any]]]:
        """The columns `LISTED` of all rows of such a table, behind their recording's UUID."""
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


# -- what may be shown of a URL ---------------------------------------------------------------


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


# -- what a pool holds -----------------------------------------------------------------------------


_MOST_OFFERED: Final = 3
_MOST_COMPARED: Final = 2000  # names or UUIDs, with one that is not there
_CONNECTION_STRING: Final = re.compile(
    r"(^|\s)(host|hostaddr|dbname|user|password|passfile|service)\s*=", re.IGNORECASE
)
_NEARLY_A_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")


def open_pool(url: str, *, ships: bool = False) -> Pool:
    """The pool of a URL, not yet connected. What it needs is imported only here.

    Args:
        url: Of PostgreSQL, or of files.
        ships: To ship to it, and not only to read it.

    Raises:
        InvalidInputError: The URL names no pool, or holds a secret.
        PoolError: The packages of an extra are missing.
    """
    if is_postgres(url):
        try:
            import_module("psycopg")
        except ImportError as missing:  # psycopg itself, or a libpq for it
            raise PoolError(explain_extra("a pool in PostgreSQL", "postgres")) from missing
        from webots_mcp.plugins.pool.postgres_pool import PostgresPool

        return PostgresPool(url, ships=ships)
    from webots_mcp.plugins.pool.parquet_pool import ParquetPool

    return ParquetPool(url, ships=ships)


def is_postgres(url: str) -> bool:
    """Whether it is PostgreSQL rather than files.

    Raises:
        InvalidInputError: It holds a secret, or is no URL and no folder.
    """
    if not url.strip():
        raise InvalidInputError("the URL is empty: give postgresql://HOST/DATABASE or a folder")
    scheme, sign, _ = url.partition("://")
    if sign:
        require_no_secret(url)
        return scheme.lower() in ("postgresql", "postgres")
    if _CONNECTION_STRING.search(url):
        raise InvalidInputError(
            "a connection string of PostgreSQL is no URL: write postgresql://USER@HOST/DATABASE, "
            "and give the password in PGPASSWORD, ~/.pgpass or a service file"
        )
    if _NEARLY_A_URL.match(url):
        raise InvalidInputError(
            f"{url!r} is neither a URL nor a folder: write postgresql://HOST/DATABASE, "
            "s3://BUCKET/PREFIX or ./FOLDER"
        )
    return False


# -- what is there ----------------------------------------------------------------------------


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
class PooledRobot:
    """A robot name in a pool, and what all its runs come to."""

    robot: str
    recordings: int
    runs: int
    row_count: int
    started_wall_time_s: float
    last_wall_time_s: float


def pooled_runs(pool: Pool) -> list[PooledRun]:
    """All runs, by when they began."""
    robots = {(owner, robot_id): name for owner, (robot_id, name) in pool.rows_of("robot")}
    found: list[PooledRun] = []
    for owner, (run_id, robot_id, uuid, *others) in pool.rows_of("run"):
        named = dict(zip(LISTED["run"][3:], others, strict=True))
        robot = robots.get((owner, robot_id), "")
        found.append(PooledRun(owner, run_id, uuid or "", robot, **named))
    return sorted(found, key=lambda run: (run.started_wall_time_s, run.recording_uuid, run.run_id))


def pooled_trial_sets(pool: Pool) -> list[PooledTrialSet]:
    """All trial sets, by when they were made."""
    trials = defaultdict[tuple[str, int], list[int | None]](list)
    for owner, (_, set_id, run_id) in pool.rows_of("trial"):
        trials[owner, set_id].append(run_id)
    found: list[PooledTrialSet] = []
    for owner, (set_id, uuid, created_s) in pool.rows_of("trial_set"):
        own = trials[owner, set_id]
        runs = tuple((owner, run_id) for run_id in own if run_id is not None)
        found.append(PooledTrialSet(owner, set_id, uuid, created_s, len(own), runs))
    return sorted(found, key=lambda each: (each.created_wall_time_s, each.uuid))


def robots(runs: Iterable[PooledRun]) -> list[PooledRobot]:
    """The robots of some runs, those that recorded last first."""
    by_name: dict[str, list[PooledRun]] = {}
    for run in runs:
        by_name.setdefault(run.robot, []).append(run)
    found = [
        PooledRobot(
            robot=name,
            recordings=len({run.recording_uuid for run in own}),
            runs=len(own),
            row_count=sum(run.row_count for run in own),
            started_wall_time_s=min(run.started_wall_time_s for run in own),
            last_wall_time_s=max(run.last_wall_time_s for run in own),
        )
        for name, own in by_name.items()
    ]
    return sorted(found, key=lambda robot: -robot.last_wall_time_s)


# -- which are meant --------------------------------------------------------------------------


def _option(name: str, metavar: str, text: str) -> Parameter:
    return Parameter(name, metavar=metavar, help=text)


@Parameter(name="*")
@dataclass(frozen=True)
class Choice:
    """Which runs are meant: those of which all that is given is true."""

    run_uuid: Annotated[
        str | None, _option("--run", "UUID", "The run of that UUID, or that begins so.")
    ] = None
    label: Annotated[
        str | None, _option("--label", "TEXT", "Runs with that label; '*' is any letters.")
    ] = None
    trials: Annotated[
        str | None,
        _option(
            "--trials",
            "UUID",
            "The runs of the trial set of that UUID, or that begins so; and its trials.",
        ),
    ] = None
    robot: Annotated[str | None, _option("--robot", "NAME", "Runs of that robot.")] = None
    since: Annotated[
        str | None,
        _option(
            "--since", "TIME", "Runs that went on after this wall time (ISO 8601 or Unix seconds)."
        ),
    ] = None
    until: Annotated[
        str | None, _option("--until", "TIME", "Runs that began before this wall time.")
    ] = None


@dataclass(frozen=True)
class Meant:
    """What a choice means in a pool.

    Attributes:
        runs: By when they began.
        trial_sets: The set of which all trials are meant, as each recording has it.
    """

    runs: Sequence[PooledRun]
    trial_sets: Sequence[PooledTrialSet]


def chosen_runs(pool: Pool, choice: Choice) -> list[PooledRun]:
    """The runs that are meant, by when they began.

    Raises:
        InvalidInputError: There is none; the text names what comes nearest.
    """
    runs = pooled_runs(pool)
    if not runs:
        raise InvalidInputError(f"the pool {pool.address} holds no run yet")
    found = runs
    if choice.run_uuid is not None:
        uuid = _named("run", choice.run_uuid, [run.uuid for run in runs])
        found = [next(run for run in runs if run.uuid == uuid)]
    if choice.trials is not None:
        ids = {run for each in chosen_trial_sets(pool, choice) for run in each.runs}
        found = [run for run in found if (run.recording_uuid, run.run_id) in ids]
    if choice.robot is not None:
        names = [run.robot for run in runs]
        if choice.robot not in names:
            raise _unknown("robot called", choice.robot, names)
        found = [run for run in found if run.robot == choice.robot]
    if (label := choice.label) is not None:
        labels = [run.label for run in runs if run.label]
        matching = {each for each in labels if each == label or fnmatch.fnmatchcase(each, label)}
        if not matching:
            raise _unknown("run with the label", label, labels)
        found = [run for run in found if run.label in matching]
    since_s = parse_wall_time(choice.since, -math.inf)
    until_s = parse_wall_time(choice.until, math.inf)
    found = [
        run
        for run in found
        if run.last_wall_time_s >= since_s and run.started_wall_time_s < until_s
    ]
    if not found:
        raise InvalidInputError(f"no run in {pool.address} is all of that: ask for less")
    return found


def meant(pool: Pool, choice: Choice) -> Meant:
    """What is to be fetched.

    Raises:
        InvalidInputError: That is nothing, or nothing is given that says what.
    """
    if choice == Choice():
        raise InvalidInputError(
            "which runs? Give --run, --label, --trials, --robot, --since or --until; "
            f"'webots-mcp pool {pool.address} runs' lists them"
        )
    sets = chosen_trial_sets(pool, choice) if choice.trials is not None else []
    return Meant(chosen_runs(pool, choice), sets)


def chosen_trial_sets(pool: Pool, choice: Choice) -> list[PooledTrialSet]:
    """The trial sets that are meant: all, or the one of that UUID, as each recording has it."""
    sets = pooled_trial_sets(pool)
    if choice.trials is None:
        return sets
    if not sets:
        raise InvalidInputError(f"the pool {pool.address} holds no trial set")
    uuid = _named("trial set", choice.trials, [each.uuid for each in sets])
    return [each for each in sets if each.uuid == uuid]


def _named(what: str, asked: str, uuids: Sequence[str]) -> str:
    """The only UUID that begins so.

    Raises:
        InvalidInputError: None does, or several do.
    """
    meant = asked.strip().lower()
    found = sorted({uuid for uuid in uuids if uuid.lower().startswith(meant)})
    if len(found) == 1:
        return found[0]
    if found and meant:
        raise InvalidInputError(
            f"{len(found)} of the {what}s have a UUID that begins with {asked!r} "
            f"({', '.join(found[:_MOST_OFFERED])}, ...): give more of it"
        )
    raise _unknown(f"{what} whose UUID begins with", asked, uuids)


def _unknown(what: str, asked: str, known: Sequence[str]) -> InvalidInputError:
    newest = list(dict.fromkeys(reversed(known)))[:_MOST_COMPARED]
    offered = nearest_first(asked, newest)[:_MOST_OFFERED]
    hint = f"; nearest are {', '.join(map(repr, offered))}" if offered else ""
    return InvalidInputError(f"the pool holds no {what} {asked!r}{hint}")
