"""`oscillation`: a signal that a robot moves with went to and fro regularly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

from webots_mcp.naming import listed
from webots_mcp.store.analysis.swings import JOINED_PERIODS, Swing, joined_swings
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.search import Search
from webots_mcp.store.rollup.swings import LONGEST_PERIOD_S, may_swing, swings_in
from webots_mcp.store.signals.registry import Signal

_MOST_NAMED: Final = 5


def oscillation_events(search: Search) -> Iterator[Event]:
    """Of heading, wheels, speed, position and the like, and of what is asked for."""
    signals = _swinging(search)
    if search.is_purged and not search.view.stored_swings(signals)[1]:
        search.require_rows()
    if left := [each.name for each in search.required_numbers() if each not in signals]:
        why = (
            f"not in {len(left)} of {len(search.numbers)} signals, whose names do not suggest "
            f"motion: name them in signals ({listed(left, _MOST_NAMED)})"
        )
        if not signals:
            raise NotSearchableError(why)
        search.not_searched("oscillation", why)
    _note_periods(search)
    search.note_too_large("oscillation")
    for name, swings in _found(search, signals).items():
        for swing in joined_swings(swings):
            details = {
                "half_periods": swing.half_swings,
                "period_s": swing.period_s,
                "amplitude": swing.amplitude,
            }
            event = search.event("oscillation", swing.start_s, swing.end_s, name, **details)
            goes_on = search.ended_s - swing.end_s < _ends_within_s(event)
            yield replace(event, ongoing=goes_on)


def _note_periods(search: Search) -> None:
    """Which periods are too long for the run to hold enough of them, or to be looked for at all."""
    half_periods, longest_s = search.options.min_half_periods, _longest_period_s(search)
    fitting_s = 2 * search.length_s / half_periods
    if fitting_s < longest_s:
        search.not_searched(
            "oscillation",
            f"run {search.segment.run_id} lasted only {search.length_s:.3g} s, too short for "
            f"{half_periods} half periods where a period is over {fitting_s:.2g} s",
        )
    elif search.view.is_long and search.options.oscillation_period_s is None:
        search.not_searched(
            "oscillation",
            f"not with a period over {longest_s:g} s in so long a range: {search.less_time}",
        )


def _longest_period_s(search: Search) -> float:
    asked_s = search.options.oscillation_period_s
    return search.view.longest_period_s if asked_s is None else asked_s


def _found(search: Search, signals: Sequence[Signal]) -> dict[str, list[Swing]]:
    """Those that are stored, and in the rows of which none are."""
    options = search.options
    asked = options.min_half_periods, _longest_period_s(search)
    usual = asked == (EventOptions.min_half_periods, LONGEST_PERIOD_S)
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


def _around_s(options: EventOptions) -> float:
    return options.min_half_periods * (options.oscillation_period_s or LONGEST_PERIOD_S) / 2


def _ends_within_s(event: Event) -> float:
    return JOINED_PERIODS * event.details["period_s"]


OSCILLATION: Final = EventKind(
    "oscillation",
    "of heading, wheels, ...",
    oscillation_events,
    lasts=True,
    around_s=_around_s,
    ends_within_s=_ends_within_s,
    of_numbers=True,
    drawn=3,
    reads_through=_swinging,
    alike=Alike(lambda events, unit: "oscillations"),
    effort=1,
)
