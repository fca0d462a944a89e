"""Running the trials of a set: some at once, each merged into the recording when it is over.

A process that works on a set may be killed at any moment. The next one ends its simulators, scores
the trials that had ended from their recordings, and runs the others again.
"""

from __future__ import annotations

import shutil
import sqlite3
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.files import make_folder
from webots_mcp.errors import (
    CommandRefusedError,
    InvalidInputError,
)
from webots_mcp.simulator.starting import end_left_over
from webots_mcp.steering.trial_plan import WorldPlan
from webots_mcp.steering.trial_run import Simulators, StoppedError, TrialAttempt, recorded_result
from webots_mcp.steering.trial_search import next_parameters
from webots_mcp.store.merging import merge
from webots_mcp.store.policy import LAUNCH
from webots_mcp.store.recording import Job, RecordingAccess
from webots_mcp.store.requests import permit
from webots_mcp.store.trial_sets import (
    TrialRecord,
    TrialResult,
    add_trial,
    begin_trial,
    fetch_trial_set,
    finish_trial,
    lay_down,
    put_back,
    stop_trial_set,
    take_up,
    trials_of,
)

FOLDER: Final = "trials"
TrialReport = Callable[[TrialRecord, TrialResult], object]


@dataclass(frozen=True)
class SetRun:
    """What is needed to run a trial set.

    Attributes:
        recording: The recording into which each trial is merged.
        plan: The plan of the trials.
        simulators: The simulators in which they run.
        stopping: Once it is set, running trials end soon and wait to be run again.
        job: The lease of the set, while this process works on it.
    """

    recording: RecordingAccess
    plan: WorldPlan
    simulators: Simulators
    stopping: threading.Event
    job: Job | None = None

    def writer(self) -> AbstractContextManager[sqlite3.Connection]:
        """Open a connection for what only the process that works on the set may write."""
        assert self.job is not None  # `run_trials` has taken it up
        return self.job.writer()

    def require_held(self) -> None:
        """Raise LeaseLostError if another process works on the set now."""
        with self.writer():
            pass

    def folder(self, trial: TrialRecord) -> Path:
        """Return the data folder of a trial."""
        return self.recording.data_dir / FOLDER / trial.uuid


def run_trials(set_run: SetRun, set_id: int, report: TrialReport) -> None:
    """Run the trials of a set that are not over.

    Args:
        set_run: The plan, and where its trials run.
        set_id: The set.
        report: Called in this thread with each trial that is over.

    Raises:
        CommandRefusedError: Another process works on the set, the set was cancelled, or there is
            nowhere to run a trial any more.
        InvalidInputError: No trial of the set can succeed; nothing else is tried.
        StoppedError: The caller wanted to stop; running trials will be run again.
        NotAllowedError: A rule of the project forbids what would be tried next.
    """
    with set_run.recording.writer() as connection:
        job = Job(set_run.recording, take_up(connection, set_id))
        stop_trial_set(connection, set_id, None)
    try:
        with job.renewed():
            _run_left(replace(set_run, job=job), set_id, report)
    except (CommandRefusedError, InvalidInputError) as error:
        with job.writer() as connection:
            if fetch_trial_set(connection, set_id).stop_reason is None:
                stop_trial_set(connection, set_id, str(error))
        raise
    finally:
        with job.writer() as connection:
            lay_down(connection, set_id, job.lease)


def _run_left(set_run: SetRun, set_id: int, report: TrialReport) -> None:
    with set_run.recording.reader() as connection:
        trials = trials_of(connection, set_id)
    for trial in trials:
        if trial.is_over:
            shutil.rmtree(set_run.folder(trial), ignore_errors=True)
    left = deque(trial for trial in trials if not trial.is_over)
    running: dict[Future[TrialResult], TrialRecord] = {}
    pool = ThreadPoolExecutor(1000)  # each waits for one trial
    try:
        while True:
            _require_wanted(set_run, set_id)
            count = set_run.simulators.count
            while len(running) < count and (trial := _next_trial(set_run, set_id, left)):
                asked = {"world": set_run.plan.own_world, "parameters": trial.values}
                permit(set_run.recording, LAUNCH, asked)
                running[pool.submit(run_trial, set_run, trial)] = trial
            if not running:
                return
            for future in wait(running, 0.5, FIRST_COMPLETED).done:
                report(running.pop(future), future.result())
    finally:
        set_run.stopping.set()
        pool.shutdown()  # the set is ours as long as a trial of it runs


def _require_wanted(set_run: SetRun, set_id: int) -> None:
    """Check that no process has cancelled the set.

    Raises:
        CommandRefusedError: If one has.
    """
    with set_run.recording.reader() as connection:
        reason = fetch_trial_set(connection, set_id).stop_reason
    if reason is not None:
        raise CommandRefusedError(f"trial set {set_id} stopped: {reason}")


def _next_trial(set_run: SetRun, set_id: int, left: deque[TrialRecord]) -> TrialRecord | None:
    """Return a waiting trial, or a new one of a search; None if there is none."""
    if left:
        return left.popleft()
    if set_run.plan.search is None:
        return None
    with set_run.recording.reader() as connection:
        trials = trials_of(connection, set_id)
    values = next_parameters(set_run.plan, trials)
    if values is None:
        return None
    with set_run.writer() as connection:
        return add_trial(connection, set_id, values)


def run_trial(set_run: SetRun, trial: TrialRecord) -> TrialResult:
    """Run one trial, or only score and merge it if it has run to its end already.

    Raises:
        StoppedError: It waits to be run again.
        InvalidInputError: No trial of the set can succeed.
    """
    folder = set_run.folder(trial)
    result = None
    if trial.status == "running":
        if trial.pid is not None and trial.started_wall_time_s is not None:
            end_left_over(trial.pid, trial.process, trial.started_wall_time_s)
        result = recorded_result(set_run.plan, trial.values, folder)
    if result is None:
        result = _run(set_run, trial)
    if result.run_id is not None:
        with set_run.recording.writer() as connection:
            merged = merge(connection, set_run.recording.data_dir, folder / DATABASE_NAME)
        result = _with_run(result, merged, folder)
    with set_run.writer() as connection:
        finish_trial(connection, trial, result)
    shutil.rmtree(folder, ignore_errors=True)
    return result


def _with_run(result: TrialResult, merged: dict[str, int], folder: Path) -> TrialResult:
    """Return a result with the id that its run has in the recording into which it was merged."""
    with RecordingAccess(folder / DATABASE_NAME, folder).reader() as connection:
        row = connection.execute("SELECT uuid FROM run WHERE id = ?", (result.run_id,)).fetchone()
    return replace(result, run_id=merged[row[0]])


def _run(set_run: SetRun, trial: TrialRecord) -> TrialResult:
    folder = set_run.folder(trial)
    set_run.require_held()  # in that folder another process may record by now
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if set_run.stopping.is_set():
        raise StoppedError

    def begun(pid: int | None) -> None:
        with set_run.writer() as connection:
            begin_trial(connection, trial, pid)

    attempt = TrialAttempt(set_run.plan, trial.values, folder, set_run.stopping, begun)
    try:
        result = set_run.simulators.run(attempt)
    except BaseException:
        with set_run.writer() as connection:
            put_back(connection, trial)
        raise
    set_run.require_held()
    return result
