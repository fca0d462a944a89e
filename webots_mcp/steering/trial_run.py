"""Runs trials, each in a simulator of its own, watched until it is over, and scored.

One trial knows nothing of its set, or of the recording that takes it in, so that it runs on another
machine as well. A process that works on a set may be killed at any moment: the next one ends its
simulators, scores trials that had ended from their recordings, and runs the others again.

In a search, samplers of Optuna (the extra `search`) propose what is tried next. A sampler is asked
for one set at a time, and knows the trial table only: the study is built again for each proposal,
in memory. So a search that was killed continues as if it had not been.
"""

from __future__ import annotations

import json
import math
import random
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Protocol, TypeAlias

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, ENDED_BY, PARAMETERS_VARIABLE
from webots_mcp.database.files import make_folder
from webots_mcp.errors import (
    CommandRefusedError,
    ConditionFailedError,
    InvalidInputError,
    NoDatabaseError,
)
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.judging.run_score import score_run
from webots_mcp.signals.conditions import Evaluator, parse_condition
from webots_mcp.simulator.starting import CommandLine, KeptProgram, Start, any_port, end_left_over
from webots_mcp.steering.trial_plan import Range, TrialPlan, WorldPlan
from webots_mcp.store.chunks import parse
from webots_mcp.store.logs import LogFilter, LogWindow, newest_lines
from webots_mcp.store.merging import merge, settled
from webots_mcp.store.parameters import (
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
from webots_mcp.store.policy import LAUNCH
from webots_mcp.store.recording import Job, RecordingAccess
from webots_mcp.store.requests import permit
from webots_mcp.store.runs import run_info

if TYPE_CHECKING:
    import optuna

CONSOLE: Final = "simulator.log"
_LOOK_EVERY_S: Final = 0.05
_SAME_TIME_S: Final = 1e-6
_ROBOTS: Final = "SELECT id, name FROM robot ORDER BY id"
_FIRST_RUN: Final = "SELECT id, started_sim_time_s FROM run WHERE robot_id = ? ORDER BY id LIMIT 1"
_NEWEST: Final = "SELECT max(sim_time_s) FROM state WHERE run_id = ?"
_ROWS: Final = "SELECT id, sim_time_s, data FROM state WHERE run_id = ? AND id > ? ORDER BY id"
_START_VALUES: Final = (
    "SELECT name, value FROM parameter_value WHERE run_id = ? AND id IN "
    "(SELECT min(id) FROM parameter_value WHERE run_id = ? GROUP BY name)"
)
_DECLARED: Final = "SELECT name, low, high, choices FROM parameter WHERE robot_id = ?"

Command = Callable[[str], CommandLine]
Ending: TypeAlias = Literal["for_s", "until", "prune"]
FOLDER: Final = "trials"
_MOST_THREADS: Final = 1000  # each waits for one trial
_PATIENCE_S: Final = 0.5  # between two checks whether the caller wants to stop
_STATES: Final = {"done": "COMPLETE", "failed": "FAIL", "pruned": "PRUNED"}
_UNDER_WAY: Final = "RUNNING"


class StoppedError(Exception):
    """The caller wants the trials to stop."""


class Stopping(Protocol):
    """Whether the caller wants a trial to stop: a `threading.Event`, or an object like one."""

    def wait(self, timeout: float | None = None, /) -> bool:
        """Wait until the caller does, or the time is over; returns which."""
        ...


@dataclass(frozen=True)
class TrialAttempt:
    """One trial that is to be run.

    Attributes:
        plan: When it ends, and how it is scored.
        values: Its parameters.
        folder: An empty one, in which its recording is left.
        stopping: Once it is set, the trial ends soon.
        begun: Called with the pid of its simulator before that does anything; with None where it
            was handed to another machine.
    """

    plan: WorldPlan
    values: dict[str, Any]
    folder: Path
    stopping: Stopping
    begun: Callable[[int | None], object]


class Simulators(Protocol):
    """Where trials are run."""

    @property
    def count(self) -> int:
        """How many can run at once, now."""
        ...

    def run(self, attempt: TrialAttempt) -> TrialResult:
        """Run a trial; its recording is in its folder then, and the result has its run's id there.

        Raises:
            StoppedError: The caller wanted it to stop.
            InvalidInputError: No trial of the set can succeed.
            CommandRefusedError: No trial can be run there any more.
        """
        ...


@dataclass(frozen=True)
class LocalSimulators:
    """Processes of this machine.

    Attributes:
        command: Of a world's simulator.
        count: How many run at once.
    """

    command: Command
    count: int

    def run(self, attempt: TrialAttempt) -> TrialResult:
        """As `Simulators.run`."""
        return run_attempt(attempt, self.command)


def stand_in(world: str) -> CommandLine:
    """The command of the stand-in."""
    return CommandLine([sys.executable, "-m", "webots_mcp.standin", world, "--mode", "fast"], [])


def webots(world: str) -> CommandLine:
    """The command of Webots, with a port that was free a moment ago.

    Raises:
        CommandRefusedError: There is no Webots.
    """
    start = Start(Path(world), "fast", headless=True, streams=False, port=any_port())
    try:
        return start.command_line()
    except CommandRefusedError as error:
        raise CommandRefusedError(f"{error}; or try on the stand-in with --stand-in") from error


class TrialSimulator(KeptProgram):
    """A simulator that prints to a file of its folder."""

    def __init__(self, command: CommandLine, folder: Path, environment: Mapping[str, str]) -> None:
        with (folder / CONSOLE).open("wb") as console:
            super().__init__(command, environment, console, subprocess.STDOUT)
        self._folder = folder

    def last_line(self) -> str:
        """What it printed last; empty if nothing."""
        text = (self._folder / CONSOLE).read_bytes()[-2000:].decode("utf-8", "replace")
        return next((line for line in reversed(text.splitlines()) if line.strip()), "")


# -- one trial --------------------------------------------------------------------------------


def run_attempt(attempt: TrialAttempt, command: Command) -> TrialResult:
    """Run a trial in a simulator of this machine.

    Raises:
        StoppedError: The caller wanted it to stop.
        InvalidInputError: No trial of the set can succeed.
    """
    folder, plan, values = attempt.folder, attempt.plan, attempt.values
    parameters = {plan.robot: values} if plan.robot else values
    environment = {DATA_DIR_VARIABLE: str(folder), PARAMETERS_VARIABLE: json.dumps(parameters)}
    simulator = TrialSimulator(command(plan.world), folder, environment)
    watch = TrialWatch(plan)
    try:
        attempt.begun(simulator.pid)
        simulator.start()
        end, why = _watched(attempt, watch, simulator)
    finally:
        simulator.end()
    return _concluded(attempt, watch, end, why)


def recorded_result(plan: TrialPlan, values: dict[str, Any], folder: Path) -> TrialResult | None:
    """The result of a trial that had ended before its process was killed; None where it had not."""
    watch = TrialWatch(plan)
    recording = _settled(folder)
    if recording is None:
        return None
    with recording.reader() as connection:
        end = watch.look(connection)
        return _scored(connection, plan, values, watch, end) if end else None


def _watched(
    attempt: TrialAttempt, watch: TrialWatch, simulator: TrialSimulator
) -> tuple[End | None, str]:
    """Until the trial is over; the end that it reached, or why it reached none."""
    folder, timeout_s = attempt.folder, attempt.plan.timeout_s
    recording = RecordingAccess(folder / DATABASE_NAME, folder, read_only=True)
    until_s = time.monotonic() + timeout_s
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
            last = simulator.last_line() if watch.run_id is None else ""
            text = f" (its simulator printed last: {last})" if last else ""
            return None, f"it took longer than {timeout_s:g} s of wall time{text}"
        if attempt.stopping.wait(_LOOK_EVERY_S):
            raise StoppedError
        ended = _ended(recording, watch)
        if ended is not None:
            return None, ended


def _ended(recording: RecordingAccess, watch: TrialWatch) -> str | None:
    """Why the run cannot continue: its controller's process has ended."""
    if watch.run_id is None:
        return None
    with recording.reader() as connection:
        reason = run_info(connection, watch.run_id).end_reason
        if reason is None or watch.look(connection) is not None:
            return None
    return f"its run ended ({reason})"


def _concluded(attempt: TrialAttempt, watch: TrialWatch, end: End | None, why: str) -> TrialResult:
    recording = _settled(attempt.folder)
    if recording is None:
        text = "the controller recorded nothing in its data folder: does it name another one?"
        return TrialResult(None, None, f"{why}; {text}" if why else text)
    with recording.reader() as connection:
        end = end or watch.look(connection)  # rows that waited next to the database are in it now
        if end is not None:
            return _scored(connection, attempt.plan, attempt.values, watch, end)
        why = _ending_line(connection, watch.run_id) or why
    reached = "nothing" if watch.reached_s is None else f"{watch.reached_s:.3f} s"
    return TrialResult(watch.run_id, None, f"did not reach its end, only {reached}: {why}")


def _ending_line(connection: sqlite3.Connection, run_id: int | None) -> str | None:
    """By which exception the controller ended, where it did."""
    wanted = LogFilter(run_id, LogWindow(-math.inf, math.inf), ENDED_BY, "error")
    found = newest_lines(connection, wanted, 1) if run_id is not None else []
    return found[0].message if found else None


def _scored(
    connection: sqlite3.Connection,
    plan: TrialPlan,
    values: dict[str, Any],
    watch: TrialWatch,
    end: End,
) -> TrialResult:
    assert watch.run_id is not None  # it has an end
    ended: tuple[Any, Any] = (end.by, end.sim_time_s)
    try:
        watch.require_parameters(connection, values)
    except ValueError as error:
        return TrialResult(watch.run_id, None, str(error), *ended)
    if end.by == "prune":
        why = f"{plan.prune!r} held at {end.sim_time_s:.3f} s"
        return TrialResult(watch.run_id, None, why, *ended, pruned=True)
    scored = score_run(connection, watch.run_id, plan.score, end_s=end.sim_time_s)
    return TrialResult(watch.run_id, scored.value, scored.why, *ended)


def _settled(folder: Path) -> RecordingAccess | None:
    """The recording of a trial whose processes have ended, with all rows that waited next to it."""
    try:
        return settled(folder / DATABASE_NAME)
    except NoDatabaseError:
        return None


# -- where it ends ----------------------------------------------------------------------------


class End(NamedTuple):
    """The simulation time at which a trial was over, and by what."""

    sim_time_s: float
    by: Ending


class TrialWatch:
    """Follows the recording of one trial."""

    def __init__(self, plan: TrialPlan) -> None:
        self._plan = plan
        self._last_id = 0
        self._evaluators: list[tuple[Ending, Evaluator]] = []
        if plan.until is not None:
            self._evaluators.append(("until", parse_condition(plan.until).evaluator()))
        if plan.prune is not None:
            self._evaluators.append(("prune", parse_condition(plan.prune).evaluator()))
        self.robot_id: int | None = None
        self.run_id: int | None = None
        self.reached_s: float | None = None
        self._started_s = 0.0

    def look(self, connection: sqlite3.Connection) -> End | None:
        """Its end, as far as it is recorded; None before.

        Raises:
            InvalidInputError: It is not clear which robot to use, or its controller does not
                have the parameters that are to be tried.
            ConditionFailedError: `until` or `prune` cannot be asked of the signals.
        """
        if self.run_id is None and not self._find_run(connection):
            return None
        self.reached_s = connection.execute(_NEWEST, (self.run_id,)).fetchone()[0]
        if not self._evaluators:
            return self._by_time(self.reached_s)
        for row_id, sim_time_s, data in connection.execute(_ROWS, (self.run_id, self._last_id)):
            self._last_id = row_id
            if (end := self._by_time(sim_time_s)) and sim_time_s > end.sim_time_s + _SAME_TIME_S:
                return end
            if by := self._condition_at(parse(data), sim_time_s):
                return End(sim_time_s, by)
        return self._by_time(self.reached_s)

    def _condition_at(self, state: Any, sim_time_s: float) -> Ending | None:
        """Which condition holds first; each of them takes in every state."""
        held: list[Ending] = [by for by, each in self._evaluators if each.holds(state, sim_time_s)]
        return held[0] if held else None

    def require_parameters(self, connection: sqlite3.Connection, wanted: dict[str, Any]) -> None:
        """See that the run began with the values that it should have begun with.

        Raises:
            InvalidInputError: The controller has not declared one.
            ValueError: It did not take one.
        """
        if self.run_id is None:
            return
        taken = dict(connection.execute(_START_VALUES, (self.run_id, self.run_id)).fetchall())
        declared = {row[0]: row[1:] for row in connection.execute(_DECLARED, (self.robot_id,))}
        for name, value in wanted.items():
            if name not in taken:
                known = ", ".join(sorted(declared)) or "none"
                raise InvalidInputError(
                    f"the controller declares no parameter {name!r}: it declares {known}; see "
                    "bridge.parameter() in docs/trials.md"
                )
            if json.loads(taken[name]) != value:
                low, high, choices = declared.get(name, (None, None, None))
                allowed = f"choices {choices}" if choices else f"from {low} to {high}"
                raise ValueError(
                    f"{name}={value!r} was not taken ({allowed}); it ran with {taken[name]}"
                )

    def _by_time(self, sim_time_s: float | None) -> End | None:
        if self._plan.for_s is None or sim_time_s is None:
            return None
        end_s = self._started_s + self._plan.for_s
        return End(end_s, "for_s") if sim_time_s >= end_s - _SAME_TIME_S else None

    def _find_run(self, connection: sqlite3.Connection) -> bool:
        robots = connection.execute(_ROBOTS).fetchall()
        wanted = self._plan.robot
        chosen = [row for row in robots if wanted in (None, row[1])]
        if wanted is None and len(robots) > 1:
            names = ", ".join(name for _, name in robots)
            raise InvalidInputError(f"several robots record ({names}): name one as robot = '...'")
        for robot_id, _ in chosen:
            row = connection.execute(_FIRST_RUN, (robot_id,)).fetchone()
            if row is not None:
                self.robot_id = robot_id
                self.run_id, self._started_s = row
        return self.run_id is not None


# -- a set of trials ---------------------------------------------------------------------------


Report = Callable[[TrialRecord, TrialResult], object]


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

    recording: RecordingAccess
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

    def folder(self, trial: TrialRecord) -> Path:
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


def _run_left(set_run: SetRun, set_id: int, report: Report) -> None:
    with set_run.recording.reader() as connection:
        trials = trials_of(connection, set_id)
    for trial in trials:
        if trial.is_over:
            shutil.rmtree(set_run.folder(trial), ignore_errors=True)
    left = deque(trial for trial in trials if not trial.is_over)
    running: dict[Future[TrialResult], TrialRecord] = {}
    pool = ThreadPoolExecutor(_MOST_THREADS)
    try:
        while True:
            _require_wanted(set_run, set_id)
            count = set_run.simulators.count
            while len(running) < count and (trial := _next_trial(set_run, set_id, left)):
                asked = {"world": set_run.plan.world, "parameters": trial.values}
                permit(set_run.recording, LAUNCH, asked)
                running[pool.submit(run_trial, set_run, trial)] = trial
            if not running:
                return
            for future in wait(running, _PATIENCE_S, FIRST_COMPLETED).done:
                report(running.pop(future), future.result())
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


def _next_trial(set_run: SetRun, set_id: int, left: deque[TrialRecord]) -> TrialRecord | None:
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


def run_trial(set_run: SetRun, trial: TrialRecord) -> TrialResult:
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


def _with_run(result: TrialResult, merged: dict[str, int], folder: Path) -> TrialResult:
    """With the id that its run has where it was merged."""
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


def next_parameters(plan: TrialPlan, trials: Sequence[TrialRecord]) -> dict[str, Any] | None:
    """The parameters of the trial after these; None where there is none.

    Each set is tried `plan.repeats` times in a row.
    """
    number = len(trials)
    if number >= plan.trial_count:
        return None
    first = number - number % plan.repeats
    return trials[first].values if first < number else _suggested(plan, trials)


def _suggested(plan: TrialPlan, trials: Sequence[TrialRecord]) -> dict[str, Any]:
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
