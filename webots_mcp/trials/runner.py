"""Runs the trials of a set, each in a simulator of its own, and merges what they recorded.

Whoever works on a set may be killed at any moment: the next one ends its simulators, scores a trial
that had come to its end from its recording, and runs any other again.
"""

from __future__ import annotations

import json
import math
import shutil
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from webots_mcp.contract import (
    DATA_DIR_VARIABLE,
    DATABASE_NAME,
    ENDED_BY,
    PARAMETERS_VARIABLE,
    make_folder,
)
from webots_mcp.errors import (
    ConditionFailedError,
    NoDatabaseError,
)
from webots_mcp.store.leases import Job
from webots_mcp.store.logs import LogFilter, newest_lines
from webots_mcp.store.merging import merge, settled
from webots_mcp.store.questions.runs import run_info
from webots_mcp.store.questions.score import score_run
from webots_mcp.store.recording import Recording
from webots_mcp.store.trials import (
    Result,
    Trial,
    add_trial,
    begin_trial,
    finish_trial,
    lay_down,
    put_back,
    take_up,
    trials_of,
)
from webots_mcp.store.window import Window
from webots_mcp.trials.plan import Plan, WorldPlan
from webots_mcp.trials.simulators import Simulator
from webots_mcp.trials.watching import End, Watch
from webots_mcp.webots.kept_program import CommandLine, end_left_over

FOLDER: Final = "trials"
_LOOK_EVERY_S: Final = 0.05
_PATIENCE_S: Final = 0.5  # between two looks at whether somebody wants to stop

Command = Callable[[str], CommandLine]
Told = Callable[[Trial, Result], object]
Search = Callable[[Plan, list[Trial]], "dict[str, Any] | None"]


class StoppedError(Exception):
    """Somebody wants the trials to stop."""


@dataclass(frozen=True)
class Workshop:
    """Where and how trials are run.

    Attributes:
        recording: Takes in what they record.
        plan: What is tried.
        command: Of a world's simulator.
        stopping: Once it is set, running trials end soon and wait to be run again.
        search: Says the parameters of the trial after those that there are, or None where there is
            none; None where all were entered with the set.
        job: The set, as long as this process works on it.
    """

    recording: Recording
    plan: WorldPlan
    command: Command
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


def run_trials(workshop: Workshop, set_id: int, jobs: int, told: Told) -> None:
    """Run the trials of a set that are not over.

    Args:
        workshop: Where and how.
        set_id: The set.
        jobs: How many at once.
        told: Is called in this thread with each trial that is over.

    Raises:
        CommandRefusedError: Another process works on the set.
        InvalidInputError: No trial of the set can succeed; nothing else is tried.
        StoppedError: Somebody wanted them to stop; what ran waits to be run again.
    """
    with workshop.recording.writer() as connection:
        lease = take_up(connection, set_id)
        trials = trials_of(connection, set_id)
    job = Job(workshop.recording, lease)
    try:
        with job.renewed():
            _run_left(replace(workshop, job=job), set_id, trials, jobs, told)
    finally:
        with job.writer() as connection:
            lay_down(connection, set_id, lease)


def _run_left(workshop: Workshop, set_id: int, trials: list[Trial], jobs: int, told: Told) -> None:
    for trial in trials:
        if trial.is_over:
            shutil.rmtree(workshop.folder(trial), ignore_errors=True)
    left = deque(trial for trial in trials if not trial.is_over)
    pool = ThreadPoolExecutor(jobs)
    try:
        _run_all(workshop, pool, jobs, partial(_next_trial, workshop, set_id, left), told)
    finally:
        workshop.stopping.set()
        pool.shutdown()  # the set is ours as long as a trial of it runs


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
    jobs: int,
    next_trial: Callable[[], Trial | None],
    told: Told,
) -> None:
    running: dict[Future[Result], Trial] = {}
    while True:
        while len(running) < jobs and (trial := next_trial()) is not None:
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
        result = _recorded_result(workshop, trial)
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


def _recorded_result(workshop: Workshop, trial: Trial) -> Result | None:
    """Of a trial whose end was recorded before somebody was killed."""
    watch = Watch(workshop.plan)
    recording = _settled(workshop.folder(trial))
    if recording is None:
        return None
    with recording.reader() as connection:
        end = watch.look(connection)
        return _scored(connection, workshop.plan, trial, watch, end) if end else None


def _run(workshop: Workshop, trial: Trial) -> Result:
    folder, plan = workshop.folder(trial), workshop.plan
    workshop.require_held()  # in that folder another process may record by now
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if workshop.stopping.is_set():
        raise StoppedError
    parameters = {plan.robot: trial.values} if plan.robot else trial.values
    environment = {
        DATA_DIR_VARIABLE: str(folder),
        PARAMETERS_VARIABLE: json.dumps(parameters),
    }
    simulator = Simulator(workshop.command(plan.world), folder, environment)
    watch = Watch(plan)
    try:
        with workshop.writer() as connection:
            begin_trial(connection, trial, simulator.pid)
        simulator.start()
        end, why = _watched(workshop, watch, simulator, folder)
    except BaseException:
        simulator.end()
        with workshop.writer() as connection:
            put_back(connection, trial)
        raise
    simulator.end()
    workshop.require_held()
    return _concluded(folder, plan, trial, watch, end, why)


def _watched(
    workshop: Workshop, watch: Watch, simulator: Simulator, folder: Path
) -> tuple[End | None, str]:
    """Until the trial is over; the end that it reached, or why it reached none."""
    recording = Recording(folder / DATABASE_NAME, folder, read_only=True)
    until_s = time.monotonic() + workshop.plan.timeout_s
    while True:
        over = simulator.is_over  # before the look: what came last is seen
        try:
            with recording.reader() as connection:
                end = watch.look(connection)
        except NoDatabaseError:
            end = None
        except ConditionFailedError as error:
            return None, str(error)
        if end is not None:
            return end, ""
        if over:
            return None, f"its simulator ended ({simulator.last_line()})"
        if time.monotonic() > until_s:
            return None, f"it took longer than {workshop.plan.timeout_s:g} s of wall time"
        if workshop.stopping.wait(_LOOK_EVERY_S):
            raise StoppedError
        ended = _ended(recording, watch)
        if ended is not None:
            return None, ended


def _ended(recording: Recording, watch: Watch) -> str | None:
    """Why the run cannot go on: its controller's process is gone."""
    if watch.run_id is None:
        return None
    with recording.reader() as connection:
        reason = run_info(connection, watch.run_id).end_reason
        if reason is None or watch.look(connection) is not None:
            return None
    return f"its run ended ({reason})"


def _concluded(
    folder: Path, plan: Plan, trial: Trial, watch: Watch, end: End | None, why: str
) -> Result:
    recording = _settled(folder)
    if recording is None:
        said = "the controller recorded nothing in its data folder: does it name another one?"
        return Result(None, None, f"{why}; {said}" if why else said)
    with recording.reader() as connection:
        end = end or watch.look(connection)  # what waited beside the database is in it now
        if end is not None:
            return _scored(connection, plan, trial, watch, end)
        why = _ending_line(connection, watch.run_id) or why
    reached = "nothing" if watch.reached_s is None else f"{watch.reached_s:.3f} s"
    return Result(watch.run_id, None, f"never reached its end, but {reached}: {why}")


def _ending_line(connection: sqlite3.Connection, run_id: int | None) -> str | None:
    """By which exception the controller ended, where it did."""
    wanted = LogFilter(run_id, Window(-math.inf, math.inf), ENDED_BY, "error")
    found = newest_lines(connection, wanted, 1) if run_id is not None else []
    return found[0].message if found else None


def _scored(
    connection: sqlite3.Connection, plan: Plan, trial: Trial, watch: Watch, end: End
) -> Result:
    assert watch.run_id is not None  # it has an end
    ended: tuple[Any, Any] = (end.by, end.sim_time_s)
    try:
        watch.require_parameters(connection, trial.values)
    except ValueError as error:
        return Result(watch.run_id, None, str(error), *ended)
    if end.by == "prune":
        why = f"{plan.prune!r} held at {end.sim_time_s:.3f} s"
        return Result(watch.run_id, None, why, *ended, pruned=True)
    scored = score_run(connection, watch.run_id, plan.score, end_s=end.sim_time_s)
    return Result(watch.run_id, scored.value, scored.why, *ended)


def _settled(folder: Path) -> Recording | None:
    """The recording of a trial whose processes are gone, with all that waited beside it."""
    try:
        return settled(folder / DATABASE_NAME)
    except NoDatabaseError:
        return None
