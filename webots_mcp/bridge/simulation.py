"""The simulation as the controller sees it: Webots' API, steps, simulation time and runs.

Webots is called only in the controller's own thread, and never after a quit.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import new_uuid
from webots_mcp.database.heartbeat import LoopTimes
from webots_mcp.database.thread_stacks import STEPPING
from webots_mcp.errors import CommandRefusedError

_ROBOT_METHODS: Final = ("step", "getTime", "getName", "getBasicTimeStep")
_INSIDE: Final = ("robot", "supervisor", "inner", "env", "unwrapped", "_robot")  # in wrappers
QUIT: Final = -1
_VEHICLE: Final = "vehicle"  # the package
_GUARD: Final = "_webots_mcp_guard"  # of a robot; None of its class
_METER: Final = "_webots_mcp_meter"  # likewise
_MARK: Final = "_webots_mcp_asks"  # of a method


class StepTimes(NamedTuple):
    """Times of waiting for a step, in seconds.

    Attributes:
        longest_wait_s: For the moment at which a step is due.
        prompt_s: Wall time that a due step takes.
        epsilon_s: Tolerance for rounding.
    """

    longest_wait_s: float = 0.1
    prompt_s: float = 0.002
    epsilon_s: float = 1e-9


_TIMES: Final = StepTimes()


class Simulation:
    """The simulation, as the user's robot can read and control it.

    Args:
        robot: A Webots `Robot` or `Supervisor`, or an instance of a subclass.

    Attributes:
        world_is_waiting: The world waits for this robot's steps, as long as a command makes them.

    Raises:
        TypeError: `robot` is something else.
    """

    def __init__(self, robot: Any) -> None:
        _require_robot(robot)
        self.robot = robot
        self.over = False  # Webots has ended the controller
        self.supervisor: bool = _may_supervise(robot)
        self.meter = LoopMeter()
        self._gate = StepGate(robot, self.meter)
        self._time_s = 0.0
        self._next_step_s = 0.0  # by the monotonic clock, in real time
        self._is_set_free = False
        self._mode_set: int | None = None  # until the next answer
        self._steps_at_setting = 0
        self.world_is_waiting = False

    @property
    def time_s(self) -> float:
        """Simulation time as of the last step; costs no request.

        Where the robot answers NaN or infinity, the last time that it knew still holds.
        """
        time_s = float(self.robot.getTime())
        if time_s - time_s == 0.0:  # faster than math.isfinite: of an infinity it is NaN
            self._time_s = time_s
        return self._time_s

    @property
    def basic_time_step_s(self) -> float:
        """WorldInfo.basicTimeStep in seconds."""
        return float(self.robot.getBasicTimeStep()) / 1000

    @property
    def waits_for_robot(self) -> bool:
        """Whether the simulation waits for this robot's next step (field `synchronization`).

        Webots' library answers with the value at the start.
        """
        return bool(self.robot.getSynchronization()) and not self._is_set_free

    @property
    def mode(self) -> int:
        """The mode that was set since Webots' last answer, else the one in that answer."""
        if self._mode_set is not None and self._steps_at_setting == self.meter.steps:
            return self._mode_set
        return int(self.robot.simulationGetMode())

    @property
    def paused(self) -> bool:
        """Whether `mode` is PAUSE."""
        return self.mode == self.robot.SIMULATION_MODE_PAUSE

    def set_mode(self, name: str) -> None:
        """Set the mode `pause`, `real_time` or `fast`.

        Webots changes it after its answer, which may still have the mode that was set before.
        """
        self._mode_set = int(getattr(self.robot, f"SIMULATION_MODE_{name.upper()}"))
        self._steps_at_setting = self.meter.steps
        self.robot.simulationSetMode(self._mode_set)

    @property
    def mode_name(self) -> str:
        """`pause`, `real_time` or `fast`."""
        names = {self.robot.SIMULATION_MODE_PAUSE: "pause", self.robot.SIMULATION_MODE_FAST: "fast"}
        return names.get(self.mode, "real_time")

    def pump(self) -> bool:
        """Exchange messages with Webots without advancing time; False if it ends the controller."""
        self._mode_set = None
        if self._gate.exchange() != QUIT:
            return True
        self.end()
        return False

    def advance_unless_paused(self) -> bool:
        """Make one basic time step once it is due in real time; False if paused, or after a quit.

        A step that is asked for in a pause does not return. So the loop does not wait in the step,
        but before it, and asks for the mode right before the step.
        """
        step_s, now_s = self.basic_time_step_s, time.monotonic()
        time.sleep(min(max(self._next_step_s - now_s, 0.0), step_s, _TIMES.longest_wait_s))
        if not self.pump() or self.paused:
            return False
        self._mode_set = None
        if self._gate.advance(max(round(step_s * 1000), 1)) == QUIT:
            self.end()
            return False
        self._next_step_s = max(self._next_step_s, time.monotonic() - _TIMES.prompt_s) + step_s
        return True

    @contextmanager
    def world_waits(self) -> Generator[None]:
        """Let the world wait for this robot's steps meanwhile, which it did not before.

        Webots reads the field `synchronization` before each step. Where the node has none, the
        world goes on without waiting.
        """
        field = self._synchronization
        if field is not None:
            field.setSFBool(True)
        self.world_is_waiting = True
        try:
            yield
        finally:
            self.world_is_waiting = False
            if field is not None and not self.over:
                field.setSFBool(False)
                self.pump()  # sends it: this may be the last call before the process ends

    def set_world_free(self) -> bool:
        """Let the world not wait for this robot's steps; False if it does not wait already."""
        field = self._synchronization
        if field is None or not field.getSFBool():
            return False
        field.setSFBool(False)
        self._is_set_free = True
        return self.pump()

    @property
    def _synchronization(self) -> Any:
        """The field of the robot's own node; None where a PROTO hides it."""
        own: Any = self.robot.getSelf()
        return own.getField("synchronization") if own is not None else None

    def guard_steps(self, guard: Guard | None) -> None:
        """Let `guard` answer the controller's steps; None: let Webots answer them again."""
        if self.over:
            return
        if guard is None:
            self._gate.open()
        else:
            self._gate.close(guard)

    @property
    def step_files(self) -> list[str]:
        """The files of the methods in which the controller waits for Webots."""
        return self._gate.files

    def end(self) -> None:
        """Stop calling Webots' API, since Webots wants the controller to end.

        Webots' library would end the process in the next `step` of the user's loop, without any
        cleanup. So the bridge answers that step with -1, and the loop ends by itself.
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
    """Return whether a robot's class has the method; wrappers only forward to a robot that has."""
    return callable(getattr(type(robot), name, None))


def _may_supervise(robot: Any) -> bool:
    """Return whether it is a Supervisor: by its class, and by the permission in the world file."""
    return hasattr(robot, "simulationSetMode") and bool(robot.getSupervisor())


# -- intercepting Robot.step, from wherever the controller calls it --------------------------------
# A loop calls the robot's method, or that of a subclass whose own `step` calls it by `super()`. So
# the method of Webots' class is replaced, and asks the robot's guard first. Robots without a guard
# step as before.


Method = Callable[..., int]


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
        meter: Takes the time of its steps from now on, in place of a former bridge's.
    """

    def __init__(self, robot: Any, meter: LoopMeter) -> None:
        self._robot = robot
        owner: Any = _owner_of_step(robot)
        for name in (_GUARD, _METER):
            if name not in vars(owner):
                setattr(owner, name, _OfSlotted())
        self.files: list[str] = []
        for cls in (owner, *_vehicles(robot)):
            for name in STEPPING:
                method: Any = getattr(cls, name, None)
                if method is not None and not hasattr(method, _MARK):
                    setattr(cls, name, _guarded(name, method))
            code = getattr(cls.step.__wrapped__, "__code__", None)
            self.files += [code.co_filename] if code else []
        _assign(robot, _METER, meter)
        self._own_step: Method = owner.step.__wrapped__

    def exchange(self) -> int:
        """Call `step(0)` past the guard; returns 0, or -1 if Webots wants the controller to end."""
        return self._own_step(self._robot, 0)

    def advance(self, duration_ms: int) -> int:
        """Make a step past the guard."""
        return self._own_step(self._robot, duration_ms)

    def close(self, guard: Guard) -> None:
        """Let the guard answer each step of the controller."""
        _assign(self._robot, _GUARD, guard)

    def open(self) -> None:
        """Let steps go to Webots directly again."""
        _assign(self._robot, _GUARD, None)


class _OfSlotted:
    """An attribute of a class for robots with `__slots__`, which cannot store it themselves.

    They are never released, so that no later robot gets the id of a former one.
    """

    def __init__(self) -> None:
        self._values: dict[int, tuple[object, object]] = {}

    def __get__(self, robot: object, owner: type) -> object:
        return self._values.get(id(robot), (None, None))[1]

    def assign(self, robot: object, value: object) -> None:
        """Give one robot its value."""
        self._values[id(robot)] = (robot, value)


def _assign(robot: Any, name: str, value: object) -> None:
    own: dict[str, object] | None = getattr(robot, "__dict__", None)
    if own is None:
        slotted = cast("_OfSlotted", vars(_owner_of_step(robot))[name])
        slotted.assign(robot, value)
    elif value is None:
        own.pop(name, None)
    else:
        own[name] = value  # past a `__setattr__` of the user's


def _guarded(name: str, method: Method) -> Method:
    ends, begins = name != "stepBegin", name != "stepEnd"

    @functools.wraps(method)
    def ask_first(robot: Any, *args: Any, **kwargs: Any) -> int:
        meter: LoopMeter | None = robot._webots_mcp_meter  # faster than getattr: in every step
        if meter is None:
            return method(robot, *args, **kwargs)
        meter.leave_own()
        advances = name != "step" or not (0 in args or 0 in kwargs.values())
        guard: Guard | None = robot._webots_mcp_guard
        if guard is None:
            return meter.leave_step(method(robot, *args, **kwargs), ends and advances)

        def make() -> int:
            meter.leave_bridge()
            return meter.leave_step(method(robot, *args, **kwargs), ends and advances)

        answer = guard(Step(begins and advances, ends and advances, make))
        meter.leave_bridge()
        return answer

    setattr(ask_first, _MARK, True)
    return ask_first


def _vehicles(robot: Any) -> list[Any]:
    """Return Webots' classes whose `step` bypasses `Robot.step`, such as `vehicle.Driver`."""
    return [cls for cls in type(robot).__mro__ if cls.__module__.partition(".")[0] == _VEHICLE]


def _owner_of_step(robot: Any) -> Any:
    """Return the last class that defines both `step` and `getTime`.

    A subclass that overrides `step` (an environment, say) hardly ever redefines `getTime` too.
    """
    owners = [cls for cls in type(robot).__mro__ if {"step", "getTime"} <= vars(cls).keys()]
    return owners[-1] if owners else type(robot)


# -- how long the controller, Webots and the bridge take in a round of the loop --------------------


class LoopMeter:
    """Adds up the wall time in the controller's own code, in its steps and in the bridge's calls.

    Each method is called where one of them is left for another. The loop's thread does all of this;
    the maintainer's only reads.

    Attributes:
        at_s: The newest sign of life, by `time.perf_counter`.
        thread: The one that steps.
    """

    __slots__ = ("_own_s", "_step_s", "_steps", "at_s", "thread")

    def __init__(self) -> None:
        self.thread = threading.get_ident()
        self.at_s = time.perf_counter()
        self._own_s = self._step_s = 0.0
        self._steps = -1  # until the first step has ended: what a controller does before is no loop

    def leave_own(self) -> None:
        """Note that the controller's own code calls a step or the bridge."""
        now_s = time.perf_counter()
        self._own_s += now_s - self.at_s
        self.at_s = now_s

    def leave_step(self, answer: int, has_advanced: bool) -> int:
        """Note that Webots has answered a step; return its answer."""
        now_s = time.perf_counter()
        self.thread = threading.get_ident()
        self._step_s += now_s - self.at_s
        self.at_s = now_s
        if has_advanced:
            if self._steps < 0:
                self._own_s = self._step_s = 0.0
            self._steps += 1
        return answer

    def leave_bridge(self) -> None:
        """Note that a call of the bridge ends, or that it lets a step be made."""
        self.at_s = time.perf_counter()

    def begin_run(self) -> None:
        """Count from here, the end of a step."""
        self._own_s = self._step_s = 0.0
        self._steps = min(self._steps, 0)

    @property
    def steps(self) -> int:
        """The steps of the controller so far, for comparison only: each run counts anew."""
        return self._steps

    @property
    def times(self) -> LoopTimes | None:
        """Of the run so far; None where no round of it was seen."""
        return LoopTimes(self._own_s, self._step_s, self._steps) if self._steps > 0 else None


class Clock:
    """The newest simulation time, and the run that it belongs to.

    A controller is not notified of a reset: it only sees that time has gone back.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.meter = simulation.meter  # whose time the rounds of the loop take
        self.sim_time_s = simulation.time_s
        self.moved_s: float | None = None  # by the monotonic clock
        self.stepped_s = self.sim_time_s  # at the end of the newest step that the bridge saw
        self.steps_seen = (
            0  # calls of `update` at which time had advanced, or the steps between them
        )
        self.step_s: float | None = None  # of a loop that only watches the steps of others
        self.run = CurrentRun("start", self.sim_time_s)
        self.ended_sim_time_s = self.sim_time_s  # of the run before this one
        self._reset_from_s: float | None = None

    def update(self, *, after_step: bool = False) -> bool:
        """Read the time; return True if it went back since the last call: a new run has begun.

        Args:
            after_step: A step has just ended. Where the time is the same as before, only this
                proves that a step was made, and so that the awaited reset has happened.
        """
        before, now = self.sim_time_s, self._simulation.time_s
        self.sim_time_s = now
        if after_step:
            self.stepped_s = now
        if now > before + _TIMES.epsilon_s:
            self.moved_s = time.monotonic()
            self.steps_seen += max(round((now - before) / self.step_s), 1) if self.step_s else 1
        if now >= before - _TIMES.epsilon_s and not self._is_awaited_reset(now, after_step):
            return False
        self._reset_from_s = None
        self.ended_sim_time_s = before
        self.run = CurrentRun("reset", now)
        self.start_moving()
        return True

    def follow(self, other: Clock, run: CurrentRun) -> bool:
        """Take the time of another clock; True if a run has begun there since `run`."""
        is_new = other.run is not run
        if is_new:
            self.ended_sim_time_s = self.sim_time_s
            self.run = CurrentRun("reset", other.sim_time_s)
        self.sim_time_s, self.moved_s = other.sim_time_s, other.moved_s
        return is_new

    def start_moving(self) -> None:
        """Count time as moving from now on; it counts as standing still only after a while."""
        self.moved_s = time.monotonic()

    def newest_s(self, run: CurrentRun) -> float:
        """Return the newest simulation time of the current run, or of the one before it."""
        return self.sim_time_s if run is self.run else self.ended_sim_time_s

    def await_reset(self) -> None:
        """Expect the reset that was requested, which happens at the end of the next physics step.

        Close to the start of a run, the first time after a reset is not below the last one before
        it. So if the last time was 0, any later time counts as the new run's; else the same time
        again after a step does.
        """
        self._reset_from_s = self.sim_time_s

    def forget_reset(self) -> None:
        """Stop expecting a reset, since none happened in time."""
        self._reset_from_s = None

    def _is_awaited_reset(self, now_s: float, after_step: bool) -> bool:
        if self._reset_from_s is None:
            return False
        if self._reset_from_s < self._simulation.basic_time_step_s - _TIMES.epsilon_s:
            return now_s > self._reset_from_s + _TIMES.epsilon_s
        return after_step and now_s <= self._reset_from_s + _TIMES.epsilon_s


# -- runs and simulation time ----------------------------------------------------------------------


class CurrentRun:
    """A segment of rising simulation time; its id is None until its row is written.

    Attributes:
        rows: The number of its states in the database.
        counted: Whether `rows` is exact: an interrupt may come between a row and its count.
    """

    __slots__ = (
        "counted",
        "id",
        "rows",
        "start_reason",
        "started_sim_time_s",
        "started_wall_time_s",
        "uuid",
    )

    def __init__(self, start_reason: str, sim_time_s: float) -> None:
        self.id: int | None = None
        self.uuid = new_uuid()
        self.rows = 0
        self.counted = True
        self.start_reason = start_reason
        self.started_sim_time_s = sim_time_s
        self.started_wall_time_s = time.time()

    def begin_anew(self) -> None:
        """Continue as a new run, in a new database."""
        self.id = None
        self.uuid = new_uuid()
        self.rows = 0


def mode_now(simulation: Simulation, clock: Clock) -> dict[str, object]:
    """Return the simulation's mode and time, as answers of commands name them."""
    return {"mode": simulation.mode_name, "sim_time_s": clock.sim_time_s}
