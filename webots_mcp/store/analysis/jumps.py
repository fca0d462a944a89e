"""Sudden jumps: dropouts and spikes that come back, and steps that stay."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.store.reading.gaps import rhythm_of

MOST_JUMPS_SHARE: Final = 0.1  # of the rows: more of them are how the signal is
LEAST_STEPS: Final = 10
LONGEST_EXCURSION: Final = 5  # rows that a value which otherwise rests may be elsewhere
BACK_SHARE: Final = 0.2  # of a step: who comes back to so near where it began is back
POSITION_STEPS: Final = 5.0  # a position jumps by so many times its 99th percentile step
WHOLE_TURNS: Final = (math.tau, 360.0)


@dataclass(frozen=True)
class Jump:
    """The value changed between two rows by much more than it usually does.

    Attributes:
        back_s: When the next row or so was back where it had been; None for a jump that stayed.
    """

    sim_time_s: float
    before: float
    after: float
    back_s: float | None = None


def find_jumps(
    times: Sequence[float], values: Sequence[float], score: float, usual: Sequence[float] = ()
) -> list[Jump]:
    """Steps whose modified z-score (see `features.find_spikes`) is above the score.

    Compared is with the steps that are not zero and do not come back at once, of which there have
    to be ten: for counters and commanded values a step is what they do. Of a value that otherwise
    rests only what comes back at once counts. After a gap a step may be larger by as many times as
    the gap is longer than the usual interval; and the step of an angle over the end of its scale
    (pi, 180 degrees, 360 degrees) is as large as what is left of a whole turn.

    Args:
        times: Of the values.
        values: In order.
        score: How much larger than usual a step has to be.
        usual: The sizes of steps to compare with; empty for those of the values themselves.
    """
    steps = [abs(after - before) for before, after in pairwise(values)]
    backs = _come_back(times, values, steps)
    there_and_back = {row for left, back in backs.items() for row in range(left, back)}
    sizes = sorted(
        size
        for size in usual or (s for place, s in enumerate(steps) if place not in there_and_back)
        if size > 0
    )
    if len(sizes) < LEAST_STEPS:
        return [
            Jump(times[row + 1], values[row], values[row + 1], times[back])
            for row, back in backs.items()
        ]
    median = sizes[len(sizes) // 2]
    limit = median + score * median / 0.6745
    wide = [index for index, step in enumerate(steps) if step > limit]
    found = [
        Jump(times[index + 1], values[index], values[index + 1])
        for index, intervals in zip(wide, _intervals(times, wide), strict=True)
        if _step(values[index], values[index + 1]) > limit * intervals
    ]
    return list(_with_return(found))


def are_usual(jumps: Sequence[Jump], rows: int) -> bool:
    """Whether there are so many of them that they are how the signal is."""
    return len(jumps) > max(3, MOST_JUMPS_SHARE * rows)


def _come_back(
    times: Sequence[float], values: Sequence[float], steps: Sequence[float]
) -> dict[int, int]:
    """Rows after which a value that had rested left, and rows in which it was back soon after.

    What was recorded on the other side of a gap is not soon after.
    """
    gaps_s = {gap.end_s for gap in rhythm_of(times).gaps}
    backs: dict[int, int] = {}
    for row in range(1, len(steps)):
        if steps[row] > 0 and steps[row - 1] == 0 and _step(values[row], values[row + 1]) > 0:
            soon = range(row + 2, min(row + 2 + LONGEST_EXCURSION, len(values)))
            back = next((later for later in soon if values[later] == values[row]), None)
            if back is not None and not gaps_s.intersection(times[row + 1 : back + 1]):
                backs[row] = back
    return backs


def _intervals(times: Sequence[float], indexes: Sequence[int]) -> list[float]:
    """How many usual intervals, at least one, lie between each of those rows and the next."""
    usual_s = (rhythm_of(times).interval_s if indexes else None) or math.inf
    return [max(1.0, (times[index + 1] - times[index]) / usual_s) for index in indexes]


def _step(before: float, after: float) -> float:
    """How far it is from one to the other; the short way round where they may be angles."""
    far = abs(after - before)
    turns = (turn for turn in WHOLE_TURNS if max(abs(before), abs(after)) <= turn and far <= turn)
    return min((far, *(turn - far for turn in turns)))


def _with_return(jumps: Sequence[Jump]) -> Iterator[Jump]:
    """A jump and the next one back to about where it began are one."""
    index = 0
    while index < len(jumps):
        jump = jumps[index]
        following = jumps[index + 1] if index + 1 < len(jumps) else None
        size = abs(jump.after - jump.before)
        if following is not None and abs(following.after - jump.before) < BACK_SHARE * size:
            yield Jump(jump.sim_time_s, jump.before, jump.after, following.sim_time_s)
            index += 2
        else:
            yield jump
            index += 1


def find_leaps(
    times: Sequence[float], places: Sequence[tuple[float, float]], at_least_m: float
) -> list[tuple[float, float]]:
    """Times and lengths of steps of a position that no driving explains.

    Longer than `at_least_m`, and than five times the 99th percentile of all steps; after a gap, by
    as many times as it is longer than the usual interval.
    """
    steps = [math.dist(before, after) for before, after in pairwise(places)]
    if not steps:
        return []
    usual_m = sorted(steps)[min(len(steps) - 1, int(0.99 * len(steps)))]
    limit_m = max(at_least_m, POSITION_STEPS * usual_m if len(steps) > 100 else 0.0)
    long = [index for index, step in enumerate(steps) if step > limit_m]
    return [
        (times[index + 1], steps[index])
        for index, intervals in zip(long, _intervals(times, long), strict=True)
        if steps[index] > limit_m * intervals
    ]
