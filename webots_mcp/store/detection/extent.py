"""Finding the events of each kind in a range, each with its true begin and end."""

from __future__ import annotations

from typing import Final

from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import EventKind, NotSearchableError
from webots_mcp.store.detection.search import NO_TIME, Search
from webots_mcp.store.detection.verdict import Ledger
from webots_mcp.store.reading.ranges import Segment, just_after

FARTHER: Final = 8.0  # times as far is looked for the ends of what reaches out of a segment


def events_touching(search: Search) -> list[Event]:
    """The events that lie in the segment of a search, or reach into it.

    What has no begin or no end where was looked is followed out of it: at first as far as the
    shortest time that counts, then each time 8 times as far.
    """
    if search.deadline.passed:
        for kind in search.kinds:
            search.not_searched(kind.name, NO_TIME)
        return []
    segment = search.recorded
    kinds = [kind for kind in search.kinds if kind.lasts or not kind.stored]
    found = _found(search.of(search.segment, kinds=[e for e in search.kinds if e not in kinds]))
    if segment is None:
        for kind in kinds:
            why = f"run {search.segment.run_id} has no row in that range"
            search.not_searched(kind.name, why)
        return found
    reaches_s = ((each.least_s, each.around_s) for each in kinds)
    reach_s = max((of(search.options) for both in reaches_s for of in both), default=0.0)
    looked, cut, waiting = search.of(segment, asked=segment), list[Event](), list[Event]()
    while kinds and not (cut and search.deadline.passed):
        looked = looked.of(_around(search, segment, reach_s), kinds=kinds)
        touching = (e for e in _found(looked) if e.start_s < segment.end_s)
        events = [each for each in touching if each.end_s >= segment.start_s]
        if cut and search.deadline.passed:
            break  # some may be lacking
        by_name = {kind.name: kind for kind in kinds}
        cut = [each for each in events if _is_cut(each, by_name[each.kind], looked)]
        names = {each.kind for each in cut}
        kinds = [kind for kind in kinds if kind.name in names]
        found += [each for each in events if each.kind not in names]
        waiting = [each for each in events if each.kind in names]
        reach_s = FARTHER * max(reach_s, 1.0)
        looked.ledger = Ledger()  # what the longer one lacks is known
    for each in cut:
        why = f"the one at {each.start_s:.3f} s may last longer: time limit reached"
        search.not_searched(each.kind, why)
    return found + waiting


def _found(search: Search) -> list[Event]:
    """The events in the segment of a search, cut off at its ends."""
    return [event for kind in search.kinds for event in _found_of(kind, search)]


def _found_of(kind: EventKind, search: Search) -> list[Event]:
    try:
        found = list(kind.find(search))
    except NotSearchableError as error:
        search.not_searched(kind.name, str(error))
        return []
    if not found and kind.lasts and search.length_s < (least_s := kind.least_s(search.options)):
        run = f"run {search.segment.run_id} lasted only {search.length_s:.3g} s"
        search.not_searched(kind.name, f"{run}; this kind needs at least {least_s:g} s")
        return []
    search.ledger.searched.add(kind.name)
    if not kind.stored:
        search.not_searched(kind.name, *map(str, search.frame.unread))
    return found


def _is_cut(event: Event, kind: EventKind, looked: Search) -> bool:
    """Whether it reaches the first or last row that was looked at, and others follow there."""
    if not kind.lasts:
        return False
    segment = looked.segment
    within_s, (first_s, last_s) = kind.ends_within_s(event), looked.frame.bounds_s
    at_begin = segment.start_s > looked.began_s and event.start_s - within_s <= first_s
    return at_begin or (segment.end_s <= looked.ended_s and event.end_s + within_s >= last_s)


def _around(search: Search, segment: Segment, reach_s: float) -> Segment:
    """The segment with so much before and after it, as far as there is something."""
    start_s = max(search.began_s, segment.start_s - reach_s)
    end_s = min(just_after(search.ended_s), segment.end_s + reach_s)
    if (start_s, end_s) == (segment.start_s, segment.end_s):
        return segment
    return Segment(segment.run_id, start_s, end_s)
