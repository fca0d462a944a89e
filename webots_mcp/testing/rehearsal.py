"""A simulation within the test's own process that can neither go on nor wait for ever."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.standin import InProcessSimulation, Mode, WouldBlockError
from webots_mcp.standin.in_process import DEFAULT_WORLD

if TYPE_CHECKING:
    from controller.wire import Message

HOLD_LIMIT_S: Final = 2.0


class Rehearsal(InProcessSimulation):
    """An `InProcessSimulation` that ends by itself, so that a whole control loop can be tested.

    After `duration_s` of simulated time `step` returns -1, as when somebody closes Webots. A loop
    that is held by a pause, with nobody left in the process who could resume it, is an error.
    """

    def __init__(self, world: str | Path = DEFAULT_WORLD, *, duration_s: float = math.inf) -> None:
        """Load a world, running fast.

        Args:
            world: A .wbt file.
            duration_s: When it ends, in seconds of simulated time.

        Raises:
            WorldError: The world cannot be used.
        """
        super().__init__(world)
        self._duration_s = duration_s
        self._held_since_s: float | None = None

    def take(self, link: Any, message: Message) -> None:
        """As of `InProcessSimulation`.

        Raises:
            WouldBlockError: The loop steps, and a pause has held it for 2 s of wall time; all else
                goes through, so that its end can resume.
        """
        if self.mode is not Mode.PAUSE or message[:2] == ("ask", "simulation_set_mode"):
            self._held_since_s = None
        elif self._held_since_s is None:
            self._held_since_s = time.monotonic()
        elif message[0] == "step" and time.monotonic() - self._held_since_s > HOLD_LIMIT_S:
            raise WouldBlockError(
                f"the simulation is paused and nobody resumed it for {HOLD_LIMIT_S:g} s: send "
                "'resume' before get_command() takes the 'pause', or run the controller as a "
                "process with webots_simulation"
            )
        super().take(link, message)

    def _advance(self) -> None:
        super()._advance()
        if self.time_s >= self._duration_s and self.exit_status is None:
            self.quit()
