"""Runs the trials of a set, each in a simulator of its own, and merges what they recorded.

Whoever works on a set may be killed at any moment: the next one ends its simulators, scores a trial
that had come to its end from its recording, and runs any other again.
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
from functools import partial
from pathlib import Path
from typing import Any, Final

from webots_mcp.contract import DATABASE_NAME, make_folder
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.store.jobs import Job
from webots_mcp.store.merging import merge
from webots_mcp.store.recording import Recording
from webots_mcp.store.trials import (
    Result,
    Trial,
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
from webots_mcp.trials.plan import Plan, WorldPlan
from webots_mcp.trials.running import Attempt, Simulators, StoppedError, recorded_result
from webots_mcp.webots.starting import end_left_over

FOLDER: Final = "trials"
_MOST_THREADS: Final = 1000  # each waits for one trial
_PATIENCE_S: Final = 0.5  # between two looks at whether somebody wants to stop

Told = Callable[[Trial, Result], object]
Search = Callable[[Plan, list[Trial]], "dict[str, Any] | None"]


@dataclass(frozen=True)
class Workshop:
    """Where and how trials are run.

    Attributes:
        recording: Takes in what they record.
        plan: What is tried.
        simulators: In which they run.
        stopping: Once it is set, running trials end soon and wait to be run again.
        search: Says the parameters of the trial after those that there are, or None where there is
            none; None where all were entered with the set.
        job: The set, as long as this process works on it.
    """

    recording: Recording
    plan: WorldPlan
    simulators: Simulators
    stopping: threading.Event
    search: Search | None = None
    job: Job | None = None

    def writer(self) -> AbstractContextManager[sqlite3.Connection]:
        """For what only the process may write that works on the set; see `Job.writer`."""
        assert self.job is not None  # `run_trials` has taken it up
        return self.job.writer()

    def require_held(self) -> None:
        """See `Job.require_held`."""
        with self.writer():
            pass

    def folder(self, trial: Trial) -> Path:
        """The data folder of a trial."""
        return self.recording.data_dir / FOLDER / trial.uuid


def run_trials(workshop: Workshop, set_id: int, told: Told) -> None:
    """Run the trials of a set that are not over.

    Args:
        workshop: Where and how.
        set_id: The set.
        told: Is called in this thread with each trial that is over.

    Raises:
        CommandRefusedError: Another process works on the set, somebody cancelled it, or there is
            nowhere to run a trial any more.
        InvalidInputError: No trial of the set can succeed; nothing else is tried.
        StoppedError: Somebody wanted them to stop; what ran waits to be run again.
    """
    run_taken_up(taken_up(workshop, set_id), set_id, told)


def taken_up(workshop: Workshop, set_id: int) -> Workshop:
    """A workshop that works on a set: `run_taken_up` has to follow.

    Raises:
        CommandRefusedError: Another process works on it.
    """
    with workshop.recording.writer() as connection:
        job = Job(workshop.recording, take_up(connection, set_id))
        stop_trial_set(connection, set_id, None)
    return replace(workshop, job=job)


def run_taken_up(workshop: Workshop, set_id: int, told: Told) -> None:
    """The rest of `run_trials`; why a set does not go on is noted in it."""
    job = workshop.job
    assert job is not None
    try:
        with job.renewed():
            _run_left(workshop, set_id, told)
    except (CommandRefusedError, InvalidInputError) as error:
        with job.writer() as connection:
            if fetch_trial_set(connection, set_id).stop_reason is None:
                stop_trial_set(connection, set_id, str(error))
        raise
    finally:
        with job.writer() as connection:
            lay_down(connection, set_id, job.lease)


def _run_left(workshop: Workshop, set_id: int, told: Told) -> None:
    with workshop.recording.reader() as connection:
        trials = trials_of(connection, set_id)
    for trial in trials:
        if trial.is_over:
            shutil.rmtree(workshop.folder(trial), ignore_errors=True)
    left = deque(trial for trial in trials if not trial.is_over)
    pool = ThreadPoolExecutor(_MOST_THREADS)
    try:
        next_trial = partial(_next_trial, workshop, set_id, left)
        _run_all(workshop, pool, next_trial, partial(_require_wanted, workshop, set_id), told)
    finally:
        workshop.stopping.set()
        pool.shutdown()  # the set is ours as long as a trial of it runs


def _require_wanted(workshop: Workshop, set_id: int) -> None:
    """See that nobody, in whatever process, has cancelled the set.

    Raises:
        CommandRefusedError: Somebody has.
    """
    with workshop.recording.reader() as connection:
        reason = fetch_trial_set(connection, set_id).stop_reason
    if reason is not None:
        raise CommandRefusedError(f"trial set {set_id} stopped: {reason}")


def _next_trial(workshop: Workshop, set_id: int, left: deque[Trial]) -> Trial | None:
    """One that waits, or a new one of a search; None where there is none, or none yet."""
    if left:
        return left.popleft()
    if workshop.search is None:
        return None
    with workshop.recording.reader() as connection:
        trials = trials_of(connection, set_id)
    values = workshop.search(workshop.plan, trials)
    if values is None:
        return None
    with workshop.writer() as connection:
        return add_trial(connection, set_id, values)


def _run_all(
    workshop: Workshop,
    pool: ThreadPoolExecutor,
    next_trial: Callable[[], Trial | None],
    require_wanted: Callable[[], None],
    told: Told,
) -> None:
    running: dict[Future[Result], Trial] = {}
    while True:
        require_wanted()
        count = workshop.simulators.count
        while len(running) < count and (trial := next_trial()) is not None:
            running[pool.submit(run_trial, workshop, trial)] = trial
        if not running:
            return
        for future in wait(running, _PATIENCE_S, FIRST_COMPLETED).done:
            told(running.pop(future), future.result())


def run_trial(workshop: Workshop, trial: Trial) -> Result:
    """Run one trial, or only score and merge it where it has run to its end already.

    Raises:
        StoppedError: It waits to be run again.
        InvalidInputError: No trial of the set can succeed.
    """
    folder = workshop.folder(trial)
    result = None
    if trial.status == "running":
        if trial.pid is not None and trial.started_wall_time_s is not None:
            end_left_over(trial.pid, trial.process, trial.started_wall_time_s)
        result = recorded_result(workshop.plan, trial.values, folder)
    if result is None:
        result = _run(workshop, trial)
    if result.run_id is not None:
        with workshop.recording.writer() as connection:
            merged = merge(connection, workshop.recording.data_dir, folder / DATABASE_NAME)
        result = _with_run(result, merged, folder)
    with workshop.writer() as connection:
        finish_trial(connection, trial, result)
    shutil.rmtree(folder, ignore_errors=True)
    return result


def _with_run(result: Result, merged: dict[str, int], folder: Path) -> Result:
    """With the id that its run has where it was merged."""
    with Recording(folder / DATABASE_NAME, folder).reader() as connection:
        row = connection.execute("SELECT uuid FROM run WHERE id = ?", (result.run_id,)).fetchone()
    return replace(result, run_id=merged[row[0]])


def _run(workshop: Workshop, trial: Trial) -> Result:
    folder = workshop.folder(trial)
    workshop.require_held()  # in that folder another process may record by now
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if workshop.stopping.is_set():
        raise StoppedError
    begun = partial(_begin, workshop, trial)
    attempt = Attempt(workshop.plan, trial.values, folder, workshop.stopping, begun)
    try:
        result = workshop.simulators.run(attempt)
    except BaseException:
        with workshop.writer() as connection:
            put_back(connection, trial)
        raise
    workshop.require_held()
    return result


def _begin(workshop: Workshop, trial: Trial, pid: int | None) -> None:
    with workshop.writer() as connection:
        begin_trial(connection, trial, pid)
