"""`off_target`: what should follow a target stayed away from it and came no nearer.

Judged is by medians of cells of a second, whose error is known from the noise of both signals, so
that neither noise nor the rate of rows decides.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Flags, Indexes, np, runs_of
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.detection.kinds import (
    Alike,
    Event,
    NotSearchableError,
)
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.signals.meaning import HOLDING, targets_in, words_in
from webots_mcp.store.signals import RegisteredSignal

OFF_S: Final = 3.0  # away for so long, without coming nearer
OFF_SHARE: Final = 0.1  # of the largest step or size of the target
_CELL_S: Final = 1.0  # over which medians are taken
_ERRORS: Final = 4.0  # standard errors of a median: one cell in 16,000 is beyond by noise alone
_MEDIAN_ERROR: Final = 1.2533  # of a median, times the standard error of a mean (normal noise)
_NEARER_SHARE: Final = 0.05  # of the distance, from one cell to the next: it is on its way ...
_ON_ITS_WAY: Final = 0.01  # ... and so is what comes nearer by this share of the target's size
_LEAST_ROWS: Final = 3  # of a cell
_PLACES: Final = ("x", "y", "height", "heading")  # where a robot goes takes as long as it takes


class Pursuit(NamedTuple):
    """A measured signal and its target."""

    measured: RegisteredSignal
    target: RegisteredSignal


def pursuits_in(search: Search) -> list[Pursuit]:
    """Return what follows a target in a run.

    Places where a robot shall go are no targets of this kind, and grippers close on things. A
    target that is always 0 has no size to judge by.
    """
    frame, known = search.whole, search.known
    there = {
        name: meaning
        for name, meaning in search.meanings.items()
        if known[name].kind in ("num", "angle") and frame.zone_map(name).value_count.any()
    }
    found: list[Pursuit] = []
    for measured, target in targets_in(there):
        zones = frame.zone_map(target)
        is_set = (zones.min < 0).any() or (zones.max > 0).any()
        follows = there[measured].quantity not in _PLACES
        if is_set and follows and HOLDING.isdisjoint(words_in(measured)):
            found.append(Pursuit(known[measured], known[target]))
    return found


def off_target_events(search: Search) -> Iterator[Event]:
    """Where the median of each second is off the target, and not on its way to it, for 3 s."""
    pursuits = pursuits_in(search)
    if not pursuits:
        raise NotSearchableError(
            "no signal is known to be the target of another, or it is always 0: declare one with "
            "target_of"
        )
    targets = {each.measured.name: each for each in pursuits}
    search.judged("off_target", [each.target for each in pursuits])
    for signal in search.in_time("off_target", [each.measured for each in pursuits]):
        yield from _apart(search, targets[signal.name])


def _apart(search: Search, pursuit: Pursuit) -> Iterator[Event]:
    frame, measured, target = search.frame, pursuit.measured, pursuit.target
    values, aims = frame.numbers(measured.name), frame.numbers(target.name)
    there = np.flatnonzero(np.isfinite(values) & np.isfinite(aims))
    if len(there) < 2:
        return
    cells = _cells_of(frame.times[there])
    values, aims = values[there][cells.order], aims[there][cells.order]
    low, high = _recent_range(frame.times[there], aims)
    course = values
    if turn := measured.turn:
        course = unwrap(values, turn)
        values = aims + np.remainder(values - aims + turn / 2, turn) - turn / 2
    off = np.maximum(values - high, 0.0) - np.maximum(low - values, 0.0)
    error = cells.medians(off)
    noise = max(search.noise.of(measured.name), search.noise.of(target.name))
    margin = _ERRORS * _MEDIAN_ERROR * noise / np.sqrt(cells.counts)
    all_aims = search.whole.usable(target.name)[1]
    size = float(np.ptp(all_aims)) or float(np.abs(all_aims).max())
    is_off = (np.abs(error) > np.maximum(OFF_SHARE * size, margin)) & cells.is_full
    before = np.append(np.nan, error[:-1])
    nearer = np.abs(before) - np.abs(error)
    least = np.minimum(_NEARER_SHARE * np.abs(before), _ON_ITS_WAY * size)
    approaches = nearer > np.maximum(least, 2 * margin)
    moved = np.diff(cells.medians(course), prepend=np.nan)
    # A target that comes to where something stays is no motion of its own.
    approaches &= -np.sign(before) * moved > np.maximum(nearer / 2, margin)
    approaches &= np.append(False, cells.follows)
    runs = (
        run
        for sign in (-1, 1)
        for run in runs_of(is_off & ~approaches & (np.sign(error) == sign), cells.starts_s).spans()
    )
    for run in sorted(runs, key=lambda each: each.start_s):
        start_s = float(cells.starts_s[run.start])
        end_s = float(cells.ends_s[run.stop - 1])
        if end_s - start_s < OFF_S:
            continue
        part = error[run.start : run.stop]
        middle = float(np.median(part))
        yield search.event(
            "off_target",
            start_s,
            end_s,
            measured.name,
            target=target.name,
            off_by=round(middle, 6),
            off_percent=round(100 * abs(middle) / size, 1),
        )


def _recent_range(times: Array, aims: Array) -> tuple[Array, Array]:
    """The minimum and maximum of a target in the last 3 s, in which a follower may lag."""
    first = np.searchsorted(times, times - OFF_S)
    low, high = np.array(aims), np.array(aims)
    steps = np.flatnonzero(np.diff(aims)) + 1
    if not len(steps):
        return low, high
    width = int(np.max(np.arange(len(times)) - first)) + 1
    padded = [np.concatenate((np.full(width - 1, each), aims)) for each in (np.inf, -np.inf)]
    windows = [np.lib.stride_tricks.sliding_window_view(each, width) for each in padded]
    return windows[0].min(axis=1), windows[1].max(axis=1)


class _Cells(NamedTuple):
    """Rows in cells of equal time."""

    order: Indexes
    edges: Indexes
    counts: Array
    starts_s: Array
    ends_s: Array
    is_full: Flags
    follows: Flags

    def medians(self, values: Array) -> Array:
        """Return the median of each cell."""
        pairs = zip(self.edges[:-1].tolist(), self.edges[1:].tolist(), strict=True)
        return np.array([float(np.median(values[a:b])) for a, b in pairs])


def _cells_of(times: Array) -> _Cells:
    cells = np.floor(times / _CELL_S).astype(np.intp)
    starts = np.flatnonzero(np.diff(cells, prepend=cells[:1] - 1))
    edges = np.append(starts, len(times))
    counts = np.diff(edges)
    follows = np.diff(cells[starts]) == 1
    return _Cells(
        np.arange(len(times)),
        edges,
        counts.astype(np.float64),
        times[starts],
        times[edges[1:] - 1],
        counts >= min(_LEAST_ROWS, int(np.max(counts, initial=1))),
        follows,
    )


OFF_TARGET: Final = EventKind(
    "off_target",
    "stays away from its target",
    off_target_events,
    lasts=True,
    least_s=lambda options: OFF_S,
    ends_within_s=lambda event: 2 * _CELL_S,
    drawn=4,
    alike=Alike(lambda events, unit: "times off target"),
    severity=60,
)
