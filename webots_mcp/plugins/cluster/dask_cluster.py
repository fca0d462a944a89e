"""Trials on a Dask cluster: a worker runs a simulator, and returns a score and a recording.

Workers need Dask's resource `simulator`, of which each trial takes one, so that no machine runs
more simulators than its owner allows. Dask repeats a trial whose worker died, and gives up after
some repetitions. Needs the extra `cluster`.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import re
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from operator import methodcaller
from pathlib import Path
from pkgutil import resolve_name
from platform import python_version
from typing import Any, Final, NamedTuple

from webots_mcp.contract import DATABASE_NAME, VERSION, host_name
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.steering.trial_plan import WorldPlan
from webots_mcp.steering.trial_run import (
    CommandOfWorld,
    StoppedError,
    TrialAttempt,
    run_attempt,
    stand_in,
    webots,
)
from webots_mcp.store.merging import pack, unpack
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.trial_sets import TrialResult

RESOURCE: Final = "simulator"
MOST_BYTES: Final = 100_000_000
"""Size of a packed recording that a worker returns, because it passes through the scheduler."""
_PATIENCE_S: Final = 0.5  # Between two checks for a request to stop.
_BUNDLE: Final = "recording.zip"
_LOST: Final = "the scheduler {} was lost: what is left can be gone on with once it is back"


# -- functions that workers run ---------------------------------------------------------------


@dataclass(frozen=True)
class ClusterTimes:
    """Times of working with a scheduler, in seconds.

    Attributes:
        connect_s: For a connection.
        count_every_s: Between two counts of the workers.
        without_workers_s: Without a worker, before that is reported.
    """

    connect_s: float = 10.0
    count_every_s: float = 2.0
    without_workers_s: float = 60.0


_TIMES: Final = ClusterTimes()


@dataclass(frozen=True)
class WorkerRequirements:
    """What a worker needs.

    Attributes:
        version: Version of webots-mcp.
        world: Path of the world file.
        digest: Hash of that file and the sources of the project's controllers.
        is_stand_in: Whether the stand-in runs the world, not Webots.
        ship_to: URL of a pool for the recordings; None to return them.
    """

    version: str
    world: str
    digest: str
    is_stand_in: bool
    ship_to: str | None = None

    @property
    def command(self) -> CommandOfWorld:
        """Return the command of the simulator."""
        return stand_in if self.is_stand_in else webots


class TrialReturn(NamedTuple):
    """What a worker returns: the result of a trial and its recording.

    Attributes:
        result: The result, with the run's id in that recording.
        recording: The packed recording; None if there is none, or it was shipped.
        shipped: UUID of the recording, if it was shipped.
    """

    result: TrialResult
    recording: bytes | None = None
    shipped: str | None = None


def missing_requirement(needs: WorkerRequirements) -> str | None:
    """Return why this machine cannot run a trial; None if it can."""
    if needs.version != VERSION:
        return f"it has webots-mcp {VERSION}, not {needs.version}"
    shared = "all workers need the project under the same path, such as in a shared folder"
    if not Path(needs.world).is_file():
        return f"there is no file {needs.world}: {shared}"
    if digest_of(needs.world) != needs.digest:
        return f"{needs.world}, or its controllers, are not the same there: {shared}"
    try:
        needs.command(needs.world)
        if needs.ship_to is not None:
            _require_pool(needs.ship_to)
    except WebotsMCPError as error:
        return str(error)
    return None


def _require_pool(url: str) -> None:
    """Check that a URL can name a pool, without connecting.

    Raises:
        InvalidInputError: It cannot, or the packages for it are missing.
    """
    try:
        open_pool(url)
    except ModuleNotFoundError as error:
        raise InvalidInputError(str(error)) from error


def digest_of(world: str) -> str:
    """Return the hash of a world and of the sources of its project's controllers."""
    controllers = Path(world).parent.parent / "controllers"
    sources = (
        each
        for each in controllers.rglob("*.*")
        if each.suffix in (".py", ".c", ".cc", ".cpp", ".h", ".hpp", ".java", ".m")
    )
    digest = hashlib.sha256()
    for file in (Path(world), *sorted(sources)):
        digest.update(f"{file}\0".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()


def run_on_worker(asked: dict[str, Any], plan_text: str) -> TrialReturn:
    """Run the only trial of a plan on this worker, in a temporary folder.

    Args:
        asked: Fields of its `WorkerRequirements`.
        plan_text: The plan as JSON.

    Raises:
        CommandRefusedError: This machine cannot run it.
        InvalidInputError: No trial of the set can succeed.
    """
    from distributed import get_worker

    needs = WorkerRequirements(**asked)
    worker: Any = get_worker()
    unwanted = _Cancellation(worker)
    where = f"worker {worker.address} on {host_name()}"
    if (lack := missing_requirement(needs)) is not None:
        raise CommandRefusedError(f"{where}: {lack}")
    plan = WorldPlan(**json.loads(plan_text))
    try:
        with tempfile.TemporaryDirectory(prefix="trial-", dir=worker.local_directory) as name:
            folder = Path(name) / "data"
            folder.mkdir()
            attempt = TrialAttempt(plan, plan.parameters[0], folder, unwanted, _note_nothing)
            result = run_attempt(attempt, needs.command)
            if result.run_id is None:
                return TrialReturn(result)
            if needs.ship_to is None:
                return packed(result, folder)
            return TrialReturn(result, shipped=_shipped(folder, needs.ship_to))
    except StoppedError:
        raise unwanted.as_dask_says() from None
    except InvalidInputError:
        raise  # No other worker could run it either.
    except (OSError, WebotsMCPError) as error:
        raise CommandRefusedError(f"{where}: {error}") from error


def _note_nothing(pid: int | None) -> None:
    """Store no process id: the caller cannot end a process of this machine."""


def packed(result: TrialResult, folder: Path) -> TrialReturn:
    """Return a result with its recording, or with an error if that is too large."""
    bundle = folder.parent / _BUNDLE
    pack(folder, bundle)
    size = bundle.stat().st_size
    if size > MOST_BYTES:
        why = (
            f"its recording has {size:,} bytes packed, and a worker returns at most "
            f"{MOST_BYTES:,}: --ship-to has it come through a pool instead"
        )
        return TrialReturn(replace(result, run_id=None, score=None, error=why, pruned=False))
    return TrialReturn(result, bundle.read_bytes())


def _shipped(folder: Path, url: str) -> str:
    """Ship the recording to the pool, and return its UUID."""
    from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, ship
    from webots_mcp.plugins.pool.shipping_source import ShippingSource

    recording = RecordingAccess(folder / DATABASE_NAME, folder, read_only=True)
    ship(
        ShippingJob(recording, partial(open_pool, url, ships=True), full=True, pictures=True),
        ShippingReport(),
    )
    with recording.reader() as connection:
        return ShippingSource(connection).uuid()


class _Cancellation:
    """Tells whether the current task was cancelled, or its worker is closing.

    The tasks of a client that has ended, even by being killed, are cancelled.
    """

    def __init__(self, worker: Any) -> None:
        self._worker = worker
        self._key = worker.get_current_task()

    def wait(self, timeout: float | None = None, /) -> bool:
        """Wait for a timeout; return whether the task was cancelled."""
        time.sleep(timeout or 0.0)
        task = self._worker.state.tasks.get(self._key)
        return task is None or task.state == "cancelled" or self._closes

    @property
    def _closes(self) -> bool:
        return self._worker.status.name in ("closing", "closed", "failed")

    def as_dask_says(self) -> Exception:
        """Return the exception that makes Dask run the task elsewhere, or end it."""
        from distributed import Reschedule

        return Reschedule() if self._closes else StoppedError()


# -- functions of the process that runs the trial set -----------------------------------------


class ClusterSimulators:
    """The simulators of a cluster's workers.

    Attributes:
        client: The client of Dask.
        address: Address of the scheduler.
        needs: What each worker needs.
        most: Maximum of trials at once; None for as many as there are simulators.
        notes: Notes for the user.
    """

    def __init__(
        self, client: Any, address: str, needs: WorkerRequirements, most: int | None
    ) -> None:
        self.notes = _other_pythons(client)
        self._client = client
        self._address = address
        self._needs = needs
        self._most = most
        self._executor: Executor = client.get_executor(pure=False, resources={RESOURCE: 1})
        self._count = 0
        self._seen_s = time.monotonic()
        self._look_again_s = 0.0

    @property
    def count(self) -> int:
        """Return how many trials can run at once now; 1 while missing workers may come back.

        Raises:
            CommandRefusedError: The scheduler was lost, or has had no workers for a minute.
        """
        now_s = time.monotonic()
        if now_s >= self._look_again_s:
            self._look_again_s = now_s + _TIMES.count_every_s
            self._count = sum(_simulators_of(self._client, self._address).values())
        if self._count:
            self._seen_s = now_s
        elif now_s > self._seen_s + _TIMES.without_workers_s:
            raise CommandRefusedError(_no_workers(self._address, "any more"))
        return max(1, min(self._count, self._most or self._count))

    def run(self, attempt: TrialAttempt) -> TrialResult:
        """Run a trial; see `Simulators.run`."""
        attempt.begun(None)
        text = _alone(attempt.plan, attempt.values).text
        future: Future[TrialReturn] = self._executor.submit(
            _call(asdict(self._needs), text),
            "webots_mcp.plugins.cluster.dask_cluster:run_on_worker",
        )
        while not wait([future], _PATIENCE_S).done:
            if attempt.stopping.wait(0):
                future.cancel()
                raise StoppedError
        returned = self._returned(future)
        if returned.shipped is not None:
            return self._fetched(returned.result, returned.shipped, attempt.folder)
        if returned.recording is not None:
            bundle = attempt.folder / _BUNDLE
            bundle.write_bytes(returned.recording)
            unpack(bundle, attempt.folder)
            bundle.unlink()
        return returned.result

    def _fetched(self, result: TrialResult, recording_uuid: str, folder: Path) -> TrialResult:
        """Fetch a shipped recording into the folder; return the result with the run's id there."""
        from webots_mcp.plugins.pool.fetching import fetch
        from webots_mcp.plugins.pool.pool_contents import ChosenRuns, pooled_runs

        assert self._needs.ship_to is not None
        recording = RecordingAccess(folder / DATABASE_NAME, folder)
        recording.create()
        with open_pool(self._needs.ship_to) as pool, recording.writer() as connection:
            runs = [each for each in pooled_runs(pool) if each.recording_uuid == recording_uuid]
            ids = fetch(pool, connection, folder, ChosenRuns(runs, ())).runs
        (own,) = (ids[each.uuid] for each in runs if each.run_id == result.run_id)
        return replace(result, run_id=own)

    def _returned(self, future: Future[TrialReturn]) -> TrialReturn:
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            why = (
                f"{error.allowed_failures + 1} workers died while they ran it, the last one "
                f"{error.last_worker.address}: see their logs"
            )
            return TrialReturn(TrialResult(None, None, why))
        except CancelledError as error:
            raise CommandRefusedError(_LOST.format(self._address)) from error
        except WebotsMCPError:
            raise
        except Exception as error:
            raise CommandRefusedError(
                f"a worker of {self._address} failed ({type(error).__name__}: {error})"
            ) from error


@contextmanager
def cluster(
    address: str,
    plan: WorldPlan,
    *,
    is_stand_in: bool,
    most: int | None = None,
    ship_to: str | None = None,
) -> Generator[ClusterSimulators]:
    """Connect to the simulators of a cluster for the duration of the block.

    Args:
        address: Address of the scheduler.
        plan: The plan of the trials.
        is_stand_in: Whether the stand-in runs them, not Webots.
        most: Maximum of trials at once; None for as many as there are simulators.
        ship_to: URL of a pool that passes the recordings on; None for the scheduler.

    Raises:
        CommandRefusedError: The scheduler does not answer, no worker has a simulator, or a worker
            lacks something.
        InvalidInputError: The address is invalid, or Dask is not installed.
    """
    if ship_to is not None:
        _require_pool(ship_to)
        ship_to = ship_to if "://" in ship_to else str(Path(ship_to).absolute())
    with _connected(address) as client:
        needs = WorkerRequirements(VERSION, plan.world, digest_of(plan.world), is_stand_in, ship_to)
        _require_fit(client, address, needs)
        yield ClusterSimulators(client, address, needs, most)


@contextmanager
def _connected(address: str) -> Generator[Any]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise InvalidInputError(explain_extra("a cluster of Dask", "cluster")) from error
    # A lost scheduler is reported in a sentence where it is noticed, not by Dask's traceback.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    if not re.fullmatch(r"(tcp|tls|ws|wss)://[^\s/]+:[0-9]{1,5}", address):
        raise InvalidInputError(
            f"scheduler {address!r} is no address, such as tcp://HOST:8786 or tls://HOST:8786"
        )
    if address.startswith(("tls://", "wss://")) and distributed.Security().tls_ca_file is None:
        raise InvalidInputError(
            f"{address} needs certificates, of which Dask's configuration tells: "
            "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ..._TLS__CLIENT__CERT and ..._TLS__CLIENT__KEY"
        )
    nobody = f"no Dask scheduler answers at {address}"
    try:
        kind = asyncio.run(
            asyncio.wait_for(_kind_of_server(distributed, address), 2 * _TIMES.connect_s)
        )
    except Exception as error:
        why = str(error) or "what listens there is something else"
        raise CommandRefusedError(f"{nobody}: {why}") from error
    if kind != "Scheduler":
        raise CommandRefusedError(f"{nobody}, but a {kind.lower()}")
    client = distributed.Client(address, timeout=_TIMES.connect_s, set_as_default=False)
    try:
        yield client
    finally:
        client.close(timeout=_PATIENCE_S)


async def _kind_of_server(distributed: Any, address: str) -> str:
    """Return `Scheduler` or `Worker`. A `Client` would wait for ever for any other server."""
    security = distributed.Security().get_connection_args("client")
    async with distributed.rpc(
        address, timeout=_TIMES.connect_s, connection_args=security
    ) as server:
        return (await server.identity())["type"]


def _require_fit(client: Any, address: str, needs: WorkerRequirements) -> None:
    """Check that there are workers with simulators, and that they meet all requirements.

    Raises:
        CommandRefusedError: There is none, or one lacks something.
    """
    workers = list(_simulators_of(client, address))
    if not workers:
        raise CommandRefusedError(_no_workers(address, "yet"))
    lacks = [*_other_versions(client, workers)]
    if not lacks:
        found = client.run(missing_requirement, needs, workers=workers)
        lacks = [f"worker {each}: {lack}" for each, lack in found.items() if lack is not None]
    if lacks:
        more = f" (and {len(lacks) - 1} other workers)" if len(lacks) > 1 else ""
        raise CommandRefusedError(f"{lacks[0]}{more}")


def _other_versions(client: Any, workers: list[str]) -> Iterator[str]:
    """Yield workers with another version of webots-mcp, which cannot be asked for the rest."""
    versions = client.get_versions(packages=["webots_mcp"])["workers"]
    for each in workers:
        version = versions[each]["packages"].get("webots_mcp")
        if version != VERSION:
            has = f"webots-mcp {version}" if version else "no webots-mcp"
            python = versions[each]["host"]["python"]
            yield f"worker {each} (Python {python}) has {has}: here is {VERSION}"


def _other_pythons(client: Any) -> list[str]:
    """Return notes on workers with another minor version of Python, which may change scores."""
    here, workers = python_version(), client.get_versions()["workers"]
    minor = here.split(".")[:2]
    pythons = {each: str(info["host"]["python"]) for each, info in workers.items()}
    others = {each: said for each, said in pythons.items() if said.split(".")[:2] != minor}
    if not others:
        return []
    some, said = next(iter(others.items()))
    return [f"{len(others)} workers, such as {some}, have Python {said}: here is {here}"]


def _simulators_of(client: Any, address: str) -> dict[str, int]:
    """Return how many simulators each worker can run at once, by its address."""
    try:
        workers = client.scheduler_info(n_workers=-1)["workers"]
    except Exception as error:
        raise CommandRefusedError(_LOST.format(address)) from error
    found = {
        each: min(int(info["resources"].get(RESOURCE, 0)), info["nthreads"])
        for each, info in workers.items()
    }
    return {each: number for each, number in found.items() if number}


def _no_workers(address: str, when: str) -> str:
    return (
        f"the scheduler {address} has no worker with the resource {RESOURCE!r} {when}: start some "
        f"with 'dask worker {address} --resources {RESOURCE}=1 --nthreads 1'"
    )


def _call(*arguments: Any) -> Callable[[str], Any]:
    """Return a function that calls a function by its name with these arguments.

    The scheduler unpickles what it passes on, and may not have this package. Only a worker resolves
    the name.
    """
    toolz: Any = import_module("toolz")  # A dependency of Dask.
    return toolz.compose(methodcaller("__call__", *arguments), resolve_name)


def _alone(plan: WorldPlan, values: dict[str, Any]) -> WorldPlan:
    """Return a plan of one trial, as a worker needs no others."""
    return replace(plan, parameters=[values], repeats=1, ranges={}, search=None, sets=0, seed=0)
