"""`threshold`: a signal was beyond a limit that the asker gives, for long enough."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.detection.event import Event, EventOptions, Threshold
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.intervals import Beyond
from webots_mcp.store.signals.catalogue import resolve_signals
from webots_mcp.store.signals.registry import Signal


def thresholds_on(
    names: Sequence[str], above: float | None, below: float | None, for_s: float
) -> tuple[Threshold, ...]:
    """One threshold per signal and limit; none where neither limit is given.

    Args:
        names: Signals, with `*`.
        above: In the unit of the signals.
        below: In the unit of the signals.
        for_s: At least so many simulated seconds.

    Raises:
        InvalidInputError: A limit without a signal, or a duration without a limit.
    """
    if for_s and above is None and below is None:
        raise InvalidInputError(f"for_s={for_s:g} needs a limit: give above or below")
    limits = [{"above": above}] * (above is not None) + [{"below": below}] * (below is not None)
    if limits and not names:
        raise InvalidInputError("above and below need signals: name those to compare")
    return tuple(Threshold(name, for_s=for_s, **limit) for name in names for limit in limits)


def threshold_events(search: Search) -> Iterator[Event]:
    """Each stretch of each signal beyond each of its limits."""
    if not search.options.thresholds:
        raise NotSearchableError("no limit was given: give signals, and above or below")
    for threshold in search.options.thresholds:
        for signal in resolve_signals(search.known, [threshold.signal]):
            if search.only is None or signal.name in search.only:
                yield from _beyond(search, signal, threshold)


def _beyond(search: Search, signal: Signal, threshold: Threshold) -> Iterator[Event]:
    limit = {"above": threshold.above, "below": threshold.below}
    given = {name: value for name, value in limit.items() if value is not None}
    longest_s = None
    for span in search.view.spans(signal, Beyond(threshold.holds)):
        if span.end_s - span.start_s >= threshold.for_s:
            details = {**given, "min": span.low, "max": span.high, **span.how_exact}
            yield search.event("threshold", span.start_s, span.end_s, signal.name, **details)
        else:
            longest_s = max(longest_s or 0.0, span.end_s - span.start_s)
    if longest_s is not None:
        what = f"{signal.name} was beyond the limit for at most {longest_s:.3g} s"
        search.came_near("threshold", longest_s / threshold.for_s, what)
    elif (extreme := _extreme(search, signal, threshold)) is not None:
        search.came_near("threshold", 0.0, f"{signal.name} reached {extreme:.4g}")


def _extreme(search: Search, signal: Signal, threshold: Threshold) -> float | None:
    summary = search.view.summary(signal)
    return summary.max if threshold.above is not None else summary.min


def _limit(event: Event) -> Hashable:
    return event.details.get("above"), event.details.get("below")


def _for_s(options: EventOptions) -> float:
    return max((threshold.for_s for threshold in options.thresholds), default=0.0)


THRESHOLD: Final = EventKind(
    "threshold",
    "",
    threshold_events,
    usual=lambda options: bool(options.thresholds),
    lasts=True,
    least_s=_for_s,
    counted=False,
    alike=Alike(lambda events, unit: "stretches", sort=_limit),
)
