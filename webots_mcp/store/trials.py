"""Trial sets and their trials: what is planned, what goes on, and what came of it."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from dataclasses import dataclass
from typing import Any, Final

from webots_mcp.connection import transaction
from webots_mcp.contract import host_name, new_uuid
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.liveness import process_alive, process_identity
from webots_mcp.store.analysis.ranking import Best, Outcome, Ranking, rank
from webots_mcp.store.rows import columns_of

_NEW_SET: Final = (
    "INSERT INTO trial_set (uuid, plan, created_wall_time_s) VALUES (?, ?, ?) RETURNING id"
)
_NEW_TRIAL: Final = (
    "INSERT INTO trial (trial_set_id, uuid, number, parameters, status) "
    "VALUES (?, ?, ?, ?, 'waiting')"
)
_NEWEST: Final = "SELECT id FROM trial_set WHERE plan = ? ORDER BY id DESC LIMIT 1"
_SET: Final = "SELECT 1 FROM trial_set WHERE id = ?"
_WORKER: Final = "SELECT host, pid, process FROM trial_set WHERE id = ?"
_WORK: Final = "UPDATE trial_set SET host = ?, pid = ?, process = ? WHERE id = ?"
_BEGIN: Final = (
    "UPDATE trial SET status = 'running', started_wall_time_s = ?, pid = ?, process = ? "
    "WHERE id = ?"
)
_PUT_BACK: Final = (
    "UPDATE trial SET status = 'waiting', started_wall_time_s = NULL, pid = NULL, process = NULL "
    "WHERE id = ? AND status = 'running'"
)
_FINISH: Final = (
    "UPDATE trial SET status = :status, run_id = :run_id, score = :score, ended_by = :ended_by, "
    "ended_sim_time_s = :ended_sim_time_s, error = :error, finished_wall_time_s = :now, "
    "pid = NULL, process = NULL WHERE id = :id"
)
_LABEL: Final = "UPDATE run SET label = coalesce(label, ?) WHERE id = ?"


@dataclass(frozen=True)
class Trial:
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
        """Whether it need not be run any more."""
        return self.status in ("done", "failed", "pruned")


@dataclass(frozen=True)
class Result:
    """What became of a trial: a score, or an error.

    Attributes:
        error: Why there is no score.
        ended_by: `for_s`, `until` or `prune`; None where it did not come to an end.
        pruned: It was ended early because it was not worth going on with.
    """

    run_id: int | None
    score: float | None
    error: str | None
    ended_by: str | None = None
    ended_sim_time_s: float | None = None
    pruned: bool = False

    @property
    def status(self) -> str:
        """Of the trial, with this."""
        if self.pruned:
            return "pruned"
        return "failed" if self.score is None else "done"


_TRIALS: Final = f"SELECT {columns_of(Trial)} FROM trial WHERE trial_set_id = ? ORDER BY number"


def create_trial_set(
    connection: sqlite3.Connection, plan: str, parameters: list[dict[str, Any]]
) -> int:
    """Enter a set and its trials, in the order in which they are to be run; returns its id."""
    with transaction(connection):
        row = connection.execute(_NEW_SET, (new_uuid(), plan, time.time())).fetchone()
        set_id = int(row[0])
        for number, values in enumerate(parameters, 1):
            _enter(connection, set_id, number, values)
    return set_id


def add_trial(connection: sqlite3.Connection, set_id: int, values: dict[str, Any]) -> Trial:
    """Enter one more trial of a set that is searched as it goes on."""
    with transaction(connection):
        _enter(connection, set_id, len(trials_of(connection, set_id)) + 1, values)
    return trials_of(connection, set_id)[-1]


def _enter(
    connection: sqlite3.Connection, set_id: int, number: int, values: dict[str, Any]
) -> None:
    text = json.dumps(values, ensure_ascii=False)
    connection.execute(_NEW_TRIAL, (set_id, new_uuid(), number, text))


def find_trial_set(connection: sqlite3.Connection, plan: str) -> int | None:
    """The newest set with exactly this plan."""
    row = connection.execute(_NEWEST, (plan,)).fetchone()
    return int(row[0]) if row else None


def trials_of(connection: sqlite3.Connection, set_id: int) -> list[Trial]:
    """The trials of a set, in order.

    Raises:
        InvalidInputError: There is no such set.
    """
    if connection.execute(_SET, (set_id,)).fetchone() is None:
        raise InvalidInputError(f"there is no trial set {set_id}")
    return [Trial(*row) for row in connection.execute(_TRIALS, (set_id,)).fetchall()]


def take_up(connection: sqlite3.Connection, set_id: int) -> None:
    """Become the process that works on a set.

    Raises:
        CommandRefusedError: Another one does.
    """
    with transaction(connection):
        host, pid, process = connection.execute(_WORKER, (set_id,)).fetchone()
        if pid is not None and (host != host_name() or process_alive(pid, process, time.time())):
            raise CommandRefusedError(
                f"process {pid} on {host} works on trial set {set_id}: wait for it, or end it"
            )
        own = os.getpid()
        connection.execute(_WORK, (host_name(), own, process_identity(own), set_id))


def lay_down(connection: sqlite3.Connection, set_id: int) -> None:
    """Let others work on a set."""
    connection.execute(_WORK, (None, None, None, set_id))


def begin_trial(connection: sqlite3.Connection, trial: Trial, pid: int) -> None:
    """A simulator runs for it."""
    connection.execute(_BEGIN, (time.time(), pid, process_identity(pid), trial.id))


def put_back(connection: sqlite3.Connection, trial: Trial) -> None:
    """It was not run to its end, and waits again."""
    connection.execute(_PUT_BACK, (trial.id,))


def finish_trial(connection: sqlite3.Connection, trial: Trial, result: Result) -> None:
    """Enter what became of it; its run gets a label, unless it has one."""
    values = ", ".join(f"{name} {value}" for name, value in trial.values.items())
    label = f"trial {trial.number} of set {trial.trial_set_id}: {values}"[:100]
    with transaction(connection):
        connection.execute(
            _FINISH,
            {
                **vars(result),
                "id": trial.id,
                "status": result.status,
                "now": time.time(),
            },
        )
        connection.execute(_LABEL, (label, result.run_id))


def ranking_of(trials: list[Trial], best: Best) -> Ranking:
    """The parameter sets of the trials that are over, the best first."""
    return rank(
        [
            Outcome(each.values, each.score, each.error, pruned=each.status == "pruned")
            for each in trials
            if each.is_over
        ],
        best,
    )
