"""Pausing the simulation without locking out its own resume."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final, Protocol

from webots_mcp.bridge.commands import ClaimedCommand
from webots_mcp.bridge.gate import QUIT, Step
from webots_mcp.bridge.heartbeat import Heartbeat
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.pauses import (
    BRIDGE_CLOSED,
    IN_WEBOTS,
    PAUSE,
    PAUSED,
    RESUME,
    SESSION_BEFORE,
    STEPPING,
    Cause,
)

PUMP_INTERVAL_S: Final = 0.01


class Companion(Protocol):
    """What goes along with each step of the controller's."""

    def before(self, step: Step) -> None:
        """The controller asks for a step."""
        ...

    def after(self, step: Step, answer: int) -> None:
        """It is answered; the controller hears of it next."""
        ...


class Pause:
    """Whether the bridge has paused the simulation, and the mode to go back to.

    A paused simulation blocks every `step(n > 0)`, so after a pause the bridge stays inside
    `get_command()`, pumps `step(0)`, and goes on serving commands there. Code of the user's that
    runs there (a handler, a callback) may step all the same: time passes for just that step.

    Args:
        simulation: What is paused.
        journal: Is told when the pause begins and ends.
        heartbeat: Tells others of it.
        stepped: Is told of each guarded step when it is over.
        begins: Is told when the loop is about to stand still.

    Attributes:
        active: The loop stays where it is.
        cause: What the newest pause was begun for.
        serve: Serves commands until the pause has ended: for a loop that steps during it.
    """

    def __init__(
        self,
        simulation: Simulation,
        journal: Journal,
        heartbeat: Heartbeat,
        stepped: Callable[[], object],
        begins: Callable[[], object],
    ) -> None:
        self._simulation = simulation
        self._journal = journal
        self._heartbeat = heartbeat
        self._stepped = stepped
        self._begins = begins
        self._mode_before: str | None = None  # a pause, a run's pace or steps; None where none is
        self._user_code_depth = 0  # a handler may ask for commands itself
        self._awaiting_step = False
        self._ask_before_steps: Callable[[], object] | None = None
        self._companion: Companion | None = None
        self.active = False
        self.cause = Cause()
        self.serve: Callable[[], object] = self.pump

    @property
    def running_mode(self) -> str:
        """The simulation mode now; or before the pause, a run's own pace or steps."""
        return self._mode_before or self._simulation.mode_name

    def begin(self, cause: Cause) -> None:
        """Pause the simulation and keep the loop from here on."""
        if self.active:
            return
        self.cause = cause
        self._begins()
        self._activate(self.running_mode)
        self._simulation.set_mode("pause")
        self._journal.event(PAUSE, cause.data)
        self._heartbeat.change_loop(PAUSED, self._mode_before)

    def end(
        self, command: ClaimedCommand, mode: str | None = None, *, stepping: bool = False
    ) -> None:
        """Let the loop go on, in `mode` or in the one that it ran in before."""
        before, was_active = self.running_mode, self.active
        self._simulation.set_mode(mode or _running(before))
        self._deactivate()
        if was_active:
            self._journal.event(RESUME, Cause(command.id).data)
        self._heartbeat.change_loop(STEPPING if stepping else None)

    def lend_mode(
        self, command: ClaimedCommand, mode: str | None, *, stepping: bool = False
    ) -> None:
        """Let the loop go on for a while, as `end` does: the mode to go back to stays."""
        before = self.running_mode
        self.end(command, mode, stepping=stepping)
        self._mode_before = before

    def give_mode_back(self) -> None:
        """That while is over: the loop goes on in the mode before it."""
        self._simulation.set_mode(self.running_mode)
        self._mode_before = None

    def take_over(self, mode_before: str) -> None:
        """Go on with the pause of a bridge whose process is gone, if the simulation still stands.

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
        """Nobody will serve commands any more: where it is paused, time goes on."""
        if self._mode_before is None or self._simulation.over:
            return
        self._simulation.set_mode(_running(self._mode_before))
        if self.active:
            self._end_by(BRIDGE_CLOSED)

    def pump(self) -> None:
        """Hear from Webots: it may want to quit, or a person may have pressed play."""
        if not self._simulation.pump():
            self._deactivate()
        elif not self._simulation.paused:
            self._end_by(IN_WEBOTS)

    def ask_before_steps(self, ask: Callable[[], object] | None) -> None:
        """Call it before each step that the loop begins: it may begin the pause. None: no more."""
        self._ask_before_steps = ask
        self._guard_steps()

    def go_along(self, companion: Companion | None) -> None:
        """Let it go along with each step from now on. None: nothing does any more."""
        self._companion = companion
        self._guard_steps()

    @property
    def in_user_code(self) -> bool:
        """A handler or a callback runs."""
        return self._user_code_depth > 0

    @contextmanager
    def awaiting_step(self) -> Generator[None]:
        """While the end of a step is to bring something: it comes before the loop goes on."""
        self._awaiting_step = True
        self._guard_steps()
        try:
            yield
        finally:
            self._awaiting_step = False
            self._guard_steps()

    @contextmanager
    def user_code(self) -> Generator[None]:
        """While a handler or a callback runs: its steps are made, also during the pause."""
        self._user_code_depth += 1
        self._guard_steps()
        try:
            yield
        finally:
            self._user_code_depth -= 1
            self._guard_steps()

    def _end_by(self, whom: str) -> None:
        self._deactivate()
        self._journal.event(RESUME, Cause(by=whom).data)
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
        """Outside a pause the steps of user code are only noted: they show that it is alive."""
        asked = self._ask_before_steps is not None or self._companion is not None
        needed = self.active or self.in_user_code or self._awaiting_step or asked
        self._simulation.guard_steps(self._on_step if needed else None)

    def _on_step(self, step: Step) -> int:
        companion = self._companion
        if companion is None:
            return self._answer(step)
        companion.before(step)
        answer = self._answer(step)
        if self._companion is companion:  # it may have been told to go meanwhile
            companion.after(step, answer)
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
            self._stepped()
        return answer

    def _leave_for(self, step: Step) -> int:
        """Leave the pause for just this step."""
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
    """The mode in which time goes on."""
    return "fast" if mode_before == "fast" else "real_time"
