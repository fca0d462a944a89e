"""How far an unchanged branch keeps to the run that it continues, and so what a ranking can tell.

The first branch of a set changes nothing. It is compared with what its run itself did after that
moment, or, where the run did not go on undisturbed, with a second unchanged branch.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.summary import Ranking
from webots_mcp.contract import RESTORED_EVENT
from webots_mcp.errors import InvalidInputError, NothingRecordedError, UnknownRunError
from webots_mcp.judging.divergence import Parting, compare_rows
from webots_mcp.judging.run_score import score_run
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.signals.naming import counted, listed
from webots_mcp.store.trial_sets import (
    TrialRecord,
    TrialSetRecord,
    best_of,
    fetch_trial_set,
    is_branching,
    origin_run,
    ranking_of,
    spelled,
    trials_of,
)

_DEADLINE_S: Final = 5.0
_SHOWN: Final = 3  # sets of parameters that are named
# Commands after which a run goes on as it would have gone on without them.
_HARMLESS: Final = (
    "pause", "resume", "fast", "step", "run", "cancel_run", "screenshot", "take_frame",
    "record_scene", "save_world", "keep", "arm_breakpoints", "get_scene", "get_field", "inspect",
    "watch",
)  # fmt: skip
_DISTURBED: Final = (
    "SELECT min(at_s) FROM (SELECT c.claimed_sim_time_s AS at_s FROM command c "
    "JOIN session s ON s.id = c.session_id JOIN run r ON r.id = :run "
    "JOIN session own ON own.id = r.session_id WHERE s.instance = own.instance "
    "AND c.claimed_wall_time_s >= :since AND c.status <> 'cancelled' "
    f"AND c.action NOT IN ({', '.join(map(repr, _HARMLESS))}) "
    "UNION ALL SELECT sim_time_s FROM parameter_value WHERE run_id = :run "
    "AND wall_time_s >= :since AND set_by IN ('command', 'trial'))"
)


class _Reference(NamedTuple):
    """What an unchanged branch is compared with.

    Attributes:
        text: What it is.
        run_id: Its run.
        begins_s: The simulation time in that run at which the branch began.
        is_origin: Whether it is the run that was left.
    """

    text: str
    run_id: int
    begins_s: float
    is_origin: bool


def continued_until(connection: sqlite3.Connection, found: TrialSetRecord) -> float | None:
    """Return until when the run that was left went on undisturbed; None if it is not recorded."""
    run_id = origin_run(connection, json.loads(found.plan))
    if run_id is None:
        return None
    asked = {"run": run_id, "since": found.created_wall_time_s}
    (disturbed_s,) = connection.execute(_DISTURBED, asked).fetchone()
    (last_s,) = connection.execute(
        "SELECT max(r.last_sim_time_s, coalesce((SELECT max(sim_time_s) FROM state "
        "WHERE run_id = r.id), r.last_sim_time_s)) FROM run r WHERE r.id = ?",
        (run_id,),
    ).fetchone()
    return last_s if disturbed_s is None else min(disturbed_s, last_s)


def lacks_reference(connection: sqlite3.Connection, set_id: int) -> bool:
    """Return whether an unchanged branch ended that nothing can be compared with yet."""
    found = fetch_trial_set(connection, set_id)
    unchanged = _unchanged(trials_of(connection, set_id))
    return len(unchanged) == 1 and _origin(connection, found, unchanged[0]) is None


def parting_notes(connection: sqlite3.Connection, set_id: int) -> list[str]:
    """Return what the unchanged branches say about the ranking; nothing of a set of other trials.

    Raises:
        InvalidInputError: There is no such set.
    """
    found = fetch_trial_set(connection, set_id)
    if not is_branching(json.loads(found.plan)):
        return []
    trials = trials_of(connection, set_id)
    unchanged = _unchanged(trials)
    if not unchanged:
        return ["no unchanged branch came to its end, so it is not known what the save lost"]
    notes = _not_restored(connection, unchanged[0])
    with suppress(NothingRecordedError, UnknownRunError):  # retention has deleted one
        reference = _reference(connection, found, unchanged)
        if reference is None:
            return [*notes, "branch 0 (unchanged) could be compared with nothing"]
        plan = json.loads(found.plan)
        told = _told_apart(connection, plan, unchanged[0], reference)
        ranking = ranking_of(trials, best_of(plan))
        return [told.text + _unknown(told.by, ranking, unchanged[0]), *told.notes, *notes]
    return [*notes, "the rows of the unchanged branches are no longer there to compare"]


def _unchanged(trials: list[TrialRecord]) -> list[TrialRecord]:
    """Return the trials that came to their end with the parameters of the moment."""
    first = trials[0].values if trials else {}
    return [e for e in trials if e.values == first and e.run_id and e.ended_sim_time_s is not None]


def _origin(
    connection: sqlite3.Connection, found: TrialSetRecord, trial: TrialRecord
) -> _Reference | None:
    """Return the run that was left, if it went on for as long as the branch."""
    plan, until_s = json.loads(found.plan), continued_until(connection, found)
    run_id, begins_s = origin_run(connection, plan), plan["moment"]["sim_time_s"]
    assert trial.ended_sim_time_s is not None
    if run_id is None or until_s is None:
        return None
    if until_s < begins_s + trial.ended_sim_time_s - SAME_TIME_S:
        return None
    return _Reference(f"what run {run_id} itself did", run_id, begins_s, is_origin=True)


def _reference(
    connection: sqlite3.Connection, found: TrialSetRecord, unchanged: list[TrialRecord]
) -> _Reference | None:
    if origin := _origin(connection, found, unchanged[0]):
        return origin
    for other in unchanged[1:]:
        assert other.run_id is not None
        text = f"a second unchanged branch (run {other.run_id})"
        return _Reference(text, other.run_id, 0.0, is_origin=False)
    return None


class _ToldApart(NamedTuple):
    """How an unchanged branch and its reference differ.

    Attributes:
        by: The difference of their scores; None without one.
    """

    text: str
    by: float | None
    notes: list[str]


def _told_apart(
    connection: sqlite3.Connection,
    plan: Mapping[str, Any],
    trial: TrialRecord,
    reference: _Reference,
) -> _ToldApart:
    assert trial.run_id is not None and trial.ended_sim_time_s is not None
    begins_s, end_s = reference.begins_s, reference.begins_s + trial.ended_sim_time_s
    found = compare_rows(
        connection,
        [reference.run_id, trial.run_id],
        until_s=end_s,
        offset_s=begins_s,
        deadline_s=_DEADLINE_S,
    )
    by = None
    if trial.score is not None:
        with suppress(InvalidInputError):
            start_s = begins_s if reference.is_origin else None
            score = score_run(
                connection, reference.run_id, plan["score"], start_s=start_s, end_s=end_s,
                deadline_s=_DEADLINE_S,
            ).value  # fmt: skip
            by = None if score is None else abs(score - trial.score)
    notes = list[str]()
    if not reference.is_origin:
        notes.append(
            "the run that was left did not go on undisturbed for as long, so this measures how far "
            "the simulator repeats itself, not what the saved world and the controller lost"
        )
    return _ToldApart(_sentence(found, trial, reference, begins_s), by, notes)


def _sentence(found: Parting, trial: TrialRecord, reference: _Reference, begins_s: float) -> str:
    branch = f"branch 0 (unchanged: {spelled(trial.values)})"
    rows = f"{counted(found.rows, 'row')} and {counted(found.signals, 'signal')}"
    if not (found.rows and found.signals):
        return f"{branch} has no row in common with {reference.text}"
    if not found.parted:
        return (
            f"{branch} equals {reference.text} to the last digit in the {rows} that "
            f"were compared, for {found.until_s - begins_s:.3f} s"
        )
    first, worst = found.parted[0], found.worst
    said = (
        f"{branch} parted from {reference.text} after "
        f"{first.from_s - begins_s:.3f} s: {first.said(first.by, 'by')}"
    )
    if worst is not None and (worst is not first or first.largest != first.by):
        said += f", {worst.said(worst.largest, 'by at most')}"
    return f"{said} ({rows} compared)"


def _unknown(by: float | None, ranking: Ranking, trial: TrialRecord) -> str:
    """Say which differences of the ranking are smaller than that of the unchanged branch."""
    if by is None:
        return "; their scores cannot be compared"
    if by == 0.0:
        return "; their scores are equal"
    said = f"; their scores differ by {by:.3g}, and a smaller difference of two branches shows "
    said += "nothing"
    own = trial.score
    near = [
        spelled(each.parameters)
        for each in ranking.sets
        if own is not None and each.score is not None and each.parameters != trial.values
        and abs(each.score.mean - own) <= by
    ]  # fmt: skip
    more = f" and {len(near) - _SHOWN} more" if len(near) > _SHOWN else ""
    return said + (f": {listed(near[:_SHOWN])}{more} may be no better or worse" if near else "")


def _not_restored(connection: sqlite3.Connection, trial: TrialRecord) -> list[str]:
    (was_read,) = connection.execute(
        "SELECT EXISTS (SELECT 1 FROM event WHERE run_id = ? AND kind = ?)",
        (trial.run_id, RESTORED_EVENT),
    ).fetchone()
    if was_read:
        return []
    return [
        "the controller did not read bridge.restored, so its own variables began anew in each "
        "branch ('webots-mcp help branches')"
    ]
