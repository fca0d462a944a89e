"""How far a signal went beyond a target that had stepped, however short that was.

A well damped follower passes its target by little: one of second order passes it by a quarter of
the step where its damping ratio is 0.4, and by more with less damping. Compared is the median of
three rows, which noise takes beyond four of its standard deviations in 1 of 300 million places. Of
660 steps of healthy joints with ratios of 0.5 or more (`tests.cases.false_alarms`) none was taken
for one.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, constant_runs, median, np, runs_of

OVERSHOOTS: Final = 0.25  # of the step
_SHOWN: Final = 0.1  # of the step: from where it is beyond, and to where it is back
_LEAST_ROWS: Final = 3
_DEVIATIONS: Final = 4.0
_NOISE_OF_HIGHEST: Final = 2.0  # deviations that the highest of some tens of rows is too high
_SAME_TURN: Final = 0.4  # of a turn: of a larger step of an angle the way is not known
_NEAR: Final = 0.5  # of the step: so near the former target it has to be when the target steps
_LATER: Final = 2.0  # times as long as it took to come: then it was not the step
_LEVELS: Final = 5  # rows that tell where it was


class Overshoot(NamedTuple):
    """From when to when a signal was beyond its new target.

    Attributes:
        beyond: By how much at most, in the direction of the step.
        step: Of the target.
        target: The new one.
    """

    start_s: float
    end_s: float
    beyond: float
    step: float
    target: float

    @property
    def share(self) -> float:
        """By how much of the step."""
        return abs(self.beyond / self.step)


def overshoots_of(
    times: Array, values: Array, aims: Array, least_step: float, noise: float, turn: float | None
) -> list[Overshoot]:
    """Return where a signal passed a target that had stepped and then stayed.

    Args:
        times: Of rows in which both are known.
        values: What was measured.
        aims: The target, in the same unit.
        least_step: Smaller steps of the target are not judged.
        noise: Standard deviation of what was measured.
        turn: A whole turn of an angle.
    """
    found: list[Overshoot] = []
    stays = [each for each in constant_runs(aims, times).spans() if each.start < each.stop]
    for before, after in pairwise(stays):
        aim = float(aims[after.start])
        step = aim - float(aims[before.start])
        if abs(step) < least_step or (turn and abs(step) > _SAME_TURN * turn):
            continue
        if after.stop - after.start < 2 * _LEAST_ROWS:
            continue
        came = values[max(before.start, before.stop - _LEVELS) : before.stop]
        if abs(median(_off(came, aim - step, turn))) > _NEAR * abs(step):
            continue
        beyond = np.sign(step) * _off(values[after.start : after.stop], aim, turn)
        reached = np.flatnonzero(beyond <= 0)
        if not len(reached):  # it was beyond when the target came
            continue
        smooth = np.median(np.stack([beyond[:-2], beyond[1:-1], beyond[2:]]), axis=0)
        clock = times[after.start + 1 : after.stop - 1]
        past = runs_of(smooth > max(_SHOWN * abs(step), _DEVIATIONS * noise), clock)
        arrives = np.flatnonzero(smooth > -_SHOWN * abs(step))
        if not len(past) or not len(arrives):
            continue
        # What moves it long after it came is no overshoot.
        rise_s = float(clock[arrives[0]]) - float(times[after.start])
        first, last = int(past.starts[0]), int(past.stops[0]) - 1
        most = float(smooth[first : last + 1].max())
        soon_s = float(clock[arrives[0]]) + max(_LATER * rise_s, float(clock[1] - clock[0]))
        if float(clock[first]) > soon_s or most < OVERSHOOTS * abs(step):
            continue
        # The median of three rows cuts a short peak off; the highest of noisy ones is too high.
        highest = float(beyond[first : last + 3].max()) - _NOISE_OF_HIGHEST * noise
        by = float(np.sign(step)) * max(most, highest)
        found.append(Overshoot(float(clock[first]), float(clock[last]), by, step, aim))
    return found


def _off(values: Array, aim: float, turn: float | None) -> Array:
    """How far values are from a target; of an angle the short way round."""
    off: Array = values - aim
    return off if turn is None else np.remainder(off + turn / 2, turn) - turn / 2
