"""Tools that try parameters in the running simulation, and rank them by a score."""

from __future__ import annotations

import time
from typing import Annotated, Any, Final, cast

import anyio
from anyio import to_thread
from pydantic import BeforeValidator, Field, WithJsonSchema

from webots_mcp.contract import MAX_RUN_S
from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.argument_types import RobotName, TimeoutS, TrialSetId
from webots_mcp.questions.declaring import DESTROYS, READS, Caller, question
from webots_mcp.questions.history_answers import TrialsAnswer
from webots_mcp.steering import trial_sets
from webots_mcp.steering.trial_worker import TrialWorkers
from webots_mcp.store.analysis.spread import Best
from webots_mcp.store.recording import Recording
from webots_mcp.trials.plan import stored_world_plan

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
    return TrialsAnswer(**await to_thread.run_sync(trial_sets.set_facts, recording, number))


@question("Get trials", READS)
def webots_get_trials(recording: Recording, trial_set: TrialSetId = None) -> TrialsAnswer:
    """How far trials are, also those from a shell; the parameters, ranked by score."""
    return TrialsAnswer(**trial_sets.set_facts(recording, trial_set))


def _begin(
    recording: Recording,
    workers: TrialWorkers,
    parameters: list[dict[str, _Value]] | dict[str, list[_Value]],
    robot: str | None,
    scheduler: str | None,
    asked: dict[str, Any],
) -> int:
    if scheduler is None:
        number = trial_sets.begin_set(recording, parameters, robot, **asked)
        workers.begin(number)
        return number
    plan = trial_sets.planned_for_cluster(recording, parameters, robot, **asked)
    return workers.begin_on_cluster(
        scheduler, plan, lambda: trial_sets.enter_cluster_set(recording, plan, scheduler)
    )


def _take_up(
    recording: Recording, workers: TrialWorkers, set_id: int, scheduler: str | None, cancel: bool
) -> None:
    """Go on with a set, or end it, unless somebody is at it already."""
    with recording.reader() as connection:
        found = fetch_trial_set(connection, set_id)
        at_work = is_at_work(connection, found)
    if trial_sets.names_world(found.plan):
        _take_up_elsewhere(recording, workers, found, scheduler, at_work=at_work, cancel=cancel)
        return
    if scheduler is not None:
        raise InvalidInputError(f"trial set {set_id} runs in a robot's simulation, on no cluster")
    trial_sets.require_ours(recording, set_id)
    if cancel:
        trial_sets.cancel(recording, set_id)
    elif not at_work:
        trial_sets.go_on(recording, set_id)
    if not at_work:
        workers.begin(set_id)


def _take_up_elsewhere(
    recording: Recording,
    workers: TrialWorkers,
    found: TrialSet,
    scheduler: str | None,
    *,
    at_work: bool,
    cancel: bool,
) -> None:
    """The same with one whose trials have simulators of their own."""
    if cancel:
        trial_sets.cancel(recording, found.id)
    elif at_work:
        return
    elif scheduler is None:
        trial_sets.require_ours(recording, found.id)
    else:
        plan, is_stand_in = stored_world_plan(found.plan)
        workers.begin_on_cluster(scheduler, plan, lambda: found.id, is_stand_in=is_stand_in)


def _end(recording: Recording, workers: TrialWorkers, set_id: int) -> None:
    """The client has cancelled the call: no other trial begins, and the one that runs here ends."""
    trial_sets.cancel(recording, set_id)
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
