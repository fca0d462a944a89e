"""Many similar events, reported as one: "10 dropouts to 0 m, the first at 3.2 s, ..."."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace

from webots_mcp.store.detection.event import Event
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
        kind = kind_named(event.kind)
        if kind.alike is None or (event.ongoing and kind.lasts and not kind.stored):
            grouped.append(event)
        else:
            sort = (event.run_id, event.kind, event.name, kind.alike.sort(event))
            alike.setdefault(sort, []).append(event)
    for some in alike.values():
        how, signal = kind_named(some[0].kind).alike, known.get(some[0].name or "")
        if how is None or len(some) <= how.most_single:
            grouped += some
        else:
            unit = f" {signal.unit}" if signal and signal.unit else ""
            grouped.append(how.as_one(sorted(some, key=lambda each: each.start_s), unit))
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
