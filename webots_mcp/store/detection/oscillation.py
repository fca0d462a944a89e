"""`oscillation`: a signal that a robot moves with went to and fro regularly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.naming import listed
from webots_mcp.store.analysis.swings import Swing, joined_swings
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import EventKind
from webots_mcp.store.detection.search import Search
from webots_mcp.store.rollup.swings import may_swing, swings_in
from webots_mcp.store.signals.registry import Signal

_MOST_NAMED: Final = 5


def oscillation_events(search: Search) -> Iterator[Event]:
    """Of heading, wheels, speed, position and the like, and of what is asked for."""
    signals = _swinging(search)
    if left := [each.name for each in search.required_numbers() if each not in signals]:
        search.not_searched(
            "oscillation",
            f"not in {len(left)} of {len(search.numbers)} signals, whose names are not of what a "
            f"robot swings with: name them in signals ({listed(left, _MOST_NAMED)})",
        )
    found = _found(search, signals)
    if not any(found.values()):
        _note_shortness(search)
    for name, swings in found.items():
        for swing in joined_swings(swings):
            details = {"period_s": swing.period_s, "amplitude": swing.amplitude}
            ends = (swing.start_s, swing.end_s)
            yield search.event("oscillation", *ends, name, turns=swing.half_swings, **details)


def _note_shortness(search: Search) -> None:
    """Which periods are too long for a run to hold as many half swings as are asked for."""
    turns = search.options.oscillation_turns
    longest_s = 2 * search.length_s / turns
    if longest_s < search.options.oscillation_period_s:
        search.not_searched(
            "oscillation",
            f"run {search.segment.run_id} is only {search.length_s:.3g} s long: {turns} half "
            f"swings with a period of more than {longest_s:.2g} s do not fit in",
        )


def _found(search: Search, signals: Sequence[Signal]) -> dict[str, list[Swing]]:
    """Those that are stored, and in the rows of which none are."""
    options = search.options
    asked = options.oscillation_turns, options.oscillation_period_s
    usual = asked == (EventOptions.oscillation_turns, EventOptions.oscillation_period_s)
    stored, found = search.view.stored_swings(signals if usual else ())
    for some, outside in (
        ([each for each in signals if each.name in found], stored),
        ([each for each in signals if each.name not in found], range(0)),
    ):
        at_rest = [0.0] * len(some)  # without any step there is no swing
        for numbers in search.view.stretches(some, at_rest, outside) if some else ():
            for index, signal in enumerate(some):
                if search.is_over("oscillation", some[index:]):
                    break
                found.setdefault(signal.name, []).extend(swings_in(numbers, signal, *asked))
    return found


def _swinging(search: Search) -> list[Signal]:
    asked = search.options.signals != EventOptions.signals
    return [each for each in search.numbers if asked or may_swing(each)]


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
    effort=1,
)
