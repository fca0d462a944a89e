"""What a kind of event is: how it is found, reported, counted and drawn, all in one place."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.detection.event import Event, EventOptions

if TYPE_CHECKING:
    from webots_mcp.store.detection.search import Search
    from webots_mcp.store.signals.registry import Signal

_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


class NotSearchableError(NothingRecordedError):
    """Nothing was recorded in which a kind could be looked for; the text says what is missing."""


def _no_time(options: EventOptions) -> float:
    return 0.0


def _to_the_row(event: Event) -> float:
    return 0.0


def _nothing(search: Search) -> Sequence[Signal]:
    return ()


def _always(options: EventOptions) -> bool:
    return True


def only_if_named(options: EventOptions) -> bool:
    """For a kind that is no news, and of which there may be thousands."""
    return False


def but_for_numbers(text: object) -> str:
    """What texts that differ in their numbers only have in common."""
    return _NUMBER.sub("#", str(text))


def _as_others(event: Event) -> Hashable:
    return None


def _nothing_more(events: Sequence[Event]) -> dict[str, Any]:
    return {}


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
    sort: Callable[[Event], Hashable] = _as_others
    adds: Callable[[Sequence[Event]], dict[str, Any]] = _nothing_more
    most_single: int = 3
    of_arrays: bool = False


@dataclass(frozen=True)
class EventKind:
    """A kind of event. One of these, entered in `registry.KINDS`, is all that a new kind takes.

    Attributes:
        name: Its name in questions and answers.
        means: What the name leaves open, in a few words; empty where it leaves nothing open.
        find: Finds the events in the segment of a search. It reports to the search what it could
            not search (`not_searched`) and what came nearest to an event (`came_near`), and raises
            `NotSearchableError` where it cannot search at all.
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
        reads_through: Signals of which it reads all rows, also of a long segment.
        of_frame: It reads nothing but the frame of a search.
        effort: Its rank by what it costs to look for: the least is searched first. Kinds of one
            rank find things together, and share their part of the time.
        of_frame: It reads the frame of a search alone.
    """

    name: str
    means: str
    find: Callable[[Search], Iterable[Event]]
    stored: bool = False
    usual: Callable[[EventOptions], bool] = _always
    lasts: bool = False
    least_s: Callable[[EventOptions], float] = _no_time
    around_s: Callable[[EventOptions], float] = _no_time
    ends_within_s: Callable[[Event], float] = _to_the_row
    of_numbers: bool = False
    routine: bool = False
    counted: bool = True
    drawn: int | None = None
    alike: Alike | None = None
    reads_through: Callable[[Search], Sequence[Signal]] = _nothing
    of_frame: bool = False
    effort: int = 0
    of_frame: bool = False
