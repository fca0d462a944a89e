"""The goal of a `run` command: what it asks for, and whether it is reached.

The goal is judged on each published state and before each step of the controller's loop.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, cast, get_args

from webots_mcp.bridge.encoding import plain
from webots_mcp.bridge.error_report import describe
from webots_mcp.bridge.simulation import Clock, CurrentRun
from webots_mcp.contract import MAX_RUN_S, Pace, RunEnd, Then
from webots_mcp.errors import CommandRefusedError, InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.signals.conditions import Condition, Evaluator
    from webots_mcp.signals.naming import Value


class Goal(NamedTuple):
    """What a `run` command asks for.

    Attributes:
        until: Run until it holds; None for no condition.
        prune: End as `pruned` where it holds first: the outcome is decided; None for no condition.
        for_s: Seconds of simulation time to run for; None for no limit.
        reset: Reset the world first; `for_s` counts from there.
        pace: The simulation mode to run in; None for the mode that it ran in last.
        parameters: Values to set first, or at the reset where there is one.
        then: What to do when the run is over.
    """

    until: Condition | None
    prune: Condition | None
    for_s: float | None
    reset: bool
    pace: Pace | None
    parameters: dict[str, object]
    then: Then


def read_goal(params: dict[str, Any]) -> Goal:
    """Return the goal that the parameters of a command describe.

    Raises:
        InvalidInputError: One of them is invalid, or both `until` and `for_s` are missing.
    """
    for_s, parameters = params.get("for_s"), params.get("parameters")
    until, prune = _condition("until", params), _condition("prune", params)
    if until is None and for_s is None:
        raise InvalidInputError("give until (a condition), for_s (simulated seconds), or both")
    if parameters is not None and not isinstance(parameters, dict):
        raise InvalidInputError(
            f'parameters must be an object such as {{"kp": 3.0}}, not {parameters!r:.80}'
        )
    return Goal(
        until=until,
        prune=prune,
        for_s=None if for_s is None else _seconds(for_s),
        reset=_one_of("reset", params.get("reset", False), (False, True)),
        pace=_one_of("pace", params.get("pace"), (None, *get_args(Pace))),
        parameters=cast("dict[str, object]", parameters or {}),
        then=_one_of("then", params.get("then", "pause"), get_args(Then)),
    )


def _condition(name: str, params: dict[str, Any]) -> Condition | None:
    from webots_mcp.signals.conditions.compiler import parse_condition

    text = params.get(name)
    if text is not None and not isinstance(text, str):
        raise InvalidInputError(
            f"{name} must be a condition, such as 'front_m < 0.1', not {text!r:.80}"
        )
    return None if text is None else parse_condition(text)


def _seconds(value: object) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= MAX_RUN_S:
        return float(value)
    raise InvalidInputError(
        f"for_s must be simulated seconds above 0 and at most {MAX_RUN_S:.0f}, not {value!r:.80}"
    )


def _one_of(name: str, value: Any, choices: tuple[Any, ...]) -> Any:
    if any(value is choice or (isinstance(value, str) and value == choice) for choice in choices):
        return value
    listed = ", ".join("null" if choice is None else repr(choice) for choice in choices)
    raise InvalidInputError(f"{name} must be one of {listed}, not {value!r:.80}")


class Reached(NamedTuple):
    """How a `run` command ended.

    Attributes:
        end: The kind of end.
        run: The run in which it ended.
        sim_time_s: Simulation time of the step at which it ended.
        monotonic_s: The monotonic clock at that step.
        why: The reason, where `end` does not say it all.
        values: The values of the condition's signals.
    """

    end: RunEnd
    run: CurrentRun
    sim_time_s: float
    monotonic_s: float
    why: str | None = None
    values: dict[str, Value] | None = None


class _Watched:
    """A goal, from the command that set it until it is reached.

    Attributes:
        run: The run in which it is watched; None while the reset is awaited.
        former: The run before the reset.
        since_s: The simulation time at which it began, and the monotonic clock at that time.
        published_s: The simulation time of the newest published state.
    """

    def __init__(self, command_id: int, goal: Goal, clock: Clock, finish: Callable[[], object]):
        self.command_id = command_id
        self.goal = goal
        self.finish = finish
        self.finished = False
        self.evaluators: list[tuple[RunEnd, Evaluator]] = []
        if goal.until is not None:
            self.evaluators.append(("condition held", goal.until.evaluator(plain)))
        if goal.prune is not None:
            self.evaluators.append(("pruned", goal.prune.evaluator(plain)))
        self.former, self.run = clock.run, None if goal.reset else clock.run
        self.since_s = (clock.sim_time_s, time.monotonic())
        self.published_s = -math.inf
        self.reached: Reached | None = None


class Watch:
    """Watches whether the goal of a `run` command is reached, at each published state and step.

    The simulation is stopped at the step that reaches the goal: in `get_command()` where the state
    of that step is published by then, else before the loop's next step begins.

    Args:
        clock: Has the simulation time and the run.
        tolerance_s: Amount by which summed floating-point steps may fall short of a time.

    Attributes:
        stepping: The id of the running `step` command; None also once it was cancelled.
    """

    def __init__(self, clock: Clock, tolerance_s: float) -> None:
        self._clock = clock
        self._tolerance_s = tolerance_s
        self._watched: _Watched | None = None
        self.stepping: int | None = None

    @property
    def asks_states(self) -> bool:
        """Whether each state has to be evaluated, recorded or not."""
        return self._watched is not None and self._watched.reached is None

    def require_free(self) -> None:
        """Refuse a second goal.

        Raises:
            CommandRefusedError: Another `run` is active; the text says how to go on.
        """
        if (watched := self._watched) is not None:
            raise CommandRefusedError(
                f"command {watched.command_id} (run) is still running: wait for it with "
                f"webots_wait_for_command(command_id={watched.command_id}), "
                "or pause to end it"
            )

    def begin(self, command_id: int, goal: Goal, finish: Callable[[], object]) -> None:
        """Watch from the next state on; where the goal asks for a reset, from the first after it.

        Args:
            command_id: The id of the `run` command.
            goal: Its goal.
            finish: Called once, at the step at which the goal is reached.
        """
        self._watched = _Watched(command_id, goal, self._clock, finish)

    def end(self) -> None:
        """Stop watching: the command is answered."""
        self._watched = None

    # -- from the loop -------------------------------------------------------------------------

    def evaluate(self, state: Any) -> bool:
        """Evaluate a published state; True if it is the one that reaches the goal."""
        watched = self._watched
        if watched is None or watched.reached is not None or not self._begun(watched):
            return False
        watched.published_s = self._clock.sim_time_s
        watched.reached = self._judge_run(watched) or self._judge(watched, state)
        return watched.reached is not None and watched.reached.run is self._clock.run

    def before_step(self) -> None:
        """Judge the goal before the loop's next step: the last step's state is complete now."""
        watched = self._watched
        if watched is None or not self._begun(watched):
            return
        watched.reached = watched.reached or self._judge_run(watched) or self._judge_time(watched)
        if watched.reached is not None:
            self._finish(watched)

    def over(self) -> bool:
        """Return in `get_command()` whether the goal is reached.

        The time limit is judged only once this step's state is published: its condition, which may
        hold at the same step, must be evaluated first.
        """
        watched = self._watched
        if watched is None or not self._begun(watched):
            return watched is None
        if watched.reached is None:
            watched.reached = self._judge_run(watched)
        if watched.reached is None and watched.published_s == self._clock.sim_time_s:
            watched.reached = self._judge_time(watched)
        if watched.reached is not None:
            self._finish(watched)
        return watched.reached is not None

    def interrupt(self, end: RunEnd, why: str) -> None:
        """End the run because another command, or a pause, controls the loop from now on."""
        if (watched := self._watched) is not None:
            watched.reached = watched.reached or self._reached(end, why)
            watched.finished = True

    def cancel(self, command_id: object) -> bool:
        """End that `run` now, as its `then` says, or that `step`; False if neither is running."""
        if command_id is not None and command_id == self.stepping:
            self.stepping = None
            return True
        watched = self._watched
        if watched is None or watched.command_id != command_id:
            return False
        watched.reached = watched.reached or self._reached("interrupted", "it was cancelled")
        return True

    def describe(self) -> dict[str, object]:
        """Return the result of the `run` command: how it ended, where, and how fast it ran.

        Raises:
            CommandRefusedError: The condition could not be evaluated on the published state.
        """
        assert self._watched is not None and self._watched.reached is not None, "ask over() first"
        reached, (since_s, since_monotonic_s) = self._watched.reached, self._watched.since_s
        if reached.end == "condition failed":
            raise CommandRefusedError(f"{reached.why}; it ended at {reached.sim_time_s:.6g} s")
        wall_s = reached.monotonic_s - since_monotonic_s
        advanced_s = round(reached.sim_time_s - since_s, 6)
        facts = {
            "ended": reached.end,
            "why": reached.why,
            "run_id": reached.run.id,
            "from_s": round(since_s, 6),
            "sim_time_s": round(reached.sim_time_s, 6),
            "advanced_s": advanced_s,
            "wall_s": round(wall_s, 3),
            "factor": round(advanced_s / wall_s, 3) if wall_s > 0 else None,
            "values": reached.values,
        }
        return {name: value for name, value in facts.items() if value is not None}

    # -- inside --------------------------------------------------------------------------------

    def _begun(self, watched: _Watched) -> bool:
        """Return whether the run to watch has begun, so that an awaited reset has happened."""
        if watched.run is None and self._clock.run is not watched.former:
            watched.run = self._clock.run
            if watched.reached is None:  # else it was ended before the reset came
                watched.since_s = (0.0, time.monotonic())
        return watched.run is not None

    def _finish(self, watched: _Watched) -> None:
        if not watched.finished:
            watched.finished = True
            watched.finish()

    def _judge(self, watched: _Watched, state: Any) -> Reached | None:
        held: Reached | None = None
        try:
            for end, evaluator in watched.evaluators:  # no early exit: each needs every state
                if evaluator.holds(state, self._clock.sim_time_s):
                    held = held or self._reached(end, values=evaluator.values(state))
        except Exception as error:  # noqa: BLE001  (the user's objects may raise anything)
            return self._reached("condition failed", describe(error))
        return held or self._judge_time(watched)

    def _judge_time(self, watched: _Watched) -> Reached | None:
        for_s, (since_s, _) = watched.goal.for_s, watched.since_s
        run_s = self._clock.sim_time_s - since_s
        if for_s is None or run_s <= 0 or run_s < for_s - self._tolerance_s:
            return None
        return self._reached("simulation time reached")

    def _judge_run(self, watched: _Watched) -> Reached | None:
        if watched.run is None or self._clock.run is watched.run:
            return None
        at_s = self._clock.ended_sim_time_s
        return Reached("run ended", watched.run, at_s, time.monotonic(), "the world was reset")

    def _reached(
        self, end: RunEnd, why: str | None = None, values: dict[str, Value] | None = None
    ) -> Reached:
        clock = self._clock
        return Reached(end, clock.run, clock.sim_time_s, time.monotonic(), why, values)
