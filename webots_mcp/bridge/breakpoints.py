"""Breakpoints: conditions that are evaluated on every published state, recorded or not."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from webots_mcp.bridge.controller_variables import ControllerVariables
from webots_mcp.bridge.encoding import plain
from webots_mcp.bridge.error_report import cut, describe, storable
from webots_mcp.bridge.full_rate import FullRateRecorder
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration
from webots_mcp.bridge.simulation import Clock, CurrentRun, Simulation
from webots_mcp.contract import BREAKPOINT_ACTIONS, MAX_BREAKPOINTS
from webots_mcp.database.pause_states import Cause
from webots_mcp.database.stored_breakpoints import ARMED, OF_CONTROLLER, SET, VIOLATION
from webots_mcp.errors import (
    ConditionFailedError,
    InvalidConditionError,
    InvalidInputError,
)

if TYPE_CHECKING:
    from webots_mcp.signals.conditions import Condition, Evaluator
    from webots_mcp.signals.conditions.expectation import Expectation, Violated

MOST_EVENTS: Final = 1000  # of one breakpoint in one run, lest a flickering condition fill the disk


# Condition, action, hits; of an expectation its name, what is expected, and during what.
Asks = tuple[str, str, int, "str | None", "str | None", "str | None"]
_KEEPING: Final = ("pause", "keep")  # after a pause, a person wants to see what led to it
_CANNOT_PAUSE: Final = (
    "the robot is not a Supervisor: set its field `supervisor` to TRUE in the world file"
)


class BreakpointErrors(NamedTuple):
    """When and how errors of breakpoints are reported.

    Attributes:
        unpublished_s: Simulation time after which an unpublished signal is reported.
        error_characters: Length at which an error is cut.
    """

    unpublished_s: float = 1.0
    error_characters: int = 1000


_ERRORS: Final = BreakpointErrors()


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
        full_rate: FullRateRecorder,
        variables: ControllerVariables,
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._pause = pause
        self._full_rate = full_rate
        self._variables = variables
        # The run in which the stored breakpoints were read; None: they have to be read again.
        self.run: CurrentRun | None = None
        self.reaches = False  # the newest state meets an expectation that has a time limit
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
        if self.armed:
            self._variables.prepare()
        return True

    def _read_later(self) -> tuple[()]:
        """Read the breakpoints of a new database with the next state; add no entries to it."""
        self.run = None
        return ()

    def _move(self, stored: list[ArmedBreakpoint]) -> None:
        """Store in another database what is armed here and missing there."""
        there = {each.asks: each for each in stored}
        for each in self.armed:
            same = there.pop(each.asks, None)
            each.id = same.id if same is not None else self._store(*each.asks)
        self.armed += there.values()

    def _read(
        self, number: int, text: bytes, action: bytes, after_hits: int, *expected: bytes | None
    ) -> ArmedBreakpoint | None:
        from webots_mcp.signals.conditions import parse_condition
        from webots_mcp.signals.conditions.expectation import parse_expectation

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
        """Arm a breakpoint of the controller's code, for as long as its session lasts.

        Returns:
            Its id; None while the database cannot be written. It is armed all the same, and stored
            when it is set again or the next run begins.

        Raises:
            InvalidInputError: If the condition or the action is invalid, or too many are armed.
        """
        from webots_mcp.signals.conditions import parse_condition

        condition = parse_condition(text)
        _require_action(action, after_hits)
        return self._arm(_armed(None, condition, action, after_hits))

    def expect(self, text: str, during: str | None, name: str | None) -> int | None:
        """Arm an expectation of the controller's code; it is stored like a breakpoint.

        Raises:
            InvalidInputError: If a condition or the name is invalid, or too many are armed.
        """
        from webots_mcp.signals.conditions.expectation import parse_expectation

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
        self._variables.prepare()
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
        """Describe which are armed or off, by id, and why a pause is not possible."""
        armed = [each.id for each in self.armed if each.id is not None]
        answer: dict[str, object] = {"armed": armed}
        if self._off:
            answer["off"] = {str(number): why for number, why in self._off.items()}
        if not self._simulation.supervisor:
            answer["cannot_pause"] = _CANNOT_PAUSE
        return answer

    # -- evaluating ----------------------------------------------------------------------------

    def must_evaluate(self) -> bool:
        """Read the stored breakpoints if due; return whether the next state must be evaluated."""
        if self.run is not self._clock.run:
            self.load()
        return bool(self.armed)

    def evaluate(self, state: Any) -> list[ArmedBreakpoint]:
        """Evaluate all conditions; return the breakpoints whose action is due, usually none."""
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
                self._full_rate.keep(f"{each.called}: {each.condition.text}")
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
        if each.action == "keep" and not self._full_rate.enabled:
            data["not_kept"] = self._full_rate.why_not
        if each.expectation is None:
            self._journal.event("breakpoint", data, each.condition.text)
            self._variables.record("breakpoint", each.condition.text, each)
        else:
            data["condition"] = each.condition.text
            self._journal.event(VIOLATION, data, each.expectation.name)
            self._variables.record(VIOLATION, each.expectation.name, each)

    # -- failures ------------------------------------------------------------------------------

    def _disarm(self, each: ArmedBreakpoint, why: str) -> None:
        """Report a condition that fails and turn it off: it would fail on every state."""
        self.armed.remove(each)
        if each.id is not None:
            self._disable(each.id, why)
        self._journal.log("warning", "bridge", f"{each.called} is off: {why}")

    def _disable(self, number: int, why: str) -> None:
        text = storable(cut(why, _ERRORS.error_characters))
        self._off[number] = text
        self._recorder.record("breakpoint failed", None, (text, number))

    def _report_unpublished(self, each: ArmedBreakpoint, state: Any) -> None:
        """Warn once of signals that are never published: a name may be misspelt."""
        now_s = self._clock.sim_time_s
        if each.asked_since_s is None:
            each.asked_since_s = now_s
        values = each.evaluator.values(state)
        each.unseen = frozenset(name for name in each.unseen if values.get(name) is None)
        if each.unseen and now_s - each.asked_since_s >= _ERRORS.unpublished_s:
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
