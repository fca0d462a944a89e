"""Branches: runs in simulators of their own that continue from a moment of a live run.

The world is saved next to its own file while it stands still, under a name of its own, and removed
when the branches are over. The user's simulation goes on as it was.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from contextvars import copy_context
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, cast

from anyio import CancelScope, to_thread

from webots_mcp.contract import LOOPING, WORLD_ENDING, new_uuid
from webots_mcp.database.files import make_folder
from webots_mcp.database.pause_states import PAUSED
from webots_mcp.database.queue import fetch_command
from webots_mcp.errors import (
    CommandRefusedError,
    InvalidInputError,
    LeaseLostError,
    NothingRecordedError,
    WebotsMCPError,
)
from webots_mcp.steering.dispatch import Dispatcher, ProgressReport
from webots_mcp.steering.target_robot import find_target
from webots_mcp.steering.trial_plan import BranchMoment, BranchPlan
from webots_mcp.steering.trial_run import Simulators, StoppedError
from webots_mcp.steering.trial_set import FOLDER, SetRun, run_trials
from webots_mcp.store.export import state_of
from webots_mcp.store.recording import RecordingAccess, RobotView, view_robot
from webots_mcp.store.requests import permit
from webots_mcp.store.robots import robot_name
from webots_mcp.store.run_parameters import described
from webots_mcp.store.sessions import companions
from webots_mcp.store.trial_sets import (
    add_trial,
    fetch_trial_set,
    put_back,
    stop_trial_set,
    trials_of,
)

SAVE: Final = "save_world"
_COMMAND_S: Final = 30.0  # wall time for each command to the controller
_UNDER_WAY: Final = (
    "SELECT id, action FROM command WHERE robot_id = ? AND status = 'claimed' "
    f"AND action IN ({', '.join(map(repr, LOOPING))}) ORDER BY id DESC LIMIT 1"
)
_PAUSING: Final = (
    "SELECT 1 FROM command WHERE robot_id = ? AND status = 'claimed' AND action IN "
    f"('pause', '{SAVE}') LIMIT 1"
)
_UNFINISHED: Final = (
    "SELECT id FROM trial_set WHERE json_valid(plan) AND json_type(plan, '$.moment') = 'object' "
    "AND stop_reason IS NULL AND EXISTS (SELECT 1 FROM trial WHERE trial_set_id = trial_set.id "
    "AND status IN ('running', 'waiting'))"
)
_MODE_BEFORE: Final = "SELECT mode_before_pause FROM session WHERE id = ?"
_CLAIMED_S: Final = 5.0  # wall time that a claimed command gets to end
_POLL_S: Final = 0.02
_BEGUN_S: Final = 60.0  # wall time after which a set has surely been begun
_COPY: Final = re.compile(r"\.branch-[0-9a-f]{8}\.wbt$")
_END_S: Final = 15.0  # wall time in which simulators end
_NUMBERED: Final = re.compile(r"#\d+$")  # of a robot whose name was taken in its recording
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SavedMoment:
    """A moment of a run, saved so that branches can begin there.

    Attributes:
        moment: The moment.
        robot: The robot whose signals are scored, by its name in the world.
        run_id: The run.
        world: The saved world.
        states: The file with the states of the robots.
        paused_by: Why the simulation stays paused, although it ran before; None if it goes on.
    """

    moment: BranchMoment
    robot: str
    run_id: int
    world: Path
    states: Path
    paused_by: str | None = None

    def remove(self) -> None:
        """Remove the files."""
        self.world.unlink(missing_ok=True)
        self.states.unlink(missing_ok=True)


async def save_moment(
    recording: RecordingAccess, robot: str | None, report: ProgressReport
) -> SavedMoment:
    """Save this moment of a simulation, which is paused for that unless it is paused already.

    Raises:
        CommandRefusedError: No live Supervisor can save it, or Webots does not.
        InvalidInputError: There is no such robot, or several are possible.
        NotAllowedError: A rule of the project forbids it.
        NothingRecordedError: The controller has published nothing yet.
    """
    name, was_paused = await to_thread.run_sync(_target, recording, robot)
    if not was_paused:  # nothing is paused that could not be resumed
        await to_thread.run_sync(permit, recording, "resume", dict[str, Any]())
    await to_thread.run_sync(_remove_left_over, recording)
    dispatcher = Dispatcher(recording, report)

    async def order(action: str, **params: Any) -> dict[str, Any]:
        answer = await dispatcher.ask(name, action, _COMMAND_S, params)
        if answer.outcome != "done":
            why = "; ".join(filter(None, (answer.error, answer.hint))) or answer.outcome
            raise CommandRefusedError(
                f"No branch was begun: the command {action} to robot {name!r} came to "
                f"{answer.outcome} ({why}). Check webots_get_robot_state, then call again."
            )
        return await to_thread.run_sync(_result, recording, answer.command_id)

    copy = await to_thread.run_sync(_new_copy, recording, name)
    try:
        if not was_paused:
            await order("pause")
        saved = await order(SAVE, name=copy.name)
        moment = await to_thread.run_sync(_moment, recording, name, saved)
    except BaseException:
        with CancelScope(shield=True):
            if not was_paused:
                await _resume(recording, name, order)
            copy.unlink(missing_ok=True)
        raise
    if not was_paused:
        why = None
        with CancelScope(shield=True):
            why = await _resume(recording, name, order)
        moment = replace(moment, paused_by=why)
    return moment


async def _resume(
    recording: RecordingAccess, robot: str, order: Callable[[str], Awaitable[object]]
) -> str | None:
    """Let a simulation go on in its former mode; return why it stays paused, if it does."""
    try:
        action = await to_thread.run_sync(_resuming, recording, robot)
        if action is not None:
            await order(action)
    except WebotsMCPError as error:  # the branches can run nevertheless
        _log.warning("the simulation stays paused after its world was saved: %s", error)
        return str(error)
    return None


def _resuming(recording: RecordingAccess, robot: str) -> str | None:
    """Return the action that ends the pause; None if there is none."""
    until_s = time.monotonic() + _CLAIMED_S
    while True:
        with recording.reader() as connection:
            view = view_robot(connection, robot)
            pausing = connection.execute(_PAUSING, (view.robot.id,)).fetchone()
        if pausing is None or time.monotonic() > until_s:
            break
        time.sleep(_POLL_S)
    if view.session is None or view.session.pause_state != PAUSED:
        return None
    with recording.reader() as connection:
        (mode,) = connection.execute(_MODE_BEFORE, (view.session.id,)).fetchone()
    return "fast" if mode == "fast" else "resume"


def _target(recording: RecordingAccess, robot: str | None) -> tuple[str, bool]:
    with recording.reader() as connection:
        view = find_target(connection, robot, SAVE)
        under_way = connection.execute(_UNDER_WAY, (view.robot.id,)).fetchone()
        if under_way is not None:
            number, action = under_way
            raise CommandRefusedError(
                f"Command {number} ({action}) of robot {view.robot.name!r} is under way, and the "
                "pause for saving the world would end it. Wait for it with "
                f"webots_wait_for_command(command_id={number}), then branch."
            )
        return view.robot.name, view.session is not None and view.session.pause_state == PAUSED


def _result(recording: RecordingAccess, command_id: int | None) -> dict[str, Any]:
    """Return the whole result of a command: an answer may shorten it."""
    assert command_id is not None  # it is done
    with recording.reader() as connection:
        return cast("dict[str, Any]", fetch_command(connection, command_id).decoded_result() or {})


def _new_copy(recording: RecordingAccess, robot: str) -> Path:
    """Return the file of the saved world, which does not exist yet."""
    with recording.view(robot) as view:
        world = Path(view.require_run().world or "world")
    return world.with_name(
        f"{world.stem.partition('.branch-')[0]}.branch-{new_uuid()[:8]}{WORLD_ENDING}"
    )


def _remove_left_over(recording: RecordingAccess) -> None:
    """Remove the files of sets whose process was killed, so that it could not remove them."""
    with recording.writer() as connection:
        for (set_id,) in connection.execute(_UNFINISHED).fetchall():
            found = fetch_trial_set(connection, set_id)
            young = time.time() - found.created_wall_time_s < _BEGUN_S
            if not found.is_left or (found.pid is None and young):
                continue
            plan = json.loads(found.plan)
            world, states = Path(plan["world"]), Path(plan["states"])
            is_copy = (
                _COPY.search(world.name) and world.parent == Path(plan["moment"]["world"]).parent
            )
            if is_copy:  # what a recording says is no reason to remove another file
                world.unlink(missing_ok=True)
            if states.suffix == ".json" and states.parent == recording.data_dir.absolute() / FOLDER:
                states.unlink(missing_ok=True)
            for trial in trials_of(connection, set_id):
                shutil.rmtree(recording.data_dir / FOLDER / trial.uuid, ignore_errors=True)
                put_back(connection, trial)
            stop_trial_set(connection, set_id, "its process ended, and its moment is over")


def _moment(recording: RecordingAccess, robot: str, saved: Mapping[str, Any]) -> SavedMoment:
    """Write the states of the robots to a file, as their bridges read it."""
    recording.settle()  # rows that waited next to the database
    states: dict[str, dict[str, Any]] = {}
    own = str(saved["robot"])
    with recording.reader() as connection:
        view = view_robot(connection, robot)
        run, session = view.require_run(), view.session
        assert session is not None  # it has just answered
        statement = "SELECT uuid FROM run WHERE id = ?"
        (run_uuid,) = connection.execute(statement, (run.id,)).fetchone()
        others = companions(connection, session, view.now_s)
        names = [robot, *(robot_name(connection, each.robot_id) for each in others)]
        for name in names:
            if (state := _state_of(view_robot(connection, name))) is not None:
                states[name] = state | {"sim_time_s": saved["sim_time_s"]}
    found = states.pop(robot, None)
    if found is None:
        raise NothingRecordedError(
            f"Robot {robot!r} has published no state in run {run.id}, so no branch can continue "
            "it. Let its simulation run until it has published one."
        )
    # Only the bridge of a robot knows whether a number at the end belongs to its name.
    states = {_NUMBERED.sub("", name): each for name, each in states.items()} | states
    states[own] = found | {"calls": saved["calls"]}
    # A controller reads it in a folder of its own.
    file = recording.data_dir.absolute() / FOLDER / f"{new_uuid()}.json"
    make_folder(file.parent)
    text = json.dumps({"world": saved["world"], "robots": states})
    file.write_text(text, "utf-8")
    parameters = {name: each["parameters"] for name, each in states.items()}
    moment = BranchMoment(run_uuid, saved["sim_time_s"], saved["world"], parameters)
    return SavedMoment(moment, own, run.id, Path(saved["file"]), file)


def _state_of(view: RobotView) -> dict[str, Any] | None:
    if view.run is None or view.state is None:
        return None
    values = {
        each["name"]: each["default"] if each["value"] is None else each["value"]
        for each in described(view.connection, view.run)
    }
    return {
        "run_id": view.run.id,
        "state": state_of(view.state.data, view.state.replaced),
        "parameters": values,
        "calls": 0,
    }


class BranchWorker(threading.Thread):
    """Runs the branches of a set until all are over, and then removes the saved world.

    Args:
        recording: The recording into which the branches are merged.
        set_id: The set.
        plan: Its plan.
        saved: The moment.
        simulators: The simulators in which the branches run.
    """

    def __init__(
        self,
        recording: RecordingAccess,
        set_id: int,
        plan: BranchPlan,
        saved: SavedMoment,
        simulators: Simulators,
    ) -> None:
        super().__init__(name=f"branches of set {set_id}", daemon=True)
        self._context = copy_context()  # in which it is known who asked for the branches
        self._recording = recording
        self._saved = saved
        self._stopping = threading.Event()
        self._run_ends = threading.Event()  # set whenever the trials of the set have been run
        self._plan, self._simulators = plan, simulators
        self.set_id = set_id

    def stop(self) -> None:
        """End the running branches."""
        self._stopping.set()
        self._run_ends.set()
        self.join(_END_S)

    def run(self) -> None:
        """Run the branches."""
        try:
            self._context.run(self._work)
        finally:
            self._saved.remove()
            self._remove_folders()

    def _work(self) -> None:
        try:
            self._run_waiting()
            if self._needs_another():
                self._run_waiting()
        except (StoppedError, LeaseLostError):
            self._note_stop("it was stopped, and its moment is over")
        except (WebotsMCPError, OSError) as error:
            self._note_stop(str(error))
        except Exception as error:  # noqa: BLE001  (a thread must not end without a report)
            _log.exception("the branches of set %d failed", self.set_id)
            self._note_stop(f"an error of webots-mcp ({error})")

    def _run_waiting(self) -> None:
        self._run_ends = threading.Event()
        if self._stopping.is_set():
            raise StoppedError
        set_run = SetRun(self._recording, self._plan, self._simulators, self._run_ends)
        run_trials(set_run, self.set_id, _ignore)

    def _needs_another(self) -> bool:
        """Add a second unchanged branch, if there is nothing else to compare the first with."""
        from webots_mcp.judging.branch_parting import lacks_reference

        with self._recording.writer() as connection:
            if fetch_trial_set(connection, self.set_id).stop_reason is not None:
                return False
            if not lacks_reference(connection, self.set_id):
                return False
            add_trial(connection, self.set_id, trials_of(connection, self.set_id)[0].values)
            return True

    def _remove_folders(self) -> None:
        """Remove what branches that did not end have recorded: they cannot be run again."""
        with self._recording.reader() as connection:
            for trial in trials_of(connection, self.set_id):
                folder = self._recording.data_dir / FOLDER / trial.uuid
                shutil.rmtree(folder, ignore_errors=True)

    def _note_stop(self, reason: str) -> None:
        with self._recording.writer() as connection:
            if fetch_trial_set(connection, self.set_id).stop_reason is None:
                stop_trial_set(connection, self.set_id, reason)


def branches_of(saved: SavedMoment, sets: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the parameters of each branch: first those of the moment, then each other set once.

    Args:
        saved: The moment.
        sets: The sets to try, of parameters that the robot declares.

    Raises:
        InvalidInputError: Nothing is changed.
    """
    known = saved.moment.parameters[saved.robot]
    now = {name: known[name] for values in sets for name in values}
    unlike = {json.dumps(each): each for values in sets if (each := {**now, **values}) != now}
    if not unlike:
        raise InvalidInputError(
            f"These parameters change nothing: they have these values already ({now}). Give other "
            "values."
        )
    return [now, *unlike.values()]


def _ignore(*_: object) -> None:
    """Do nothing with a branch that is over: its result is in the recording."""
