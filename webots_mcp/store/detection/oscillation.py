"""`oscillation`: a signal that a robot moves with went to and fro regularly."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from webots_mcp.naming import listed
from webots_mcp.store.analysis.features import unwrap
from webots_mcp.store.analysis.swings import Swing, find_swings, joined_swings
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import EventKind
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.rows import Numbers
from webots_mcp.store.signals.registry import Signal

_MOST_NAMED: Final = 5
# What a robot swings with; sensors swing by nature while it drives.
_SWINGING: Final = re.compile(
    r"(^|[._])(heading|yaw|theta|bearing|steer\w*|wheels?|motors?|speed|velocity|pose|position"
    r"|left|right|cmd|command\w*|error)([._]|$)",
    re.IGNORECASE,
)


def oscillation_events(search: Search) -> Iterator[Event]:
    """Of heading, wheels, speed, position and the like, and of what is asked for."""
    signals = _swinging(search)
    if left := [each.name for each in search.required_numbers() if each not in signals]:
        search.not_searched(
            "oscillation",
            f"not in {len(left)} of {len(search.numbers)} signals, whose names are not of what a "
            f"robot swings with: name them in signals ({listed(left, _MOST_NAMED)})",
        )
    found: dict[str, list[Swing]] = {}
    at_rest = [0.0] * len(signals)  # without any step there is no swing
    for numbers in search.view.stretches(signals, 1.0, at_rest):
        for index, signal in enumerate(signals):
            if search.is_over("oscillation", signals[index:]):
                break
            found.setdefault(signal.name, []).extend(_swings(search, signal, numbers))
    for name, swings in found.items():
        for swing in joined_swings(swings):
            details = {"period_s": swing.period_s, "amplitude": swing.amplitude}
            ends = (swing.start_s, swing.end_s)
            yield search.event("oscillation", *ends, name, turns=swing.half_swings, **details)


def _swinging(search: Search) -> list[Signal]:
    asked = search.options.signals != EventOptions.signals
    return [each for each in search.numbers if asked or _SWINGING.search(each.name)]


def _swings(search: Search, signal: Signal, numbers: Numbers) -> list[Swing]:
    times, values = numbers.of(signal.name)
    return find_swings(
        times,
        unwrap(values, signal.turn) if signal.turn else values,
        least_half_swings=search.options.oscillation_turns,
        longest_period_s=search.options.oscillation_period_s,
    )


def _least_s(options: EventOptions) -> float:
    return options.oscillation_turns * options.oscillation_period_s / 2


OSCILLATION: Final = EventKind(
    "oscillation",
    "of heading, wheels, ...",
    oscillation_events,
    least_s=_least_s,
    of_numbers=True,
    drawn=3,
    reads_through=_swinging,
)
