"""What the bridge asks of Webots: only from the controller's own thread, never after a quit."""

from __future__ import annotations

from typing import Any, Final

from webots_mcp.bridge.gate import QUIT, Guard, StepGate
from webots_mcp.errors import CommandRefusedError

_ROBOT_METHODS: Final = ("step", "getTime", "getName", "getBasicTimeStep")
_INSIDE: Final = ("robot", "supervisor", "inner", "env", "unwrapped", "_robot")  # of wrappers


class Simulation:
    """The user's robot, seen as the way to its simulation.

    Args:
        robot: A Webots `Robot` or `Supervisor`, or an instance of a subclass.

    Raises:
        TypeError: `robot` is something else.
    """

    def __init__(self, robot: Any) -> None:
        _require_robot(robot)
        self.robot = robot
        self.over = False
        self.supervisor: bool = _may_supervise(robot)
        self._gate = StepGate(robot)

    @property
    def time_s(self) -> float:
        """Simulation time as of the last step; costs no request."""
        return float(self.robot.getTime())

    @property
    def basic_time_step_s(self) -> float:
        """WorldInfo.basicTimeStep in seconds."""
        return float(self.robot.getBasicTimeStep()) / 1000

    @property
    def waits_for_robot(self) -> bool:
        """Whether the world stands still until this robot asks for its next step."""
        return bool(self.robot.getSynchronization())

    @property
    def mode(self) -> int:
        """The simulation mode as of the last answer from Webots."""
        return int(self.robot.simulationGetMode())

    @property
    def paused(self) -> bool:
        """Whether the last answer from Webots said PAUSE."""
        return self.mode == self.robot.SIMULATION_MODE_PAUSE

    def set_mode(self, name: str) -> None:
        """Set the mode `pause`, `real_time` or `fast`."""
        self.robot.simulationSetMode(getattr(self.robot, f"SIMULATION_MODE_{name.upper()}"))

    @property
    def mode_name(self) -> str:
        """`pause`, `real_time` or `fast`."""
        names = {self.robot.SIMULATION_MODE_PAUSE: "pause", self.robot.SIMULATION_MODE_FAST: "fast"}
        return names.get(self.mode, "real_time")

    def pump(self) -> bool:
        """Exchange news with Webots without letting time pass; False if Webots says quit."""
        if self._gate.exchange() != QUIT:
            return True
        self.end()
        return False

    def guard_steps(self, guard: Guard | None) -> None:
        """Let `guard` answer the controller's steps, or (None) Webots itself again."""
        if self.over:
            return
        if guard is None:
            self._gate.open()
        else:
            self._gate.close(guard)

    def end(self) -> None:
        """Webots wants the controller to end: the API must not be called any more.

        The next `step` of the user's loop would end the process in the middle, without any
        cleanup, so it is answered here: -1, which ends the loop as Webots itself would.
        """
        self._gate.close(lambda _: QUIT)
        self.over = True

    def require_supervisor(self, action: str) -> None:
        """Refuse what only a Supervisor can do.

        Raises:
            CommandRefusedError: With what to change.
        """
        if self.supervisor:
            return
        missing = (
            "set the field 'supervisor' of its Robot node to TRUE"
            if hasattr(self.robot, "simulationSetMode")
            else "create it with Supervisor() instead of Robot(), and set 'supervisor' to TRUE"
        )
        refused = f"{action} needs a Supervisor and this robot is not one"
        raise CommandRefusedError(f"{refused}: {missing}")


def _require_robot(robot: Any) -> None:
    missing = [name for name in _ROBOT_METHODS if not _has_method(robot, name)]
    if not missing:
        return
    inside = next((name for name in _INSIDE if _is_robot(getattr(robot, name, None))), None)
    hint = f"; give its attribute: MCPBridge(x.{inside})" if inside else ""
    raise TypeError(
        f"MCPBridge needs a Webots Robot or Supervisor; the class {type(robot).__name__} has no "
        f"{', '.join(missing)}{hint}"
    )


def _is_robot(value: object) -> bool:
    return all(_has_method(value, name) for name in _ROBOT_METHODS)


def _has_method(robot: object, name: str) -> bool:
    """Of its class: an object that passes everything on to its robot is none itself."""
    return callable(getattr(type(robot), name, None))


def _may_supervise(robot: Any) -> bool:
    """Both are needed: the class that has the methods, and the world's permission."""
    return hasattr(robot, "simulationSetMode") and bool(robot.getSupervisor())
