"""`off_target`: what should follow a target stayed away from it and came no nearer.

Judged is by medians of cells of a second, whose error is known from the noise of both signals, so
that neither noise nor the rate of rows decides. A target that keeps moving is judged by how it is
followed, and one that steps also by how far it is passed. A height takes as long as it takes: it is
off only where it never came to a target that stayed, nor any nearer in the second half of its stay.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import (
    MOSTLY,
    Array,
    Flags,
    Indexes,
    constant_runs,
    np,
    runs_of,
)
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.detection.event import (
    Alike,
    Event,
    NotSearchableError,
)
from webots_mcp.judging.detection.following import following_of
from webots_mcp.judging.detection.holding import Grip, grips_in, lost_grips
from webots_mcp.judging.detection.overshoot import overshoots_of
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.signals.meaning import HOLDING, Meaning, Quantity, targets_in, words_in
from webots_mcp.signals.naming import METRES
from webots_mcp.store.chunks import shown
from webots_mcp.store.reading.segment import just_after
from webots_mcp.store.registered_signals import RegisteredSignal

OFF_S: Final = 3.0  # away for so long, without coming nearer
OVERSHOT: Final = "overshoot_percent"  # of the step, in the details of an event
OFF_SHARE: Final = 0.1  # of the largest step or size of the target
_CELL_S: Final = 1.0  # over which medians are taken
_ERRORS: Final = 4.0  # standard errors of a median: one cell in 16,000 is beyond by noise alone
_MEDIAN_ERROR: Final = 1.2533  # of a median, times the standard error of a mean (normal noise)
_NEARER_SHARE: Final = 0.05  # of the distance, from one cell to the next: it is on its way ...
_ON_ITS_WAY: Final = 0.01  # ... and so is what comes nearer by this share of the target's size
_LEAST_ROWS: Final = 3  # of a cell
_PLACES: Final = ("x", "y", "heading")  # where a robot goes takes as long as it takes
# What goes round so fast, be it of a wheel, a motor or a joint: names tell one or the other.
_TURNING: Final = frozenset[Quantity | None](
    ("angular velocity", "turn rate", "wheel speed", "motor speed", "joint speed")
)
# A target of a height for so long, to judge by the half of it: of 300 stays that healthy heights
# came to, with delays up to 2 s and time constants up to 20 s, none was taken to be off.
_STAYS_S: Final = 2 * OFF_S
_TURNS: Final = {"rad": 1.0, "deg": math.pi / 180}
_SPEEDS: Final = {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001, "km/h": 1 / 3.6}
_TURN_SPEEDS: Final = {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30}
_SCALES: Final = (METRES, _TURNS, _SPEEDS, _TURN_SPEEDS)


class Pursuit(NamedTuple):
    """A measured signal and its target.

    Attributes:
        measured: What follows.
        target: What it shall come to.
        scale: What one unit of the target is in the unit of what follows.
        is_height: It takes as long as it takes.
    """

    measured: RegisteredSignal
    target: RegisteredSignal
    scale: float = 1.0
    is_height: bool = False


def pursuits_in(search: Search) -> list[Pursuit]:
    """Return what follows a target in a run, where the units of both can be compared.

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
    by_dimension = {
        name: meaning._replace(quantity="angular velocity")
        if meaning.quantity in _TURNING
        else meaning
        for name, meaning in there.items()
    }
    for measured, target in targets_in(by_dimension):
        zones = frame.zone_map(target)
        is_set = (zones.min < 0).any() or (zones.max > 0).any()
        follows = there[measured].quantity not in _PLACES
        scale = _scale_between(there[target], there[measured])
        if is_set and follows and scale and HOLDING.isdisjoint(words_in(measured)):
            is_height = there[measured].quantity == "height"
            found.append(Pursuit(known[measured], known[target], scale, is_height))
    return found


def _scale_between(target: Meaning, measured: Meaning) -> float | None:
    """What one unit of a target is in the other unit; None where they cannot be compared.

    Without a unit of one of them nothing says that they differ.
    """
    if target.unit == measured.unit or target.unit is None or measured.unit is None:
        return 1.0
    for units in _SCALES:
        if target.unit in units and measured.unit in units:
            return units[target.unit] / units[measured.unit]
    return None


def off_target_events(search: Search) -> Iterator[Event]:
    """Where the median of each second is off the target, and not on its way to it, for 3 s."""
    pursuits, grips = pursuits_in(search), grips_in(search)
    yield from _lost_grips(search, grips)
    if not pursuits and not grips:
        raise NotSearchableError(
            "no signal is known to be the target of another, or it is always 0: declare one with "
            "target_of"
        )
    targets = {each.measured.name: each for each in pursuits}
    search.judged("off_target", [each.target for each in pursuits])
    for signal in search.in_time("off_target", [each.measured for each in pursuits]):
        pursuit = targets[signal.name]
        found = list((_never_reached if pursuit.is_height else _off_or_lost)(search, pursuit))
        yield from found
        for each in _overshoots(search, pursuit):
            if all(each.end_s < e.start_s or each.start_s > e.end_s for e in found):
                yield each


def _lost_grips(search: Search, grips: Sequence[Grip]) -> Iterator[Event]:
    """Where closed grippers lost what they held; what they hold decides what is a loss."""
    segment = search.segment
    search.judged("off_target", [each for grip in grips for each in grip])
    for grip in grips:
        for lost in lost_grips(search, grip):
            if lost.start_s >= segment.end_s or lost.end_s < segment.start_s:
                continue
            size = abs(lost.held - lost.empty)
            error = np.array([lost.empty - lost.held])
            event = _off_target(
                search, Pursuit(grip.force, grip.command), lost.start_s, lost.end_s, error, size
            )
            says = (
                f"the grip was lost: from {lost.held:.3g} to {lost.empty:.3g}, as while it is "
                f"open, though {grip.command.name} stayed"
            )
            yield replace(event, details=event.details | {"says": says})


def _off_or_lost(search: Search, pursuit: Pursuit) -> Iterator[Event]:
    """Where it was off a target that stays, and where it did not follow one that moves."""
    apart, limp = list[Event](), dict[str, None]()
    for each in _apart(search, pursuit):
        if mode := limp_in(search, pursuit, each):
            limp[mode] = None
        else:
            apart.append(each)
    for mode in limp:
        search.not_searched(
            "off_target",
            f"not judged in {mode}: no target moves in it, and what should follow them left them, "
            "as with limp drives",
            cause="undecided",
        )
    lost = list(_lost(search, pursuit))
    for each in apart:  # it stopped following before it was far away
        before = [e.start_s for e in lost if e.start_s <= each.start_s <= e.end_s + OFF_S]
        start_s = min((each.start_s, *before))
        yield replace(each, start_s=start_s, wall_time_s=search.wall_time_at(start_s))
    known = [(each.start_s - OFF_S, each.end_s) for each in apart]
    yield from (e for e in lost if all(e.end_s < a or e.start_s > b for a, b in known))


def _lost(search: Search, pursuit: Pursuit) -> Iterator[Event]:
    """Where it did not follow a moving target.

    Off a target that moves so far in 3 s nothing can be. Where that is so for twice as long, and
    it cannot be told how it follows, it is not searched.
    """
    frame, measured, target = search.frame, pursuit.measured, pursuit.target
    values, aims = frame.numbers(measured.name), pursuit.scale * frame.numbers(target.name)
    there = np.flatnonzero(np.isfinite(values) & np.isfinite(aims))
    if len(there) < 2:
        return
    times, values, aims = frame.times[there], values[there], aims[there]
    if turn := measured.turn:
        values, aims = unwrap(values, turn), unwrap(aims, turn)
    size = _size_of(search, pursuit)
    low, high = _recent_range(times, aims)
    moving = runs_of(high - low > OFF_SHARE * size, times)
    moving_s = float(moving.durations_s[moving.durations_s >= 2 * OFF_S].sum())
    if not moving_s:
        return
    noise = max(search.noise.of(measured.name), pursuit.scale * search.noise.of(target.name))
    found = following_of(times, values, aims, OFF_SHARE * size, noise, _ERRORS)
    if found.judged_s < moving_s / 2:
        why = found.why_not or f"how it follows is known in only {found.judged_s:.3g} s"
        search.not_searched(
            "off_target",
            f"{measured.name} while {target.name} moved ({moving_s:.3g} s): {why}",
            cause="undecided",
        )
    for span in found.lost:
        rows = slice(*np.searchsorted(times, (span.start_s, just_after(span.end_s))).tolist())
        says = (
            f"it made {100 * max(span.gain, 0.0):.0f} % of the motion of its target, "
            f"{100 * span.usual:.0f} % at other times"
        )
        error = np.abs(values[rows] - aims[rows])
        event = _off_target(search, pursuit, span.start_s, span.end_s, error, size)
        yield replace(event, details=event.details | {"says": says})


def limp_in(search: Search, pursuit: Pursuit, off: Event) -> str | None:
    """Return the mode in which drives are limp as far as can be told; None where they are not.

    In limp mode no target moves, and most of what should follow one leaves it by itself. One joint
    that leaves its target is off it; and so is what was off before the mode began.

    Args:
        search: Where it is looked.
        pursuit: What left its target.
        off: From when to when.
    """
    mode, frame = search.motion.mode, search.frame
    if mode is None or mode.name not in frame:
        return None
    codes, labels = frame.coded(mode.name)
    first, stop = frame.places([off.start_s, off.end_s]).tolist()
    code = int(codes[first])
    visit = next(
        e for e in runs_of(codes == code, frame.times).spans() if e.start <= first < e.stop
    )
    if visit.start == 0 or visit.stop < stop:
        return None
    moved: list[bool] = []
    for each in pursuits_in(search):
        if each.is_height or each.measured.name not in frame or each.target.name not in frame:
            continue
        aims = frame.numbers(each.target.name)
        size = _size_of(search, each)
        if each.scale * _range_of(aims[codes == code]) > OFF_SHARE * size:
            return None  # targets are followed in this mode
        part = frame.numbers(each.measured.name)[visit.start : visit.stop]
        moved.append(_range_of(part) > OFF_SHARE * size)
    if len(moved) < 2 or sum(moved) <= MOSTLY * len(moved):
        return None
    return f"{mode.name} {shown(labels[code])}"


def _range_of(values: Array) -> float:
    """From the first to the last percentile, so that single readings do not count."""
    known = values[np.isfinite(values)]
    return float(np.ptp(np.quantile(known, (0.01, 0.99)))) if len(known) else 0.0


def _apart(search: Search, pursuit: Pursuit) -> Iterator[Event]:
    frame, measured, target = search.frame, pursuit.measured, pursuit.target
    values, aims = frame.numbers(measured.name), pursuit.scale * frame.numbers(target.name)
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
    noise = max(search.noise.of(measured.name), pursuit.scale * search.noise.of(target.name))
    margin = _ERRORS * _MEDIAN_ERROR * noise / np.sqrt(cells.counts)
    size = _size_of(search, pursuit)
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
        yield _off_target(search, pursuit, start_s, end_s, error[run.start : run.stop], size)


def _size_of(search: Search, pursuit: Pursuit) -> float:
    """The range of a target in the whole run, or its size where it stays, in the other's unit."""
    aims = pursuit.scale * search.whole.usable(pursuit.target.name)[1]
    return float(np.ptp(aims)) or float(np.abs(aims).max())


def _overshoots(search: Search, pursuit: Pursuit) -> Iterator[Event]:
    """Where it passed a target that had stepped by a quarter of the step, however short."""
    frame, measured, target = search.frame, pursuit.measured, pursuit.target
    values, aims = frame.numbers(measured.name), pursuit.scale * frame.numbers(target.name)
    there = np.flatnonzero(np.isfinite(values) & np.isfinite(aims))
    if len(there) < 2:
        return
    size, noise = _size_of(search, pursuit), search.noise.of(measured.name)
    for each in overshoots_of(
        frame.times[there], values[there], aims[there], OFF_SHARE * size, noise, measured.turn
    ):
        says = (
            f"it passed its target of {each.target:.4g} by {abs(each.beyond):.3g}, "
            f"{100 * each.share:.0f} % of the step of {abs(each.step):.3g}"
        )
        error = np.array([each.beyond])
        event = _off_target(search, pursuit, each.start_s, each.end_s, error, size)
        details = event.details | {OVERSHOT: round(100 * each.share, 1), "says": says}
        yield replace(event, details=details)


def _alike(events: Sequence[Event], unit: str) -> str:
    if OVERSHOT in events[0].details:
        shares = [each.details[OVERSHOT] for each in events]
        return f"overshoots of {min(shares):.0f} to {max(shares):.0f} % of the step"
    return "times off target"


def _never_reached(search: Search, pursuit: Pursuit) -> Iterator[Event]:
    """Where a target stayed, was never reached, and came no nearer in the second half of that."""
    frame, measured, target = search.frame, pursuit.measured, pursuit.target
    values, aims = frame.numbers(measured.name), pursuit.scale * frame.numbers(target.name)
    there = np.flatnonzero(np.isfinite(values) & np.isfinite(aims))
    times, values, aims = frame.times[there], values[there], aims[there]
    size, noise = _size_of(search, pursuit), search.noise.of(measured.name)
    stays = constant_runs(aims, times)
    for stay in stays.only(stays.durations_s >= _STAYS_S).spans():
        cells = _cells_of(times[stay.start : stay.stop])
        error = cells.medians((values - aims)[stay.start : stay.stop])[cells.is_full]
        margin = _ERRORS * _MEDIAN_ERROR * noise / math.sqrt(float(np.median(cells.counts)))
        away, half = np.abs(error), len(error) // 2
        nearest = max(OFF_SHARE * size, margin)
        nearer = max(_ON_ITS_WAY * size, 2 * margin)
        crosses = np.any(np.sign(error) != np.sign(error[0]))
        if crosses or away.min() <= nearest or _drop_of(away[half:]) > nearer:
            continue
        # Gusts move it to and fro while it stays away; before, it was on its way.
        farthest = float(away[half:].max()) + nearer
        first = int(np.flatnonzero(np.append(True, away[:half] > farthest))[-1])
        start_s, end_s = float(cells.starts_s[cells.is_full][first]), stay.end_s
        yield _off_target(search, pursuit, start_s, end_s, error[first:], size)


def _drop_of(values: Array) -> float:
    """By how much the straight line through some values falls from the first to the last."""
    at = np.arange(len(values)) - (len(values) - 1) / 2
    return -float((at * values).sum() / max(float((at * at).sum()), 1.0)) * (len(values) - 1)


def _off_target(
    search: Search, pursuit: Pursuit, start_s: float, end_s: float, error: Array, size: float
) -> Event:
    """Return the event of an interval with the median of its errors, also in per cent of a size."""
    off_by = float(np.median(error))
    return search.event(
        "off_target",
        start_s,
        end_s,
        pursuit.measured.name,
        target=pursuit.target.name,
        off_by=round(off_by, 6),
        off_percent=round(100 * abs(off_by) / size, 1),
    )


def _recent_range(times: Array, aims: Array) -> tuple[Array, Array]:
    """The minimum and maximum of a target in the last 3 s, in which a follower may lag."""
    first = np.searchsorted(times, times - OFF_S)
    if not np.diff(aims).any():
        return np.array(aims), np.array(aims)
    width = int(np.max(np.arange(len(times)) - first)) + 1
    padded = [np.concatenate((np.full(width - 1, each), aims)) for each in (np.inf, -np.inf)]
    return _of_each(np.minimum, padded[0], width), _of_each(np.maximum, padded[1], width)


def _of_each(least_or_most: np.ufunc, values: Array, width: int) -> Array:
    """The minimum or maximum of each so many values, from those of half as many."""
    done = 1
    while done < width:
        step = min(done, width - done)
        values = least_or_most(values[:-step], values[step:])
        done += step
    return values


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
    alike=Alike(_alike, sort=lambda event: OVERSHOT in event.details),
    severity=60,
)
