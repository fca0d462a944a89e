"""Sudden jumps: dropouts and spikes that come back, and steps that stay."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.analysis.rhythm import gap_borders, usual_interval_s
from webots_mcp.store.analysis.swings import LEAST_HALF_SWINGS, Swing, find_swings

MOST_JUMPS_SHARE: Final = 0.1  # of the rows: more of them are how the signal is
LEAST_STEPS: Final = 10
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


def find_jumps(times: Array, values: Array, score: float, usual: Array | None = None) -> list[Jump]:
    """Steps whose modified z-score (see `features.find_spikes`) is above the score.

    Compared is with the steps that are not zero and do not come back at once, of which there have
    to be ten: for counters and commanded values a step is what they do. Of a value that otherwise
    rests only what comes back at once counts. A step next to one in the same direction and is at
    least half as large is part of a motion, however quick, and no jump. After a gap a step may be
    larger by as many times as the gap is longer than the usual interval; and the step of an angle
    over the end of its scale (pi, 180 degrees, 360 degrees) is as large as what is left of a whole
    turn. The steps of a swing are no jumps.

    Args:
        times: Of the values.
        values: In order.
        score: How much larger than usual a step has to be.
        usual: Values one after the other whose steps and level to compare with; None for the same.
    """
    steps = np.abs(np.diff(values))
    backs = _come_back(times, values, steps)
    sizes = steps[_stay(backs, len(steps))] if usual is None else np.abs(np.diff(usual))
    sizes = sizes[sizes > 0]
    if len(sizes) < LEAST_STEPS:
        away = [_excursion(times, values, row, back) for row, back in backs.items()]
        return _without_swings(away, times, values)
    limit = _limit(sizes, score)
    wide = np.flatnonzero(steps > limit)
    far = _step(values[wide], values[wide + 1]) > limit * _intervals(times, wide)
    alone = far & ~_in_motion(values, wide)
    jumps = [_jump(times, values, row) for row in wide[alone].tolist()]
    jumps = _without_swings(jumps, times, values)
    if len(jumps) < 2:
        return jumps
    return list(_with_return(jumps, float(np.median(values if usual is None else usual))))


def least_jump(usual: Array, score: float) -> float:
    """How large a step has to be at least to be a jump among such values; 0 where they rest."""
    sizes = np.abs(np.diff(usual))
    return _limit(sizes[sizes > 0], score)


def _limit(sizes: Array, score: float) -> float:
    """The modified z-score as a size; 0 of too few sizes."""
    if len(sizes) < LEAST_STEPS:
        return 0.0
    median = float(np.partition(sizes, len(sizes) // 2)[len(sizes) // 2])
    return median + score * median / 0.6745


def are_usual(jumps: Sequence[Jump], rows: int) -> bool:
    """Whether there are so many of them that they are how the signal is."""
    return len(jumps) > max(3, MOST_JUMPS_SHARE * rows)


def _jump(times: Array, values: Array, row: int) -> Jump:
    """The one after that row."""
    return Jump(float(times[row + 1]), float(values[row]), float(values[row + 1]))


def _excursion(times: Array, values: Array, row: int, back: int) -> Jump:
    """The one after that row, from which it was back in a later one."""
    away = values[row + 1 : back]
    farthest = float(away[np.abs(away - values[row]).argmax()])
    ends = float(times[back]), float(values[back])
    return Jump(float(times[row + 1]), float(values[row]), farthest, *ends)


def _come_back(times: Array, values: Array, steps: Array) -> dict[int, int]:
    """Rows after which a value that had rested left, and rows in which it was back soon after.

    What was recorded on the other side of a gap is not soon after.
    """
    # At the turn of a swing two rows may meet the same value; three are a rest.
    left = np.flatnonzero((steps[2:] > 0) & (steps[1:-1] == 0) & (steps[:-2] == 0)) + 2
    left = left[_step(values[left], values[left + 1]) > 0]
    backs: dict[int, int] = {}
    for later in range(LONGEST_EXCURSION + 1, 1, -1):
        within = left[left + later < len(values)]
        back = within[values[within + later] == values[within]]
        backs.update(zip(back.tolist(), (back + later).tolist(), strict=True))
    gaps = gap_borders(times, usual_interval_s(times) or math.inf)
    passed: list[int] = np.searchsorted(gaps, np.arange(len(times)), "right").tolist()
    return {row: backs[row] for row in sorted(backs) if passed[backs[row]] == passed[row]}


def _stay(backs: dict[int, int], steps: int) -> Flags:
    """Which steps are no part of an excursion."""
    stays = np.ones(steps, np.bool_)
    for left, back in backs.items():
        stays[left:back] = False
    return stays


def _in_motion(values: Array, rows: Indexes) -> Flags:
    """Whether the step after each of those rows goes on as the step before or after it goes."""
    steps = np.pad(np.diff(values), 1)
    here = steps[rows + 1]
    neighbours = np.maximum(steps[rows] * np.sign(here), steps[rows + 2] * np.sign(here))
    return neighbours >= MOTION_SHARE * np.abs(here)


def _without_swings(jumps: Sequence[Jump], times: Array, values: Array) -> list[Jump]:
    """Those that are no steps of a swing: fast for its rows, or switched from side to side."""
    if not jumps:
        return []
    ends_s = jumps[0].sim_time_s - BESIDE_SWINGS_S, jumps[-1].sim_time_s + BESIDE_SWINGS_S
    part = slice(*np.searchsorted(times, ends_s))
    if not any(_has_its_like(jump, values[part]) for jump in jumps):
        return list(jumps)
    interval_s = usual_interval_s(times[part]) or 0.0
    left = list(jumps)
    for swing in find_swings(
        times[part],
        values[part],
        least_half_swings=LEAST_HALF_SWINGS,
        longest_period_s=SWING_PERIOD_S,
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


def _intervals(times: Array, rows: Indexes) -> Array:
    """How many usual intervals, at least one, lie between each of those rows and the next."""
    usual_s = usual_interval_s(times) if len(rows) else None
    return np.maximum(1.0, (times[rows + 1] - times[rows]) / (usual_s or math.inf))


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
    times: Array, x: Array, y: Array, at_least_m: float, rows: int | None = None
) -> list[tuple[float, float]]:
    """Times and lengths of steps of a position that no driving explains.

    Longer than `at_least_m`, and than five times the 99th percentile of all steps; after a gap, by
    as many times as it is longer than the usual interval.
    """
    if len(times) < 2:
        return []
    steps = np.hypot(np.diff(x), np.diff(y))
    count = len(steps) if rows is None else max(rows - 1, len(steps))
    place = len(steps) - count + min(count - 1, int(0.99 * count))
    usual_m = float(np.partition(steps, place)[place]) if place >= 0 else 0.0
    limit_m = max(at_least_m, POSITION_STEPS * usual_m if count > 100 else 0.0)
    long = np.flatnonzero(steps > limit_m)
    long = long[steps[long] > limit_m * _intervals(times, long)]
    return list(zip(times[long + 1].tolist(), steps[long].tolist(), strict=True))
