"""All calls to Webots' API: only in the controller's own thread, and never after a quit."""

from __future__ import annotations

from typing import Any, Final

from webots_mcp.bridge.gate import QUIT, Guard, StepGate
from webots_mcp.errors import CommandRefusedError

_ROBOT_METHODS: Final = ("step", "getTime", "getName", "getBasicTimeStep")
_INSIDE: Final = ("robot", "supervisor", "inner", "env", "unwrapped", "_robot")  # in wrappers


class Simulation:
    """The simulation, as the user's robot can read and control it.

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
        """Whether the simulation waits for this robot's next step (field `synchronization`)."""
        return bool(self.robot.getSynchronization())

    @property
    def mode(self) -> int:
        """The simulation mode in Webots' last answer."""
        return int(self.robot.simulationGetMode())

    @property
    def paused(self) -> bool:
        """Whether the mode in Webots' last answer is PAUSE."""
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
        """Exchange messages with Webots without advancing time; False if it says quit."""
        if self._gate.exchange() != QUIT:
            return True
        self.end()
        return False

    def guard_steps(self, guard: Guard | None) -> None:
        """Let `guard` answer the controller's steps; None: let Webots answer them again."""
        if self.over:
            return
        if guard is None:
            self._gate.open()
        else:
            self._gate.close(guard)

    def end(self) -> None:
        """Webots wants the controller to end: its API must not be called any more.

        Webots' library would end the process in the next `step` of the user's loop, without any
        cleanup. So that step is answered here, with -1, on which the loop ends by itself.
        """
        self._gate.close(lambda _: QUIT)
        self.over = True

    def require_supervisor(self, action: str) -> None:
        """Refuse what only a Supervisor can do.

        Raises:
            CommandRefusedError: The robot is not one; the text says what to change.
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
    hint = f"; pass its attribute: MCPBridge(x.{inside})" if inside else ""
    raise TypeError(
        f"MCPBridge needs a Webots Robot or Supervisor; the class {type(robot).__name__} has no "
        f"{', '.join(missing)}{hint}"
    )


def _is_robot(value: object) -> bool:
    return all(_has_method(value, name) for name in _ROBOT_METHODS)


def _has_method(robot: object, name: str) -> bool:
    """Whether its class has the method: a wrapper that forwards all attributes is not a robot."""
    return callable(getattr(type(robot), name, None))


def _may_supervise(robot: Any) -> bool:
    """Whether it is a Supervisor: by its class, and by the permission in the world file."""
    return hasattr(robot, "simulationSetMode") and bool(robot.getSupervisor())
