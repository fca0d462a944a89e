"""Many events that are alike, told as one: "10 dropouts to 0 m, the first at 3.2 s, ..."."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Final

from webots_mcp.store.detection.event import Event, Kind
from webots_mcp.store.signals.registry import Signal

MOST_SINGLE: Final = 3  # of one signal and sort that are told one by one
MOST_TIMES: Final = 5  # of a group that are named
_GROUPED: Final = frozenset[Kind]({"jump", "silent", "flat"})
_OF_ARRAYS: Final = frozenset[Kind]({"silent", "flat"})
_ALIKE_SHARE: Final = 0.05  # of a dropout's size: so near each other they go to the same value


def grouped(events: Sequence[Event], known: dict[str, Signal]) -> list[Event]:
    """The same events; what the items of an array did at once, and many alike, is one of them.

    A group begins with its first event and ends with its last one; its details count them, name
    their first times and say what they are.
    """
    single = [event for event in events if event.kind not in _GROUPED]
    rest = _of_arrays([event for event in events if event.kind in _GROUPED])
    rest.sort(key=_sort)
    for _, same in groupby(rest, _sort):
        alike = sorted(same, key=lambda event: event.start_s)
        single += alike if len(alike) <= MOST_SINGLE else [_as_one(alike, known)]
    return single


def _of_arrays(events: Iterable[Event]) -> list[Event]:
    """What several items of one array, or parts of one branch, did at once is told as one."""
    found: dict[tuple[object, ...], Event] = {}
    for event in events:
        branch = (event.name or "").rpartition(".")[0]
        own = event.name if event.kind not in _OF_ARRAYS or not branch else None
        key = (event.kind, event.run_id, branch, own, event.start_s, event.end_s)
        if key in found:
            found[key] = replace(found[key], name=f"{branch}.*", details={})
        else:
            found[key] = event
    return list(found.values())


def _sort(event: Event) -> tuple[object, ...]:
    """Events that may be told as one: a value that came back is not one that stayed."""
    return event.run_id, event.kind, event.name or "", _is_back(event)


def _is_back(event: Event) -> bool:
    return event.kind == "jump" and event.end_s > event.start_s


def _as_one(alike: Sequence[Event], known: dict[str, Signal]) -> Event:
    first, last = alike[0], max(alike, key=lambda event: event.end_s)
    signal = known.get(first.name or "")
    unit = f" {signal.unit}" if signal and signal.unit else ""
    times_s = [round(event.start_s, 3) for event in alike]
    details: dict[str, object] = {
        "count": len(alike),
        "says": f"{len(alike)} {_what(alike, unit)}, the first at {times_s[0]:.6g} s, "
        f"the last at {times_s[-1]:.6g} s",
        "first_times_s": times_s[:MOST_TIMES],
    }
    if first.kind != "jump":
        details["lasted_s"] = round(sum(event.duration_s for event in alike), 3)
    return replace(first, end_s=last.end_s, ongoing=last.ongoing, details=details)


def _what(alike: Sequence[Event], unit: str) -> str:
    if alike[0].kind != "jump":
        return {"silent": "times without a value", "flat": "times flat"}[alike[0].kind]
    after = [float(event.details["after"]) for event in alike]
    if not _is_back(alike[0]):
        sizes = [abs(event.details["after"] - event.details["before"]) for event in alike]
        return f"steps of {min(sizes):.4g} to {max(sizes):.4g}{unit}"
    size = max(abs(event.details["after"] - event.details["before"]) for event in alike)
    if max(after) - min(after) > _ALIKE_SHARE * size:
        return f"spikes to values from {min(after):.4g} to {max(after):.4g}{unit}"
    name = "dropouts" if after[0] < alike[0].details["before"] else "spikes"
    return f"{name} to {sorted(after)[len(after) // 2]:.4g}{unit}"
