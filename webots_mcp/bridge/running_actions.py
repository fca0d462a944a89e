"""The built-in actions that let the simulation run: pause, resume, fast, step, run, cancel_run.

Each returns a generator, see `webots_mcp.bridge.control`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from typing import Final

from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress, whole_number
from webots_mcp.bridge.parameters import Parameters, setter_of
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.run_goal import Goal, Watch, read_goal
from webots_mcp.bridge.simulation import Clock, Simulation, mode_now
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import MAX_STEPS, Then
from webots_mcp.database.pause_states import Cause
from webots_mcp.errors import CommandRefusedError, ControllerEndedError, InterruptedCommandError

_ROUND_S: Final = 0.05  # wall time of steps that a command makes before it serves the loop again


class RunningActions:
    """Pause, continue and step the simulation, and run it until a goal is reached."""

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        pause: Pause,
        throttle: Throttle,
        watch: Watch,
        breakpoints: Breakpoints,
        parameters: Parameters,
        reset_world: Callable[[], Generator[None]],
        check_clock: Callable[[], None],
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._pause = pause
        self._throttle = throttle
        self._watch = watch
        self._breakpoints = breakpoints
        self._parameters = parameters
        self._reset_world = reset_world
        self._check_clock = check_clock

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {
            "pause": self.pause,
            "resume": self.resume,
            "fast": self.fast,
            "step": self.step,
            "run": self.run,
            "cancel_run": self.cancel_run,
        }

    def pause(self, command: ClaimedCommand) -> Progress:
        """Pause at once, or after one more round if the state of this round was not recorded.

        The newest recorded state of a paused robot must be its current one.
        """
        if self._throttle.stale and not self._pause.active:
            self._throttle.want()
            yield
        self._pause.begin(Cause(command.id))
        return self._mode()

    def resume(self, command: ClaimedCommand) -> Progress:
        """Continue in real time, whatever the mode was before."""
        before = self._pause.running_mode
        self._pause.end(command.id, "real_time")
        why = "resume means real time"
        if before == "fast":
            why += "; it ran fast before: the command fast continues in that mode"
        return {**mode_now(self._simulation, self._clock), "why": why}
        yield

    def fast(self, command: ClaimedCommand) -> Progress:
        """Continue as fast as the computer can."""
        self._pause.end(command.id, "fast")
        return self._mode()
        yield

    def step(self, command: ClaimedCommand) -> Progress:
        """Let the user's loop run `steps` rounds, each with its own step, then pause.

        A loop that does not ask for commands in every round makes more steps; the answer begins
        with a warning that says how many. A world that does not wait for the robot
        (`synchronization` FALSE) runs in real time meanwhile, so that it can be stopped in time.
        """
        steps = whole_number(command.params, "steps", 1, MAX_STEPS, default=1)
        if self._clock.step_s is not None and not self._simulation.waits_for_robot:
            return self._step_world(command, steps)
        return self._step(command, steps)

    def _step(self, command: ClaimedCommand, steps: int) -> Progress:
        clock, watch = self._clock, self._watch
        from_s, from_step = clock.sim_time_s, clock.steps_seen
        mode = None if self._simulation.waits_for_robot else "real_time"
        self._pause.change_mode_temporarily(command.id, mode, stepping=True)
        watch.stepping = command.id
        try:
            while (made := clock.steps_seen - from_step) < steps and not self._pause.active:
                if watch.stepping != command.id:
                    break
                yield
        except InterruptedCommandError as interruption:
            made = clock.steps_seen - from_step
            watch.stepping = None
            raise CommandRefusedError(f"{interruption} after {made} of {steps} steps") from None
        ended_by = "it was cancelled" if watch.stepping != command.id else "a breakpoint paused it"
        watch.stepping = None
        self._pause.begin(Cause(command.id))
        return self._stepped(made, steps, round(clock.sim_time_s - from_s, 6), ended_by)

    def _step_world(self, command: ClaimedCommand, steps: int) -> Progress:
        """Make `steps` steps of a world that does not wait for this robot, then pause.

        The first step is awaited without blocking: another controller may hang and hold up the
        world. After it the world is made to wait for this robot, so that it stops at exactly the
        last step. A pause, by a breakpoint or in Webots, ends the command early: a step requested
        during a pause would not return.
        """
        pause, simulation, watch = self._pause, self._simulation, self._watch
        simulation.pump()  # the newest answer may be older than the world
        world = _WorldSteps(simulation, pause, watch, command.id)
        pause.change_mode_temporarily(command.id, "real_time", stepping=True)
        watch.stepping = command.id
        try:
            yield from world.make(1, simulation.pump, _ROUND_S)
            if world.go_on_to(steps):
                with pause.world_waits():
                    # Conditions are evaluated on what is published in a round.
                    round_s = 0.0 if self._breakpoints.armed else _ROUND_S
                    yield from world.make(steps, simulation.advance_unless_paused, round_s)
                    simulation.set_mode("pause")  # before the world stops waiting
        except InterruptedCommandError as interruption:
            watch.stepping = None
            made = world.count()
            raise CommandRefusedError(f"{interruption} after {made} of {steps} steps") from None
        simulation.set_mode("pause")
        if not simulation.pump():  # the world may have made a step until it was paused
            yield  # Webots has ended the controller
        made = world.count()
        watch.stepping = None
        self._check_clock()
        pause.begin(Cause(command.id))
        advanced_s = round(made * simulation.basic_time_step_s, 6)
        ended_by = world.ended_by or "it was cancelled"
        return self._stepped(made, steps, advanced_s, ended_by)

    def _stepped(
        self, made: int, steps: int, advanced_s: float, ended_by: str
    ) -> dict[str, object]:
        """Return the answer of `step`; a warning comes first where another number was made."""
        answer: dict[str, object] = {}
        if made > steps:
            why = "the loop could not stop in time"
            answer["warning"] = f"{made} steps were made, not {steps}: {why}"
        answer |= {"steps": made, "advanced_s": advanced_s}
        answer |= mode_now(self._simulation, self._clock)
        if made < steps:
            answer["why"] = f"{ended_by} before the last step"
        return answer

    def run(self, command: ClaimedCommand) -> Progress:
        """Let the loop run until a condition holds or a time has passed; then act on `then`."""
        goal = read_goal(command.params)
        self._watch.require_free()
        return self._run_until(command, goal)

    def cancel_run(self, command: ClaimedCommand) -> Progress:
        """End the `run` command of that id, as its `then` says, or the `step`: its caller left."""
        return {"was_under_way": self._watch.cancel(command.params.get("command_id"))}
        yield

    def _run_until(self, command: ClaimedCommand, goal: Goal) -> Progress:
        """Apply the goal's parameters, run until the goal is reached, and report how far it got."""
        watch, pause, finish = self._watch, self._pause, self._finish_of(command, goal.then)
        self._set_before_run(command, goal)
        watch.begin(command.id, goal, finish)
        pause.ask_before_steps(watch.before_step)
        try:
            pause.change_mode_temporarily(command.id, goal.pace)
            if goal.reset:
                yield from self._reset_world()
            while not watch.over():
                if pause.active:
                    why = f"the simulation was paused meanwhile: {pause.cause}"
                    watch.interrupt("interrupted", why)
                yield
            return watch.describe() | {"mode": self._simulation.mode_name}
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

    def _set_before_run(self, command: ClaimedCommand, goal: Goal) -> None:
        """Set the parameters of a goal, all or none."""
        if goal.parameters:
            parameters, setter = self._parameters, setter_of(command.params, command.id)
            (parameters.set_from_reset if goal.reset else parameters.set_now)(
                goal.parameters, setter
            )

    def _finish_of(self, command: ClaimedCommand, then: Then) -> Callable[[], None]:
        """Return the function that is called at the step that ends a run."""
        pause = self._pause
        was_paused = pause.active

        def finish() -> None:
            if then == "go_on" or (then == "as_before" and not was_paused):
                pause.restore_mode()
            else:
                pause.begin(Cause(command.id))

        return finish

    def _mode(self) -> dict[str, object]:
        return {"mode": self._simulation.mode_name, "sim_time_s": self._clock.sim_time_s}


class _WorldSteps:
    """Counts the steps of a world that does not wait for this robot, and lets it make them.

    Args:
        command_id: The `step` command; it is cancelled once `watch` holds another one.

    Attributes:
        ended_by: What ended the steps early; empty if nothing did, or the command was cancelled.
    """

    def __init__(self, simulation: Simulation, pause: Pause, watch: Watch, command_id: int) -> None:
        self._simulation = simulation
        self._pause = pause
        self._watch = watch
        self._command_id = command_id
        self._count, self._counted_to_s = 0, simulation.time_s
        self.ended_by = ""

    def count(self) -> int:
        """Return the number of steps that the world has made."""
        time_s = self._simulation.time_s
        began_s = self._counted_to_s if time_s >= self._counted_to_s else 0.0  # it was reset
        self._count += round((time_s - began_s) / self._simulation.basic_time_step_s)
        self._counted_to_s = time_s
        return self._count

    def go_on_to(self, steps: int) -> bool:
        """Return whether the world is to make more steps to reach that count."""
        going_on = self._watch.stepping == self._command_id and not self.ended_by
        return self.count() < steps and going_on

    def make(self, steps: int, go_on: Callable[[], bool], round_s: float) -> Generator[None]:
        """Step until the count is reached; yield after each round to serve the loop.

        Args:
            steps: The count at which to stop.
            go_on: Waits for or makes the next step, and returns False if the world is paused.
            round_s: Wall time of a round.
        """
        simulation, until_s = self._simulation, time.monotonic() + round_s
        while self.go_on_to(steps):
            may_go_on = go_on()
            if time.monotonic() >= until_s or simulation.over:
                yield
                until_s = time.monotonic() + round_s
                may_go_on = may_go_on and not simulation.paused
            if self._pause.active:
                self.ended_by = "a breakpoint paused it"
            elif not may_go_on:
                self.ended_by = "it was paused in Webots"
