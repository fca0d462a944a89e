"""Many events that are alike, told as one: "10 dropouts to 0 m, the first at 3.2 s, ..."."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Final

from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.registry import kind_named
from webots_mcp.store.signals.registry import Signal

MOST_SINGLE: Final = 3  # of one signal and sort that are told one by one
MOST_TIMES: Final = 5  # of a group that are named


def grouped(events: Sequence[Event], known: dict[str, Signal]) -> list[Event]:
    """The same events; what the items of an array did at once, and many alike, is one of them.

    A group begins with its first event and ends with its last one; its details count them, name
    their first times and say what they are.
    """
    single = [event for event in events if not _may_be_grouped(event)]
    rest = _of_arrays([event for event in events if _may_be_grouped(event)])
    rest.sort(key=_sort)
    for _, same in groupby(rest, _sort):
        alike = sorted(same, key=lambda event: event.start_s)
        single += alike if len(alike) <= MOST_SINGLE else [_as_one(alike, known)]
    return single


def _may_be_grouped(event: Event) -> bool:
    return kind_named(event.kind).says_alike is not None


def _of_arrays(events: Iterable[Event]) -> list[Event]:
    """What several items of one array, or parts of one branch, did at once is told as one."""
    found: dict[tuple[object, ...], Event] = {}
    for event in events:
        branch = (event.name or "").rpartition(".")[0]
        own = None if branch and kind_named(event.kind).of_arrays else event.name
        key = (event.kind, event.run_id, branch, own, event.start_s, event.end_s)
        if key in found:
            found[key] = replace(found[key], name=f"{branch}.*", details={})
        else:
            found[key] = event
    return list(found.values())


def _sort(event: Event) -> tuple[object, ...]:
    """Events that may be told as one: a value that came back is not one that stayed."""
    is_back = event.end_s > event.start_s and not kind_named(event.kind).lasts
    return event.run_id, event.kind, event.name or "", is_back


def _as_one(alike: Sequence[Event], known: dict[str, Signal]) -> Event:
    first, last = alike[0], max(alike, key=lambda event: event.end_s)
    kind, signal = kind_named(first.kind), known.get(first.name or "")
    unit = f" {signal.unit}" if signal and signal.unit else ""
    what = kind.says_alike(alike, unit) if kind.says_alike else first.kind
    times_s = [round(event.start_s, 3) for event in alike]
    details: dict[str, object] = {
        "count": len(alike),
        "says": f"{len(alike)} {what}, the first at {times_s[0]:.6g} s, "
        f"the last at {times_s[-1]:.6g} s",
        "first_times_s": times_s[:MOST_TIMES],
    }
    if kind.lasts:
        details["lasted_s"] = round(sum(event.duration_s for event in alike), 3)
    return replace(first, end_s=last.end_s, ongoing=last.ongoing, details=details)
