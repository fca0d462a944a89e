"""Pausing the simulation while still serving the command that resumes it."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final, Protocol

from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.simulation import QUIT, Simulation, Step
from webots_mcp.database.pause_states import (
    BRIDGE_CLOSED,
    IN_WEBOTS,
    PAUSE,
    PAUSED,
    RESUME,
    SESSION_BEFORE,
    SET_FREE,
    STEPPING,
    STEPPING_WORLD,
    Cause,
)

PUMP_INTERVAL_S: Final = 0.01


class StepListener(Protocol):
    """Called before and after each step of the controller."""

    def before(self, step: Step) -> None:
        """Handle that the controller asks for a step."""
        ...

    def after(self, step: Step, answer: int) -> None:
        """Handle that Webots has answered the step; the controller receives the answer next."""
        ...


class Pause:
    """Whether the bridge has paused the simulation, and the mode to return to.

    A paused simulation blocks every `step(n > 0)`, so during a pause the bridge stays inside
    `get_command()`, calls `step(0)` repeatedly, and serves commands there. Code of the user that
    runs there (a handler, a callback) may step nevertheless: time advances for just that step.

    Args:
        before_pause: Called before a pause begins, to write rows: the loop makes no call during the
            pause.
        after_step: Called after each intercepted step, before the loop's own code runs.

    Attributes:
        active: Whether the loop is paused.
        cause: Why the newest pause was begun.
        serve: Serves commands until the pause has ended, for a loop that steps during it.
    """

    def __init__(
        self,
        simulation: Simulation,
        journal: Journal,
        heartbeat: Heartbeat,
        before_pause: Callable[[], object],
        after_step: Callable[[], object],
    ) -> None:
        self._simulation = simulation
        self._journal = journal
        self._heartbeat = heartbeat
        self._before_pause = before_pause
        self._after_step = after_step
        self._mode_before: str | None = None  # before a pause, a run's pace or steps; None without
        self._user_code_depth = 0  # a count: a handler may call get_command(), which runs another
        self._awaiting_reset = False
        self._ask_before_steps: Callable[[], object] | None = None
        self._step_listener: StepListener | None = None
        self.active = False
        self.cause = Cause()
        self.serve: Callable[[], object] = self.pump

    @property
    def running_mode(self) -> str:
        """The simulation mode now; or before the pause, a run's own pace or steps."""
        return self._mode_before or self._simulation.mode_name

    def begin(self, cause: Cause) -> None:
        """Pause the simulation and the loop."""
        if self.active:
            return
        self.cause = cause
        self._before_pause()
        self._activate(self.running_mode)
        self._simulation.set_mode("pause")
        self._journal.event(PAUSE, cause.data)
        self._heartbeat.change_loop(PAUSED, self._mode_before)

    def end(self, command_id: int, mode: str | None = None, *, stepping: bool = False) -> None:
        """Let the loop continue, in `mode` or in the mode before the pause."""
        before, was_active = self.running_mode, self.active
        self._simulation.set_mode(mode or _running(before))
        self._deactivate()
        if was_active:
            self._journal.event(RESUME, Cause(command_id).data)
        self._heartbeat.change_loop(STEPPING if stepping else None)

    def change_mode_temporarily(
        self, command_id: int, mode: str | None, *, stepping: bool = False
    ) -> None:
        """Let the loop continue as `end` does, but remember the mode to return to."""
        before = self.running_mode
        self.end(command_id, mode, stepping=stepping)
        self._mode_before = before

    @contextmanager
    def world_waits(self) -> Generator[None]:
        """Make the world wait for this robot's steps during the block.

        The heartbeat records it first: if the process is killed meanwhile, the next session lets
        the world continue (`set_world_free`).
        """
        self._heartbeat.change_loop(STEPPING_WORLD)
        with self._simulation.world_waits():
            yield
        if self._heartbeat.loop == STEPPING_WORLD:  # else a breakpoint has paused it
            self._heartbeat.change_loop(STEPPING)

    def set_world_free(self) -> None:
        """Release a world that an ended process left waiting for its steps."""
        if self._simulation.supervisor and self._simulation.set_world_free():
            self._journal.log("warning", "bridge", SET_FREE)

    def restore_mode(self) -> None:
        """Return to the mode before `change_mode_temporarily`; the loop continues in it."""
        self._simulation.set_mode(self.running_mode)
        self._mode_before = None

    def take_over(self, mode_before: str) -> None:
        """Continue the pause of a bridge whose process has ended, if Webots is still paused.

        Args:
            mode_before: The mode before that pause.
        """
        if not self._simulation.supervisor or not self._simulation.pump():
            return
        if self._simulation.paused:
            self._activate(mode_before)
            self.cause = Cause(by=SESSION_BEFORE)
            self._journal.event(PAUSE, self.cause.data)
            self._heartbeat.change_loop(PAUSED, mode_before)

    def close(self) -> None:
        """Resume a paused simulation: after closing, no command could resume it."""
        if self._mode_before is None or self._simulation.over:
            return
        self._simulation.set_mode(_running(self._mode_before))
        if self.active:
            self._end_by(BRIDGE_CLOSED)

    def pump(self) -> None:
        """Exchange messages with Webots: it may quit, or a person may have pressed play."""
        if not self._simulation.pump():
            self._deactivate()
        elif not self._simulation.paused:
            self._end_by(IN_WEBOTS)

    def ask_before_steps(self, ask: Callable[[], object] | None) -> None:
        """Call `ask` before each step that the loop begins; it may begin a pause. None: stop."""
        self._ask_before_steps = ask
        self._guard_steps()

    def listen_to_steps(self, listener: StepListener | None) -> None:
        """Call the listener before and after each step from now on. None: stop."""
        self._step_listener = listener
        self._guard_steps()

    @property
    def in_user_code(self) -> bool:
        """Whether a handler or a callback is running."""
        return self._user_code_depth > 0

    @contextmanager
    def awaiting_reset(self) -> Generator[None]:
        """Intercept steps while a reset is awaited, to see it before the loop's code runs."""
        self._awaiting_reset = True
        self._guard_steps()
        try:
            yield
        finally:
            self._awaiting_reset = False
            self._guard_steps()

    @contextmanager
    def user_code(self) -> Generator[None]:
        """Let the steps of a handler or a callback advance time, even during a pause."""
        self._user_code_depth += 1
        self._guard_steps()
        try:
            yield
        finally:
            self._user_code_depth -= 1
            self._guard_steps()

    def _end_by(self, actor: str) -> None:
        self._deactivate()
        self._journal.event(RESUME, Cause(by=actor).data)
        self._heartbeat.change_loop(None)

    def _activate(self, mode_before: str) -> None:
        self._mode_before = mode_before
        self.active = True
        self._guard_steps()

    def _deactivate(self) -> None:
        self.active = False
        self._mode_before = None
        self._guard_steps()

    def _guard_steps(self) -> None:
        """Intercept the steps while anything needs that, and else let them go to Webots directly.

        Steps of a handler are intercepted outside a pause too: they show that the loop is alive.
        """
        asked = self._ask_before_steps is not None or self._step_listener is not None
        needed = self.active or self.in_user_code or self._awaiting_reset or asked
        self._simulation.guard_steps(self._on_step if needed else None)

    def _on_step(self, step: Step) -> int:
        listener = self._step_listener
        if listener is None:
            return self._answer(step)
        listener.before(step)
        answer = self._answer(step)
        if self._step_listener is listener:  # a handler in that step may have called detach()
            listener.after(step, answer)
        return answer

    def _answer(self, step: Step) -> int:
        if step.begins and self._ask_before_steps is not None and not self.active:
            self._ask_before_steps()
        if self.active and step.begins:
            if self.in_user_code:
                self.pump()  # a person may have ended the pause by now
            else:
                self.serve()
        if self._simulation.over:
            return QUIT
        answer = self._leave_for(step) if self.active else step.make()
        if answer == QUIT:
            self._simulation.end()
            self.active = False
        elif step.ends:
            self._after_step()
        return answer

    def _leave_for(self, step: Step) -> int:
        """Run the simulation for just this step, then pause it again."""
        if step.begins:
            self._simulation.set_mode(_running(self.running_mode))
        try:
            answer = step.make()
        except BaseException:
            self._simulation.set_mode("pause")
            raise
        if answer != QUIT and step.ends:
            self._simulation.set_mode("pause")
        return answer


def _running(mode_before: str) -> str:
    """Return the mode in which time advances: the one before, or real time if that was a pause."""
    return "fast" if mode_before == "fast" else "real_time"
