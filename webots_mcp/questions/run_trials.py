"""Trying parameters in the running simulation or on a cluster, and ranking them by a score."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Any, Final, cast

import anyio
from anyio import to_thread
from pydantic import BeforeValidator, Field, WithJsonSchema

from webots_mcp.conditions.scoring import parse_score
from webots_mcp.contract import MAX_RUN_S
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.parameter import require_known
from webots_mcp.questions.answers import TrialsAnswer
from webots_mcp.questions.budget import (
    condensed,
    cut_text,
    figure,
    figures,
    fitting,
    header_of_only,
    notes_of,
    shown,
)
from webots_mcp.questions.compare_runs import webots_list_runs
from webots_mcp.questions.declaring import (
    DESTROYS,
    READS,
    Caller,
    RobotName,
    TimeoutS,
    TrialSetId,
    merged,
    question,
)
from webots_mcp.questions.send_command import settable
from webots_mcp.steering.dispatch import ACTION, find_target, known_names, require_possible
from webots_mcp.steering.trial_plan import (
    SCHEDULER,
    TrialPlan,
    WorldPlan,
    combinations,
    stored_world_plan,
)
from webots_mcp.steering.trial_worker import TrialWorkers
from webots_mcp.store.analysis.summary import Best, Ranked, Ranking
from webots_mcp.store.parameters import (
    Declared,
    Trial,
    TrialSet,
    best_of,
    count_planned,
    create_trial_set,
    declared_for,
    fetch_trial_set,
    find_trial_set,
    is_at_work,
    progress_of,
    ranking_of,
    stop_trial_set,
    trials_of,
)
from webots_mcp.store.questions.runs import require_kinds, unseen, way_of_run
from webots_mcp.store.reading.segment import Deadline, Subject, in_one_snapshot
from webots_mcp.store.recording import Recording, View, look
from webots_mcp.store.robots import robot_name

_WAIT_S: Final = 60.0
_TRIAL_S: Final = 300.0
_LOOK_EVERY_S: Final = 0.05
_REPORT_EVERY_S: Final = 1.0

_Value = float | int | bool | str


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


@question("Run trials", DESTROYS)
async def webots_run_trials(
    recording: Recording,
    caller: Caller,
    parameters: Annotated[
        Tried, Field(description='Sets, [{"kp": 1.0}], or a grid, {"kp": [1.0, 2.0]}.')
    ] = None,
    score: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Over a run: max(x) - 2 * count(stuck); min, mean, first, last, "
            "time(condition), duration.",
        ),
    ] = None,
    best: Annotated[Best, Field(description="Which score.")] = "highest",
    for_s: Annotated[
        float | None, Field(gt=0, le=MAX_RUN_S, description="Simulated seconds each.")
    ] = None,
    until: Annotated[str | None, Field(max_length=500, description="Or when this holds.")] = None,
    prune: Annotated[
        str | None, Field(max_length=500, description="Or, unscored, when this holds.")
    ] = None,
    repeats: Annotated[int, Field(ge=1, le=1000, description="Of each set.")] = 1,
    trial_timeout_wall_s: Annotated[float, Field(gt=0, description="At most.")] = _TRIAL_S,
    trial_set: TrialSetId = None,
    cancel: Annotated[bool, Field(description="Stop it after this trial.")] = False,
    scheduler: Annotated[
        str | None, Field(description="tcp://HOST:8786: on a Dask cluster, a simulator each.")
    ] = None,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> TrialsAnswer:
    """Which parameters are best? Each trial resets the world, sets them, runs fast, is scored.

    After timeout_wall_s they go on: trial_set alone waits on, or resumes. At the end parameters are
    set back.
    """
    given = parameters is not None or score is not None
    if (trial_set is None) != given:
        raise InvalidInputError("give parameters and score for a new set, or trial_set, not both")
    workers: TrialWorkers = caller.companions.trials
    if trial_set is None:
        if parameters is None or score is None:
            raise InvalidInputError("give both: parameters to try, and a score to rank them by")
        if cancel:
            raise InvalidInputError("cancel needs trial_set: which one is to stop?")
        asked = {"score": score, "best": best, "for_s": for_s, "until": until, "repeats": repeats}
        asked |= {"timeout_s": trial_timeout_wall_s, "prune": prune}
        number = await to_thread.run_sync(
            lambda: _begin(recording, workers, parameters, robot, scheduler, asked)
        )
    else:
        number = trial_set
        await to_thread.run_sync(_take_up, recording, workers, number, scheduler, cancel)
    try:
        await _wait(recording, caller, number, timeout_wall_s)
    except anyio.get_cancelled_exc_class():
        with anyio.CancelScope(shield=True):
            await to_thread.run_sync(_end, recording, workers, number)
        raise
    return TrialsAnswer(**await to_thread.run_sync(set_facts, recording, number))


@question("Get trials", READS)
def webots_get_trials(recording: Recording, trial_set: TrialSetId = None) -> TrialsAnswer:
    """How far trials are, also those from a shell; the parameters, ranked by score."""
    return TrialsAnswer(**set_facts(recording, trial_set))


def _begin(
    recording: Recording,
    workers: TrialWorkers,
    parameters: list[dict[str, _Value]] | dict[str, list[_Value]],
    robot: str | None,
    scheduler: str | None,
    asked: dict[str, Any],
) -> int:
    """Enter a set of trials, after checking that they can be run, and begin it; returns its id.

    Raises:
        InvalidInputError: The controller does not declare a parameter or not with such a value,
            a signal of the score or of `until` was never recorded, or the plan contradicts itself.
        CommandRefusedError: No live controller could run them, or another set of the robot is not
            over.
    """
    sets = combinations(parameters) if isinstance(parameters, dict) else parameters
    if scheduler is not None:
        return _begin_on_cluster(recording, workers, sets, robot, scheduler, asked)
    require_possible(recording, robot, asked["until"], asked["for_s"], reset=True)
    if asked["prune"] is not None:
        require_possible(recording, robot, asked["prune"], None, reset=True)
    checked = _as_declared(settable(recording, robot), sets)
    with recording.reader() as connection:
        view = find_target(connection, robot, ACTION)
        plan = TrialPlan(parameters=checked, robot=view.robot.name, **asked)
        _require_scorable(connection, plan, view)
    with recording.writer() as connection:
        set_id = create_trial_set(connection, plan.text, plan.trials, view.robot.id)
    workers.begin(set_id)
    return set_id


def _begin_on_cluster(
    recording: Recording,
    workers: TrialWorkers,
    sets: list[dict[str, Any]],
    robot: str | None,
    scheduler: str,
    asked: dict[str, Any],
) -> int:
    """The same in the world of a robot's newest run; the robot need not be live."""
    with recording.reader() as connection:
        view = look(connection, robot)
        run = view.require_run()
        if run.world is None:
            raise InvalidInputError(f"the world file of run {run.id} is not recorded")
        checked = _as_declared(declared_for(connection, view.robot.id), sets)
        plan = WorldPlan(world=run.world, parameters=checked, robot=view.robot.name, **asked)
        _require_scorable(connection, plan, view)
    text = json.dumps({SCHEDULER: scheduler, **json.loads(plan.text)}, sort_keys=True)

    def enter() -> int:
        with recording.writer() as connection:
            return create_trial_set(connection, text, plan.trials)

    return workers.begin_on_cluster(scheduler, plan, enter)


def _require_scorable(connection: sqlite3.Connection, plan: TrialPlan, view: View) -> None:
    score = parse_score(plan.score)
    require_kinds(connection, score, view.require_run().id)
    if known := known_names(view):
        score.require_known(known)


def _as_declared(
    declared: Mapping[str, Declared], sets: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The values in the types of the declared parameters."""
    require_known(list({name: None for values in sets for name in values}), list(declared))
    return [
        {name: declared[name].declaration.checked(value) for name, value in values.items()}
        for values in sets
    ]


def _take_up(
    recording: Recording, workers: TrialWorkers, set_id: int, scheduler: str | None, cancel: bool
) -> None:
    """Continue a set, or end it, unless somebody works on it already.

    Raises:
        InvalidInputError: It cannot be continued here, or there is no such set.
    """
    with recording.reader() as connection:
        found = fetch_trial_set(connection, set_id)
        at_work = is_at_work(connection, found)
    elsewhere = _names_world(found)
    if scheduler is not None and not elsewhere:
        raise InvalidInputError(f"trial set {set_id} runs in a robot's simulation, on no cluster")
    if found.robot_id is None and not (elsewhere and (cancel or at_work or scheduler)):
        why = f"has simulators of its own: {_goes_on(found)}" if elsewhere else _FROM_ELSEWHERE
        raise InvalidInputError(
            f'trial set {set_id} {why}; webots_list_runs(what="trials", trial_set={set_id}) has '
            "its trials"
        )
    if cancel:
        _stop(recording, set_id, CANCELLED)
    if at_work:
        return
    if not elsewhere:
        if not cancel:
            _stop(recording, set_id, None)
        workers.begin(set_id)  # also to restore the parameters of one that is cancelled
    elif scheduler is not None and not cancel:
        plan, is_stand_in = stored_world_plan(found.plan)
        workers.begin_on_cluster(scheduler, plan, lambda: set_id, is_stand_in=is_stand_in)


def _names_world(found: TrialSet) -> bool:
    """Whether the trials of a set each have a simulator of their own."""
    return "world" in json.loads(found.plan)


def _goes_on(found: TrialSet) -> str:
    """How to continue a set whose trials have simulators of their own."""
    scheduler = json.loads(found.plan).get(SCHEDULER)
    again = f"webots_run_trials(trial_set={found.id}, scheduler={scheduler or 'tcp://...'!r})"
    return f"{again} continues it" if scheduler else f"{_GOES_ON}, or {again} on a cluster"


def _stop(recording: Recording, set_id: int, reason: str | None) -> None:
    """Let a set stop after its current trial; without a reason, let a stopped one continue."""
    with recording.writer() as connection:
        stop_trial_set(connection, set_id, reason)


def _end(recording: Recording, workers: TrialWorkers, set_id: int) -> None:
    """The client has cancelled the call: no other trial begins, and the one that runs here ends."""
    _stop(recording, set_id, CANCELLED)
    workers.end(set_id)


async def _wait(recording: Recording, caller: Caller, set_id: int, timeout_wall_s: float) -> None:
    """Until nobody works on the set any more, or the time is over."""
    until_s, report_s = time.monotonic() + timeout_wall_s, time.monotonic() + _REPORT_EVERY_S
    with recording.reader() as connection:
        while time.monotonic() < until_s:
            if not is_at_work(connection, fetch_trial_set(connection, set_id)):
                return
            if time.monotonic() >= report_s:
                report_s += _REPORT_EVERY_S
                await caller.report(*progress_of(connection, set_id))
            await anyio.sleep(_LOOK_EVERY_S)


CANCELLED: Final = "it was cancelled"
_TABLE_TOKENS: Final = 1_250
_GOES_ON: Final = "the command 'webots-mcp trials PLAN' continues it"
_FROM_ELSEWHERE: Final = "came from another recording, and its robot did not: begin a new set"
_LONGEST_WHY: Final = 120
_RANK_LOWER: Final = "that rank lower are not shown: webots_query_sql has all in table trial"
_FIGURES: Final = ("score", "range", "scored", "pruned", "failed", "why", "runs")
_MOST_NAMED_RUNS: Final = 5
_STANDING_DEADLINE_S: Final = 1.0
_MOVED_M: Final = 0.1  # a robot that travelled as far has moved
_STILL_M: Final = 0.01  # a robot that travelled less has stood still
_STILL_NOISES: Final = 4.0  # standard deviations of the position's noise that are not motion
_BEFORE: Final = (
    "SELECT id FROM run WHERE robot_id = ? AND id < ? "
    "ORDER BY start_reason = 'reset', id DESC LIMIT 5"
)


# -- answers ----------------------------------------------------------------------------------


def set_facts(recording: Recording, set_id: int | None) -> dict[str, Any]:
    """The facts of an answer about a set, by default about the newest one.

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


def _header(connection: sqlite3.Connection, found: TrialSet) -> dict[str, Any]:
    with suppress(NothingRecordedError):  # the robot's rows may be gone while its trials remain
        if found.robot_id is not None:
            return look(connection, robot_name(connection, found.robot_id)).header()
    return header_of_only(connection)


def _facts(connection: sqlite3.Connection, found: TrialSet) -> dict[str, Any]:
    trials, plan = trials_of(connection, found.id), json.loads(found.plan)
    best = best_of(plan)
    over = sum(each.is_over for each in trials)
    planned = count_planned(plan, trials)
    state, hint = _state(found, planned - over, at_work=is_at_work(connection, found))
    ranking = ranking_of(trials, best)
    rows = fitting(_rows(ranking, trials), _TABLE_TOKENS)
    left_out = len(ranking.sets) - len(rows)
    return {
        "trial_set": found.id,
        "state": state,
        "trials": planned,
        "over": over,
        "pruned": sum(each.status == "pruned" for each in trials) or None,
        "failed": sum(each.status == "failed" for each in trials) or None,
        "score": f"{cut_text(str(plan.get('score')), 500)} ({best} is best)",
        "ranked": condensed((*_names(ranking), *_FIGURES), rows),
        "noise": figure(ranking.noise.deviation) if ranking.noise.freedom else None,
        "is_best_confirmed": ranking.better,
        "verdict": ranking.verdict if over else None,
        "notes": notes_of(
            [
                *_standing(connection, found, trials),
                *[f"{left_out} sets {_RANK_LOWER}"] * (left_out > 0),
                *_gone(connection, trials),
                *unseen(connection, (each.run_id for each in trials if each.score is not None)),
            ]
        ),
        "hint": hint,
    }


def _state(found: TrialSet, left: int, *, at_work: bool) -> tuple[str, str | None]:
    """The state of a set, and what to do next."""
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
        return "left", _goes_on(found) if _names_world(found) else _FROM_ELSEWHERE
    return why, f"{again} continues with the {left} that are left"


def _names(ranking: Ranking) -> list[str]:
    """The parameters as columns, renamed where a column of figures has the same name."""
    names = dict.fromkeys(name for each in ranking.sets for name in each.parameters)
    return [f"parameter {name}" if name in _FIGURES else name for name in names]


def _rows(ranking: Ranking, trials: Sequence[Trial]) -> list[list[Any]]:
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
        why and cut_text(why, _LONGEST_WHY),
        list(runs[:_MOST_NAMED_RUNS]),
    ]


def _standing(
    connection: sqlite3.Connection, found: TrialSet, trials: Sequence[Trial]
) -> list[str]:
    """A note where a robot moved before its trials, but stood still in all of them."""
    runs = [each.run_id for each in trials if each.is_over and each.run_id is not None]
    if found.robot_id is None or not runs:
        return []
    robot, deadline = f"robot {found.robot_id}", Deadline(_STANDING_DEADLINE_S)
    stood = 0
    for run_id in runs:
        way = way_of_run(connection, Subject(found.robot_id, robot, run_id), deadline)
        if way is not None and way.length_m >= max(_STILL_M, _STILL_NOISES * way.noise_m):
            return []
        stood += way is not None
    before = connection.execute(_BEFORE, (found.robot_id, min(runs))).fetchall()
    for (run_id,) in before if stood else ():
        way = way_of_run(connection, Subject(found.robot_id, robot, run_id), deadline)
        if way is not None and way.length_m >= max(_MOVED_M, _STILL_NOISES * way.noise_m):
            return [
                f"the robot travelled {figure(way.length_m)} m in run {run_id}, before the trials, "
                f"but stood still in all {stood} that were checked: a reset does not repeat what "
                "its controller does once, before its loop (docs/trials.md: motors after a reset)"
            ]
    return []


def _gone(connection: sqlite3.Connection, trials: Sequence[Trial]) -> list[str]:
    """A note on trials whose rows were purged: their scores remain."""
    asked = json.dumps([each.run_id for each in trials if each.run_id is not None])
    purged = {number for (number,) in connection.execute(_PURGED, (asked,)).fetchall()}
    deleted = [each.number for each in trials if each.score is not None and each.run_id is None]
    gone = sorted({each.number for each in trials if each.run_id in purged} | {*deleted})
    if not gone:
        return []
    listed = ", ".join(map(str, gone[:_MOST_NAMED_RUNS])) + (
        f" and {len(gone) - _MOST_NAMED_RUNS} more" if len(gone) > _MOST_NAMED_RUNS else ""
    )
    return [f"rows of trial {listed} were purged since; the scores remain"]


_PURGED: Final = (
    "SELECT id FROM run WHERE purged_rows > 0 AND id IN (SELECT value FROM json_each(?))"
)


RUNS: Final = merged(
    webots_list_runs,
    choice="what",
    meaning="trials: how far a trial_set is, its parameters ranked by score.",
    parts={"runs": webots_list_runs, "trials": webots_get_trials},
    text="""\
Runs, newest first: controller file and its hash, world, duration, pace, how it ended.

`notable` counts warnings, errors, dropped rows, failed
commands; `parameters` are those that differ.""",
)
