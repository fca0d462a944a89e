"""`jump`: a value, or the position, changed at once by much more than it usually does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.naming import metres_in
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.jump_search import (
    Jump,
    are_usual,
    find_jumps,
    find_leaps,
)
from webots_mcp.store.detection.kind import Alike, EventKind
from webots_mcp.store.detection.search import Search
from webots_mcp.store.signals.registry import Signal

REACH_S: Final = 2.0  # before and after a range: whether a value comes back shows there
_ALIKE_SHARE: Final = 0.05  # of a dropout's size: so near each other they go to the same value


def jump_events(search: Search) -> Iterator[Event]:
    """Dropouts and spikes that come back, steps that stay, and leaps of the position."""
    position = search.motion.position or ()
    numbers = search.numbers if position else search.required_quantities()
    search.note_too_large("jump")
    signals = [
        signal
        for signal in numbers
        if signal.kind != "angle" and not signal.is_index and signal not in position
    ]
    for index, signal in enumerate(signals):
        if search.is_over("jump", signals[index:]):
            break
        jumps = find_jumps(search.frame, signal.name, search.options.jump_min_score)
        if jumps and are_usual(jumps, int(search.frame.zones(signal.name).value_count.sum())):
            many = f"not in {signal.name}: large steps are normal for it ({len(jumps)} found)"
            search.not_searched("jump", many)
            continue
        yield from (_jump(search, signal, jump) for jump in jumps)
    yield from _leaps(search)


def _jump(search: Search, signal: Signal, jump: Jump) -> Event:
    end_s = jump.sim_time_s if jump.back_s is None else jump.back_s
    details = {"before": jump.before, "after": jump.after}
    details |= {} if jump.back is None else {"back": jump.back}
    return search.event("jump", jump.sim_time_s, end_s, signal.name, **details)


def _leaps(search: Search) -> Iterator[Event]:
    """The position changed by more than driving explains."""
    if (position := search.motion.position) is None:
        return
    x, y = (each.name for each in position)
    metres = metres_in(x), metres_in(y)
    for time_s, length_m in find_leaps(search.frame, x, y, metres, search.options.jump_m):
        yield search.event("jump", time_s, time_s, "position", distance_m=length_m)


def _is_back(event: Event) -> bool:
    """A value that came back is not one that stayed."""
    return event.end_s > event.start_s


def _alike(events: Sequence[Event], unit: str) -> str:
    """Dropouts, spikes or steps, and to where."""
    if "distance_m" in events[0].details:
        lengths = [event.details["distance_m"] for event in events]
        return f"position jumps of {min(lengths):.3g} to {max(lengths):.3g} m"
    after = [float(event.details["after"]) for event in events]
    sizes = [abs(event.details["after"] - event.details["before"]) for event in events]
    if events[0].end_s == events[0].start_s:
        return f"steps of {min(sizes):.4g} to {max(sizes):.4g}{unit}"
    if max(after) - min(after) > _ALIKE_SHARE * max(sizes):
        return f"spikes to values from {min(after):.4g} to {max(after):.4g}{unit}"
    name = "dropouts" if after[0] < events[0].details["before"] else "spikes"
    return f"{name} to {sorted(after)[len(after) // 2]:.4g}{unit}"


JUMP: Final = EventKind(
    "jump",
    "step, spike or dropout",
    jump_events,
    least_s=lambda options: REACH_S,
    of_numbers=True,
    drawn=1,
    alike=Alike(_alike, sort=_is_back),
    effort=2,
)
