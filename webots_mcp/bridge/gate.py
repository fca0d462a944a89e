"""Intercepting `Robot.step`, from wherever the controller calls it.

A loop calls the robot's method, or that of a subclass whose own `step` calls it by `super()`. So
the method of Webots' class is replaced, and asks the robot's guard first. Robots without a guard
step as before.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final, NamedTuple

QUIT: Final = -1

Method = Callable[..., int]

_STEPPING: Final = ("step", "stepBegin", "stepEnd")
_VEHICLE: Final = "vehicle"  # the package
_GUARD: Final = "_webots_mcp_guard"  # of a robot; None of its class
_MARK: Final = "_webots_mcp_asks"  # of a method


class Step(NamedTuple):
    """A call of a step method by the controller.

    Attributes:
        begins: It lets simulation time advance: `step(n)` and `stepBegin`, not `step(0)`.
        ends: It waits until the time has advanced: `step(n)` and `stepEnd`.
        make: Makes the original call.
    """

    begins: bool
    ends: bool
    make: Callable[[], int]

    @property
    def finishes(self) -> bool:
        """Whether it is the second half of a step that has begun: `stepEnd`."""
        return self.ends and not self.begins


Guard = Callable[[Step], int]


class StepGate:
    """Intercepts the steps of one robot while it is closed.

    Args:
        robot: A Webots `Robot`, or an instance of a subclass.
    """

    def __init__(self, robot: Any) -> None:
        self._robot = robot
        self._of_robot: dict[str, Any] = vars(robot)
        owner: Any = _owner_of_step(robot)
        setattr(owner, _GUARD, None)
        for cls in (owner, *_vehicles(robot)):
            for name in _STEPPING:
                method: Any = getattr(cls, name, None)
                if method is not None and not hasattr(method, _MARK):
                    setattr(cls, name, _guarded(name, method))
        self._own_step: Method = owner.step.__wrapped__

    def exchange(self) -> int:
        """Call `step(0)` past the guard; returns 0, or -1 if Webots wants the controller to end."""
        return self._own_step(self._robot, 0)

    def close(self, guard: Guard) -> None:
        """Let the guard answer each step of the controller."""
        self._of_robot[_GUARD] = guard

    def open(self) -> None:
        """Let steps go to Webots directly again."""
        self._of_robot.pop(_GUARD, None)


def _guarded(name: str, method: Method) -> Method:
    @functools.wraps(method)
    def ask_first(robot: Any, *args: Any, **kwargs: Any) -> int:
        guard: Guard | None = robot._webots_mcp_guard  # faster than getattr: runs in every step
        if guard is None:
            return method(robot, *args, **kwargs)
        make = functools.partial(method, robot, *args, **kwargs)
        if name == "step" and 0 in (*args, *kwargs.values()):
            return guard(Step(begins=False, ends=False, make=make))
        return guard(Step(name != "stepEnd", name != "stepBegin", make))

    setattr(ask_first, _MARK, True)
    return ask_first


def _vehicles(robot: Any) -> list[Any]:
    """Webots' classes whose `step` calls the C library and not `Robot.step`: `vehicle.Driver`."""
    return [cls for cls in type(robot).__mro__ if cls.__module__.partition(".")[0] == _VEHICLE]


def _owner_of_step(robot: Any) -> Any:
    """The last class that defines both `step` and `getTime`.

    A subclass that overrides `step` (an environment, say) hardly ever redefines `getTime` too.
    """
    owners = [cls for cls in type(robot).__mro__ if {"step", "getTime"} <= vars(cls).keys()]
    return owners[-1] if owners else type(robot)
