"""Pausing the simulation without locking out its own resume."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final

from webots_mcp.bridge.commands import Command
from webots_mcp.bridge.gate import QUIT, Step
from webots_mcp.bridge.heart import Heart
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.contract import PAUSED, STEPPING

PUMP_INTERVAL_S: Final = 0.01


class Hold:
    """Whether the user's loop is held, and the simulation mode to go back to.

    A paused simulation blocks every `step(n > 0)`, so after a pause the bridge stays inside
    `get_command()`, pumps `step(0)`, and goes on serving commands there. Code of the user's that
    runs there (a handler, a callback) may step all the same: time passes for just that step.

    Args:
        simulation: What is paused.
        journal: Is told when the hold begins and ends.
        heart: Tells others of it.
        stay: Serves commands until the hold has ended: for a loop that steps while it is held.
        stepped: Is told of each step that user code made during the hold.
    """

    def __init__(
        self,
        simulation: Simulation,
        journal: Journal,
        heart: Heart,
        stay: Callable[[], object],
        stepped: Callable[[], object],
    ) -> None:
        self._simulation = simulation
        self._journal = journal
        self._heart = heart
        self._stay = stay
        self._stepped = stepped
        self._users_code = 0  # how deep: a handler may ask for commands itself
        self.mode_before = "real_time"
        self.held = False

    def take(self, command: Command) -> None:
        """Pause the simulation and hold the loop from here on."""
        if self.held:
            return
        self._begin(self._simulation.mode_name)
        self._simulation.set_mode("pause")
        self._journal.event("pause", {"command_id": command.id})
        self._heart.change_hold(PAUSED, self.mode_before)

    def release(self, command: Command, mode: str | None = None, *, stepping: bool = False) -> None:
        """Let the loop go on, in `mode` or in the one that it ran in before."""
        before = self.mode_before if self.held else self._simulation.mode_name
        self._simulation.set_mode(mode or _running(before))
        if self.held:
            self._end()
            self._journal.event("resume", {"command_id": command.id})
        self._heart.change_hold(STEPPING if stepping else None)

    def take_over(self, mode_before: str) -> None:
        """Go on with the hold of a bridge whose process is gone, if the simulation still stands."""
        if not self._simulation.supervisor or not self._simulation.pump():
            return
        if self._simulation.paused:
            self._begin(mode_before)
            self._journal.event("pause", {"by": "the controller's session before this one"})
            self._heart.change_hold(PAUSED, mode_before)

    def let_go(self) -> None:
        """Nobody will serve commands any more: time goes on, if it was held."""
        if self.held and not self._simulation.over:
            self._simulation.set_mode(_running(self.mode_before))
            self._end()
            self._journal.event("resume", {"by": "the bridge, which was closed"})
            self._heart.change_hold(None)

    def pump(self) -> None:
        """Hear from Webots: it may want to quit, or a person may have pressed play."""
        if not self._simulation.pump():
            self._end()
        elif not self._simulation.paused:
            self._end()
            self._journal.event("resume", {"by": "a person or another controller, in Webots"})
            self._heart.change_hold(None)

    @contextmanager
    def users_code(self) -> Generator[None]:
        """While a handler or a callback runs: its steps are made, not held."""
        self._users_code += 1
        try:
            yield
        finally:
            self._users_code -= 1

    def _begin(self, mode_before: str) -> None:
        self.mode_before = mode_before
        self.held = True
        self._simulation.guard_steps(self._on_step)

    def _end(self) -> None:
        self.held = False
        self._simulation.guard_steps(None)

    def _on_step(self, step: Step) -> int:
        if step.begins and self._users_code:
            self.pump()  # a person may have ended the pause by now
        elif step.begins:
            self._stay()
        if self._simulation.over:
            return QUIT
        return self._let_pass(step) if self.held else step.make()

    def _let_pass(self, step: Step) -> int:
        """Leave the pause for just this step."""
        if step.begins:
            self._simulation.set_mode(_running(self.mode_before))
        try:
            answer = step.make()
        except BaseException:
            self._simulation.set_mode("pause")
            raise
        if answer == QUIT:
            self._simulation.end()
            self._end()
        elif step.ends:
            self._simulation.set_mode("pause")
            self._stepped()
        return answer


def _running(mode_before: str) -> str:
    """The mode in which time goes on."""
    return "fast" if mode_before == "fast" else "real_time"
