"""Runs the trials of a set one after another in a robot's simulation, in a thread of the server.

Each result is in the database before the next action, so that another server can continue where
this one was killed: the command of a trial has a key by which it is found again, and is never sent
twice.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
import time
from collections.abc import Mapping
from contextvars import copy_context
from dataclasses import dataclass
from typing import Any, Final, Protocol

from webots_mcp.database.queue import CommandQueue, QueuedCommand, fetch_command, find_command
from webots_mcp.errors import CommandRefusedError, InvalidInputError, LeaseLostError, WebotsMCPError
from webots_mcp.steering.dispatch import BLOCK_NOTICED_S, withdraw_if_blocked
from webots_mcp.steering.run_command import ACTION
from webots_mcp.steering.target_robot import find_target
from webots_mcp.steering.trial_plan import TrialPlan, stored_plan
from webots_mcp.store.recording import Job, RecordingAccess, RobotView
from webots_mcp.store.requests import permit
from webots_mcp.store.robot_status import find_block
from webots_mcp.store.robots import robot_name
from webots_mcp.store.run_parameters import described, parameters_of
from webots_mcp.store.trial_sets import (
    TrialRecord,
    TrialResult,
    TrialSetRecord,
    begin_trial,
    borrow_parameters,
    fetch_trial_set,
    finish_trial,
    lay_down,
    next_trial,
    put_back,
    stop_trial_set,
    take_up,
    trials_of,
)

OF_EACH_TRIAL: Final[Mapping[str, Any]] = {"reset": True, "pace": "fast", "then": "pause"}
_ASKER: Final = "trials"
_ENDS: Final = {"condition held": "until", "simulation time reached": "for_s", "pruned": "prune"}
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrialTimes:
    """Times of working on trials, in seconds of wall time unless stated otherwise.

    Attributes:
        poll_s: Between two reads of a command.
        settle_s: Between two times of ingesting rows that wait in files.
        block_search_s: Between two searches for what keeps the loop from a command.
        patience_s: For a command that takes a round of the loop.
        end_patience_s: The same when the server ends.
        new_run_sim_s: Simulation time of the run after the last trial: long enough that time
            visibly goes back at the next reset, by which a reset is detected.
    """

    poll_s: float = 0.02
    settle_s: float = 1.0
    block_search_s: float = 0.25
    patience_s: float = 5.0
    end_patience_s: float = 2.0
    new_run_sim_s: float = 0.2


_TIMES: Final = TrialTimes()


class _StopError(Exception):
    """The server ends, or the call was cancelled; another server can continue the set."""


class TrialWorker(threading.Thread):
    """Works on a set until it is over or cannot be continued.

    Args:
        recording: The recording of the robot.
        set_id: The set.

    Raises:
        CommandRefusedError: Another process works on it.
    """

    def __init__(self, recording: RecordingAccess, set_id: int) -> None:
        super().__init__(name=f"trial set {set_id}", daemon=True)
        self._context = copy_context()  # in which it is known who asked for the trials
        self._recording = recording
        self.set_id = set_id
        self._stopping = threading.Event()
        with recording.writer() as connection:
            self._job = Job(recording, take_up(connection, set_id))
            self._set = fetch_trial_set(connection, set_id)
            self._robot = robot_name(connection, self._set.robot_id or 0)
        self._plan: TrialPlan = stored_plan(self._set.plan)

    def stop(self) -> None:
        """End the running trial, which will be run again later, and leave the set as it is."""
        self._stopping.set()
        self.join(2 * _TIMES.end_patience_s + 1)

    def run(self) -> None:
        """Run the rest of the set, as long as this thread has the set's lease."""
        try:
            with self._job.renewed():
                self._context.run(self._work)
        except LeaseLostError as error:
            _log.warning("%s", error)

    def _work(self) -> None:
        try:
            while (trial := self._next()) is not None:
                self._try(trial)
        except LeaseLostError:
            raise
        except _StopError:
            pass
        except WebotsMCPError as error:
            self._record_stop(str(error))
        except Exception as error:  # noqa: BLE001  (a thread must not end without a report)
            _log.exception("trial set %d failed", self.set_id)
            self._record_stop(f"a defect of webots-mcp ({type(error).__name__}: {error})")
        finally:
            self._leave()

    # -- one trial -----------------------------------------------------------------------------

    def _next(self) -> TrialRecord | None:
        """Return the next trial, first one that a killed server began; None if the set stops."""
        if self._stopping.is_set():
            raise _StopError
        with self._recording.reader() as connection:
            trial = next_trial(connection, self.set_id)
            stops = fetch_trial_set(connection, self.set_id).stop_reason is not None
        return None if trial and trial.status == "waiting" and stops else trial

    def _try(self, trial: TrialRecord) -> None:
        try:
            command = self._watched(self._sent(trial), self._plan.timeout_s)
            result = self._result(trial, command)
        except BaseException:
            with self._job.writer() as connection:
                put_back(connection, trial)
            raise
        with self._job.writer() as connection:
            finish_trial(connection, trial, result)
        if not command.is_final:
            raise CommandRefusedError(
                f"The loop of robot {self._robot!r} no longer calls bridge.get_command(). "
                "Check what it is waiting for, or restart its controller."
            )

    def _sent(self, trial: TrialRecord) -> QueuedCommand:
        """Return the command that runs a trial; one that was sent already is not sent again."""
        with self._job.writer() as connection:
            known = find_command(connection, _key(trial))
            if known is not None:
                return known
            view = self._borrow(connection)
            former = fetch_trial_set(connection, self.set_id).former_values or "{}"
        asked = self._asked(json.loads(former) | trial.values)
        # Outside of a transaction: a refusal is recorded by another connection.
        request_id = permit(self._recording, ACTION, asked)
        with self._job.writer() as connection:
            begun = begin_trial(connection, trial) if trial.status == "waiting" else trial
            return CommandQueue(connection).enqueue(
                view.robot.id,
                ACTION,
                asked,
                requested_by=_ASKER,
                idempotency_key=_key(begun),
                request_id=request_id,
            )

    def _asked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters of a trial's `run` command.

        They name every tried parameter, since a reset keeps the values of the trial before.
        """
        asked = {
            "until": self._plan.until,
            "prune": self._plan.prune,
            "for_s": self._plan.for_s,
            "parameters": values,
            "by": "trial",
            **OF_EACH_TRIAL,
        }
        return {name: value for name, value in asked.items() if value is not None}

    def _borrow(self, connection: sqlite3.Connection) -> RobotView:
        """Find the robot, and store the values of its parameters once for each session."""
        view = find_target(connection, self._robot, ACTION)
        noted = fetch_trial_set(connection, self.set_id)
        assert view.session is not None  # it is live
        if noted.former_values is None or noted.session_id != view.session.id:
            tried = {name for values in self._plan.parameters for name in values}
            known = {each["name"]: each for each in described(connection, view.require_run())}
            former = {name: _value(known[name]) for name in known if name in tried}
            borrow_parameters(connection, self.set_id, view.session.id, former)
        return view

    def _watched(self, command: QueuedCommand, timeout_s: float) -> QueuedCommand:
        """Wait until the command is final; a run that takes longer is ended."""
        command = self._settled(command.id, timeout_s)
        if not command.is_final:
            self._cancel(command)
            command = self._settled(command.id, _TIMES.patience_s)
        return command

    def _settled(
        self, command_id: int, timeout_s: float, *, hurried: bool = False
    ) -> QueuedCommand:
        """Return the command, once it is final or the time is over."""
        until_s, settle_s = time.monotonic() + timeout_s, time.monotonic() + _TIMES.settle_s
        search_s = time.monotonic() + BLOCK_NOTICED_S
        with self._recording.reader() as connection:
            while not (command := fetch_command(connection, command_id)).is_final:
                now_s = time.monotonic()
                if now_s >= until_s:
                    break
                if now_s >= settle_s:
                    settle_s = now_s + _TIMES.settle_s
                    self._recording.settle()
                if command.status == "pending" and now_s >= search_s:
                    search_s = now_s + _TIMES.block_search_s
                    if withdraw_if_blocked(self._recording, command):
                        continue
                if hurried:
                    time.sleep(_TIMES.poll_s)
                elif self._stopping.wait(_TIMES.poll_s):
                    self._cancel(command)
                    self._settled(command_id, _TIMES.end_patience_s, hurried=True)
                    raise _StopError
        return command

    def _cancel(self, command: QueuedCommand) -> None:
        """Cancel a pending command, or end a running one."""
        with self._job.writer() as connection:
            queue = CommandQueue(connection)
            if not queue.cancel(command.id, "its trial was stopped"):
                params = {"command_id": command.id}
                queue.enqueue(command.robot_id, "cancel_run", params, requested_by=_ASKER)

    # -- results -------------------------------------------------------------------------------

    def _result(self, trial: TrialRecord, command: QueuedCommand) -> TrialResult:
        """Return the result of a trial.

        Raises:
            CommandRefusedError: No controller ran it, or another command interrupted it.
            InvalidInputError: No trial of the set can succeed.
        """
        if command.status in ("expired", "cancelled"):
            with self._recording.reader() as connection:
                find_target(connection, self._robot, ACTION)  # raises with the reason, if any
            raise CommandRefusedError(f"trial {trial.number} was not run: {command.error}")
        with self._recording.reader() as connection:
            run_id = connection.execute(
                (
                    "SELECT min(id) FROM run WHERE session_id = ? AND started_wall_time_s >= "
                    "(SELECT claimed_wall_time_s FROM command WHERE id = ?)"
                ),
                (command.session_id, command.id),
            ).fetchone()[0]
            if command.status != "done":
                why = self._too_long if command.status == "claimed" else command.error
                return TrialResult(run_id, None, f"{_reached(connection, run_id)}: {why}")
            answer: Mapping[str, Any] = command.decoded_result() or {}
            if answer.get("ended") in _ENDS:
                _require_untouched(connection, trial, run_id, answer["sim_time_s"])
                return self._scored(connection, run_id, answer)
            return TrialResult(run_id, None, self._why_not(connection, trial, run_id, answer))

    def _why_not(
        self,
        connection: sqlite3.Connection,
        trial: TrialRecord,
        run_id: int | None,
        answer: Mapping[str, Any],
    ) -> str:
        """Return why a run ended without having reached its end."""
        why = str(answer.get("why") or answer.get("ended"))
        if answer.get("ended") == "interrupted":
            if "cancelled" not in why:
                raise CommandRefusedError(f"trial {trial.number} was interrupted: {why}")
            why = self._too_long
        return f"{_reached(connection, run_id)}: {why}"

    @property
    def _too_long(self) -> str:
        return f"it took longer than {self._plan.timeout_s:g} s of wall time"

    def _scored(
        self, connection: sqlite3.Connection, run_id: int, answer: Mapping[str, Any]
    ) -> TrialResult:
        end_s = answer["sim_time_s"]
        ended = (_ENDS[answer["ended"]], end_s)
        if answer["ended"] == "pruned":
            why = f"{self._plan.prune!r} held at {end_s:.3f} s"
            return TrialResult(run_id, None, why, *ended, pruned=True)
        try:
            from webots_mcp.judging.run_score import score_run

            scored = score_run(connection, run_id, self._plan.score, end_s=end_s)
        except InvalidInputError as error:
            if not any(each.score is not None for each in trials_of(connection, self.set_id)):
                raise
            return TrialResult(run_id, None, str(error), *ended)
        return TrialResult(run_id, scored.value, scored.why, *ended)

    # -- at the end ----------------------------------------------------------------------------

    def _record_stop(self, reason: str) -> None:
        """Store why the set stops, unless a reason is stored already."""
        with self._job.writer() as connection:
            if fetch_trial_set(connection, self.set_id).stop_reason is None:
                stop_trial_set(connection, self.set_id, reason)

    def _leave(self) -> None:
        """Restore the parameters, and release the set for other servers."""
        try:
            self._give_back()
        except LeaseLostError:
            raise
        except WebotsMCPError as error:
            _log.warning("trial set %d: the parameters were not restored: %s", self.set_id, error)
        with self._job.writer() as connection:
            lay_down(connection, self.set_id, self._job.lease)

    def _give_back(self) -> None:
        """Restore the parameters of a live controller; one that has ended needs nothing."""
        with self._job.writer() as connection:
            noted = fetch_trial_set(connection, self.set_id)
            if noted.former_values is None:
                return
            assert noted.robot_id is not None and noted.session_id is not None
        with self._recording.view(self._robot) as view:
            block = find_block(view.connection, view.session, view.run, view.now_s)
        if block is not None and view.session and view.session.id == noted.session_id:
            self._record_stop(f"its parameters were not restored: {block.why}")
            return
        with self._job.writer() as connection:
            command = self._ask_back(connection, noted)
        patience_s = _TIMES.end_patience_s if self._stopping.is_set() else _TIMES.patience_s
        if command is not None:
            command = self._settled(command.id, patience_s, hurried=True)
        if command is None or command.status == "done":
            with self._job.writer() as connection:
                borrow_parameters(connection, self.set_id, noted.session_id, None)
        else:
            self._record_stop(
                f"its parameters were not restored: {command.error or command.status}"
            )

    def _ask_back(
        self, connection: sqlite3.Connection, noted: TrialSetRecord
    ) -> QueuedCommand | None:
        """Queue the command that restores the parameters; return None if nothing is to do."""
        assert noted.robot_id is not None and noted.former_values is not None
        former = json.loads(noted.former_values)
        if noted.stop_reason is None and not self._stopping.is_set():
            action, params = ACTION, _new_run_with(former)
        elif former:  # no reset: a person may want to see the state that the trial left
            action, params = "set_parameters", {"values": former, "when": "now", "by": "trial"}
        else:
            return None
        try:
            view = find_target(connection, self._robot, action)
        except CommandRefusedError:
            return None
        if view.session is None or view.session.id != noted.session_id:
            return None
        return CommandQueue(connection).enqueue(noted.robot_id, action, params, requested_by=_ASKER)


class SetWorker(Protocol):
    """A thread that works on a trial set."""

    @property
    def set_id(self) -> int:
        """The set."""
        ...

    def start(self) -> None:
        """Begin to work."""

    def stop(self) -> None:
        """End what runs, and wait for that."""

    def is_alive(self) -> bool:
        """Return whether it works."""
        ...


class TrialWorkers:
    """The workers of a server.

    Args:
        recording: The recording of the robots.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        self._recording = recording
        self._workers: list[SetWorker] = []

    def begin(self, set_id: int) -> None:
        """Work on a set.

        Raises:
            CommandRefusedError: Another process works on it.
        """
        self.begin_worker(TrialWorker(self._recording, set_id))

    def begin_worker(self, worker: SetWorker) -> None:
        """Let a worker begin, which is stopped with the others."""
        worker.start()
        self._workers = [each for each in self._workers if each.is_alive()] + [worker]

    def end(self, set_id: int) -> None:
        """End the trials of a set that run here."""
        for worker in self._workers:
            if worker.set_id == set_id:
                worker.stop()

    def stop(self) -> None:
        """Stop all workers, since the server ends."""
        for worker in self._workers:
            worker.stop()


def _new_run_with(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `run` parameters that begin a new run, so that the last trial's run ends."""
    return {"for_s": _TIMES.new_run_sim_s, "parameters": values, "by": "trial", **OF_EACH_TRIAL}


def _key(trial: TrialRecord) -> str:
    """Return the idempotency key of a trial's command; it differs if a trial is begun again."""
    return f"trial {trial.uuid} {trial.started_wall_time_s}"


def _value(parameter: Mapping[str, Any]) -> Any:
    """Return a parameter's value; before the first is recorded, the declared default."""
    return parameter["default"] if parameter["value"] is None else parameter["value"]


def _require_untouched(
    connection: sqlite3.Connection, trial: TrialRecord, run_id: int, end_s: float
) -> None:
    """Refuse a trial whose parameters a command changed, since its score would be misattributed.

    Raises:
        CommandRefusedError: A parameter was set before the trial was over.
    """
    for name, parameter in parameters_of(connection, [run_id])[run_id].items():
        for later in parameter.settings[1:]:
            if later.set_by == "command" and later.sim_time_s < end_s:
                raise CommandRefusedError(
                    f"trial {trial.number} was interrupted: {name} was set to {later.value} "
                    f"at {later.sim_time_s:.3f} s"
                )


def _reached(connection: sqlite3.Connection, run_id: int | None) -> str:
    if run_id is None:
        return "its run did not start"
    reached_s = connection.execute(
        # Rows may follow the last heartbeat.
        "SELECT max(last_sim_time_s, coalesce("
        "(SELECT max(sim_time_s) FROM state WHERE run_id = run.id), last_sim_time_s)) "
        "FROM run WHERE id = ?",
        (run_id,),
    ).fetchone()[0]
    return f"did not reach its end, only {reached_s:.3f} s"
