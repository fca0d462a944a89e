"""Trying parameters from one moment of a running simulation, each in a simulator of its own."""

from __future__ import annotations

import time
from typing import Annotated, Any

import anyio
from anyio import to_thread
from pydantic import Field

from webots_mcp.analysis.summary import Best
from webots_mcp.answers.answer_models import TrialsAnswer
from webots_mcp.contract import MAX_RUN_S
from webots_mcp.questions.arguments import RobotName, TimeoutS
from webots_mcp.questions.controller_parameters import settable
from webots_mcp.questions.declaration import CHANGES, Caller, question
from webots_mcp.questions.run_trials import (
    CANCELLED,
    Tried,
    as_declared,
    require_scorable,
    set_facts,
)
from webots_mcp.steering.branches import SAVE, BranchWorker, SavedMoment, branches_of, save_moment
from webots_mcp.steering.run_command import require_possible
from webots_mcp.steering.target_robot import find_target
from webots_mcp.steering.trial_plan import BranchPlan, TrialPlan, combinations
from webots_mcp.steering.trial_run import LocalSimulators, webots
from webots_mcp.steering.trial_run import stand_in as stand_in_command
from webots_mcp.store.policy import LAUNCH
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import permit
from webots_mcp.store.trial_sets import create_trial_set, progress_of, stop_trial_set

_POLL_S = 0.05
_REPORT_S = 1.0


@question("Branch a run", CHANGES, quotes=True, tier="all")
async def webots_branch_run(
    recording: RecordingAccess,
    caller: Caller,
    parameters: Annotated[
        Tried, Field(description='Values to try: a grid {"kp": [1.0, 2.0]} or sets [{"kp": 1.0}].')
    ],
    score: Annotated[
        str,
        Field(
            max_length=500,
            description="Formula over the signals of a branch, such as max(pose.x); see "
            "webots_run_trials.",
        ),
    ],
    best: Annotated[Best, Field(description="Which score is best.")] = "highest",
    for_s: Annotated[
        float | None, Field(gt=0, le=MAX_RUN_S, description="Simulated seconds of each branch.")
    ] = None,
    until: Annotated[
        str | None,
        Field(max_length=500, description="Condition that ends a branch earlier: goal_m < 0.1."),
    ] = None,
    prune: Annotated[
        str | None,
        Field(max_length=500, description="Condition that ends a branch without a score: fallen."),
    ] = None,
    repeats: Annotated[
        int, Field(ge=1, le=1000, description="Number of branches of each set.")
    ] = 1,
    jobs: Annotated[
        int, Field(ge=1, le=64, description="Maximum number of simulators at once.")
    ] = 1,
    stand_in: Annotated[
        bool, Field(description="Use the stand-in simulator, where it runs instead of Webots.")
    ] = False,
    branch_timeout_wall_s: Annotated[
        float, Field(gt=0, description="Maximum wall-clock seconds of a branch.")
    ] = 300.0,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = 60.0,
) -> TrialsAnswer:
    """Try parameters from this moment on: each branch continues a copy of the world and is scored.

    The simulation is paused to save its world, and resumed if it ran. Branch 0 changes nothing; the
    notes say when it parted from the original, and so which differences show nothing. The
    controller takes its own variables from bridge.restored. If timeout_wall_s is over first, wait
    with webots_run_trials(trial_set=...). To start from the beginning use webots_run_trials.
    """
    assert parameters is not None  # it has no default
    sets = combinations(parameters) if isinstance(parameters, dict) else parameters
    asked: dict[str, Any] = {"score": score, "best": best, "for_s": for_s, "until": until}
    asked |= {"prune": prune, "repeats": repeats, "timeout_s": branch_timeout_wall_s}
    simulators = LocalSimulators(stand_in_command if stand_in else webots, jobs)
    robot, checked = await to_thread.run_sync(_checked, recording, robot, sets, asked, simulators)
    saved = await save_moment(recording, robot, caller.report)
    try:
        worker = await to_thread.run_sync(_worker, recording, saved, checked, asked, simulators)
    except BaseException:
        saved.remove()
        raise
    caller.companions.trials.begin_worker(worker)
    try:
        await _wait(recording, caller, worker, timeout_wall_s)
    except anyio.get_cancelled_exc_class():
        with anyio.CancelScope(shield=True):
            await to_thread.run_sync(_end, recording, worker)
        raise
    facts = await to_thread.run_sync(set_facts, recording, worker.set_id)
    if saved.paused_by is not None:
        stays = f"the simulation ran before and could not be resumed: {saved.paused_by}"
        facts["notes"] = [stays, *(facts.get("notes") or [])]
    return TrialsAnswer(**facts)


def _checked(
    recording: RecordingAccess,
    robot: str | None,
    sets: list[dict[str, Any]],
    asked: dict[str, Any],
    simulators: LocalSimulators,
) -> tuple[str, list[dict[str, Any]]]:
    """Return the robot, and the sets in the types of its parameters, before anything is paused.

    Raises:
        InvalidInputError: A parameter, the score or a condition is not possible.
        CommandRefusedError: No live Supervisor could save the world, or there is no simulator.
        NotAllowedError: A rule of the project forbids to start a simulator.
    """
    with recording.reader() as connection:
        view = find_target(connection, robot, SAVE)
        name, world = view.robot.name, view.require_run().world
    for condition in (asked["until"], asked["prune"]):
        if condition is not None:
            require_possible(recording, name, condition, asked["for_s"], reset=True)
    checked = as_declared(settable(recording, name), sets)
    plan = TrialPlan(parameters=checked, **asked)
    with recording.reader() as connection:
        require_scorable(connection, plan, find_target(connection, name, SAVE))
    for values in checked:
        permit(recording, LAUNCH, {"world": world, "parameters": values})
    simulators.command(world or "")
    return name, checked


def _worker(
    recording: RecordingAccess,
    saved: SavedMoment,
    sets: list[dict[str, Any]],
    asked: dict[str, Any],
    simulators: LocalSimulators,
) -> BranchWorker:
    plan = BranchPlan(
        parameters=branches_of(saved, sets),
        robot=saved.robot,
        world=str(saved.world),
        moment=saved.moment,
        states=str(saved.states),
        **asked,
    )
    with recording.writer() as connection:
        set_id = create_trial_set(connection, plan.text, plan.trials)
    return BranchWorker(recording, set_id, plan, saved, simulators)


async def _wait(
    recording: RecordingAccess, caller: Caller, worker: BranchWorker, timeout_wall_s: float
) -> None:
    """Wait until all branches are over, or the time is."""
    until_s, report_s = time.monotonic() + timeout_wall_s, time.monotonic() + _REPORT_S
    while worker.is_alive() and time.monotonic() < until_s:
        if time.monotonic() >= report_s:
            report_s += _REPORT_S
            await caller.report(*await to_thread.run_sync(_progress, recording, worker.set_id))
        await anyio.sleep(_POLL_S)


def _progress(recording: RecordingAccess, set_id: int) -> tuple[float, float, str]:
    with recording.reader() as connection:
        return progress_of(connection, set_id)


def _end(recording: RecordingAccess, worker: BranchWorker) -> None:
    """End the branches, since the client has cancelled the call."""
    with recording.writer() as connection:
        stop_trial_set(connection, worker.set_id, CANCELLED)
    worker.stop()
