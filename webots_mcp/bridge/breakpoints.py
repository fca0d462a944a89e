"""Breakpoints: conditions that are evaluated on every published state, recorded or not."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.encoding import plain
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.keeping import Keeper
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration
from webots_mcp.bridge.run import Run
from webots_mcp.bridge.text import cut, describe, storable
from webots_mcp.bridge.webots_api import Simulation
from webots_mcp.contract import BREAKPOINT_ACTIONS, MAX_BREAKPOINTS
from webots_mcp.errors import ConditionFailedError, InvalidConditionError, InvalidInputError
from webots_mcp.pauses import ARMED, OF_CONTROLLER, SET, Cause

if TYPE_CHECKING:
    from webots_mcp.conditions import Condition, Evaluator

MOST_EVENTS: Final = 1000  # of one breakpoint in one run: a flickering condition fills no database
_UNPUBLISHED_S: Final = 1.0  # a signal that was not published for so long is reported
_MOST_ERROR_CHARACTERS: Final = 1000


class Breakpoint:
    """An armed breakpoint.

    Attributes:
        id: None where the database could not take it yet.
        of_code: The controller's own code has set it.
        hit_count: How often its condition began to hold in this run.
        holding: Its condition held in the previous state.
        asked_since_s: The simulation time of the first state that it was evaluated on in this run.
        unseen: Its signals that no state has contained yet.
    """

    def __init__(
        self,
        id: int | None,  # noqa: A002
        condition: Condition,
        evaluator: Evaluator,
        action: str,
        after_hits: int,
        *,
        of_code: bool,
    ) -> None:
        self.id = id
        self.of_code = of_code
        self.condition = condition
        self.evaluator = evaluator
        self.action = action
        self.after_hits = after_hits
        self.hit_count = 0
        self.holding = False
        self.asked_since_s: float | None = None
        self.unseen = frozenset(condition.signals)

    @property
    def asks(self) -> tuple[str, str, int]:
        """Its condition, action and hits: what identifies it in another database."""
        return self.condition.text, self.action, self.after_hits

    def begin_run(self) -> None:
        """Arm it again for a new run."""
        self.evaluator.forget()
        self.hit_count, self.holding, self.asked_since_s = 0, False, None

    def begins(self, state: Any, sim_time_s: float) -> bool:
        """Evaluate the condition on a state; True if it begins to hold with it.

        Raises:
            ConditionFailedError: See `Evaluator.holds`.
        """
        held, self.holding = self.holding, self.evaluator.holds(state, sim_time_s)
        return self.holding and not held


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
        self.run: Run | None = None  # in which the stored ones were read; None: to be read again
        self._begun = clock.run
        self._registration: Registration | None = None  # in the database that was read last
        self._off: dict[int, str] = {}
        self.armed: list[Breakpoint] = []
        recorder.session.new_database_entries.append(self._read_later)

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
        registration = self._recorder.session.registration
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
            stored = [known.get(row[0]) or self._read(*row) for row in rows]
            self.armed = [*unstored, *filter(None, stored)]
        self.run = run
        return True

    def _read_later(self) -> tuple[()]:
        """A new database was begun: read its breakpoints with the next state. Adds no entries."""
        self.run = None
        return ()

    def _move(self, stored: list[Breakpoint]) -> None:
        """Move to another database: those of the code are stored there, others are reported off."""
        for each in self.armed:
            same = next((other for other in stored if other.asks == each.asks), None)
            if same is not None:
                each.id = same.id
                stored[stored.index(same)] = each
            elif each.of_code:
                each.id = self._store(*each.asks)
                stored.append(each)
            else:
                why = "the database that it was set in is lost; set it again"
                text = f"breakpoint {each.id} ({each.condition.text}) is off: {why}"
                self._journal.log("warning", "bridge", text)
        self.armed = stored

    def _read(self, number: int, text: bytes, action: bytes, after_hits: int) -> Breakpoint | None:
        from webots_mcp.conditions import parse_condition

        try:
            condition = parse_condition(text.decode("utf-8", "replace"))
        except InvalidConditionError as error:
            self._disable(number, str(error))
            return None
        asked = (condition, action.decode("utf-8", "replace"), int(after_hits))
        return _armed(number, *asked, of_code=False)

    def set(self, text: str, action: str, after_hits: int) -> int | None:
        """Arm one of the controller's code, for as long as its session lasts.

        Returns:
            Its id; None while the database cannot take it: it is armed all the same.

        Raises:
            InvalidInputError: The condition is not of the language, there is no such action, or
                there are too many.
        """
        from webots_mcp.conditions import parse_condition

        condition = parse_condition(text)
        _require_action(action, after_hits)
        for each in self.armed:
            if each.asks == (condition.text, action, after_hits):
                return each.id
        if len(self.armed) >= MAX_BREAKPOINTS:
            raise InvalidInputError(f"{MAX_BREAKPOINTS} breakpoints are armed already: remove one")
        number = self._store(condition.text, action, after_hits)
        self.armed.append(_armed(number, condition, action, after_hits, of_code=True))
        return number

    def _store(self, text: str, action: str, after_hits: int) -> int | None:
        registration = self._recorder.session.registration
        if registration is None:
            return None
        ids = (registration.robot_id, registration.session_id)
        values = (*ids, storable(text), action, after_hits, time.time(), OF_CONTROLLER)
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

    def look(self, state: Any) -> list[Breakpoint]:
        """The breakpoints whose condition begins to hold and whose action is due; usually none."""
        clock, hit = self._clock, list[Breakpoint]()
        if self.run is not clock.run:
            self.load()
        for each in tuple(self.armed):  # a copy: a failing one is removed meanwhile
            try:
                if each.begins(state, clock.sim_time_s):
                    self._count(each, hit)
            except ConditionFailedError as error:
                self._disarm(each, str(error))
            except Exception as error:  # noqa: BLE001  (the user's objects may raise anything)
                self._disarm(each, f"condition {each.condition.text!r}: {describe(error)}")
            if each.unseen:
                self._look_for_signals(each, state)
        return hit

    def _count(self, each: Breakpoint, hit: list[Breakpoint]) -> None:
        each.hit_count += 1
        if each.id is not None:
            self._recorder.record("breakpoint hit", None, (each.id,))
        if each.hit_count >= each.after_hits:
            hit.append(each)

    def act(self, hit: list[Breakpoint], state: Any) -> None:
        """Record the hits, keep the seconds around them, and pause where one demands it."""
        for each in hit:
            if each.action in _KEEPING:
                self._keeper.keep(f"breakpoint {each.id or ''}: {each.condition.text}")
            if each.hit_count - each.after_hits < MOST_EVENTS:
                self._record_hit(each, state)
        pausing = [each for each in hit if each.action == "pause"]
        if pausing and self._simulation.supervisor:
            first = pausing[0]
            self._pause.begin(Cause(breakpoint_id=first.id, condition=first.condition.text))

    def _record_hit(self, each: Breakpoint, state: Any) -> None:
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
        self._journal.event("breakpoint", data, each.condition.text)

    # -- failures ------------------------------------------------------------------------------

    def _disarm(self, each: Breakpoint, why: str) -> None:
        """Report a condition that fails and turn it off: it would fail on every state."""
        self.armed.remove(each)
        if each.id is not None:
            self._disable(each.id, why)
        self._journal.log("warning", "bridge", f"breakpoint {each.id or ''} is off: {why}")

    def _disable(self, number: int, why: str) -> None:
        text = storable(cut(why, _MOST_ERROR_CHARACTERS))
        self._off[number] = text
        self._recorder.record("breakpoint failed", None, (text, number))

    def _look_for_signals(self, each: Breakpoint, state: Any) -> None:
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
                self._journal.log("warning", "bridge", f"breakpoint {each.id or ''}: {text}")


_KEEPING: Final = ("pause", "keep")  # a pause is for looking at what led to it
_CANNOT_PAUSE: Final = (
    "the robot is not a Supervisor: set its field `supervisor` to TRUE in the world file"
)


def _armed(
    number: int | None, condition: Condition, action: str, after_hits: int, *, of_code: bool
) -> Breakpoint:
    evaluator = condition.evaluator(plain)
    return Breakpoint(number, condition, evaluator, action, after_hits, of_code=of_code)


def _require_action(action: str, after_hits: object) -> None:
    if action not in BREAKPOINT_ACTIONS:
        names = " or ".join(map(repr, BREAKPOINT_ACTIONS))
        raise InvalidInputError(f"the action of a breakpoint must be {names}, not {action!r}")
    if isinstance(after_hits, bool) or not isinstance(after_hits, int) or after_hits < 1:
        raise InvalidInputError(f"after_hits must be a whole number of at least 1: {after_hits!r}")
