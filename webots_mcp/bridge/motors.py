"""Restarting motors in velocity control (`setPosition(inf)`) after a reset of the world.

A reset stops each motor at its position. A controller that calls `setPosition(inf)` once, before
its loop, does not notice the reset, and its robot would stand still from then on. Webots' library
does not notice it either: `getTargetPosition` still returns the last command, which is used here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.webots_api import Simulation


class Motors:
    """Repeats `setPosition(inf)` and the velocity of motors after a reset.

    Args:
        simulation: Has the robot.
        journal: Receives a log line that names the restarted motors.
        failed: Receives name and error of each motor that could not be restarted.
    """

    def __init__(
        self, simulation: Simulation, journal: Journal, failed: Callable[[str, Exception], object]
    ) -> None:
        self._simulation = simulation
        self._journal = journal
        self._failed = failed

    def begin_run(self) -> None:
        """The world was reset: restart the motors in velocity control, at their last velocity."""
        devices: dict[str, Any] = getattr(self._simulation.robot, "devices", None) or {}
        motors = [each for each in devices.items() if type(each[1]).__name__ == "Motor"]
        restarted = [text for name, motor in motors if (text := self._restart(name, motor))]
        if restarted:
            what = "the reset stopped these motors; the bridge called setPosition(inf) again"
            listed = ", ".join(restarted)
            self._journal.log("info", "bridge", f"{what}, with their last velocity: {listed}")

    def _restart(self, name: str, motor: Any) -> str | None:
        """Restart a motor; returns its name and velocity, or None where it was not in that mode."""
        try:
            target, velocity = motor.getTargetPosition(), motor.getVelocity()
            if not math.isinf(target):
                return None
            if name.count("::") == 1 and motor.getMultiplier() != 1:
                return None  # coupled (`name::part`): the motor of multiplier 1 drives it too
            motor.setPosition(target)
            motor.setVelocity(velocity)  # else it would turn at its maximum velocity
        except Exception as error:  # noqa: BLE001  (the other motors are still restarted)
            self._failed(f"setPosition(inf) after the reset, of the motor {name!r},", error)
            return None
        return f"{name} ({velocity:g})"
