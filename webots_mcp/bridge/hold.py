"""Pausing the simulation without locking out its own resume."""

from __future__ import annotations

from typing import Final

from webots_mcp.bridge.commands import Command
from webots_mcp.bridge.heart import Heart
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.contract import PAUSED, STEPPING

PUMP_INTERVAL_S: Final = 0.01


class Hold:
    """Whether the user's loop is held, and the simulation mode to go back to.

    A paused simulation blocks every `step(n > 0)`, so after a pause the bridge stays inside
    `get_command()`, pumps `step(0)`, and goes on serving commands there.
    """

    def __init__(self, simulation: Simulation, journal: Journal, heart: Heart) -> None:
        self._simulation = simulation
        self._journal = journal
        self._heart = heart
        self._mode_before = "real_time"
        self.held = False

    def take(self, command: Command) -> None:
        """Pause the simulation and hold the loop from here on."""
        if self.held:
            return
        self._mode_before = self._simulation.mode_name
        self._simulation.set_mode("pause")
        self.held = True
        self._journal.event("pause", {"command_id": command.id})
        self._heart.change_hold(PAUSED)

    def release(self, command: Command, mode: str | None = None, *, stepping: bool = False) -> None:
        """Let the loop go on, in `mode` or in the one that it ran in before."""
        before = self._mode_before if self.held else self._simulation.mode_name
        self._simulation.set_mode(mode or ("fast" if before == "fast" else "real_time"))
        if self.held:
            self.held = False
            self._journal.event("resume", {"command_id": command.id})
        self._heart.change_hold(STEPPING if stepping else None)

    def pump(self) -> None:
        """Hear from Webots: it may want to quit, or a person may have pressed play."""
        if not self._simulation.pump():
            self.held = False
        elif not self._simulation.paused:
            self.held = False
            self._journal.event("resume", {"by": "a person or another controller, in Webots"})
            self._heart.change_hold(None)
