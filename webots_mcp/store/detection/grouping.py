"""Many similar events, reported as one: "10 dropouts to 0 m, the first at 3.2 s, ..."."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace
from typing import Any

from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, told_together
from webots_mcp.store.detection.registry import kind_named
from webots_mcp.store.signals.registry import Signal


def grouped(events: Sequence[Event], known: dict[str, Signal]) -> list[Event]:
    """The same events; what the items of an array did at once, and many alike, is one of them.

    A group begins with its first event and ends with its last one. Its details say what they are,
    when, and what they have in common. An event that is still going on is reported by itself.
    """
    grouped: list[Event] = []
    alike: dict[Hashable, list[Event]] = {}
    for event in _of_arrays(events):
        how = kind_named(event.kind).alike
        if how is None or (event.ongoing and kind_named(event.kind).lasts):
            grouped.append(event)
        else:
            sort = (event.run_id, event.kind, event.name, how.sort(event))
            alike.setdefault(sort, []).append(event)
    for some in alike.values():
        how = kind_named(some[0].kind).alike
        if how is None or len(some) <= how.most_single:
            grouped += some
        else:
            grouped.append(_as_one(sorted(some, key=lambda each: each.start_s), how, known))
    return grouped


def _of_arrays(events: Iterable[Event]) -> list[Event]:
    """What several items of one array, or parts of one branch, did at once is reported as one.

    Its details are those that all of them have.
    """
    found: dict[tuple[object, ...], Event] = {}
    alone: list[Event] = []
    for event in events:
        how, branch = kind_named(event.kind).alike, (event.name or "").rpartition(".")[0]
        if how is None or not (how.of_arrays and branch):
            alone.append(event)
            continue
        key = (event.kind, event.run_id, branch, event.start_s, event.end_s)
        if other := found.get(key):
            same = dict(each for each in event.details.items() if each in other.details.items())
            event = replace(event, name=f"{branch}.*", details=same)
        found[key] = event
    return [*alone, *found.values()]


def _as_one(alike: Sequence[Event], how: Alike, known: dict[str, Signal]) -> Event:
    first, last = alike[0], max(alike, key=lambda event: event.end_s)
    signal = known.get(first.name or "")
    what = how.says(alike, f" {signal.unit}" if signal and signal.unit else "")
    starts_s, lengths_s = zip(*((each.start_s, each.duration_s) for each in alike), strict=True)
    details = _in_common([event.details for event in alike]) | how.adds(alike)
    details |= told_together(what, starts_s, lengths_s)
    ends = {"end_s": last.end_s, "ongoing": last.ongoing}
    return replace(first, **ends, details=details, count=len(alike))


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
