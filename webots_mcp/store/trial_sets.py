"""Store trial sets and their trials: what is planned, what is running, and the scores so far."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from webots_mcp.analysis.summary import Best, Outcome, Ranking, rank
from webots_mcp.contract import host_name, new_uuid
from webots_mcp.database.job_leases import JobLease, give_back, holder_of, lease_of, take
from webots_mcp.database.processes import process_alive, process_identity
from webots_mcp.database.transactions import transaction
from webots_mcp.errors import CommandRefusedError, InvalidInputError, NothingRecordedError
from webots_mcp.store.run_rows import columns_of

_MOMENT: Final = "moment"  # of a plan whose trials branch off a run
_WORK: Final = "UPDATE trial_set SET host = ?, pid = ?, process = ? WHERE id = ?"


@dataclass(frozen=True)
class TrialSetRecord:
    """Runs with chosen parameters. Columns as in `store.models`; two of them are JSON text."""

    id: int
    uuid: str
    plan: str
    created_wall_time_s: float
    host: str | None
    pid: int | None
    process: str | None
    robot_id: int | None
    session_id: int | None
    former_values: str | None
    stop_reason: str | None

    @property
    def job(self) -> str:
        """The name of the lease for working on it."""
        return f"trial set {self.id}"

    @property
    def is_left(self) -> bool:
        """Return whether the process that worked on it is known to have ended, without waiting."""
        if self.pid is None:
            return True
        return self.host == host_name() and not process_alive(self.pid, self.process, time.time())


@dataclass(frozen=True)
class TrialRecord:
    """One run of a trial set. Columns as in `store.models`; `parameters` is JSON text."""

    id: int
    trial_set_id: int
    uuid: str
    number: int
    parameters: str
    status: str
    run_id: int | None
    score: float | None
    ended_by: str | None
    ended_sim_time_s: float | None
    error: str | None
    started_wall_time_s: float | None
    finished_wall_time_s: float | None
    pid: int | None
    process: str | None

    @property
    def values(self) -> dict[str, Any]:
        """The parameters."""
        return json.loads(self.parameters)

    @property
    def is_over(self) -> bool:
        """Whether it need not run any more."""
        return self.status in ("done", "failed", "pruned")


@dataclass(frozen=True)
class TrialResult:
    """The outcome of a trial: a score or an error.

    Attributes:
        error: Why there is no score.
        ended_by: `for_s`, `until` or `prune`; None if it was not completed.
        pruned: Whether it was ended early because its score could no longer be good.
    """

    run_id: int | None
    score: float | None
    error: str | None
    ended_by: str | None = None
    ended_sim_time_s: float | None = None
    pruned: bool = False

    @property
    def status(self) -> str:
        """The status of a trial with this result."""
        if self.pruned:
            return "pruned"
        return "failed" if self.score is None else "done"


def create_trial_set(
    connection: sqlite3.Connection,
    plan: str,
    parameters: list[dict[str, Any]],
    robot_id: int | None = None,
) -> int:
    """Create a set and its trials, in the order in which they will run. Return its id.

    Args:
        connection: A connection in the role "writer".
        plan: The plan as JSON text.
        parameters: The parameters of each trial.
        robot_id: The robot in whose simulation they run; None if each has its own.

    Raises:
        CommandRefusedError: Another set of that robot is not over.
    """
    with transaction(connection):
        if robot_id is not None:
            _require_free(connection, robot_id)
        values = (new_uuid(), plan, time.time(), robot_id)
        set_id = int(
            connection.execute(
                "INSERT INTO trial_set (uuid, plan, created_wall_time_s, robot_id) "
                "VALUES (?, ?, ?, ?) RETURNING id",
                values,
            ).fetchone()[0]
        )
        for number, values in enumerate(parameters, 1):
            _enter(connection, set_id, number, values)
    return set_id


def add_trial(connection: sqlite3.Connection, set_id: int, values: dict[str, Any]) -> TrialRecord:
    """Add one more trial to a set whose search continues."""
    _enter(connection, set_id, len(trials_of(connection, set_id)) + 1, values)
    return trials_of(connection, set_id)[-1]


def _enter(
    connection: sqlite3.Connection, set_id: int, number: int, values: dict[str, Any]
) -> None:
    text = json.dumps(values, ensure_ascii=False)
    connection.execute(
        "INSERT INTO trial (trial_set_id, uuid, number, parameters, status) "
        "VALUES (?, ?, ?, ?, 'waiting')",
        (set_id, new_uuid(), number, text),
    )


def _require_free(connection: sqlite3.Connection, robot_id: int) -> None:
    """Refuse a second set in one simulation."""
    for (set_id,) in connection.execute(
        "SELECT id FROM trial_set WHERE robot_id = ? ORDER BY id DESC", (robot_id,)
    ).fetchall():
        found = fetch_trial_set(connection, set_id)
        if is_at_work(connection, found):
            raise CommandRefusedError(
                f"Trial set {set_id} of this robot is under way. Wait for it with "
                f"webots_run_trials(trial_set={set_id}), or end it with cancel=true"
            )
        is_left = found.stop_reason is None and next_trial(connection, set_id) is not None
        if is_left or found.former_values is not None:
            why = found.stop_reason or "its server ended"
            raise CommandRefusedError(
                f"Trial set {set_id} of this robot is not over ({why}). "
                f"webots_run_trials(trial_set={set_id}) continues it, cancel=true ends it"
            )


def find_trial_set(connection: sqlite3.Connection, plan: str | None = None) -> int | None:
    """Return the newest set with exactly this plan; without one the newest of all."""
    return connection.execute(
        "SELECT max(id) FROM trial_set WHERE plan = coalesce(?, plan)", (plan,)
    ).fetchone()[0]


def fetch_trial_set(connection: sqlite3.Connection, set_id: int) -> TrialSetRecord:
    """Return the set with an id.

    Raises:
        InvalidInputError: The set does not exist.
    """
    row = connection.execute(
        f"SELECT {columns_of(TrialSetRecord)} FROM trial_set WHERE id = ?", (set_id,)
    ).fetchone()
    if row is None:
        newest = find_trial_set(connection)
        if newest is None:
            raise InvalidInputError(
                f"No trial set {set_id} is recorded: none was started yet. Only "
                "webots_run_trials starts one."
            )
        raise InvalidInputError(
            f"No trial set {set_id} is recorded. The newest is {newest}: use trial_set={newest}."
        )
    return TrialSetRecord(*row)


def is_at_work(connection: sqlite3.Connection, found: TrialSetRecord) -> bool:
    """Return whether a process works on a set: it seems alive and renews its lease."""
    return not found.is_left and holder_of(connection, found.job) is not None


def next_trial(connection: sqlite3.Connection, set_id: int) -> TrialRecord | None:
    """Return the trial that is next, or was begun; None if all are over."""
    row = connection.execute(
        f"SELECT {columns_of(TrialRecord)} FROM trial WHERE trial_set_id = ? "
        "AND status IN ('running', 'waiting') ORDER BY status = 'waiting', number LIMIT 1",
        (set_id,),
    ).fetchone()
    return TrialRecord(*row) if row else None


def stop_trial_set(connection: sqlite3.Connection, set_id: int, reason: str | None) -> None:
    """Record why a set stops after its current trial; None lets it continue."""
    connection.execute("UPDATE trial_set SET stop_reason = ? WHERE id = ?", (reason, set_id))


def borrow_parameters(
    connection: sqlite3.Connection, set_id: int, session_id: int, former: dict[str, Any] | None
) -> None:
    """Store the original parameters of a controller; None once they are restored."""
    text = None if former is None else json.dumps(former, ensure_ascii=False)
    connection.execute(
        "UPDATE trial_set SET session_id = ?, former_values = ? WHERE id = ?",
        (session_id, text, set_id),
    )


def trials_of(connection: sqlite3.Connection, set_id: int) -> list[TrialRecord]:
    """Return the trials of a set, in order.

    Raises:
        InvalidInputError: The set does not exist.
    """
    fetch_trial_set(connection, set_id)
    return [
        TrialRecord(*row)
        for row in connection.execute(
            f"SELECT {columns_of(TrialRecord)} FROM trial WHERE trial_set_id = ? ORDER BY number",
            (set_id,),
        ).fetchall()
    ]


def take_up(connection: sqlite3.Connection, set_id: int) -> JobLease:
    """Become the process that works on a set, as long as it renews the lease.

    Raises:
        CommandRefusedError: Another process works on it.
    """
    with transaction(connection):
        found = fetch_trial_set(connection, set_id)
        lease = lease_of(found.job)
        if not take(connection, lease, forced=found.is_left):
            raise CommandRefusedError(
                f"Process {found.pid} on {found.host} works on trial set {set_id}. Wait for it, "
                "or end that process."
            )
        if found.host not in (None, host_name()):  # its simulators run on that host
            connection.execute(
                "UPDATE trial SET pid = NULL, process = NULL WHERE trial_set_id = ?", (set_id,)
            )
        own = os.getpid()
        connection.execute(_WORK, (host_name(), own, process_identity(own), set_id))
    return lease


def lay_down(connection: sqlite3.Connection, set_id: int, lease: JobLease) -> None:
    """Release a set to other processes: at once, if this is in the transaction of a `Job`."""
    connection.execute(_WORK, (None, None, None, set_id))
    give_back(connection, lease)


def begin_trial(
    connection: sqlite3.Connection, trial: TrialRecord, pid: int | None = None
) -> TrialRecord:
    """Record that a trial runs: in a simulator with that pid, or in that of a live controller."""
    process = None if pid is None else process_identity(pid)
    now_s = time.time()
    connection.execute(
        "UPDATE trial SET status = 'running', started_wall_time_s = ?, pid = ?, process = ? "
        "WHERE id = ?",
        (now_s, pid, process, trial.id),
    )
    return replace(trial, status="running", started_wall_time_s=now_s, pid=pid, process=process)


def put_back(connection: sqlite3.Connection, trial: TrialRecord) -> None:
    """Record that a trial did not run to its end and waits again."""
    connection.execute(
        "UPDATE trial "
        "SET status = 'waiting', started_wall_time_s = NULL, pid = NULL, process = NULL "
        "WHERE id = ? AND status = 'running'",
        (trial.id,),
    )


def finish_trial(connection: sqlite3.Connection, trial: TrialRecord, result: TrialResult) -> None:
    """Record the outcome of a trial; its run gets a label unless it has one."""
    plan = json.loads(fetch_trial_set(connection, trial.trial_set_id).plan)
    label = f"trial {trial.number} of set {trial.trial_set_id}: {spelled(trial.values)}"[:100]
    if _MOMENT in plan:
        label = f"branch of {_origin(connection, plan)}: {spelled(trial.values)}"[:100]
    now = {"id": trial.id, "status": result.status, "now": time.time()}
    connection.execute(
        "UPDATE trial SET status = :status, run_id = :run_id, score = :score, ended_by = "
        ":ended_by, ended_sim_time_s = :ended_sim_time_s, error = :error, finished_wall_time_s = "
        ":now, pid = NULL, process = NULL WHERE id = :id",
        vars(result) | now,
    )
    connection.execute(
        "UPDATE run SET label = coalesce(label, ?) WHERE id = ?", (label, result.run_id)
    )


def origins_of(connection: sqlite3.Connection, run_ids: Sequence[int]) -> dict[int, str]:
    """Return from which run, and at which moment, those of these runs branched that did."""
    return {
        run_id: _origin(connection, json.loads(plan))
        for run_id, plan in connection.execute(
            "SELECT t.run_id, s.plan FROM trial t JOIN trial_set s ON s.id = t.trial_set_id "
            "WHERE t.run_id IN (SELECT value FROM json_each(?)) AND json_valid(s.plan) "
            f"AND json_type(s.plan, '$.{_MOMENT}') = 'object'",
            (json.dumps(list(run_ids)),),
        ).fetchall()
    }


def origin_run(connection: sqlite3.Connection, plan: Mapping[str, Any]) -> int | None:
    """Return the run that the branches of a plan continue; None if it is not recorded here."""
    uuid = plan[_MOMENT]["run"]
    row = connection.execute("SELECT id FROM run WHERE uuid = ?", (uuid,)).fetchone()
    return row[0] if row else None


def is_branching(plan: Mapping[str, Any]) -> bool:
    """Return whether the trials of a stored plan are branches of a run."""
    return _MOMENT in plan


def _origin(connection: sqlite3.Connection, plan: Mapping[str, Any]) -> str:
    run_id = origin_run(connection, plan)
    run = "a run that is not recorded here" if run_id is None else f"run {run_id}"
    return f"{run} at {plan[_MOMENT]['sim_time_s']:.3f} s"


def spelled(values: Mapping[str, Any]) -> str:
    """Return values of parameters in one line."""
    return ", ".join(f"{name} {value}" for name, value in values.items())


def scored_runs(connection: sqlite3.Connection, set_id: int) -> dict[str, list[int]]:
    """Return the runs with a score by their parameters in one line, the best first.

    Raises:
        InvalidInputError: The set does not exist.
        NothingRecordedError: None of its runs has a score.
    """
    trials = trials_of(connection, set_id)
    plan = json.loads(fetch_trial_set(connection, set_id).plan)
    runs: dict[str, list[int]] = {}
    for each in trials:
        if each.score is not None and each.run_id is not None:
            runs.setdefault(spelled(each.values), []).append(each.run_id)
    if not runs:
        raise NothingRecordedError(
            f"No run of trial set {set_id} has a score yet. "
            f"webots_get_trials(trial_set={set_id}) shows why."
        )
    ranked = [spelled(each.parameters) for each in ranking_of(trials, best_of(plan)).sets]
    return {name: runs[name] for name in ranked if name in runs}


def best_of(plan: Mapping[str, Any]) -> Best:
    """Return which scores of a stored plan are the best."""
    return "lowest" if plan.get("best") == "lowest" else "highest"


def count_planned(plan: Mapping[str, Any], trials: Sequence[TrialRecord]) -> int:
    """Return how many trials a set will have; those of a search are added as it continues."""
    return max(len(trials), int(plan.get("sets") or 0) * int(plan.get("repeats") or 1))


def progress_of(connection: sqlite3.Connection, set_id: int) -> tuple[float, float, str]:
    """Return how many trials of a set are over, the total, and a status word."""
    over, of, last = connection.execute(
        "SELECT count(finished_wall_time_s), count(*), (SELECT score FROM trial "
        "WHERE trial_set_id = t.trial_set_id ORDER BY finished_wall_time_s DESC LIMIT 1) "
        "FROM trial t WHERE trial_set_id = ?",
        (set_id,),
    ).fetchone()
    return over, of, f"{over} of {of} trials" + ("" if last is None else f", the last: {last:g}")


def ranking_of(trials: list[TrialRecord], best: Best) -> Ranking:
    """Return the parameter sets of the finished trials, the best first."""
    return rank(
        [
            Outcome(each.values, each.score, each.error, pruned=each.status == "pruned")
            for each in trials
            if each.is_over
        ],
        best,
    )
