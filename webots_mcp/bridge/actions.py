"""Serving the command queue, with the built-in actions.

For each action in `contract.BUILT_IN_ACTIONS` there is the function of its name. It returns a
generator, which yields until its outcome is known (once per round of the user's loop, or of the
pause), returns the command's result, or raises the command's error. A command that is refused
before its generator exists does not interrupt another one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from webots_mcp.bridge.breakpoints import Goal, read_goal
from webots_mcp.bridge.commands import ClaimedCommand, Handlers, Progress, whole_number
from webots_mcp.bridge.error_report import describe
from webots_mcp.bridge.parameters import SETTERS, Setter
from webots_mcp.bridge.pause import PUMP_INTERVAL_S
from webots_mcp.bridge.pictures import complete_png_size, find_pictured, take_picture
from webots_mcp.bridge.scene import get_field, get_scene
from webots_mcp.bridge.scene_changes import add_node, remove_node, set_field
from webots_mcp.contract import (
    BUILT_IN_ACTIONS,
    ENDING,
    LOOPING,
    MAX_STEPS,
    SCREENSHOT_FOLDER,
    Then,
)
from webots_mcp.database.files import full_path
from webots_mcp.database.liveness import EXTERN
from webots_mcp.database.location import require_world_of
from webots_mcp.database.pauses import Cause
from webots_mcp.errors import (
    CommandRefusedError,
    ControllerEndedError,
    InterruptedCommandError,
    InvalidInputError,
)
from webots_mcp.signals.naming import misfit_of_parameters

if TYPE_CHECKING:
    from webots_mcp.bridge.session import Session


Action = Callable[["Session", ClaimedCommand], Progress]

_ROUND_S: Final = 0.05  # of wall time in which a loop makes steps before it looks around
_SCREENSHOT_TIMEOUT_S: Final = 10.0
_RESET_TIMEOUT_S: Final = 10.0
_RELOAD_TIMEOUT_S: Final = 30.0
_DIALOG: Final = "a dialog may be open in Webots (start it with --batch)"
_HIGHEST_STATUS: Final = 255

_known: Final[dict[str, Action]] = {
    "get_scene": get_scene,
    "get_field": get_field,
    "set_field": set_field,
    "add_node": add_node,
    "remove_node": remove_node,
}
POLL_INTERVAL_S: Final = 0.005


def begin(session: Session, command: ClaimedCommand) -> Progress:
    """The generator of a built-in action.

    Raises:
        CommandRefusedError: It needs a Supervisor and this robot is not one.
        InvalidInputError: A parameter is unknown or missing.
    """
    action = BUILT_IN_ACTIONS[command.action]
    if action.needs_supervisor:
        session.simulation.require_supervisor(command.action)
    misfit = misfit_of_parameters(
        command.params, action.parameters, action.required, command.action
    )
    if misfit is not None:
        raise InvalidInputError(misfit)
    return _known[command.action](session, command)


def _built_in(action: Action) -> Action:
    assert action.__name__ in BUILT_IN_ACTIONS, "enter it there too: the server reads that list"
    _known[action.__name__] = action
    return action


@_built_in
def pause(session: Session, command: ClaimedCommand) -> Progress:
    """Pause at once, or after one more round where the state of this round was throttled.

    A person looks at the newest recorded state of a paused robot, so it must be the current one.
    """
    if session.throttle.stale and not session.pause.active:
        session.throttle.want()
        yield
    session.pause.begin(Cause(command.id))
    return _mode(session)


@_built_in
def resume(session: Session, command: ClaimedCommand) -> Progress:
    """Continue in real time, whatever the mode was before."""
    before = session.pause.running_mode
    session.pause.end(command.id, "real_time")
    why = "resume means real time"
    if before == "fast":
        why += "; it ran fast before: the command fast continues in that mode"
    return {**_mode(session), "why": why}
    yield


@_built_in
def fast(session: Session, command: ClaimedCommand) -> Progress:
    """Continue as fast as the computer can."""
    session.pause.end(command.id, "fast")
    return _mode(session)
    yield


@_built_in
def step(session: Session, command: ClaimedCommand) -> Progress:
    """Let the user's loop run `steps` rounds, each with its own step, then pause.

    A loop that does not ask for commands in every round makes more steps; the answer has the number
    made, as a warning first. A world that does not wait for the robot (`synchronization` FALSE)
    runs in real time meanwhile, so that it can be stopped in time.
    """
    steps = whole_number(command.params, "steps", 1, MAX_STEPS, default=1)
    if session.clock.step_s is not None and not session.simulation.waits_for_robot:
        return _step_world(session, command, steps)
    return _step(session, command, steps)


def _step(session: Session, command: ClaimedCommand, steps: int) -> Progress:
    clock, watch = session.clock, session.watch
    from_s, from_step = clock.sim_time_s, clock.steps_seen
    mode = None if session.simulation.waits_for_robot else "real_time"
    session.pause.change_mode_temporarily(command.id, mode, stepping=True)
    watch.stepping = command.id
    try:
        while (made := clock.steps_seen - from_step) < steps and not session.pause.active:
            if watch.stepping != command.id:
                break
            yield
    except InterruptedCommandError as interruption:
        made = clock.steps_seen - from_step
        watch.stepping = None
        raise CommandRefusedError(f"{interruption} after {made} of {steps} steps") from None
    ended_by = "it was cancelled" if watch.stepping != command.id else "a breakpoint paused it"
    why = {"why": f"{ended_by} before the last step"} if made < steps else {}
    watch.stepping = None
    session.pause.begin(Cause(command.id))
    advanced_s = round(clock.sim_time_s - from_s, 6)
    counted = {"steps": made, "advanced_s": advanced_s}
    return {**_miscounted(made, steps), **counted, **_mode(session), **why}


def _miscounted(made: int, steps: int) -> dict[str, object]:
    """A warning where another number of steps was made than was asked for."""
    if made <= steps:
        return {}
    return {"warning": f"{made} steps were made, not {steps}: the loop could not stop in time"}


def _step_world(session: Session, command: ClaimedCommand, steps: int) -> Progress:
    """Make so many steps of a world that does not wait for this robot, then pause.

    The first is awaited without waiting in it: a controller that hangs, and so holds up the world,
    must not block this loop too. Then the world can go on, and is made to wait for this robot, so
    that it stops at the very step. A pause, by a breakpoint or in Webots, ends it: a step asked for
    during one would not return.
    """
    pause, simulation, watch = session.pause, session.simulation, session.watch
    simulation.pump()  # the newest answer may be older than the world
    counted_steps, counted_to_s, ended_by = 0, simulation.time_s, ""
    pause.change_mode_temporarily(command.id, "real_time", stepping=True)
    watch.stepping = command.id

    def made() -> int:
        nonlocal counted_steps, counted_to_s
        time_s = simulation.time_s
        began_s = counted_to_s if time_s >= counted_to_s else 0.0  # the simulation was reset
        counted_steps += round((time_s - began_s) / simulation.basic_time_step_s)
        counted_to_s = time_s
        return counted_steps

    def steps_until(count: int, go_on: Callable[[], bool], round_s: float) -> Generator[None]:
        """Step until `count` steps are made; yield in between for heartbeat, rows and commands."""
        nonlocal ended_by
        until_s = time.monotonic() + round_s
        while made() < count and watch.stepping == command.id and not ended_by:
            may_go_on = go_on()
            if time.monotonic() >= until_s or simulation.over:
                yield
                until_s = time.monotonic() + round_s
                may_go_on = may_go_on and not simulation.paused
            if pause.active:
                ended_by = "a breakpoint paused it"
            elif not may_go_on:
                ended_by = "it was paused in Webots"

    try:
        yield from steps_until(1, simulation.pump, _ROUND_S)
        if made() < steps and watch.stepping == command.id and not ended_by:
            with pause.world_waits():
                # Conditions are evaluated on what is published in a round.
                round_s = 0.0 if session.breakpoints.armed else _ROUND_S
                yield from steps_until(steps, simulation.advance_unless_paused, round_s)
                simulation.set_mode("pause")  # before the world stops waiting
    except InterruptedCommandError as interruption:
        watch.stepping = None
        raise CommandRefusedError(f"{interruption} after {made()} of {steps} steps") from None
    simulation.set_mode("pause")
    if not simulation.pump():  # the world may have made a step until it was paused
        yield  # Webots has ended the controller
    ended_by = ended_by or "it was cancelled"
    why = {"why": f"{ended_by} before the last step"} if made() < steps else {}
    watch.stepping = None
    session.look()
    pause.begin(Cause(command.id))
    counted = {"steps": made(), "advanced_s": round(made() * simulation.basic_time_step_s, 6)}
    return {**_miscounted(made(), steps), **counted, **_mode(session), **why}


@_built_in
def run(session: Session, command: ClaimedCommand) -> Progress:
    """Let the loop run until a condition holds or a time has passed; then act on `then`."""
    goal = read_goal(command.params)
    session.watch.require_free()
    return _run_until(session, command, goal)


@_built_in
def cancel_run(session: Session, command: ClaimedCommand) -> Progress:
    """End the `run` command of that id, as its `then` says, or the `step`: its caller left."""
    return {"was_under_way": session.watch.cancel(command.params.get("command_id"))}
    yield


@_built_in
def reset(session: Session, command: ClaimedCommand) -> Progress:
    """Ask for the reset; done when simulation time has gone back, which takes a physics step."""
    was_paused = session.pause.active
    session.queue.issue(command)
    session.pause.end(command.id)  # first: a paused simulation makes no physics step
    yield from _reset(session)
    why = "a reset takes a step, which ended the pause" if was_paused else "a reset keeps the mode"
    return {"run_id": session.clock.run.id, **_mode(session), "why": f"{why}; the simulation runs"}


def _reset(session: Session) -> Generator[None]:
    clock, run = session.clock, session.clock.run
    clock.await_reset()
    session.simulation.robot.simulationReset()
    deadline_s = time.monotonic() + _RESET_TIMEOUT_S
    with session.pause.awaiting_step():  # the state published in the first step is of the new run
        while clock.run is run:
            if time.monotonic() > deadline_s:
                clock.forget_reset()
                raise CommandRefusedError(
                    "simulationReset() was called, but simulation time did not go back within "
                    f"{_RESET_TIMEOUT_S:.0f} s; check that the loop still calls step()"
                )
            yield


@_built_in
def reload(session: Session, command: ClaimedCommand) -> Progress:
    """Ask for the reload; this process ends, and the next session confirms the command."""
    session.queue.issue(command)
    session.reloads.requested_by = command
    session.pause.end(command.id)  # first: after worldReload() Webots answers nothing but quit
    session.simulation.robot.worldReload()
    deadline_s = time.monotonic() + _RELOAD_TIMEOUT_S
    while time.monotonic() < deadline_s:
        yield
    session.reloads.requested_by = None
    raise CommandRefusedError(
        f"worldReload() was called, but Webots has not ended the controller after "
        f"{_RELOAD_TIMEOUT_S:.0f} s; {_DIALOG}"
    )


@_built_in
def load_world(session: Session, command: ClaimedCommand) -> Progress:
    """Ask for another world of the project; this process ends, as all controllers do."""
    return _load(session, command, _world_of_project(session, command.params.get("world")))


def _load(session: Session, command: ClaimedCommand, world: Path) -> Progress:
    session.pause.end(command.id)  # first: a paused simulation makes no physics step
    session.simulation.robot.worldLoad(str(world))
    return (yield from _until_ended("worldLoad"))


def _world_of_project(session: Session, world: object) -> Path:
    """A world of the current one's project.

    This is checked here, so that every client is bound by it: loading a world starts its
    controllers, and so runs their code.
    """
    try:
        file = full_path(world) if isinstance(world, str) else Path()
        is_file = file.is_file()
    except OSError:  # the name is too long, has a NUL, or its links form a circle
        file, is_file = Path(), False
    if not is_file:
        raise InvalidInputError(f"world must be the full path of a world file, not {world!r:.200}")
    present = full_path(session.simulation.robot.getWorldPath())
    require_world_of(require_world_of(None, present), file)
    return file


@_built_in
def quit(session: Session, command: ClaimedCommand) -> Progress:  # noqa: A001  (the action's name)
    """Ask Webots to end; this process ends with it."""
    status = whole_number(command.params, "status", 0, _HIGHEST_STATUS, default=0)
    return _quit(session, command, status)


def _quit(session: Session, command: ClaimedCommand, status: int) -> Progress:
    session.pause.end(command.id)
    session.simulation.robot.simulationQuit(status)
    return (yield from _until_ended("simulationQuit"))


def _until_ended(asked: str) -> Progress:
    """Done when the controller ends, which Webots does before anything else."""
    deadline_s = time.monotonic() + _RELOAD_TIMEOUT_S
    try:
        while time.monotonic() < deadline_s:
            yield
    except ControllerEndedError:
        return {"controller": "it has ended"}
    raise CommandRefusedError(
        f"{asked}() was called, but Webots has not ended the controller after "
        f"{_RELOAD_TIMEOUT_S:.0f} s; {_DIALOG}"
    )


@_built_in
def screenshot(session: Session, command: ClaimedCommand) -> Progress:
    """Ask for the picture; Webots writes the file some time later, or never."""
    quality = whole_number(command.params, "quality", 1, 100, default=100)
    path = f"{SCREENSHOT_FOLDER}/command-{command.id:06d}.png"
    file = session.album.make_room(path)
    session.simulation.robot.exportImage(str(file), quality)
    size = yield from _wait_for_picture(file)
    return session.album.add_screenshot(path, *size)


@_built_in
def take_frame(session: Session, command: ClaimedCommand) -> Progress:
    """Take a picture of the newest measurement of a camera, a range finder or a lidar."""
    name = command.params.get("camera") or ""
    if not isinstance(name, str):
        raise InvalidInputError(f"camera must be the name of a device, not {name!r:.80}")
    device = find_pictured(session.simulation.robot, name)
    picture, camera = take_picture(device), str(device.getName())
    saved = session.album.add_frame(camera, picture.bgra, picture.width, picture.height)
    when = {"sim_time_s": session.clock.sim_time_s}
    return {"camera": camera, **saved, **when, "scale": picture.scale}
    yield


@_built_in
def reset_state(session: Session, command: ClaimedCommand) -> Progress:
    """Run the callbacks of `on_reload`; not called where the controller registered its own action.

    See `Control._start`, where a registered function comes first.
    """
    with session.pause.user_code():
        outcomes = session.reloads.call_back()
    if not outcomes:
        raise CommandRefusedError(
            "nothing was reset: this controller registered no callback with bridge.on_reload() and "
            "no function for 'reset_state'; only a loop that handles the return value of "
            "get_command() itself can have reset its state"
        )
    if errors := [describe(error) for error in outcomes if error is not None]:
        raise CommandRefusedError(
            f"{len(errors)} of {len(outcomes)} callbacks failed: {'; '.join(errors)}"
        )
    return {"callbacks": len(outcomes)}
    yield


@_built_in
def set_parameters(session: Session, command: ClaimedCommand) -> Progress:
    """Set all given parameters or none: `when` "now", or "reset" for the next reset."""
    params, clock, parameters = command.params, session.clock, session.parameters
    values, when = params.get("values"), params.get("when", "now")
    if not isinstance(values, dict) or not values or when not in ("now", "reset"):
        raise InvalidInputError(
            'give values, such as {"kp": 3.0}, and when: "now" or "reset" (at the next reset)'
        )
    setter = _setter(command)
    given = cast("dict[str, object]", values)
    if when == "reset":
        waiting = parameters.set_from_reset(given, setter)
        shown = {name: {"now": now, "next": then} for name, (now, then) in waiting.items()}
        return {"values": shown, "since": "the next reset"}
    changed = parameters.set_now(given, setter)
    shown = {name: {"old": old, "new": new} for name, (old, new) in changed.items()}
    return {"values": shown, "since_sim_time_s": clock.sim_time_s, "run_id": clock.run.id}
    yield


@_built_in
def arm_breakpoints(session: Session, command: ClaimedCommand) -> Progress:
    """Read the stored breakpoints again, since some were set or removed."""
    while not session.breakpoints.load():
        yield
    return session.breakpoints.describe()


@_built_in
def keep(session: Session, command: ClaimedCommand) -> Progress:
    """Keep the last seconds and the next ones at full rate, for a `reason`."""
    reason, sim_time_s = command.params.get("reason"), session.clock.sim_time_s
    if not isinstance(reason, str) or not reason.strip():
        raise InvalidInputError(f"reason must be a text that is not empty, not {reason!r:.80}")
    if not session.keeper.keep(reason):
        raise CommandRefusedError(session.keeper.why_not)
    return {"run_id": session.clock.run.id, "kept_around_s": sim_time_s}
    yield


def _run_until(session: Session, command: ClaimedCommand, goal: Goal) -> Progress:
    """Apply the goal's parameters, run until the goal is reached, and report how far it got."""
    watch, pause, finish = session.watch, session.pause, _finish_of(session, command, goal.then)
    _set_before_run(session, command, goal)
    watch.begin(command.id, goal, finish)
    pause.ask_before_steps(watch.before_step)
    try:
        pause.change_mode_temporarily(command.id, goal.pace)
        if goal.reset:
            yield from _reset(session)
        while not watch.over():
            if pause.active:
                why = f"the simulation was paused meanwhile: {pause.cause}"
                watch.interrupt("interrupted", why)
            yield
        return watch.describe() | {"mode": session.simulation.mode_name}
    except ControllerEndedError as ending:
        watch.interrupt("run ended", str(ending))
        return watch.describe()
    except InterruptedCommandError as interruption:
        watch.interrupt("interrupted", str(interruption))
        return watch.describe()
    except CommandRefusedError:  # no reset happened: the loop must not stay in the goal's mode
        finish()
        raise
    finally:
        pause.ask_before_steps(None)
        watch.end()


def _set_before_run(session: Session, command: ClaimedCommand, goal: Goal) -> None:
    """Set the parameters of a goal, all or none."""
    if goal.parameters:
        parameters, setter = session.parameters, _setter(command)
        (parameters.set_from_reset if goal.reset else parameters.set_now)(goal.parameters, setter)


def _setter(command: ClaimedCommand) -> Setter:
    """Who sets the parameters: the command itself, or the trial that sent it."""
    by = command.params.get("by")
    return Setter(by if by in SETTERS else "command", command.id)


def _finish_of(session: Session, command: ClaimedCommand, then: Then) -> Callable[[], None]:
    """The function that is called at the step that ends a run."""
    pause = session.pause
    was_paused = pause.active

    def finish() -> None:
        if then == "go_on" or (then == "as_before" and not was_paused):
            pause.restore_mode()
        else:
            pause.begin(Cause(command.id))

    return finish


def _mode(session: Session) -> dict[str, object]:
    return {"mode": session.simulation.mode_name, "sim_time_s": session.clock.sim_time_s}


def _wait_for_picture(file: Path) -> Generator[None, None, tuple[int, int, int]]:
    deadline_s = time.monotonic() + _SCREENSHOT_TIMEOUT_S
    while (size := complete_png_size(file)) is None:
        if time.monotonic() > deadline_s:
            raise CommandRefusedError(
                f"Webots wrote no complete picture to {file} within {_SCREENSHOT_TIMEOUT_S:.0f} s; "
                "its console has the reason"
            )
        yield
    return size


# -- serving the queue -----------------------------------------------------------------------------


class Control:
    """Claims commands, runs them, and keeps the loop while the simulation is paused.

    Attributes:
        handlers: The controller's own actions.
        why_ended: The error of commands that are still running when the process ends.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.handlers = Handlers(session)
        self.why_ended = "the controller ended"
        self._running: dict[ClaimedCommand, Progress] = {}
        self._reported = False
        self._next_poll_s = 0.0
        session.pause.serve = self._serve_pause

    def report_end(self, *, extern: bool) -> None:
        """The process is about to end: answer the commands that no successor will answer."""
        for running in [c for c in self._running if c.action in (*LOOPING, *ENDING)]:
            self._end(running, ControllerEndedError(self.why_ended))
        command = self._session.reloads.requested_by
        if command is not None and extern and not self._reported:
            self._reported = True
            self._running.pop(command, None)
            self._succeed(command, {"controller": f"it has ended; {EXTERN}"})

    def serve(self) -> ClaimedCommand | None:
        """One round: advance running actions, begin one new command, and stay in a pause.

        Returns:
            The command that was handled last in this call, if any.
        """
        now, handled = time.monotonic(), None
        due = now >= self._next_poll_s
        if not (due or self._running or self._session.pause.active):
            return None
        self._advance_all()
        if due:
            handled = self._serve_one()
            # Commands often come in groups: after one, the next round looks for another.
            self._next_poll_s = now + POLL_INTERVAL_S if handled is None else now
        return self._serve_pause() or handled

    def _serve_pause(self) -> ClaimedCommand | None:
        """Serve commands for as long as the pause lasts."""
        handled, pause = None, self._session.pause
        while pause.active:
            self._session.heartbeat.poll()
            pause.pump()
            self._advance_all()
            handled = self._serve_one() or handled
            time.sleep(PUMP_INTERVAL_S if pause.active else 0)
        return handled

    def _serve_one(self) -> ClaimedCommand | None:
        if self._session.simulation.over:
            return None
        command = self._session.queue.claim(self._session.clock.sim_time_s)
        if command is not None:
            self._start(command)
        return command

    def _start(self, command: ClaimedCommand) -> None:
        built_in = BUILT_IN_ACTIONS.get(command.action)
        try:
            self._session.queue.begin(command)
            if built_in is None or self.handlers.knows(command.action):
                self._succeed(command, self.handlers.run(command))
            else:
                progress = begin(self._session, command)
                if built_in.ends_steps:
                    self._interrupt(f"interrupted by command {command.id} ({command.action})")
                self._running[command] = progress
        except BaseException as error:
            self._fail(command, error)  # whatever a handler raises is the answer
            if not isinstance(error, Exception):
                raise  # Ctrl-C and SystemExit still end the loop, but the command is answered first
        self._advance(command)

    def _advance_all(self) -> None:
        for command in tuple(self._running):  # a copy: an advanced action leaves or changes it
            if self._session.simulation.over:
                self._abandon(command)
            else:
                self._advance(command)

    def _abandon(self, command: ClaimedCommand) -> None:
        """Drop an action after Webots said quit; a reload is left for the successor to confirm."""
        if command.action == "reload":
            del self._running[command]
        else:
            self._end(command, ControllerEndedError("Webots ended the controller"))

    def _advance(self, command: ClaimedCommand) -> None:
        """Advance a built-in action by one round.

        It is taken out meanwhile: a callback of the user may call `get_command()` and so come back
        to here, and a generator cannot be entered twice.
        """
        progress = self._running.pop(command, None)
        if progress is None:
            return
        try:
            next(progress)
            self._running[command] = progress
        except StopIteration as end:
            self._succeed(command, end.value)
        except BaseException as error:
            self._fail(command, error)  # whatever the action raises is the answer
            if not isinstance(error, Exception):
                raise

    def _interrupt(self, why: str) -> None:
        """Another command controls the loop from now on: end the ones that let it run."""
        for command in [c for c in self._running if c.action in LOOPING]:
            self._end(command, InterruptedCommandError(why))

    def _end(self, command: ClaimedCommand, interruption: InterruptedCommandError) -> None:
        """End a running built-in action, which may answer how far it got."""
        progress = self._running.pop(command)
        try:
            progress.throw(interruption)
        except StopIteration as end:
            self._succeed(command, end.value)
        except CommandRefusedError as reason:
            self._fail(command, reason)

    def _succeed(self, command: ClaimedCommand, result: object) -> None:
        session = self._session
        replaced = session.queue.succeed(command, result, session.clock.sim_time_s)
        if replaced is not None:
            text = f"command {command.id} ({command.action}): {replaced}"
            session.journal.log("warning", "bridge", text)

    def _fail(self, command: ClaimedCommand, error: BaseException) -> None:
        self._session.queue.fail(command, describe(error), self._session.clock.sim_time_s)
