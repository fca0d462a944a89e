"""Runs one trial: in a simulator of its own, watched until it is over, and scored.

What it recorded stays in its folder. Nothing here knows of the set, or of the recording that takes
it in, so that it runs on another machine as well.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, ENDED_BY, PARAMETERS_VARIABLE
from webots_mcp.errors import ConditionFailedError, NoDatabaseError
from webots_mcp.store.logs import LogFilter, Window, newest_lines
from webots_mcp.store.merging import settled
from webots_mcp.store.questions.runs import run_info
from webots_mcp.store.questions.score import score_run
from webots_mcp.store.recording import Recording
from webots_mcp.store.trials import Result
from webots_mcp.trials.plan import Plan, WorldPlan
from webots_mcp.trials.simulators import Simulator
from webots_mcp.trials.watching import End, Watch
from webots_mcp.webots.starting import CommandLine

_LOOK_EVERY_S: Final = 0.05

Command = Callable[[str], CommandLine]


class StoppedError(Exception):
    """Somebody wants the trials to stop."""


class Stopping(Protocol):
    """Whether somebody wants a trial to stop: a `threading.Event`, or what looks like one."""

    def wait(self, timeout: float | None = None, /) -> bool:
        """Wait until somebody does, or the time is over; returns which."""
        ...


@dataclass(frozen=True)
class Attempt:
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

    def run(self, attempt: Attempt) -> Result:
        """Run a trial; its recording is in its folder then, and the result has its run's id there.

        Raises:
            StoppedError: Somebody wanted it to stop.
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

    def run(self, attempt: Attempt) -> Result:
        """As `Simulators.run`."""
        return run_attempt(attempt, self.command)


def run_attempt(attempt: Attempt, command: Command) -> Result:
    """Run a trial in a simulator of this machine.

    Raises:
        StoppedError: Somebody wanted it to stop.
        InvalidInputError: No trial of the set can succeed.
    """
    folder, plan, values = attempt.folder, attempt.plan, attempt.values
    parameters = {plan.robot: values} if plan.robot else values
    environment = {DATA_DIR_VARIABLE: str(folder), PARAMETERS_VARIABLE: json.dumps(parameters)}
    simulator = Simulator(command(plan.world), folder, environment)
    watch = Watch(plan)
    try:
        attempt.begun(simulator.pid)
        simulator.start()
        end, why = _watched(attempt, watch, simulator)
    finally:
        simulator.end()
    return _concluded(attempt, watch, end, why)


def recorded_result(plan: Plan, values: dict[str, Any], folder: Path) -> Result | None:
    """Of a trial that had come to its end before somebody was killed; None where it had not."""
    watch = Watch(plan)
    recording = _settled(folder)
    if recording is None:
        return None
    with recording.reader() as connection:
        end = watch.look(connection)
        return _scored(connection, plan, values, watch, end) if end else None


def _watched(attempt: Attempt, watch: Watch, simulator: Simulator) -> tuple[End | None, str]:
    """Until the trial is over; the end that it reached, or why it reached none."""
    folder, timeout_s = attempt.folder, attempt.plan.timeout_s
    recording = Recording(folder / DATABASE_NAME, folder, read_only=True)
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
            said = f" (its simulator printed last: {last})" if last else ""
            return None, f"it took longer than {timeout_s:g} s of wall time{said}"
        if attempt.stopping.wait(_LOOK_EVERY_S):
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


def _concluded(attempt: Attempt, watch: Watch, end: End | None, why: str) -> Result:
    recording = _settled(attempt.folder)
    if recording is None:
        said = "the controller recorded nothing in its data folder: does it name another one?"
        return Result(None, None, f"{why}; {said}" if why else said)
    with recording.reader() as connection:
        end = end or watch.look(connection)  # what waited beside the database is in it now
        if end is not None:
            return _scored(connection, attempt.plan, attempt.values, watch, end)
        why = _ending_line(connection, watch.run_id) or why
    reached = "nothing" if watch.reached_s is None else f"{watch.reached_s:.3f} s"
    return Result(watch.run_id, None, f"never reached its end, but {reached}: {why}")


def _ending_line(connection: sqlite3.Connection, run_id: int | None) -> str | None:
    """By which exception the controller ended, where it did."""
    wanted = LogFilter(run_id, Window(-math.inf, math.inf), ENDED_BY, "error")
    found = newest_lines(connection, wanted, 1) if run_id is not None else []
    return found[0].message if found else None


def _scored(
    connection: sqlite3.Connection, plan: Plan, values: dict[str, Any], watch: Watch, end: End
) -> Result:
    assert watch.run_id is not None  # it has an end
    ended: tuple[Any, Any] = (end.by, end.sim_time_s)
    try:
        watch.require_parameters(connection, values)
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
