"""`threshold`: a signal was beyond a limit that the asker gives, for long enough."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.analysis.arrays import extremes_in, np, runs_of
from webots_mcp.store.conditions_on_arrays import compared
from webots_mcp.store.detection.event import Event, Threshold
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.search import Search
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
        signals = resolve_signals(search.known, [threshold.signal])
        for signal in search.in_time("threshold", signals, judged=False):
            yield from _beyond(search, signal, threshold)


def _beyond(search: Search, signal: Signal, threshold: Threshold) -> Iterator[Event]:
    frame, is_above = search.frame, threshold.above is not None
    (limit,) = (each for each in (threshold.above, threshold.below) if each is not None)
    holds = compared(frame, signal.name, ast.Gt if is_above else ast.Lt, limit)
    runs = runs_of(holds, frame.times)
    long = runs.only(runs.durations_s >= threshold.for_s)
    numbers = frame.numbers(signal.name) if len(long) else np.zeros(0)
    for run, low, high in zip(long.each(), *extremes_in(long, numbers), strict=True):
        details = {"above" if is_above else "below": limit, "min": float(low), "max": float(high)}
        yield search.event("threshold", run.start_s, run.end_s, signal.name, **details)
    zones = frame.zones(signal.name)
    extremes = (zones.max if is_above else zones.min)[
        (zones.value_count > 0) & ~np.isnan(zones.min)
    ]
    if len(runs) > len(long):
        longest_s = float(runs.durations_s[runs.durations_s < threshold.for_s].max())
        what = f"{signal.name} was beyond the limit for at most {longest_s:.3g} s"
        search.note_nearest("threshold", longest_s / threshold.for_s, what)
    elif not len(runs) and len(extremes):
        extreme = extremes.max() if is_above else extremes.min()
        search.note_nearest("threshold", 0.0, f"{signal.name} reached {extreme:.4g}")


THRESHOLD: Final = EventKind(
    "threshold",
    "",
    threshold_events,
    usual=lambda options: bool(options.thresholds),
    lasts=True,
    least_s=lambda options: max((each.for_s for each in options.thresholds), default=0.0),
    counted=False,
    alike=Alike(
        lambda events, unit: "stretches",
        sort=lambda e: (e.details.get("above"), e.details.get("below")),
    ),
)
