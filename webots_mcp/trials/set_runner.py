"""Runs the trials of a set, each in a simulator of its own, and merges what they recorded.

A process that works on a set may be killed at any moment: the next one ends its simulators, scores
trials that had ended from their recordings, and runs the others again.

In a search, samplers of Optuna (the extra `search`) propose what is tried next. A sampler is asked
for one set at a time, and knows the trial table only: the study is built again for each proposal,
in memory. So a search that was killed continues as if it had not been.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
import threading
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.contract import DATABASE_NAME, make_folder
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.requirements import explain_extra
from webots_mcp.store.merging import merge
from webots_mcp.store.parameters import (
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
from webots_mcp.store.recording import Job, Recording
from webots_mcp.trials.plan import Range, TrialPlan, WorldPlan
from webots_mcp.trials.trial_run import Simulators, StoppedError, TrialAttempt, recorded_result
from webots_mcp.webots.starting import end_left_over

if TYPE_CHECKING:
    import optuna

FOLDER: Final = "trials"
_MOST_THREADS: Final = 1000  # each waits for one trial
_PATIENCE_S: Final = 0.5  # between two checks whether the caller wants to stop
_STATES: Final = {"done": "COMPLETE", "failed": "FAIL", "pruned": "PRUNED"}
_UNDER_WAY: Final = "RUNNING"

Report = Callable[[Trial, Result], object]


@dataclass(frozen=True)
class SetRun:
    """The run of a trial set: what is tried, where, and who takes it in.

    Attributes:
        recording: Takes in what they record.
        plan: What is tried.
        simulators: In which they run.
        stopping: Once it is set, running trials end soon and wait to be run again.
        job: The set, as long as this process works on it.
    """

    recording: Recording
    plan: WorldPlan
    simulators: Simulators
    stopping: threading.Event
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


def run_trials(set_run: SetRun, set_id: int, report: Report) -> None:
    """Run the trials of a set that are not over.

    Args:
        set_run: Of the plan, and where its trials run.
        set_id: The set.
        report: Is called in this thread with each trial that is over.

    Raises:
        CommandRefusedError: Another process works on the set, the set was cancelled, or there is
            nowhere to run a trial any more.
        InvalidInputError: No trial of the set can succeed; nothing else is tried.
        StoppedError: The caller wanted to stop; running trials will be run again.
    """
    run_taken_up(taken_up(set_run, set_id), set_id, report)


def taken_up(set_run: SetRun, set_id: int) -> SetRun:
    """The same, as the process that works on the set: `run_taken_up` has to follow.

    Raises:
        CommandRefusedError: Another process works on it.
    """
    with set_run.recording.writer() as connection:
        job = Job(set_run.recording, take_up(connection, set_id))
        stop_trial_set(connection, set_id, None)
    return replace(set_run, job=job)


def run_taken_up(set_run: SetRun, set_id: int, report: Report) -> None:
    """The rest of `run_trials`; it stores why a set stops."""
    job = set_run.job
    assert job is not None
    try:
        with job.renewed():
            _run_left(set_run, set_id, report)
    except (CommandRefusedError, InvalidInputError) as error:
        with job.writer() as connection:
            if fetch_trial_set(connection, set_id).stop_reason is None:
                stop_trial_set(connection, set_id, str(error))
        raise
    finally:
        with job.writer() as connection:
            lay_down(connection, set_id, job.lease)


def _run_left(set_run: SetRun, set_id: int, report: Report) -> None:
    with set_run.recording.reader() as connection:
        trials = trials_of(connection, set_id)
    for trial in trials:
        if trial.is_over:
            shutil.rmtree(set_run.folder(trial), ignore_errors=True)
    left = deque(trial for trial in trials if not trial.is_over)
    pool = ThreadPoolExecutor(_MOST_THREADS)
    try:
        next_trial = partial(_next_trial, set_run, set_id, left)
        _run_all(set_run, pool, next_trial, partial(_require_wanted, set_run, set_id), report)
    finally:
        set_run.stopping.set()
        pool.shutdown()  # the set is ours as long as a trial of it runs


def _require_wanted(set_run: SetRun, set_id: int) -> None:
    """Check that the set was not cancelled, by whatever process.

    Raises:
        CommandRefusedError: It was.
    """
    with set_run.recording.reader() as connection:
        reason = fetch_trial_set(connection, set_id).stop_reason
    if reason is not None:
        raise CommandRefusedError(f"trial set {set_id} stopped: {reason}")


def _next_trial(set_run: SetRun, set_id: int, left: deque[Trial]) -> Trial | None:
    """One that waits, or a new one of a search; None where there is none."""
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


def _run_all(
    set_run: SetRun,
    pool: ThreadPoolExecutor,
    next_trial: Callable[[], Trial | None],
    require_wanted: Callable[[], None],
    report: Report,
) -> None:
    running: dict[Future[Result], Trial] = {}
    while True:
        require_wanted()
        count = set_run.simulators.count
        while len(running) < count and (trial := next_trial()) is not None:
            running[pool.submit(run_trial, set_run, trial)] = trial
        if not running:
            return
        for future in wait(running, _PATIENCE_S, FIRST_COMPLETED).done:
            report(running.pop(future), future.result())


def run_trial(set_run: SetRun, trial: Trial) -> Result:
    """Run one trial, or only score and merge it where it has run to its end already.

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


def _with_run(result: Result, merged: dict[str, int], folder: Path) -> Result:
    """With the id that its run has where it was merged."""
    with Recording(folder / DATABASE_NAME, folder).reader() as connection:
        row = connection.execute("SELECT uuid FROM run WHERE id = ?", (result.run_id,)).fetchone()
    return replace(result, run_id=merged[row[0]])


def _run(set_run: SetRun, trial: Trial) -> Result:
    folder = set_run.folder(trial)
    set_run.require_held()  # in that folder another process may record by now
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    if set_run.stopping.is_set():
        raise StoppedError
    begun = partial(_begin, set_run, trial)
    attempt = TrialAttempt(set_run.plan, trial.values, folder, set_run.stopping, begun)
    try:
        result = set_run.simulators.run(attempt)
    except BaseException:
        with set_run.writer() as connection:
            put_back(connection, trial)
        raise
    set_run.require_held()
    return result


def _begin(set_run: SetRun, trial: Trial, pid: int | None) -> None:
    with set_run.writer() as connection:
        begin_trial(connection, trial, pid)


# -- a search ---------------------------------------------------------------------------------


def require_optuna() -> None:
    """See that there is what a search needs, before anything is written.

    Raises:
        InvalidInputError: Optuna is not installed.
    """
    try:
        import_module("optuna")
    except ImportError as error:
        raise InvalidInputError(explain_extra("a search", "search")) from error


def next_parameters(plan: TrialPlan, trials: Sequence[Trial]) -> dict[str, Any] | None:
    """The parameters of the trial after these; None where there is none.

    Each set is tried `plan.repeats` times in a row.
    """
    number = len(trials)
    if number >= plan.trial_count:
        return None
    first = number - number % plan.repeats
    return trials[first].values if first < number else _suggested(plan, trials)


def _suggested(plan: TrialPlan, trials: Sequence[Trial]) -> dict[str, Any]:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize" if plan.best == "highest" else "minimize",
        sampler=_sampler(plan, len(trials)),
    )
    distributions = {name: _distribution(each) for name, each in plan.ranges.items()}
    for trial in trials:
        state = optuna.trial.TrialState[_STATES.get(trial.status, _UNDER_WAY)]
        study.add_trial(
            optuna.trial.create_trial(
                state=state, value=trial.score, params=trial.values, distributions=distributions
            )
        )
    return study.ask(distributions).params


def _sampler(plan: TrialPlan, number: int) -> optuna.samplers.BaseSampler:
    """A sampler seeded by the trial's number, so that a proposal depends on the trials only."""
    import optuna

    seed = random.Random(f"{plan.seed} {number}").getrandbits(32)
    if plan.search == "random":
        return optuna.samplers.RandomSampler(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # Trials that run at the same time are not to try the same place.
        return optuna.samplers.TPESampler(seed=seed, constant_liar=True)


def _distribution(each: Range) -> optuna.distributions.BaseDistribution:
    import optuna

    if each.choices is not None:
        return optuna.distributions.CategoricalDistribution(each.choices)
    assert each.low is not None
    assert each.high is not None
    if each.is_whole:
        low, high, step = int(each.low), int(each.high), int(each.step or 1)
        return optuna.distributions.IntDistribution(low, high, log=each.log, step=step)
    return optuna.distributions.FloatDistribution(each.low, each.high, log=each.log, step=each.step)
