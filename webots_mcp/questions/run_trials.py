"""Trying parameters in the running simulation, and ranking them by a score."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Final, cast

import anyio
from anyio import to_thread
from pydantic import BeforeValidator, Field, WithJsonSchema

from webots_mcp.analysis.summary import Best, Ranked, Ranking
from webots_mcp.answers.answer_models import TrialsAnswer
from webots_mcp.answers.budget import (
    condensed,
    figure,
    figures,
    fitting,
    header_of_only,
    notes_of,
    shown,
)
from webots_mcp.answers.shortening import cut_text
from webots_mcp.answers.summaries import TRIAL_FIGURES
from webots_mcp.contract import MAX_RUN_S
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.questions.arguments import RobotName, TimeoutS, TrialSetId
from webots_mcp.questions.controller_parameters import settable
from webots_mcp.questions.declaration import DESTROYS, READS, Caller, question
from webots_mcp.signals.conditions.scoring import parse_score
from webots_mcp.signals.parameter import require_known
from webots_mcp.steering.run_command import ACTION, known_names, require_possible
from webots_mcp.steering.target_robot import find_target
from webots_mcp.steering.trial_plan import TrialPlan, combinations
from webots_mcp.steering.trial_worker import OF_EACH_TRIAL, TrialWorkers
from webots_mcp.store.reading.segment import in_one_snapshot
from webots_mcp.store.recording import RecordingAccess, RobotView, view_robot
from webots_mcp.store.requests import permit
from webots_mcp.store.robots import robot_name
from webots_mcp.store.run_parameters import Declared
from webots_mcp.store.trial_sets import (
    TrialRecord,
    TrialSetRecord,
    best_of,
    count_planned,
    create_trial_set,
    fetch_trial_set,
    find_trial_set,
    is_at_work,
    is_branching,
    progress_of,
    ranking_of,
    stop_trial_set,
    trials_of,
)

_Value = float | int | bool | str
CANCELLED: Final = "it was cancelled"


@dataclass(frozen=True)
class TrialAnswerSizes:
    """How much of a trial set its answer shows, and how long a call waits.

    Attributes:
        wait_s: Wall time of a call, unless given.
        trial_s: Wall time of a trial, unless given.
        poll_s: Wall time between two reads of the set.
        report_s: Wall time between two reports of progress.
        table_tokens: Budget of the ranking.
        why_characters: Characters of the reason of a failure.
        runs: Runs that are named of each set of parameters.
    """

    wait_s: float = 60.0
    trial_s: float = 300.0
    poll_s: float = 0.05
    report_s: float = 1.0
    table_tokens: int = 1_250
    why_characters: int = 120
    runs: int = 5


_SIZES: Final = TrialAnswerSizes()


def _require_sets(given: Any) -> Any:
    """See that it is sets of values or a grid, in words that say how to write them.

    Raises:
        ValueError: It is neither.
    """
    if given is None or _is_tried(given):
        return given
    raise ValueError('be sets, [{"kp": 1.0}, {"kp": 2.0}], or a grid, {"kp": [1.0, 2.0]}')


def _is_tried(given: object) -> bool:
    if isinstance(given, dict):
        lists = cast("dict[str, object]", given).values()
        return bool(lists) and all(isinstance(each, list) for each in lists)
    sets = cast("list[object]", given) if isinstance(given, list) else []
    return bool(sets) and all(isinstance(each, dict) for each in sets)


# What a value may be is the parameter's to say, and would take as much room as all else.
Tried = Annotated[
    list[dict[str, _Value]] | dict[str, list[_Value]] | None,
    BeforeValidator(_require_sets),
    WithJsonSchema({"anyOf": [{"type": "array"}, {"type": "object"}]}),
]


@question("Run trials", DESTROYS, quotes=True)
async def webots_run_trials(
    recording: RecordingAccess,
    caller: Caller,
    parameters: Annotated[
        Tried, Field(description='Values to try: sets [{"kp": 1.0}] or a grid {"kp": [1.0, 2.0]}.')
    ] = None,
    score: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Formula over the signals of a run, such as max(pose.x) - "
            "2 * count(stuck): min, max, mean, first or last of a signal, count of an event "
            "kind, time of a condition, duration.",
        ),
    ] = None,
    best: Annotated[Best, Field(description="Which score is best.")] = "highest",
    for_s: Annotated[
        float | None, Field(gt=0, le=MAX_RUN_S, description="Simulated seconds of each trial.")
    ] = None,
    until: Annotated[
        str | None,
        Field(
            max_length=500, description="Condition that ends a trial earlier, such as goal_m < 0.1."
        ),
    ] = None,
    prune: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Condition that ends a trial without a score, such as fallen.",
        ),
    ] = None,
    repeats: Annotated[int, Field(ge=1, le=1000, description="Number of trials of each set.")] = 1,
    trial_timeout_wall_s: Annotated[
        float, Field(gt=0, description="Maximum wall-clock seconds of a trial.")
    ] = _SIZES.trial_s,
    trial_set: TrialSetId = None,
    cancel: Annotated[bool, Field(description="Stop the set after the current trial.")] = False,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _SIZES.wait_s,
) -> TrialsAnswer:
    """Find the best parameters: each trial resets the world, sets them, runs fast and is scored.

    If timeout_wall_s is over first, the trials go on: call again with trial_set alone to wait or
    resume. At the end the former parameters are set again. To change parameters once use
    webots_set_parameters.
    """
    given = parameters is not None or score is not None
    if trial_set is not None and given:
        raise InvalidInputError(
            f"trial_set={trial_set} names a set that was started before, so it excludes parameters "
            "and score. Give trial_set alone to go on with it, or leave it out for a new set."
        )
    workers: TrialWorkers = caller.companions.trials
    if trial_set is None:
        if cancel:
            raise InvalidInputError(
                "cancel=true needs the set that is to stop. Add trial_set; webots_get_trials() "
                "shows the newest."
            )
        if parameters is None or score is None:
            raise InvalidInputError(
                "A new set needs parameters to try, a score to rank them by and an end. Example: "
                """parameters=[{"kp": 1.0}, {"kp": 2.0}], score='mean(abs(error))', for_s=10."""
            )
        asked = {"score": score, "best": best, "for_s": for_s, "until": until, "repeats": repeats}
        asked |= {"timeout_s": trial_timeout_wall_s, "prune": prune}
        number = await to_thread.run_sync(
            lambda: _begin(recording, workers, parameters, robot, asked)
        )
    else:
        number = trial_set
        await to_thread.run_sync(_take_up, recording, workers, number, cancel)
    try:
        await _wait(recording, caller, number, timeout_wall_s)
    except anyio.get_cancelled_exc_class():
        with anyio.CancelScope(shield=True):
            await to_thread.run_sync(_end, recording, workers, number)
        raise
    return TrialsAnswer(**await to_thread.run_sync(set_facts, recording, number))


@question("Get trials", READS, quotes=True, tier="all")
def webots_get_trials(recording: RecordingAccess, trial_set: TrialSetId = None) -> TrialsAnswer:
    """Show how far a set of trials is, with its parameters ranked by score.

    Includes trials that were started from a shell. To wait for them use webots_run_trials with
    trial_set.
    """
    return TrialsAnswer(**set_facts(recording, trial_set))


def _begin(
    recording: RecordingAccess,
    workers: TrialWorkers,
    parameters: list[dict[str, _Value]] | dict[str, list[_Value]],
    robot: str | None,
    asked: dict[str, Any],
) -> int:
    """Enter a set of trials, after checking that they can be run, and begin it; returns its id.

    Raises:
        InvalidInputError: The controller does not declare a parameter or not with such a value,
            a signal of the score or of `until` was never recorded, or the plan contradicts itself.
        CommandRefusedError: No live controller could run them, or another set of the robot is not
            over.
        NotAllowedError: A rule of the project forbids one of them.
    """
    sets = combinations(parameters) if isinstance(parameters, dict) else parameters
    require_possible(recording, robot, asked["until"], asked["for_s"], reset=True)
    if asked["prune"] is not None:
        require_possible(recording, robot, asked["prune"], None, reset=True)
    checked = as_declared(settable(recording, robot), sets)
    for name, value in {(name, each) for values in checked for name, each in values.items()}:
        permit(recording, ACTION, {**OF_EACH_TRIAL, "parameters": {name: value}})
    with recording.reader() as connection:
        view = find_target(connection, robot, ACTION)
        plan = TrialPlan(parameters=checked, robot=view.robot.name, **asked)
        require_scorable(connection, plan, view)
    with recording.writer() as connection:
        set_id = create_trial_set(connection, plan.text, plan.trials, view.robot.id)
    workers.begin(set_id)
    return set_id


def require_scorable(connection: sqlite3.Connection, plan: TrialPlan, view: RobotView) -> None:
    """Refuse a score that no run of the robot can have.

    Raises:
        InvalidInputError: It reads a signal or counts events that there are not.
    """
    from webots_mcp.judging.run_score import require_kinds

    score = parse_score(plan.score)
    require_kinds(connection, score, view.require_run().id)
    if known := known_names(view):
        score.require_known(known)


def as_declared(
    declared: Mapping[str, Declared], sets: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return the values in the types of the declared parameters."""
    require_known(list({name: None for values in sets for name in values}), list(declared))
    return [
        {name: declared[name].declaration.checked(value) for name, value in values.items()}
        for values in sets
    ]


def _take_up(recording: RecordingAccess, workers: TrialWorkers, set_id: int, cancel: bool) -> None:
    """Continue a set, or end it, unless another process works on it already.

    Raises:
        InvalidInputError: It cannot be continued here, or there is no such set.
    """
    with recording.reader() as connection:
        found = fetch_trial_set(connection, set_id)
        at_work = is_at_work(connection, found)
    if found.robot_id is None and not at_work:
        raise InvalidInputError(
            f"Trial set {set_id} {_goes_on(found)}. webots_get_trials("
            f"trial_set={set_id}) shows its trials."
        )
    if cancel:
        _stop(recording, set_id, CANCELLED)
    if at_work or found.robot_id is None:
        return
    if not cancel:
        _stop(recording, set_id, None)
    workers.begin(set_id)  # also to restore the parameters of one that is cancelled


def _goes_on(found: TrialSetRecord) -> str:
    """Return how to continue a set that no robot's simulation runs."""
    plan = json.loads(found.plan)
    if is_branching(plan):
        return "branched off a moment that is over: begin new branches with webots_branch_run"
    return (
        "has simulators of its own: the command 'webots-mcp trials PLAN' continues it"
        if "world" in plan
        else "came from another recording, and its robot did not: begin a new set"
    )


def _stop(recording: RecordingAccess, set_id: int, reason: str | None) -> None:
    """Let a set stop after its current trial; without a reason, let a stopped one continue."""
    with recording.writer() as connection:
        stop_trial_set(connection, set_id, reason)


def _end(recording: RecordingAccess, workers: TrialWorkers, set_id: int) -> None:
    """The client has cancelled the call: no other trial begins, and the one that runs here ends."""
    _stop(recording, set_id, CANCELLED)
    workers.end(set_id)


async def _wait(
    recording: RecordingAccess, caller: Caller, set_id: int, timeout_wall_s: float
) -> None:
    """Until nobody works on the set any more, or the time is over."""
    until_s, report_s = time.monotonic() + timeout_wall_s, time.monotonic() + _SIZES.report_s
    with recording.reader() as connection:
        while time.monotonic() < until_s:
            if not is_at_work(connection, fetch_trial_set(connection, set_id)):
                return
            if time.monotonic() >= report_s:
                report_s += _SIZES.report_s
                await caller.report(*progress_of(connection, set_id))
            await anyio.sleep(_SIZES.poll_s)


# -- answers ----------------------------------------------------------------------------------


def set_facts(recording: RecordingAccess, set_id: int | None) -> dict[str, Any]:
    """Return the facts of an answer about a set, by default about the newest one.

    Raises:
        InvalidInputError: There is no such set.
        NothingRecordedError: There is no database.
    """
    with recording.reader() as connection:
        return _set_facts(connection, set_id)


@in_one_snapshot
def _set_facts(connection: sqlite3.Connection, set_id: int | None) -> dict[str, Any]:
    number = find_trial_set(connection) if set_id is None else set_id
    if number is None:
        return {**header_of_only(connection), "hint": "no trials were begun: webots_run_trials"}
    found = fetch_trial_set(connection, number)
    return {**_header(connection, found), **_facts(connection, found)}


def _header(connection: sqlite3.Connection, found: TrialSetRecord) -> dict[str, Any]:
    with suppress(NothingRecordedError):  # the robot's rows may be gone while its trials remain
        if found.robot_id is not None:
            return view_robot(connection, robot_name(connection, found.robot_id)).header()
    return header_of_only(connection)


def _facts(connection: sqlite3.Connection, found: TrialSetRecord) -> dict[str, Any]:
    trials, plan = trials_of(connection, found.id), json.loads(found.plan)
    from webots_mcp.judging.branch_parting import parting_notes
    from webots_mcp.judging.divergence import repeats_noted
    from webots_mcp.judging.run_score import unseen

    best = best_of(plan)
    over = sum(each.is_over for each in trials)
    planned = count_planned(plan, trials)
    state, hint = _state(found, planned - over, at_work=is_at_work(connection, found))
    ranking = ranking_of(trials, best)
    rows = fitting(_rows(ranking, trials), _SIZES.table_tokens)
    repeats = list[str]()
    if state != "under way":
        repeats = parting_notes(connection, found.id) or repeats_noted(connection, found.id)
    left_out = len(ranking.sets) - len(rows)
    rank_lower = "that rank lower are not shown: webots_query_sql has all in table trial"
    return {
        "trial_set": found.id,
        "state": state,
        "trials": planned,
        "over": over,
        "pruned": sum(each.status == "pruned" for each in trials) or None,
        "failed": sum(each.status == "failed" for each in trials) or None,
        "score": f"{cut_text(str(plan.get('score')), 500)} ({best} is best)",
        "ranked": condensed((*_names(ranking), *TRIAL_FIGURES), rows),
        "noise": figure(ranking.noise.deviation) if ranking.noise.freedom else None,
        "is_best_confirmed": ranking.better,
        "verdict": ranking.verdict if over else None,
        "notes": notes_of(
            [
                *[f"{left_out} sets {rank_lower}"] * (left_out > 0),
                *repeats,
                *unseen(connection, (each.run_id for each in trials if each.score is not None)),
            ]
        ),
        "hint": hint,
    }


def _state(found: TrialSetRecord, left: int, *, at_work: bool) -> tuple[str, str | None]:
    """Return the state of a set, and what to do next."""
    again = f"webots_run_trials(trial_set={found.id})"
    if at_work:
        if found.stop_reason:
            return f"stopping: {found.stop_reason}", None
        return "under way", f"{again} waits for it, with cancel=true it stops"
    why = f"stopped: {found.stop_reason}" if found.stop_reason else "left by a server that ended"
    if found.former_values is not None:
        return why, f"{again} continues it and restores the parameters"
    if not left:
        return "done", None
    if found.robot_id is None:
        is_stopped = found.stop_reason and is_branching(json.loads(found.plan))
        return why if is_stopped else "left", f"it {_goes_on(found)}"
    return why, f"{again} continues with the {left} that are left"


def _names(ranking: Ranking) -> list[str]:
    """Return the parameters as columns, renamed where a column of figures has the same name."""
    names = dict.fromkeys(name for each in ranking.sets for name in each.parameters)
    return [f"parameter {name}" if name in TRIAL_FIGURES else name for name in names]


def _rows(ranking: Ranking, trials: Sequence[TrialRecord]) -> list[list[Any]]:
    names = list(dict.fromkeys(name for each in ranking.sets for name in each.parameters))
    runs: dict[str, list[int]] = {}
    for each in trials:
        if each.is_over and each.run_id is not None:
            runs.setdefault(_as_key(each.values), []).append(each.run_id)
    return [_row(each, names, runs.get(_as_key(each.parameters), [])) for each in ranking.sets]


def _as_key(values: Mapping[str, Any]) -> str:
    return json.dumps(values, sort_keys=True)


def _row(ranked: Ranked, names: Sequence[str], runs: Sequence[int]) -> list[Any]:
    spread, why = ranked.score, next(iter(ranked.failures), None)
    several = spread is not None and len(ranked.scores) > 1
    return [
        *(shown(ranked.parameters.get(name)) for name in names),
        figure(spread.mean) if spread else None,
        figures([spread.low, spread.high]) if spread and several else None,
        len(ranked.scores),
        ranked.pruned or None,
        len(ranked.failures) or None,
        why and cut_text(why, _SIZES.why_characters),
        list(runs[: _SIZES.runs]),
    ]
