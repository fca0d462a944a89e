"""Motors that turn without end, and turn on after a reset of the world.

With a reset each motor stays where it is. A controller that calls `setPosition(inf)` once, before
its loop, would stand still from then on: it does not notice the reset. The library of Webots does
not either, and goes on telling what the controller asked for last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Simulation


class Motors:
    """Asks for endless turning again, where the controller has not done so by itself.

    Args:
        simulation: Whose robot has them.
        journal: Is told which were asked.
        failed: Is told of those that could not be.
    """

    def __init__(
        self, simulation: Simulation, journal: Journal, failed: Callable[[str, Exception], object]
    ) -> None:
        self._simulation = simulation
        self._journal = journal
        self._failed = failed

    def begin_run(self) -> None:
        """The world was reset: what was to turn without end does so again, as fast as before."""
        devices: dict[str, Any] = getattr(self._simulation.robot, "devices", None) or {}
        motors = [each for each in devices.items() if type(each[1]).__name__ == "Motor"]
        asked = [told for name, motor in motors if (told := self._ask_again(name, motor))]
        if asked:
            what = "the reset stopped these motors; they were asked for setPosition(inf) again"
            self._journal.log("info", "bridge", f"{what}, at their velocity: {', '.join(asked)}")

    def _ask_again(self, name: str, motor: Any) -> str | None:
        """Ask a motor to turn on, and tell how fast; None if it was not to turn without end."""
        try:
            target, velocity = motor.getTargetPosition(), motor.getVelocity()
            if not math.isinf(target):
                return None
            if name.count("::") == 1 and motor.getMultiplier() != 1:
                return None  # coupled: its sibling of multiplier 1 takes it along
            motor.setPosition(target)
            motor.setVelocity(velocity)  # else it would turn as fast as it can
        except Exception as error:  # noqa: BLE001  (the other motors are to turn on)
            self._failed(f"setPosition(inf) after the reset, of the motor {name!r},", error)
            return None
        return f"{name} ({velocity:g})"
