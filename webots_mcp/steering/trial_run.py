"""Running one trial in a simulator of its own, watched until it is over, and scored.

A trial knows nothing of its set, or of the recording into which it is merged, so that it runs on
another machine as well.
"""

from __future__ import annotations

import math
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, ENDED_BY
from webots_mcp.errors import (
    CommandRefusedError,
    ConditionFailedError,
    NoDatabaseError,
)
from webots_mcp.simulator.starting import CommandLine, KeptProgram, Start, any_port
from webots_mcp.steering.trial_plan import TrialPlan, WorldPlan
from webots_mcp.steering.trial_watch import End, TrialWatch
from webots_mcp.store.logs import LogFilter, LogWindow, newest_lines
from webots_mcp.store.merging import settled
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.runs import run_info
from webots_mcp.store.trial_sets import TrialResult

CONSOLE: Final = "simulator.log"
CommandOfWorld = Callable[[str], CommandLine]


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
        plan: The plan, which says when the trial ends and how it is scored.
        values: Its parameters.
        folder: An empty folder, in which its recording is left.
        stopping: Once it is set, the trial ends soon.
        begun: Called with the pid of its simulator before that does anything; with None if another
            machine runs the trial.
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
        """How many trials can run at the same time now."""
        ...

    def run(self, attempt: TrialAttempt) -> TrialResult:
        """Run a trial; leave its recording in its folder, and return its result with the run's id.

        Raises:
            StoppedError: If the caller wanted it to stop.
            InvalidInputError: If no trial of the set can succeed.
            CommandRefusedError: If no trial can be run there any more.
        """
        ...


@dataclass(frozen=True)
class LocalSimulators:
    """Simulators on this machine.

    Attributes:
        command: Returns the command that starts the simulator of a world.
        count: How many run at the same time.
    """

    command: CommandOfWorld
    count: int

    def run(self, attempt: TrialAttempt) -> TrialResult:
        """Run a trial in a simulator of this machine, see `Simulators.run`."""
        return run_attempt(attempt, self.command)


def stand_in(world: str) -> CommandLine:
    """Return the command of the stand-in."""
    return CommandLine([sys.executable, "-m", "webots_mcp.standin", world, "--mode", "fast"], [])


def webots(world: str) -> CommandLine:
    """Return the command of Webots, with a port that was free a moment ago.

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
        """Return what it printed last; empty if nothing."""
        text = (self._folder / CONSOLE).read_bytes()[-2000:].decode("utf-8", "replace")
        return next((line for line in reversed(text.splitlines()) if line.strip()), "")


def run_attempt(attempt: TrialAttempt, command: CommandOfWorld) -> TrialResult:
    """Run a trial in a simulator of this machine.

    Raises:
        StoppedError: The caller wanted it to stop.
        InvalidInputError: No trial of the set can succeed.
    """
    folder, plan = attempt.folder, attempt.plan
    environment = {DATA_DIR_VARIABLE: str(folder.absolute()), **plan.environment(attempt.values)}
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
    """Return the result of a trial that ended before its process was killed, or None."""
    watch = TrialWatch(plan)
    recording = _settled(folder)
    if recording is None:
        return None
    with recording.reader() as connection:
        end = watch.find_end(connection)
        return _scored(connection, plan, values, watch, end) if end else None


def _watched(
    attempt: TrialAttempt, watch: TrialWatch, simulator: TrialSimulator
) -> tuple[End | None, str]:
    """Wait until a trial is over; return the end that it reached, or why it reached none."""
    folder, timeout_s = attempt.folder, attempt.plan.timeout_s
    recording = RecordingAccess(folder / DATABASE_NAME, folder, read_only=True)
    until_s = time.monotonic() + timeout_s
    while True:
        over = simulator.is_over  # checked first, so that rows of its last moment are read
        try:
            with recording.reader() as connection:
                end = watch.find_end(connection)
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
        if attempt.stopping.wait(0.05):
            raise StoppedError
        ended = _ended(recording, watch)
        if ended is not None:
            return None, ended


def _ended(recording: RecordingAccess, watch: TrialWatch) -> str | None:
    """Return why the run cannot continue: its controller's process has ended."""
    if watch.run_id is None:
        return None
    with recording.reader() as connection:
        reason = run_info(connection, watch.run_id).end_reason
        if reason is None or watch.find_end(connection) is not None:
            return None
    return f"its run ended ({reason})"


def _concluded(attempt: TrialAttempt, watch: TrialWatch, end: End | None, why: str) -> TrialResult:
    recording = _settled(attempt.folder)
    if recording is None:
        text = "the controller recorded nothing in its data folder: does it name another one?"
        return TrialResult(None, None, f"{why}; {text}" if why else text)
    with recording.reader() as connection:
        end = end or watch.find_end(
            connection
        )  # rows that waited next to the database are in it now
        if end is not None:
            return _scored(connection, attempt.plan, attempt.values, watch, end)
        why = _ending_line(connection, watch.run_id) or why
    reached = "nothing" if watch.reached_s is None else f"{watch.reached_s:.3f} s"
    return TrialResult(watch.run_id, None, f"did not reach its end, only {reached}: {why}")


def _ending_line(connection: sqlite3.Connection, run_id: int | None) -> str | None:
    """Return the log line of the exception that ended the controller, if one did."""
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
    from webots_mcp.judging.run_score import score_run

    scored = score_run(connection, watch.run_id, plan.score, end_s=end.sim_time_s)
    return TrialResult(watch.run_id, scored.value, scored.why, *ended)


def _settled(folder: Path) -> RecordingAccess | None:
    """Return the recording of a trial that is over, with all rows that waited next to it."""
    try:
        return settled(folder / DATABASE_NAME)
    except NoDatabaseError:
        return None
