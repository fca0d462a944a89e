"""What a kind of event is: how it is found, reported, counted and drawn, all in one place."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.detection.event import Event, EventOptions

if TYPE_CHECKING:
    from webots_mcp.store.detection.search import Search

MOST_TIMES: Final = 3  # of a group that are named
_SAME_LENGTH: Final = 0.05  # of the longest: so near each other they last equally long
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


class NotSearchableError(NothingRecordedError):
    """Nothing was recorded in which a kind could be looked for; the text says what is missing."""


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


@dataclass(frozen=True)
class EventKind:
    """A kind of event. One of these, entered in `registry.KINDS`, is all that a new kind takes.

    Attributes:
        name: Its name in questions and answers.
        means: What the name leaves open, in a few words; empty where it leaves nothing open.
        find: Finds the events in the segment of a search. It reports to the search what it could
            not search (`not_searched`) and what came nearest to an event (`note_nearest`), and
            raises `NotSearchableError` where it cannot search at all.
        stored: It was stored when it happened: nothing is judged, and a timeline shows it.
        usual: Whether it is looked for where no kinds are named.
        lasts: It has a begin and an end, which are followed out of the range.
        least_s: How long it has to last; a shorter range has to be widened by as much.
        around_s: How far around a range it has to be looked for, where it may be shorter than that.
        ends_within_s: How exactly its begin and end are known: nearer to the end of what was
            looked at it may go on there.
        of_numbers: The numeric signals are looked at.
        routine: It happens all the time; it is shown in the room that all other kinds leave.
        counted: Comparisons of runs count it.
        drawn: Its place among the rows below a plot, the least first; None if it has none there.
        alike: How similar ones are reported as one; None where each is reported by itself.
    """

    name: str
    means: str
    find: Callable[[Search], Iterable[Event]]
    stored: bool = False
    usual: Callable[[EventOptions], bool] = lambda options: True
    lasts: bool = False
    least_s: Callable[[EventOptions], float] = lambda options: 0.0
    around_s: Callable[[EventOptions], float] = lambda options: 0.0
    ends_within_s: Callable[[Event], float] = lambda event: 0.0
    of_numbers: bool = False
    routine: bool = False
    counted: bool = True
    drawn: int | None = None
    alike: Alike | None = None


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
