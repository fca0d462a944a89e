"""`degradation`: the noise of a sensor grew for good.

Noise is estimated in blocks of equal numbers of rows, from fourth differences, which leave out any
smooth motion. A change counts where every block after it is noisier than every block before it:
by chance that happens once in `comb(before + after, before)` orders, at most once in 12,870.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final

from webots_mcp.analysis.arrays import Array, Indexes, noise_of, np
from webots_mcp.judging.detection.kinds import Event, NotSearchableError
from webots_mcp.judging.detection.search import EventKind, Search, places_in
from webots_mcp.signals.meaning import Quantity
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.registered_signals import RegisteredSignal

_ROUNDING: Final = 1e-9  # of the largest value: less noise is that of floating-point numbers
TIMES: Final = 3.0  # the noise after, of the noise before
_BLOCKS: Final = 32
_LEAST_ROWS: Final = 40  # of a block: its noise is known to about 15 % then
_LEAST_SIDE: Final = 6  # blocks before, and after
_MOST_CHANCE: Final = 1 / 12_870
_SAME_MOTION: Final = 2.0  # times as fast: then the motion may explain the noise
_SHAKEN: Final[frozenset[Quantity | None]] = frozenset(("angular velocity", "acceleration"))
# Quantities whose noise does not depend on how the robot moves.
_STEADY: Final[frozenset[Quantity | None]] = frozenset(
    ("distance", "x", "y", "height", "heading", "temperature", "voltage", "pressure", "light")
)


def degradation_events(search: Search) -> Iterator[Event]:
    """Of sensors whose noise does not depend on motion: distances, places, temperatures, ..."""
    signals = [
        search.known[name]
        for name, meaning in search.meanings.items()
        if meaning.is_sensed and meaning.quantity in _STEADY and search.known[name].is_number
    ]
    wanted = {each.name for each in search.signals}
    signals = [each for each in signals if each.name in wanted and not each.is_index]
    shaken = [
        search.known[name]
        for name in wanted
        if search.meanings[name].quantity in _SHAKEN
        and search.meanings[name].is_sensed
        and search.known[name].is_number
    ]
    undecided = sorted(_shaken_more(search, shaken))
    search.not_searched("degradation", *undecided, cause="undecided")
    if undecided and not signals:
        raise NotSearchableError("; ".join(undecided), "undecided")
    if not signals:
        raise NotSearchableError("no sensor is known whose noise does not depend on motion")
    found_any = False
    for signal in search.in_time("degradation", signals):
        found = _change_of(search, signal)
        if found is None:
            continue
        found_any = True
        start_s, before, after = found
        end_s = float(search.frame.times[-1])
        details = {"noise_before": float(f"{before:.3g}"), "noise_after": float(f"{after:.3g}")}
        yield search.event("degradation", start_s, end_s, signal.name, **details)
    if not found_any and search.frame.times[:1].tolist() > [search.began_s]:
        search.not_searched(
            "degradation", "noise that grew earlier is not seen: ask for the whole run"
        )


def _shaken_more(search: Search, signals: Sequence[RegisteredSignal]) -> Iterator[str]:
    """Of gyros and accelerometers the noise that grew: motors and the ground shake them as well."""
    grown: dict[str, tuple[float, float, float]] = {}
    for signal in search.in_time("degradation", signals, judged=False):
        if (found := _change_of(search, signal)) is not None:
            branch, _, item = signal.name.rpartition(".")
            grown.setdefault(f"{branch}.*" if item.isdigit() else signal.name, found)
    for name, (start_s, before, after) in grown.items():
        yield (
            f"noise of {name} grew from {before:.3g} to {after:.3g} at {start_s:.4g} s: nothing "
            "recorded says whether the sensor or what shakes it did so"
        )


def _change_of(search: Search, signal: RegisteredSignal) -> tuple[float, float, float] | None:
    """When the noise grew, and how large it was before and after; None where it did not."""
    zones = search.frame.zone_map(signal.name)
    rows = int(zones.value_count.sum())
    blocks = min(_BLOCKS, rows // _LEAST_ROWS)
    if blocks < 2 * _LEAST_SIDE:
        return None
    edges = np.linspace(0, rows, blocks + 1).astype(np.intp)
    if not _may_have_grown(search.frame, signal.name, edges):
        return None
    times, values = search.frame.usable(signal.name)
    noises = np.array([noise_of(values[a:b]) for a, b in pairwise(edges.tolist())])
    if noises.min() <= _ROUNDING * float(np.abs(values).max()):
        return None
    best: tuple[float, int] | None = None
    for at in range(_LEAST_SIDE, blocks - _LEAST_SIDE + 1):
        if noises[:at].max() < noises[at:].min() and 1 / math.comb(blocks, at) <= _MOST_CHANCE:
            ratio = float(np.median(noises[at:]) / np.median(noises[:at]))
            best = max(best or (0.0, 0), (ratio, at))
    if best is None or best[0] < TIMES or not _moves_alike(search, times, int(edges[best[1]])):
        return None
    middle = best[1]
    return (
        float(times[edges[middle]]),
        float(np.median(noises[:middle])),
        float(np.median(noises[middle:])),
    )


def _may_have_grown(frame: Frame, name: str, edges: Indexes) -> bool:
    """Return whether the last blocks are noisier than the first ones, pair by pair from outside.

    The noise of most sensors stays, so that two or four blocks of them suffice to say no.

    Args:
        frame: The rows.
        name: The signal.
        edges: Of the blocks, counted in rows that have a usable value.
    """
    if edges[-1] < len(frame):  # where a block lies is known once all values are
        return True
    before, after = 0.0, math.inf
    for at in range(_LEAST_SIDE):
        first, last = (
            noise_of(frame.rows(*span).numbers(name))
            for span in (edges[at : at + 2].tolist(), edges[len(edges) - 2 - at :][:2].tolist())
        )
        before, after = max(before, first), min(after, last)
        if before >= after:
            return False
    return True


def _moves_alike(search: Search, times: Array, row: int) -> bool:
    """Whether the robot moved about as fast before a row as after it, as far as that is known."""
    if search.motion.position is None or not 0 < row < len(times):
        return True
    rows, x, y = places_in(search.frame, search.motion.position)
    clock = search.frame.times[rows]
    speeds: list[float] = []
    for part in (clock < times[row], clock >= times[row]):
        if np.count_nonzero(part) < 2:
            return True
        ends = np.flatnonzero(part)[[0, -1]]
        lasts_s = float(clock[ends[1]] - clock[ends[0]]) or 1.0
        thin = max(1, int(np.count_nonzero(part)) // 100)
        way_m = np.hypot(np.diff(x[part][::thin]), np.diff(y[part][::thin])).sum()
        speeds.append(float(way_m) / lasts_s)
    slow, fast = sorted(speeds)
    return fast <= max(_SAME_MOTION * slow, search.options.min_commanded_m_s)


DEGRADATION: Final = EventKind(
    "degradation",
    "a sensor's noise grew for good",
    degradation_events,
    of_numbers=True,
    lasts=True,
    ends_within_s=lambda event: math.inf,
    drawn=3,
    severity=35,
)
