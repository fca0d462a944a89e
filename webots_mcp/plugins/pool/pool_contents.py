"""Opening a pool by its URL, listing what it holds, and choosing some of its runs.

`postgresql://[USER@]HOST[:PORT]/DATABASE` and `postgresql:///?service=NAME` are PostgreSQL; a
folder, `file:///FOLDER` and any other URL that fsspec knows are a dataset of Parquet files.
Passwords come from PGPASSWORD, ~/.pgpass or a service file: every process could see them in a URL.
"""

from __future__ import annotations

import fnmatch
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Final

from webots_mcp.cli.options import Parameter
from webots_mcp.errors import InvalidInputError, PoolError
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.plugins.pool.pool_interface import LISTED, Pool, require_no_secret
from webots_mcp.signals.naming import nearest_first
from webots_mcp.store.reading.ranges import parse_wall_time

_CONNECTION_STRING: Final = re.compile(
    r"(^|\s)(host|hostaddr|dbname|user|password|passfile|service)\s*=", re.IGNORECASE
)


@dataclass(frozen=True)
class SimilarNames:
    """How similar names are searched.

    Attributes:
        offered: Similar names that an error offers.
        compared: Names or UUIDs to compare with.
    """

    offered: int = 3
    compared: int = 2000


_SIMILAR: Final = SimilarNames()


def open_pool(url: str, *, ships: bool = False) -> Pool:
    """Return the pool of a URL, not yet connected. Its packages are imported on this call.

    Args:
        url: URL of PostgreSQL or of files.
        ships: Whether to ship to it, and not only read it.

    Raises:
        InvalidInputError: The URL names no pool, or holds a secret.
        PoolError: The packages of an extra are missing.
    """
    if is_postgres(url):
        try:
            import_module("psycopg")
        except ImportError as missing:  # Of psycopg itself, or of a libpq for it.
            raise PoolError(explain_extra("a pool in PostgreSQL", "postgres")) from missing
        from webots_mcp.plugins.pool.postgres_pool import PostgresPool

        return PostgresPool(url, ships=ships)
    from webots_mcp.plugins.pool.parquet_pool import ParquetPool

    return ParquetPool(url, ships=ships)


def is_postgres(url: str) -> bool:
    """Return whether a URL names PostgreSQL rather than files.

    Raises:
        InvalidInputError: It contains a secret, or is neither a URL nor a folder.
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
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", url):
        raise InvalidInputError(
            f"{url!r} is neither a URL nor a folder: write postgresql://HOST/DATABASE, "
            "s3://BUCKET/PREFIX or ./FOLDER"
        )
    return False


@dataclass(frozen=True)
class PooledRun:
    """A run in a pool. Its UUID is empty if an old version recorded it."""

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
    """A trial set in a pool. `runs` are those of its trials: UUID of the recording and run id."""

    recording_uuid: str
    trial_set_id: int
    uuid: str
    created_wall_time_s: float
    trials: int
    runs: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class PooledRobot:
    """A robot name in a pool, with totals of its runs."""

    robot: str
    recordings: int
    runs: int
    row_count: int
    started_wall_time_s: float
    last_wall_time_s: float


def pooled_runs(pool: Pool) -> list[PooledRun]:
    """Return all runs, by start time."""
    robots = {(owner, robot_id): name for owner, (robot_id, name) in pool.rows_of("robot")}
    found: list[PooledRun] = []
    for owner, (run_id, robot_id, uuid, *others) in pool.rows_of("run"):
        named = dict(zip(LISTED["run"][3:], others, strict=True))
        robot = robots.get((owner, robot_id), "")
        found.append(PooledRun(owner, run_id, uuid or "", robot, **named))
    return sorted(found, key=lambda run: (run.started_wall_time_s, run.recording_uuid, run.run_id))


def pooled_trial_sets(pool: Pool) -> list[PooledTrialSet]:
    """Return all trial sets, by creation time."""
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
    """Return the robots of some runs, the one that recorded last first."""
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


def _option(name: str, metavar: str, text: str) -> Parameter:
    return Parameter(name, metavar=metavar, help=text)


@Parameter(name="*")
@dataclass(frozen=True)
class RunFilter:
    """Options that choose runs: those to which all given options apply."""

    run_uuid: Annotated[
        str | None, _option("--run", "UUID", "Only the run with this UUID, or its first letters.")
    ] = None
    label: Annotated[
        str | None, _option("--label", "TEXT", "Only runs with this label; '*' means any text.")
    ] = None
    trials: Annotated[
        str | None,
        _option(
            "--trials",
            "UUID",
            "Only the runs of the trial set with this UUID, or its first letters.",
        ),
    ] = None
    robot: Annotated[str | None, _option("--robot", "NAME", "Only runs of this robot.")] = None
    since: Annotated[
        str | None,
        _option(
            "--since",
            "TIME",
            "Only runs that ended after this wall-clock time: 2026-05-01T03:00:00Z, or Unix "
            "seconds.",
        ),
    ] = None
    until: Annotated[
        str | None, _option("--until", "TIME", "Only runs that began before this wall-clock time.")
    ] = None


@dataclass(frozen=True)
class ChosenRuns:
    """The runs and trial sets that a filter chooses.

    Attributes:
        runs: Runs by start time.
        trial_sets: The chosen trial set, once for each recording that has it.
    """

    runs: Sequence[PooledRun]
    trial_sets: Sequence[PooledTrialSet]


def chosen_runs(pool: Pool, choice: RunFilter) -> list[PooledRun]:
    """Return the chosen runs, by start time.

    Raises:
        InvalidInputError: There is none. The text names similar ones.
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


def resolve_filter(pool: Pool, choice: RunFilter) -> ChosenRuns:
    """Return the runs and trial sets to fetch.

    Raises:
        InvalidInputError: Nothing is chosen, or no option is given.
    """
    if choice == RunFilter():
        raise InvalidInputError(
            "which runs? Give --run, --label, --trials, --robot, --since or --until; "
            f"'webots-mcp pool {pool.address} runs' lists them"
        )
    sets = chosen_trial_sets(pool, choice) if choice.trials is not None else []
    return ChosenRuns(chosen_runs(pool, choice), sets)


def chosen_trial_sets(pool: Pool, choice: RunFilter) -> list[PooledTrialSet]:
    """Return all trial sets, or the one with the chosen UUID from each recording that has it."""
    sets = pooled_trial_sets(pool)
    if choice.trials is None:
        return sets
    if not sets:
        raise InvalidInputError(f"the pool {pool.address} holds no trial set")
    uuid = _named("trial set", choice.trials, [each.uuid for each in sets])
    return [each for each in sets if each.uuid == uuid]


def _named(what: str, asked: str, uuids: Sequence[str]) -> str:
    """Return the only UUID that begins with a text.

    Raises:
        InvalidInputError: None does, or several do.
    """
    resolve_filter = asked.strip().lower()
    found = sorted({uuid for uuid in uuids if uuid.lower().startswith(resolve_filter)})
    if len(found) == 1:
        return found[0]
    if found and resolve_filter:
        raise InvalidInputError(
            f"{len(found)} of the {what}s have a UUID that begins with {asked!r} "
            f"({', '.join(found[: _SIMILAR.offered])}, ...): give more of it"
        )
    raise _unknown(f"{what} whose UUID begins with", asked, uuids)


def _unknown(what: str, asked: str, known: Sequence[str]) -> InvalidInputError:
    newest = list(dict.fromkeys(reversed(known)))[: _SIMILAR.compared]
    offered = nearest_first(asked, newest)[: _SIMILAR.offered]
    hint = f"; nearest are {', '.join(map(repr, offered))}" if offered else ""
    return InvalidInputError(f"the pool holds no {what} {asked!r}{hint}")
