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
from webots_mcp.judging.detection.event import Event, NotSearchableError
from webots_mcp.judging.detection.search import EventKind, Search, places_in, were_not_searched
from webots_mcp.signals.meaning import Quantity, words_in
from webots_mcp.store.chunks import shown
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.registered_signals import RegisteredSignal

_ROUNDING: Final = 1e-9  # of the largest value: less noise is that of floating-point numbers
TIMES: Final = 3.0  # the noise after, of the noise before
_BLOCKS: Final = 32
_LEAST_ROWS: Final = 40  # of a block: its noise is known to about 15 % then
_LEAST_SIDE: Final = 6  # blocks before, and after
_LEAST_BLOCKS: Final = 16  # of fewer no order is as rare
_MOST_CHANCE: Final = 1 / math.comb(_LEAST_BLOCKS, _LEAST_BLOCKS // 2)  # 1 in 12,870
_DIFFERENCES: Final = 4  # leave out smooth motion; of independent noise they have ...
_DIFFERENCE_VARIANCE: Final = 70.0  # ... so many times its variance
_OUTLIER: Final = 4.0  # standard deviations of the larger noise; more does not count more
_SAME_MOTION: Final = 2.0  # times as fast: then the motion may explain the noise
_NEAR_BLOCKS: Final = 2  # before and after: something else that changed then may explain the noise
_PROPORTIONAL: Final = 2.0  # times the ratio of distances: so much more noise may be theirs
_LEFT: Final = 5.0  # times the range, or the noise, that a height had kept before
_FEW: Final = 0.1  # of the rows after that may lie in the former range
_DEPTHS: Final = frozenset(("depth", "altitude"))
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
    wanted = dict.fromkeys(each.name for each in search.signals)  # in their order, always the same
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
    least_rows = _LEAST_ROWS * _LEAST_BLOCKS
    few = [each for each in signals if _rows_of(search, each) < least_rows]
    signals = [each for each in signals if each not in few]
    if few:
        why = (
            f"{were_not_searched([each.name for each in few])}: noise is judged only in "
            f"{least_rows} rows or more"
        )
        if not signals:
            raise NotSearchableError(why, "undecided")
        search.not_searched("degradation", why)
    found_any, excused = False, list[tuple[str, float, float, float, str]]()
    for signal in search.in_time("degradation", signals):
        found = _change_of(search, signal)
        if found is None:
            continue
        start_s, before, after = found
        if why := _explained_by(search, signal, start_s, after / before):
            excused.append((signal.name, before, after, start_s, why))
            continue
        found_any = True
        end_s = float(search.frame.times[-1])
        details = {"noise_before": float(f"{before:.3g}"), "noise_after": float(f"{after:.3g}")}
        yield search.event("degradation", start_s, end_s, signal.name, **details)
    for name, before, after, start_s, why in excused[:1]:
        others = f" (and {len(excused) - 1} more)" if len(excused) > 1 else ""
        search.not_searched(
            "degradation",
            f"noise of {name}{others} grew from {before:.3g} to {after:.3g} at {start_s:.4g} s, "
            f"when {why}: nothing recorded says whether the sensor or its surroundings did so",
            cause="undecided",
        )
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
    rows = _rows_of(search, signal)
    blocks = min(_BLOCKS, rows // _LEAST_ROWS)
    if blocks < _LEAST_BLOCKS:
        return None
    edges = np.linspace(0, rows, blocks + 1).astype(np.intp)
    if not _may_have_grown(search.frame, signal.name, edges):
        return None
    times, values = search.frame.usable(signal.name)
    noises = np.array([noise_of(values[a:b]) for a, b in pairwise(edges.tolist())])
    if noises.min() <= _ROUNDING * float(np.abs(values).max()):
        return None
    divided = [
        at
        for at in range(_LEAST_SIDE, blocks - _LEAST_SIDE + 1)
        if noises[:at].max() < noises[at:].min() and 1 / math.comb(blocks, at) <= _MOST_CHANCE
    ]
    if not divided:
        return None
    # Where one level before and one after it explain all blocks best, whatever their order is.
    middle = min(divided, key=lambda at: _misfit(np.log(noises), at))
    before, after = float(np.median(noises[:middle])), float(np.median(noises[middle:]))
    first, stop = int(edges[middle - 1]), int(edges[middle + 1])
    row = first + _onset(values[first:stop], before, after)
    if after < TIMES * before or not _moves_alike(search, times, row):
        return None
    return float(times[row]), before, after


def _explained_by(
    search: Search, signal: RegisteredSignal, start_s: float, times_noise: float
) -> str | None:
    """Return what else changed for good when the noise of a signal grew; None where nothing did.

    A receiver below the surface, or off the ground, measures in other surroundings. What counts is
    a mode that begins then and was never there before, and a height or depth that leaves then the
    range that it had kept. The noise of a distance grows with the distance.
    """
    frame, margin_s = search.frame, (search.length_s / _BLOCKS) * _NEAR_BLOCKS
    before = frame.between(search.began_s, start_s - margin_s)
    after = frame.between(start_s + margin_s, search.ended_s)
    if len(before) < 2 or len(after) < 2:
        return None
    if search.meanings[signal.name].quantity == "distance":
        near, far = (part.usable(signal.name)[1] for part in (before, after))
        levels = [float(np.median(np.abs(each))) if len(each) else 0.0 for each in (near, far)]
        if levels[0] > 0 and times_noise <= _PROPORTIONAL * levels[1] / levels[0]:
            return f"it measured {levels[1] / levels[0]:.2g} times as far"
    mode = search.motion.mode
    if mode is not None and mode.name in frame:
        codes, labels = frame.coded(mode.name)
        first, stop = frame.places([start_s - margin_s, start_s + margin_s]).tolist()
        earlier: set[int] = set(codes[:first].tolist())
        later: set[int] = set(codes[stop:].tolist())
        around = codes[max(0, first - 1) : stop + 1]
        if earlier.isdisjoint(later) and len(set(around.tolist())) > 1:
            return f"{mode.name} became {shown(labels[int(codes[min(stop, len(codes) - 1)])])}"
    for name, meaning in search.meanings.items():
        is_height = meaning.quantity == "height" or _DEPTHS.intersection(words_in(name))
        if not is_height or not meaning.is_sensed or name == signal.name or name not in frame:
            continue
        low_high = before.usable(name)[1]
        values = after.usable(name)[1]
        if len(low_high) < 2 or len(values) < 2:
            continue
        kept = float(np.ptp(low_high))
        away = min(abs(float(np.median(values)) - end) for end in (low_high.min(), low_high.max()))
        outside = (values < low_high.min()) | (values > low_high.max())
        if away > max(_LEFT * kept, _LEFT * search.noise.of(name)) and outside.mean() > 1 - _FEW:
            return f"{name} left {float(np.median(low_high)):.3g}"
    return None


def _rows_of(search: Search, signal: RegisteredSignal) -> int:
    """How many rows have a value of a signal."""
    return int(search.frame.zone_map(signal.name).value_count.sum())


def _misfit(values: Array, at: int) -> float:
    """The squares that are left of values with one mean before a place and one after it."""
    return float(sum(np.square(part - part.mean()).sum() for part in (values[:at], values[at:])))


def _onset(values: Array, before: float, after: float) -> int:
    """The row from which the larger noise is likelier (maximum likelihood of normal noise).

    Args:
        values: Of the block before the change and the one after it, which begin around it.
        before: Standard deviation of the noise before.
        after: Of the noise after.
    """
    squares = np.square(np.diff(values, _DIFFERENCES)) / _DIFFERENCE_VARIANCE
    squares = np.minimum(squares, np.square(_OUTLIER * after))
    likelier = squares * (1 / before**2 - 1 / after**2) / 2 - math.log(after / before)
    from_there = np.cumsum(likelier[::-1])[::-1]
    return min(int(from_there.argmax()) + _DIFFERENCES - 1, len(values) - 1)


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
