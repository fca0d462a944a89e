"""Breakpoints: conditions that are evaluated on every published state, recorded or not."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast, get_args

from webots_mcp.bridge.encoding import plain
from webots_mcp.bridge.error_report import cut, describe, storable
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.keeping import Keeper
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration
from webots_mcp.bridge.simulation import Clock, CurrentRun, Simulation
from webots_mcp.contract import BREAKPOINT_ACTIONS, MAX_BREAKPOINTS, MAX_RUN_S, Pace, RunEnd, Then
from webots_mcp.database.pauses import ARMED, OF_CONTROLLER, SET, VIOLATION, Cause
from webots_mcp.errors import (
    CommandRefusedError,
    ConditionFailedError,
    InvalidConditionError,
    InvalidInputError,
)

if TYPE_CHECKING:
    from webots_mcp.signals.conditions import Condition, Evaluator
    from webots_mcp.signals.conditions.compiler import Expectation, Violated
    from webots_mcp.signals.naming import Value

MOST_EVENTS: Final = 1000  # of one breakpoint in one run: a flickering condition fills no database
_UNPUBLISHED_S: Final = 1.0  # a signal that was not published for so long is reported
_MOST_ERROR_CHARACTERS: Final = 1000


# Condition, action, hits; of an expectation its name, what is expected, and during what.
Asks = tuple[str, str, int, "str | None", "str | None", "str | None"]
_KEEPING: Final = ("pause", "keep")  # a pause is for looking at what led to it
_CANNOT_PAUSE: Final = (
    "the robot is not a Supervisor: set its field `supervisor` to TRUE in the world file"
)


class ArmedBreakpoint:
    """An armed breakpoint.

    Attributes:
        id: None where the database could not take it yet.
        hit_count: How often its condition began to hold in this run.
        holding: Its condition held in the previous state.
        asked_since_s: The simulation time of the first state that it was evaluated on in this run.
        unseen: Its signals that no state has contained yet.
        expectation: What is expected, where the condition is that it does not hold.
    """

    def __init__(
        self,
        id: int | None,  # noqa: A002
        condition: Condition,
        evaluator: Evaluator | Violated,
        action: str,
        after_hits: int,
        expectation: Expectation | None = None,
    ) -> None:
        self.id = id
        self.condition = condition
        self.evaluator = evaluator
        self.action = action
        self.after_hits = after_hits
        self.hit_count = 0
        self.holding = False
        self.asked_since_s: float | None = None
        self.unseen = frozenset(condition.signals)
        self.expectation = expectation

    @property
    def asks(self) -> Asks:
        """Its condition, action, hits and expectation: what identifies it in another database."""
        own = self.condition.text, self.action, self.after_hits
        if self.expectation is None:
            return *own, None, None, None
        name, expects, during = self.expectation.asks
        return *own, name, expects, during

    @property
    def called(self) -> str:
        """How messages name it."""
        expected = self.expectation
        return f"expectation {expected.name!r}" if expected else f"breakpoint {self.id or ''}"

    def begin_run(self) -> None:
        """Arm it again for a new run."""
        self.evaluator.forget()
        self.hit_count, self.holding, self.asked_since_s = 0, False, None


class Breakpoints:
    """This robot's armed breakpoints: the stored ones, and those of the controller's code."""

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        pause: Pause,
        keeper: Keeper,
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._pause = pause
        self._keeper = keeper
        self.run: CurrentRun | None = (
            None  # in which the stored ones were read; None: to be read again
        )
        self.reaches = False  # the newest state meets what is expected within a time
        self._begun = clock.run
        self._registration: Registration | None = None  # in the database that was read last
        self._off: dict[int, str] = {}
        self.armed: list[ArmedBreakpoint] = []
        recorder.new_database_entries.append(self._read_later)

    # -- setting -------------------------------------------------------------------------------

    def begin(self) -> None:
        """Arm what is stored, without what the code of earlier sessions has set."""
        self._recorder.record("breakpoints forgotten", None, {"by": OF_CONTROLLER})
        self.load()

    def load(self) -> bool:
        """Arm what is stored now; breakpoints armed already keep their hits within a run.

        Returns:
            False where it could not be read: nothing changes, and the next state tries again.
        """
        run, self.run = self._clock.run, None
        if run is not self._begun:
            self._begun = run
            for each in self.armed:
                each.begin_run()
        registration = self._recorder.registration
        if registration is None:
            return False
        ids = {"robot": registration.robot_id, "session": registration.session_id}
        rows = self._recorder.fetch(ARMED, {**ids, "most": MAX_BREAKPOINTS})
        if rows is None:
            return False
        if registration is not self._registration:
            self._registration = registration
            self._move([each for row in rows if (each := self._read(*row)) is not None])
        else:
            known = {each.id: each for each in self.armed}
            unstored = [each for each in self.armed if each.id is None]
            for each in unstored:
                each.id = self._store(*each.asks)
            stored = [known.get(row[0]) or self._read(*row) for row in rows]
            self.armed = [*unstored, *filter(None, stored)]
        self.run = run
        return True

    def _read_later(self) -> tuple[()]:
        """A new database was begun: read its breakpoints with the next state. Adds no entries."""
        self.run = None
        return ()

    def _move(self, stored: list[ArmedBreakpoint]) -> None:
        """Move to another database: what is armed and not there is stored in it."""
        there = {each.asks: each for each in stored}
        for each in self.armed:
            same = there.pop(each.asks, None)
            each.id = same.id if same is not None else self._store(*each.asks)
        self.armed += there.values()

    def _read(
        self, number: int, text: bytes, action: bytes, after_hits: int, *expected: bytes | None
    ) -> ArmedBreakpoint | None:
        from webots_mcp.signals.conditions import parse_condition
        from webots_mcp.signals.conditions.compiler import parse_expectation

        name, expects, during = (
            None if each is None else each.decode("utf-8", "replace") for each in expected
        )
        try:
            if expects is not None:
                found = _expected(number, parse_expectation(expects, during, name))
                found.unseen = frozenset()  # it may be of all robots of a project
                return found
            condition = parse_condition(text.decode("utf-8", "replace"))
        except InvalidConditionError as error:
            self._disable(number, str(error))
            return None
        asked = (condition, action.decode("utf-8", "replace"), int(after_hits))
        return _armed(number, *asked)

    def set(self, text: str, action: str, after_hits: int) -> int | None:
        """Arm one of the controller's code, for as long as its session lasts.

        Returns:
            Its id; None while the database cannot take it: it is armed all the same, and stored
            when it is set again, or the next run begins.

        Raises:
            InvalidInputError: The condition is not of the language, there is no such action, or
                there are too many.
        """
        from webots_mcp.signals.conditions import parse_condition

        condition = parse_condition(text)
        _require_action(action, after_hits)
        return self._arm(_armed(None, condition, action, after_hits))

    def expect(self, text: str, during: str | None, name: str | None) -> int | None:
        """Arm an expectation of the controller's code; as `set`.

        Raises:
            InvalidInputError: As of `set`.
        """
        from webots_mcp.signals.conditions.compiler import parse_expectation

        return self._arm(_expected(None, parse_expectation(text, during, name)))

    def _arm(self, new: ArmedBreakpoint) -> int | None:
        for each in self.armed:
            if each.asks == new.asks:
                if each.id is None:
                    each.id = self._store(*each.asks)
                return each.id
        if len(self.armed) >= MAX_BREAKPOINTS:
            raise InvalidInputError(f"{MAX_BREAKPOINTS} breakpoints are armed already: remove one")
        new.id = self._store(*new.asks)
        self.armed.append(new)
        return new.id

    def _store(self, text: str, action: str, after_hits: int, *expected: str | None) -> int | None:
        registration = self._recorder.registration
        if registration is None:
            return None
        ids = (registration.robot_id, registration.session_id)
        asked = (storable(text), action, after_hits, time.time(), OF_CONTROLLER)
        values = (*ids, *asked, *(each and storable(each) for each in expected))
        rows = self._recorder.fetch(SET, values)
        return int(rows[0][0]) if rows else None

    def describe(self) -> dict[str, object]:
        """The armed ones and those that are off, by id; and why a pause is not possible."""
        armed = [each.id for each in self.armed if each.id is not None]
        answer: dict[str, object] = {"armed": armed}
        if self._off:
            answer["off"] = {str(number): why for number, why in self._off.items()}
        if not self._simulation.supervisor:
            answer["cannot_pause"] = _CANNOT_PAUSE
        return answer

    # -- evaluating ----------------------------------------------------------------------------

    def ask_states(self) -> bool:
        """Whether the next state has to be evaluated; reads the stored ones if that is due."""
        if self.run is not self._clock.run:
            self.load()
        return bool(self.armed)

    def evaluate(self, state: Any) -> list[ArmedBreakpoint]:
        """The breakpoints whose condition begins to hold and whose action is due; usually none."""
        clock, hit, self.reaches = self._clock, list[ArmedBreakpoint](), False
        if self.run is not clock.run:
            self.load()
        now_s = clock.sim_time_s
        for each in tuple(self.armed):  # a copy: a failing one is removed meanwhile
            held, evaluator = each.holding, each.evaluator
            try:
                each.holding = holds = evaluator.holds(state, now_s)
                if holds and not held:
                    self._count(each, hit)
                if evaluator.reaches:
                    self.reaches = True
            except ConditionFailedError as error:
                self._disarm(each, str(error))
            except Exception as error:  # noqa: BLE001  (the user's objects may raise anything)
                self._disarm(each, f"condition {each.condition.text!r}: {describe(error)}")
            if each.unseen:
                self._report_unpublished(each, state)
        return hit

    def _count(self, each: ArmedBreakpoint, hit: list[ArmedBreakpoint]) -> None:
        each.hit_count += 1
        if each.id is not None:
            self._recorder.record("breakpoint hit", None, (each.id,))
        if each.hit_count >= each.after_hits:
            hit.append(each)

    def act(self, hit: list[ArmedBreakpoint], state: Any) -> None:
        """Record the hits, keep the seconds around them, and pause where one demands it."""
        for each in hit:
            if each.action in _KEEPING:
                self._keeper.keep(f"{each.called}: {each.condition.text}")
            if each.hit_count - each.after_hits < MOST_EVENTS:
                self._record_hit(each, state)
        pausing = [each for each in hit if each.action == "pause"]
        if pausing and self._simulation.supervisor:
            first = pausing[0]
            self._pause.begin(Cause(breakpoint_id=first.id, condition=first.condition.text))

    def _record_hit(self, each: ArmedBreakpoint, state: Any) -> None:
        data: dict[str, object] = {
            "breakpoint_id": each.id,
            "action": each.action,
            "hit_count": each.hit_count,
            "values": each.evaluator.values(state),
        }
        if each.action == "pause" and not self._simulation.supervisor:
            data["not_paused"] = _CANNOT_PAUSE
        if each.action == "keep" and not self._keeper.enabled:
            data["not_kept"] = self._keeper.why_not
        if each.expectation is None:
            self._journal.event("breakpoint", data, each.condition.text)
        else:
            data["condition"] = each.condition.text
            self._journal.event(VIOLATION, data, each.expectation.name)

    # -- failures ------------------------------------------------------------------------------

    def _disarm(self, each: ArmedBreakpoint, why: str) -> None:
        """Report a condition that fails and turn it off: it would fail on every state."""
        self.armed.remove(each)
        if each.id is not None:
            self._disable(each.id, why)
        self._journal.log("warning", "bridge", f"{each.called} is off: {why}")

    def _disable(self, number: int, why: str) -> None:
        text = storable(cut(why, _MOST_ERROR_CHARACTERS))
        self._off[number] = text
        self._recorder.record("breakpoint failed", None, (text, number))

    def _report_unpublished(self, each: ArmedBreakpoint, state: Any) -> None:
        """Warn once of signals that are never published: a name may be misspelt."""
        now_s = self._clock.sim_time_s
        if each.asked_since_s is None:
            each.asked_since_s = now_s
        values = each.evaluator.values(state)
        each.unseen = frozenset(name for name in each.unseen if values.get(name) is None)
        if each.unseen and now_s - each.asked_since_s >= _UNPUBLISHED_S:
            each.unseen = frozenset()
            known = each.evaluator.names_in(state)
            for text in each.condition.describe_unknown(known):
                self._journal.log("warning", "bridge", f"{each.called}: {text}")


def _armed(
    number: int | None, condition: Condition, action: str, after_hits: int
) -> ArmedBreakpoint:
    return ArmedBreakpoint(number, condition, condition.evaluator(plain), action, after_hits)


def _expected(number: int | None, expectation: Expectation) -> ArmedBreakpoint:
    condition, evaluator = expectation.violation, expectation.evaluator(plain)
    return ArmedBreakpoint(number, condition, evaluator, "keep", 1, expectation)


def _require_action(action: str, after_hits: object) -> None:
    if action not in BREAKPOINT_ACTIONS:
        names = " or ".join(map(repr, BREAKPOINT_ACTIONS))
        raise InvalidInputError(f"the action of a breakpoint must be {names}, not {action!r}")
    if isinstance(after_hits, bool) or not isinstance(after_hits, int) or after_hits < 1:
        raise InvalidInputError(f"after_hits must be a whole number of at least 1: {after_hits!r}")


# -- the goal of a run command ---------------------------------------------------------------------


class Goal(NamedTuple):
    """What a `run` command asks for.

    Attributes:
        until: Run until it holds; None for no condition.
        prune: End as `pruned` where it holds first: the outcome is decided; None for no condition.
        for_s: Run for so many seconds of simulation time; None for no limit.
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
    """The goal that the parameters of a command describe.

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
    from webots_mcp.signals.conditions.compiler import (
        parse_condition,  # only here: most controllers never need it
    )

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
        tolerance_s: Summed floating-point steps may fall short of a time by so much.

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
        """In `get_command()`: whether the goal is reached.

        The time is judged here only where this step's state is published already: else its
        condition, which may hold at the same step, would not be evaluated.
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
        """The result of the `run` command: how it ended, where, and how fast it ran.

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
        """Whether the run in which it is watched has begun: the awaited reset has happened."""
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
