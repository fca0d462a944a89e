"""An event, and how similar events of a kind are reported as one."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, Final

from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.verdicts import Cause
from webots_mcp.signals.naming import Value

MOST_TIMES: Final = 3  # of a group that are named
_SAME_LENGTH: Final = 0.05  # of the longest: so near each other they last equally long
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        kind: The name of one of `events.KINDS`.
        end_s: Equal to the start for what has no duration; of a change when the value ended.
        ongoing: It lasts up to the newest row of a run that goes on; of a command, it is not
            finished.
        name: The signal, the action, the level or the device that it is about.
        details: What there is to say about it, by kind.
        around: Values of a few signals when it began.
        count: How many alike events it stands for; it begins with the first, ends with the last.
    """

    kind: str
    run_id: int
    start_s: float
    end_s: float
    wall_time_s: float
    name: str | None = None
    details: dict[str, Any] = field(default_factory=dict[str, Any])
    ongoing: bool = False
    around: dict[str, Value] = field(default_factory=dict[str, Value])
    count: int = 1

    @property
    def duration_s(self) -> float:
        """How long it lasted, in simulated seconds."""
        return self.end_s - self.start_s


class NotSearchableError(NothingRecordedError):
    """Nothing was recorded in which a kind could be looked for; the text says what is missing.

    Attributes:
        cause: None where the text tells it.
    """

    def __init__(self, reason: str, cause: Cause | None = None) -> None:
        super().__init__(reason)
        self.cause: Cause | None = cause


class NotAskedError(Exception):
    """A kind that was not named has nothing to look for, and nothing is said of it."""


def but_for_numbers(text: object) -> str:
    """What texts that differ in their numbers only have in common."""
    return _NUMBER.sub("#", str(text))


@dataclass(frozen=True)
class Alike:
    """How similar events of a kind are reported as one.

    Attributes:
        says: What they are, in the plural, given them in order and the unit of their signal.
        sort: What they share besides the run and the signal.
        adds: More of their details than what all of them have in common.
        most_single: So many of a sort are reported one by one.
        of_arrays: What several items of one array did at once is one event.
    """

    says: Callable[[Sequence[Event], str], str]
    sort: Callable[[Event], Hashable] = lambda event: None
    adds: Callable[[Sequence[Event]], dict[str, Any]] = lambda events: {}
    most_single: int = 3
    of_arrays: bool = False

    def as_one(self, alike: Sequence[Event], unit: str = "") -> Event:
        """Several of one sort, in order; what they are, when, and what they have in common."""
        first, last = alike[0], max(alike, key=lambda event: event.end_s)
        times_s = [round(each.start_s, 3) for each in alike]
        span = f"the first at {times_s[0]:.6g} s, the last at {times_s[-1]:.6g} s"
        lasted = _lengths([each.duration_s for each in alike])
        says = f"{len(alike)} {self.says(alike, unit)}, {span}{lasted}"
        details = _in_common([event.details for event in alike]) | self.adds(alike)
        details |= {"says": says, "first_times_s": times_s[:MOST_TIMES]}
        ends = {"end_s": last.end_s, "ongoing": last.ongoing}
        return replace(first, **ends, details=details, count=len(alike))


def _lengths(lengths_s: Sequence[float]) -> str:
    """How long they lasted, where they did."""
    least_s, most_s, middle_s = min(lengths_s), max(lengths_s), median(lengths_s)
    if not most_s:
        return ""
    if most_s - least_s <= _SAME_LENGTH * most_s:
        return f", each {middle_s:.3g} s long"
    total = f"{sum(lengths_s):.4g} s in total"
    return f", {least_s:.3g} to {most_s:.3g} s long (median {middle_s:.3g} s), {total}"


def _in_common(all_details: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the details of all of them are, or lie between."""
    first, *others = all_details
    names = [name for name in first if all(name in other for other in others)]
    shared = {name: _shared([details[name] for details in all_details]) for name in names}
    return {name: value for name, value in shared.items() if value is not None}


def _shared(values: Sequence[Any]) -> Any:
    """The one value; of numbers the least and the greatest; of texts the clauses that all have."""
    if all(value == values[0] for value in values):
        return values[0]
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return f"{min(values):.4g} to {max(values):.4g}"
    if all(isinstance(value, dict) for value in values):
        return _in_common(values) or None
    if all(isinstance(value, str) for value in values):
        clauses: list[list[str]] = [value.split("; ") for value in values]
        return "; ".join(e for e in clauses[0] if all(e in each for each in clauses)) or None
    return None


def count_by_kind(events: Iterable[Event]) -> Counter[str]:
    """How many there are of each kind, where one may stand for many that are alike."""
    counts = Counter[str]()
    for event in events:
        counts[event.kind] += event.count
    return counts
