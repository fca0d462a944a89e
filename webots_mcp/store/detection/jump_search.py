"""Sudden jumps: dropouts and spikes that come back, and steps that stay."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, median, np
from webots_mcp.store.analysis.rhythm import gap_borders, usual_interval_s
from webots_mcp.store.analysis.swings import LEAST_HALF_SWINGS, Swing, find_swings
from webots_mcp.store.reading.frame import Frame, Zones

MOST_JUMPS_SHARE: Final = 0.1  # of the rows: more of them are how the signal is
LEAST_STEPS: Final = 10
SAMPLED_CHUNKS: Final = 16  # that tell what is usual
MARGIN_ROWS: Final = 10  # around steps: what an excursion takes, and the motion next to it
LONGEST_EXCURSION: Final = 5  # rows that a value which otherwise rests may be elsewhere
BACK_SHARE: Final = 0.2  # of a step: who comes back to so near where it began is back
BACK_HALF: Final = 0.5  # of a step: who comes back by so much to where it usually is, as well
MOTION_SHARE: Final = 0.5  # of a step: the smallest neighbouring one of the same motion
POSITION_STEPS: Final = 5.0  # a position jumps by so many times its 99th percentile step
WHOLE_TURNS: Final = (math.tau, 360.0)
SWING_PERIOD_S: Final = 5.0  # of a longer one no single step is as a jump
BESIDE_SWINGS_S: Final = 20.0  # before and after jumps: so long six half swings of it last
SWING_HEIGHTS: Final = 2.6  # amplitudes: from one turn to the other it is 2, and noise adds some
SWING_STEP: Final = 1.3  # of the largest step of a sine
SWING_STEPS: Final = 3  # of one swing there are at least so many, none of them much smaller
MUCH_SMALLER: Final = 0.25  # between two turns of a swing the largest steps are at least half alike
SWITCHED_SHARE: Final = 0.5  # of the half swings: so many have a jump where a swing is switched


@dataclass(frozen=True)
class Jump:
    """The value changed between two rows by much more than it usually does.

    Attributes:
        after: Of an excursion the value that is farthest from the one before.
        back_s: When the next row or so was back where it had been; None for a jump that stayed.
        back: The value then.
    """

    sim_time_s: float
    before: float
    after: float
    back_s: float | None = None
    back: float | None = None


def find_jumps(frame: Frame, name: str, score: float) -> list[Jump]:
    """Steps whose modified z-score (see `features.find_spikes`) is above the score.

    Compared is with the steps that are not zero and do not come back at once, of which there have
    to be ten: for counters and commanded values a step is what they do. Of a value that otherwise
    rests only what comes back at once counts. A step next to one in the same direction and is at
    least half as large is part of a motion, however quick, and no jump. After a gap a step may be
    larger by as many times as the gap is longer than the usual interval; and the step of an angle
    over the end of its scale (pi, 180 degrees, 360 degrees) is as large as what is left of a whole
    turn. The steps of a swing are no jumps.

    What is usual is that of 16 chunks at most, at equal shares of all changes. Opened besides are
    the chunks alone that have a step that is large enough, by their statistics.

    Args:
        frame: The rows.
        name: Of the signal.
        score: How much larger than usual a step has to be.
    """
    zones = frame.zones(name)
    changes, largest = _steps_of(zones)
    parts = _sample(frame, name, zones, changes)
    interval_s = _interval_s([times for times, _ in parts])
    sizes = np.concatenate([np.zeros(0), *(_staying(*part, interval_s) for part in parts)])
    if len(sizes) < LEAST_STEPS:
        away = [
            jump
            for span in zones.spans(changes > 0)
            for jump in _excursions(*_with_margin(frame, name, span), interval_s)
        ]
        jumps = list({jump.sim_time_s: jump for jump in away}.values())
        return _without_swings(jumps, frame, name)
    limit = _limit(sizes, score)
    jumps = [
        jump
        for span in zones.spans(largest > limit)
        for jump in _wide(*_with_margin(frame, name, span), limit, interval_s)
    ]
    jumps = _without_swings(jumps, frame, name)
    if len(jumps) < 2:
        return jumps
    levels = [values for _, values in _sample(frame, name, zones, zones.value_count)]
    return list(_with_return(jumps, float(np.median(np.concatenate(levels)))))


def _sample(frame: Frame, name: str, zones: Zones, weights: Indexes) -> list[tuple[Array, Array]]:
    """Times and values of some of the chunks."""
    return [frame.rows(*span).usable(name) for span in zones.spans(_sampled(weights))]


def _interval_s(parts: Sequence[Array]) -> float:
    """The usual one between the times of several stretches."""
    intervals: Array = np.concatenate([np.zeros(0), *map(np.diff, parts)])
    moving = intervals[intervals > 0]
    return median(moving) if len(moving) else math.inf


def _steps_of(zones: Zones) -> tuple[Indexes, Array]:
    """How often a signal changes in each chunk, and its largest step, with those into the chunk."""
    changes: Indexes = np.array(zones.change_count)
    largest = np.nan_to_num(zones.largest_step)
    there = np.flatnonzero(~np.isnan(zones.first))
    into = np.abs(zones.first[there[1:]] - zones.last[there[:-1]])
    changes[there[1:]] += into > 0
    largest[there[1:]] = np.maximum(largest[there[1:]], into)
    return changes, largest


def _sampled(weights: Array | Indexes) -> Flags:
    """Some of the chunks, at equal shares of all weights; all that have one, if these are few."""
    sampled = weights > 0
    if np.count_nonzero(sampled) > SAMPLED_CHUNKS:
        reached = np.cumsum(weights)
        shares = (np.arange(SAMPLED_CHUNKS) + 0.5) / SAMPLED_CHUNKS * reached[-1]
        sampled = np.zeros(len(weights), np.bool_)
        sampled[np.searchsorted(reached, shares)] = True
    return sampled


def _with_margin(frame: Frame, name: str, span: tuple[int, int]) -> tuple[Array, Array]:
    """Times and values of some rows, and of a few before and after them."""
    start, stop = span
    return frame.rows(start - MARGIN_ROWS, stop + MARGIN_ROWS).usable(name)


def _wide(times: Array, values: Array, limit: float, interval_s: float) -> Iterator[Jump]:
    """The steps above a limit that are no part of a motion."""
    wide = np.flatnonzero(np.abs(np.diff(values)) > limit)
    far = _step(values[wide], values[wide + 1]) > limit * _intervals(times, wide, interval_s)
    for row in wide[far & ~_in_motion(values, wide)].tolist():
        yield Jump(float(times[row + 1]), float(values[row]), float(values[row + 1]))


def _limit(sizes: Array, score: float) -> float:
    """The modified z-score as a size."""
    middle = float(np.partition(sizes, len(sizes) // 2)[len(sizes) // 2])
    return middle + score * middle / 0.6745


def _staying(times: Array, values: Array, interval_s: float) -> Array:
    """The sizes of the steps that are not zero and are no part of an excursion."""
    steps = np.abs(np.diff(values))
    stays = steps > 0
    for left, back in zip(*_come_back(times, values, steps, interval_s), strict=True):
        stays[left:back] = False
    return steps[stays]


def _excursions(times: Array, values: Array, interval_s: float) -> Iterator[Jump]:
    """The values that left one that had rested and came back soon."""
    lefts, backs = _come_back(times, values, np.abs(np.diff(values)), interval_s)
    for row, back in zip(lefts.tolist(), backs.tolist(), strict=True):
        away = values[row + 1 : back]
        farthest = float(away[np.abs(away - values[row]).argmax()])
        ends = float(times[back]), float(values[back])
        yield Jump(float(times[row + 1]), float(values[row]), farthest, *ends)


def _come_back(
    times: Array, values: Array, steps: Array, interval_s: float
) -> tuple[Indexes, Indexes]:
    """Rows after which a value that had rested left, and rows in which it was back soon after.

    What was recorded on the other side of a gap is not soon after.
    """
    # At the turn of a swing two rows may meet the same value; three are a rest.
    left = np.flatnonzero((steps[2:] > 0) & (steps[1:-1] == 0) & (steps[:-2] == 0)) + 2
    left = left[_step(values[left], values[left + 1]) > 0]
    backs = np.zeros(len(left), np.intp)
    for later in range(LONGEST_EXCURSION + 1, 1, -1):
        after = np.minimum(left + later, len(values) - 1)
        is_back = (values[after] == values[left]) & (after == left + later)
        backs[is_back] = after[is_back]
    gaps = gap_borders(times, interval_s)
    is_soon = np.searchsorted(gaps, left, "right") == np.searchsorted(gaps, backs, "right")
    is_soon &= backs > 0
    return left[is_soon], backs[is_soon]


def are_usual(jumps: Sequence[Jump], rows: int) -> bool:
    """Whether there are so many of them that they are how the signal is."""
    return len(jumps) > max(3, MOST_JUMPS_SHARE * rows)


def _in_motion(values: Array, rows: Indexes) -> Flags:
    """Whether the step after each of those rows goes on as the step before or after it goes."""
    steps = np.pad(np.diff(values), 1)
    here = steps[rows + 1]
    neighbours = np.maximum(steps[rows] * np.sign(here), steps[rows + 2] * np.sign(here))
    return neighbours >= MOTION_SHARE * np.abs(here)


def _without_swings(jumps: Sequence[Jump], frame: Frame, name: str) -> list[Jump]:
    """Those that are no steps of a swing: fast for its rows, or switched from side to side."""
    left: list[Jump] = []
    for near in _near_each_other(jumps):
        ends_s = near[0].sim_time_s - BESIDE_SWINGS_S, near[-1].sim_time_s + BESIDE_SWINGS_S
        left += _none_of_swings(near, *frame.between(*ends_s).usable(name))
    return left


def _near_each_other(jumps: Sequence[Jump]) -> Iterator[Sequence[Jump]]:
    """Groups of them, so far apart that no swing reaches from one to the next."""
    times_s = np.array([jump.sim_time_s for jump in jumps])
    ends = np.flatnonzero(np.diff(times_s) > 2 * BESIDE_SWINGS_S) + 1
    for start, stop in pairwise([0, *ends.tolist(), len(jumps)] if jumps else ()):
        yield jumps[start:stop]


def _none_of_swings(jumps: Sequence[Jump], times: Array, values: Array) -> Sequence[Jump]:
    if not any(_has_its_like(jump, values) for jump in jumps):
        return jumps
    interval_s = usual_interval_s(times) or 0.0
    left = list(jumps)
    for swing in find_swings(
        times, values, least_half_swings=LEAST_HALF_SWINGS, longest_period_s=SWING_PERIOD_S
    ):
        own = [jump for jump in left if _may_be_of(swing, jump)]
        if len(own) < SWITCHED_SHARE * swing.half_swings:
            angle = min(math.pi / 2, math.pi * interval_s / swing.period_s)
            limit = SWING_STEP * 2 * swing.amplitude * math.sin(angle)
            own = [jump for jump in own if abs(jump.after - jump.before) < limit]
        left = [jump for jump in left if jump not in own]
    return left


def _has_its_like(jump: Jump, values: Array) -> bool:
    """Whether there are as many steps about as large as the least of swings has, its own too."""
    alike = np.abs(np.diff(values)) >= MUCH_SMALLER * abs(jump.after - jump.before)
    return int(np.count_nonzero(alike)) >= SWING_STEPS


def _may_be_of(swing: Swing, jump: Jump) -> bool:
    """Whether it lies in the swing, whose ends are known to half a period, and is no higher."""
    about_s = swing.period_s / 2
    inside = swing.start_s - about_s <= jump.sim_time_s <= swing.end_s + about_s
    return inside and abs(jump.after - jump.before) < SWING_HEIGHTS * swing.amplitude


def _intervals(times: Array, rows: Indexes, interval_s: float) -> Array:
    """How many usual intervals, at least one, lie between each of those rows and the next."""
    return np.maximum(1.0, (times[rows + 1] - times[rows]) / interval_s)


def _step(before: Array, after: Array) -> Array:
    """How far it is from one to the other; the short way round where they may be angles."""
    far = np.abs(after - before)
    largest = np.maximum(np.maximum(np.abs(before), np.abs(after)), far)
    return np.min([far, *(np.where(largest <= turn, turn - far, far) for turn in WHOLE_TURNS)], 0)


def _with_return(jumps: Sequence[Jump], usual: float) -> Iterator[Jump]:
    """A jump away from where it usually is and the next one back are one.

    Usual is the median: the level at which it is for the greater share of the time. Back is also
    who comes to where it usually is, in one step of at least half the size.

    Args:
        jumps: In order.
        usual: Jumps towards it begin nothing.
    """
    index = 0
    while index < len(jumps):
        jump = jumps[index]
        following = jumps[index + 1] if index + 1 < len(jumps) else None
        if following is not None and _is_excursion(jump, following, usual):
            farthest = max(jump.after, following.before, key=lambda each: abs(each - jump.before))
            yield Jump(
                jump.sim_time_s, jump.before, farthest, following.sim_time_s, following.after
            )
            index += 2
        else:
            yield jump
            index += 1


def _is_excursion(jump: Jump, following: Jump, usual: float) -> bool:
    """Whether one leads away from where it usually is, and the other from there back."""
    size, way_back = jump.after - jump.before, following.before - following.after
    if abs(jump.after - usual) < abs(jump.before - usual):
        return False
    if abs(following.after - jump.before) < BACK_SHARE * abs(size):
        return True
    from_there = abs(following.before - jump.after) < BACK_SHARE * abs(size)
    nearer = abs(following.after - usual) < abs(following.before - usual)
    return from_there and nearer and way_back / size >= BACK_HALF


def find_leaps(
    frame: Frame, x: str, y: str, metres: tuple[float, float], at_least_m: float
) -> list[tuple[float, float]]:
    """Times and lengths of steps of a position that no driving explains.

    Longer than `at_least_m`, and than five times the 99th percentile of all steps; after a gap, by
    as many times as it is longer than the usual interval.

    Args:
        frame: The rows.
        x: The name of one direction.
        y: That of the other.
        metres: What one of the unit of each is in metres.
        at_least_m: Shorter ones are none.
    """
    zones = frame.zones(x), frame.zones(y)
    along_x, along_y = (_steps_of(each)[1] * unit for each, unit in zip(zones, metres, strict=True))
    has_gaps = (zones[0].value_count + zones[1].value_count) < 2 * zones[0].row_count
    # After a row that lacks one of them, the step is that of several rows.
    has_gaps |= np.append(False, has_gaps[:-1])
    long = zones[0].spans((np.hypot(along_x, along_y) > at_least_m) | has_gaps)
    if not long:
        return []
    sample = [
        _way(frame.rows(*span), x, y, metres)
        for span in zones[0].spans(_sampled(zones[0].value_count))
    ]
    interval_s = _interval_s([times for times, _ in sample])
    steps = np.concatenate([np.zeros(0), *(steps for _, steps in sample)])
    place = min(len(steps) - 1, int(0.99 * len(steps)))
    usual_m = float(np.partition(steps, place)[place]) if len(steps) > 100 else 0.0
    limit_m = max(at_least_m, POSITION_STEPS * usual_m)
    leaps: dict[float, float] = {}
    for start, stop in long:
        times, steps = _way(frame.rows(start - MARGIN_ROWS, stop), x, y, metres)
        rows = np.flatnonzero(steps > limit_m)
        far = rows[steps[rows] > limit_m * _intervals(times, rows, interval_s)]
        leaps |= zip(times[far + 1].tolist(), steps[far].tolist(), strict=True)
    return sorted(leaps.items())


def _way(frame: Frame, x: str, y: str, metres: tuple[float, float]) -> tuple[Array, Array]:
    """Times of the rows that have a position, and the steps between them in metres."""
    along_x, along_y = frame.numbers(x) * metres[0], frame.numbers(y) * metres[1]
    there = np.isfinite(along_x) & np.isfinite(along_y)
    steps = np.hypot(np.diff(along_x[there]), np.diff(along_y[there]))
    return frame.times[there], steps
