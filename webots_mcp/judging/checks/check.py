"""What a check is, what it may read, and what it reports."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from webots_mcp.judging.detection.condition import every_call_of
from webots_mcp.judging.detection.event import Event, NotSearchableError
from webots_mcp.judging.detection.events import Found
from webots_mcp.judging.detection.search import Motion, RunNoise, Search
from webots_mcp.judging.verdicts import Coverage, Fault, JudgedInterval, Outcome, cause_of
from webots_mcp.signals.conditions.expectation import Expectation
from webots_mcp.signals.meaning import SOURCES, Meaning
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.runs import RunInfo

Examined = Fault | Coverage


class Finding(NamedTuple):
    """What a check came to, as it is reported; `verdicts.outcome_of` derives it.

    Attributes:
        evidence: The numbers that it rests on.
        since_s: Simulation time at which what is wrong began first.
        often: How many times it was so.
        more: The call that shows it in full.
        name: Of what was checked, where a check is about several things.
        signals: Those that were judged, or that a fault was found in.
    """

    outcome: Outcome
    evidence: str
    since_s: float | None = None
    often: int | None = None
    more: str = ""
    name: str = ""
    signals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Check:
    """A check. One of these, a line in `checks.CHECKS`, is all that a new check takes.

    Attributes:
        find: Returns the fault that was found, else what could be judged without finding one; its
            docstring says when it warns and when it fails. It may raise `NotSearchableError` where
            the run lacks what it is about.
        needs: What has to be recorded, for a person.
        kinds: Of events that it judges: where one could not be searched, the check is not made.
        of_values: It reads values itself: where some were not read, it does not pass.
    """

    name: str
    find: Callable[[RunUnderCheck], Examined | Iterable[Examined]]
    needs: str
    kinds: tuple[str, ...] = ()
    of_values: bool = False

    @property
    def means(self) -> str:
        """When it warns and when it fails, for a person."""
        return " ".join((inspect.getdoc(self.find) or "").split())


@dataclass
class RunUnderCheck:
    """A run, and what was found in it.

    Attributes:
        info: What `webots_list_runs` says of it.
        found: Events of the kinds that checks judge, each by itself.
        search: In the whole run: its signals, values and motion.
        expected: What was expected of it, be it for this question alone.
    """

    info: RunInfo
    robot_id: int
    found: Found
    search: Search
    expected: Sequence[Expectation] = ()

    @property
    def frame(self) -> Frame:
        """All rows of the run."""
        return self.search.whole

    @cached_property
    def every_call(self) -> Frame:
        """All rows of the run, in kept stretches each call."""
        return every_call_of(self.search)

    @property
    def motion(self) -> Motion:
        """The signals of its motion."""
        return self.search.motion

    @property
    def meanings(self) -> dict[str, Meaning]:
        """What each of its signals means."""
        return self.search.meanings

    @property
    def noise(self) -> RunNoise:
        """How noisy its signals are."""
        return self.search.noise

    def events(self, kind: str) -> list[Event]:
        """What was found of a kind, in order."""
        found = (each for each in self.found.events if each.kind == kind)
        return sorted(found, key=lambda each: each.start_s)

    def coverage_of(self, *kinds: str) -> Coverage:
        """Return what could be judged for kinds of events."""
        covered = Coverage()
        for kind in kinds:
            covered.add(self.found.verdicts.coverage.get(kind, Coverage()))
        return covered

    def covered(
        self,
        says: str,
        *,
        of: str | None = None,
        signals: Iterable[str] = (),
        judged: str = "",
        limit: str = "",
        subject: str = "",
        lasts_s: float | None = None,
    ) -> Coverage:
        """Return what a check judged without finding a fault.

        Args:
            says: What held.
            of: The kind of event whose coverage it is; None: all rows of the run.
            signals: Those that were judged, where it is of no kind.
            judged: What was judged, in words; empty for the number of signals.
            limit: What would have been a fault.
            subject: Which one, of a check about several things.
            lasts_s: How much of the run was judged; None for all of it.
        """
        covered = Coverage(says=says, judged=judged, limit=limit, subject=subject)
        if of is not None:
            covered.add(self.coverage_of(of))
            return covered
        covered.signals |= dict.fromkeys(signals)
        start_s, end_s = self.search.bounds or (0.0, 0.0)
        end_s = end_s if lasts_s is None else start_s + lasts_s
        covered.intervals.append(JudgedInterval(self.info.run_id, start_s, end_s))
        return covered

    def firmest(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return those signals whose meaning is known from the strongest source of all of them."""
        there = [name for name in dict.fromkeys(names) if name in self.meanings]
        places = {name: SOURCES.index(self.meanings[name].source) for name in there}
        return tuple(name for name in there if places[name] == min(places.values()))

    def more(self, *kinds: str) -> str:
        """The call that shows events of these kinds."""
        return f"webots_find_events(kinds={list(kinds)}, run_id={self.info.run_id})"

    def shows(self, *names: str) -> str:
        """The call that shows signals."""
        return f"webots_query_history(signals={list(names)}, run_id={self.info.run_id})"

    def require(self, check: Check) -> None:
        """Make sure that a check can be made.

        Raises:
            NotSearchableError: Why it cannot.
        """
        for kind in check.kinds:
            if why := self.found.verdicts.why_unsearched(kind):
                undecided = self.coverage_of(kind).reasons_for("undecided")
                raise NotSearchableError(why, "undecided" if undecided else None)
            if not self.found.verdicts.knows(kind):
                raise NotSearchableError(check.needs)
        if check.of_values and not len(self.frame):
            none = f"run {self.info.run_id} has no state row: call bridge.publish"
            raise NotSearchableError("; ".join(map(str, self.frame.unread)) or none)

    def unread(self, check: Check) -> str:
        """What of the run a check did not see; empty if nothing."""
        said = self.found.verdicts.reasons
        reasons = [
            why for kind in check.kinds for why in said.get(kind, ()) if cause_of(why) == "unread"
        ]
        if check.of_values:
            frames = (self.frame, self.__dict__.get("every_call", self.frame))
            reasons += [str(part) for frame in frames for part in frame.unread]
            if self.search.deadline.passed and not any(
                cause_of(why) == "unread" for why in reasons
            ):
                reasons.append("time limit reached")
        return "; ".join(dict.fromkeys(reasons))


def total_s(events: Iterable[Event]) -> float:
    """How long they lasted together."""
    return sum(each.duration_s for each in events)


def times(count: int) -> str:
    """How often, in words."""
    return "once" if count == 1 else f"{count} times"
