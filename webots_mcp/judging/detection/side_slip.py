"""Slip of one side: its wheels turned, and that side of the robot rolled less than half as far.

A robot on wheels at its left and right goes ahead by r * (left + right) / 2 and turns by
k * (right - left). Both factors are fitted to the whole run, so neither the radius of the wheels
nor the track matters, and skid steering has a track of its own. How far it went and turned then
tells how far each side rolled.

A cell of time counts where the difference is beyond four standard deviations of what wheels and
sides usually differ by, which noise alone is in 1 of 15,000. A slip takes 3 s, at least two such
cells in a row, so that chance makes one in 10^8 pairs of cells. In 180 recordings of healthy wheels
and tracks of 2 minutes each (`tests.cases.false_alarms`) no side was taken to slip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Flags, median, np, runs_of
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.detection.event import NotSearchableError
from webots_mcp.judging.detection.search import Search, places_in
from webots_mcp.judging.detection.standstill import ON_THE_SPOT
from webots_mcp.signals.meaning import words_in
from webots_mcp.store.registered_signals import RegisteredSignal

SLIP_S: Final = 3.0  # for so long
SLIPS: Final = 0.5  # of the usual way per turn of the wheels
CELLS_S: Final = (0.25, 0.5, 1.0)  # over which speeds are compared; the noise chooses
_CREEPS: Final = 0.2  # of how fast its wheels turn at their best: at less little can be said
_LEAST_CELLS: Final = 6  # that tell a factor
_DIFFERS: Final = 0.2  # of the faster side: by so much a curve shows in the wheels
_TURNS_RAD: Final = 1.0  # from cell to cell, or row to row: what turns faster is not resolved
_NEAR: Final = 0.3  # of a factor: cells within that agree with it
_AGREES: Final = 0.5  # of the cells: fewer that agree with a factor tell none
_ALONG: Final = 0.9  # mean cosine between where it went and where it looked, of what only rolls
# Of the faster side: errors of the fitted factors, as with wheels of unlike radius, are less.
_FACTOR_ERROR: Final = 0.25
_DEVIATIONS: Final = 4.0  # of what the sides usually differ by
_MEDIAN_TO_SD: Final = 1.4826  # of deviations from a median, for normal noise
_ON_THE_GROUND: Final = frozenset(("wheel", "track", "caterpillar"))
_RUDDERS: Final = frozenset(("steering", "steer", "rudder", "aileron", "elevon", "fin"))


class SideSlip(NamedTuple):
    """From when to when a side slipped.

    Attributes:
        share: How far the side rolled, of what its wheels turned.
    """

    start_s: float
    end_s: float
    side: str
    share: float


class SideSlips(NamedTuple):
    """What was found in a run.

    Attributes:
        slips: Where one side slipped.
        factor: How fast the heading turns per difference of the wheels, right less left.
    """

    slips: list[SideSlip]
    factor: float


class _WheelCells(NamedTuple):
    """Means over cells of equal time, and how the robot moved from each cell to the next.

    Attributes:
        went: Velocities as complex numbers.
        turned: Turn rates in rad/s.
        course: The heading in the middle.
        left, right: Mean speeds of the wheels of each side.
    """

    starts_s: Array
    lasts_s: float
    went: Array
    turned: Array
    course: Array
    left: Array
    right: Array


def wheels_by_side(
    search: Search, wheels: Sequence[RegisteredSignal]
) -> tuple[list[RegisteredSignal], list[RegisteredSignal]]:
    """Return the wheels of the left and of the right side; none of a robot that steers or flies.

    A robot that steers turns by its nature while its wheels turn alike. Motors that are not known
    to drive wheels may be those of propellers.
    """
    steers = any(not _RUDDERS.isdisjoint(words_in(name)) for name in search.known)
    on_ground = all(
        not _ON_THE_GROUND.isdisjoint(words_in(each.name))
        or search.meanings[each.name].source in ("declared", "device")
        for each in wheels
    )
    if steers or not on_ground:
        return [], []
    left, right = (
        [each for each in wheels if (search.meanings[each.name].side or "").endswith(side)]
        for side in ("left", "right")
    )
    return left, right


def side_slips(search: Search, wheels: Sequence[RegisteredSignal], usual_m_s: float) -> SideSlips:
    """Return where one side slipped.

    Args:
        search: In which run.
        wheels: Of both sides.
        usual_m_s: How fast it goes per unit of the mean speed of its wheels.

    Raises:
        NotSearchableError: If it cannot be determined how far a side rolled; the text says why.
    """
    left, right = wheels_by_side(search, wheels)
    if not left or not right:
        raise NotSearchableError("it has no wheels that are known to be at its left and right")
    if search.motion.heading is None:
        raise NotSearchableError("no heading is recorded")
    why = "its rows are too few"
    columns = _wheel_columns(search, left, right)
    for lasts_s in CELLS_S:
        if lasts_s < 3 * search.noise.interval_s and lasts_s != CELLS_S[-1]:
            continue
        cells = _cells_of(columns, lasts_s)
        try:
            return _slips_in(cells, usual_m_s)
        except NotSearchableError as error:
            why = str(error)
    raise NotSearchableError(why)


def _wheel_columns(
    search: Search, left: Sequence[RegisteredSignal], right: Sequence[RegisteredSignal]
) -> Array:
    """Times, x, y, the course and the mean speeds of both sides, in rows that have all of them."""
    frame, position, heading = search.whole, search.motion.position, search.motion.heading
    assert position is not None and heading is not None
    rows, x, y = places_in(frame, position)
    turn = heading.turn or math.tau
    course = unwrap(frame.numbers(heading.name)[rows], turn) * math.tau / turn
    sides = (
        np.mean([frame.numbers(each.name)[rows] for each in wheels], axis=0)
        for wheels in (left, right)
    )
    columns = np.array([frame.times[rows], x, y, course, *sides])
    known = np.isfinite(columns).all(axis=0)
    return columns if known.all() else columns[:, known]


def _cells_of(columns: Array, lasts_s: float) -> _WheelCells:
    """Return means over cells of equal time.

    Args:
        columns: As `_wheel_columns` gives them.
        lasts_s: How long a cell is.
    """
    numbers = (columns[0] // lasts_s).astype(np.intp)
    firsts = np.flatnonzero(np.diff(numbers, prepend=-1))
    if len(firsts) < 2:
        return _WheelCells(np.zeros(0), lasts_s, *[np.zeros(0)] * 5)
    counts = np.diff(firsts, append=len(numbers))
    t, x, y, course, on_left, on_right = np.add.reduceat(columns, firsts, axis=1) / counts
    follows = (np.diff(numbers[firsts]) == 1) & (np.diff(t) > 0)
    row_turns = np.abs(np.diff(columns[3], append=columns[3][-1:]))
    fast = np.maximum.reduceat(row_turns, firsts) > _TURNS_RAD
    follows &= (np.abs(np.diff(course)) <= _TURNS_RAD) & ~fast[1:] & ~fast[:-1]
    steps_s = np.where(follows, np.diff(t), 1.0)
    went = (np.diff(x) + 1j * np.diff(y)) / steps_s
    turned = np.diff(course) / steps_s
    bend = np.minimum(np.abs(np.diff(course)), _TURNS_RAD) / 2  # the way along an arc is longer
    went /= np.sinc(bend / math.pi)
    moved = (went, turned, *((each[1:] + each[:-1]) / 2 for each in (course, on_left, on_right)))
    return _WheelCells(t[:-1][follows], lasts_s, *(each[follows] for each in moved))


def _slips_in(cells: _WheelCells, usual_m_s: float) -> SideSlips:
    """Return where a side rolled less than half of what it turned while the other one rolled.

    Raises:
        NotSearchableError: The motion does not follow from the wheels.
    """
    left, right = cells.left, cells.right
    fastest = np.maximum(np.abs(left), np.abs(right))
    least = _CREEPS * float(np.quantile(fastest, 0.9)) if len(fastest) else 0.0
    drives = fastest > max(least, 1e-9)
    ahead, turned, sense = _along(cells, drives)
    found: list[SideSlip] = []
    factor = _factor_of_turns(turned, left, right, drives)
    mean, apart = ahead / usual_m_s, turned / factor
    # A position that is not measured at the middle of the axle moves ahead when the robot turns.
    bends = drives & (np.abs(right - left) > _DIFFERS * fastest)
    bends &= np.abs(apart - (right - left)) <= _NEAR * np.abs(right - left)
    if np.count_nonzero(bends) >= _LEAST_CELLS:
        mean = mean - apart * median((mean - (left + right) / 2)[bends] / apart[bends])
    rolled = {"left": mean - apart / 2, "right": mean + apart / 2}
    turns = {"left": left, "right": right}
    off = {side: turns[side] - rolled[side] for side in turns}
    deviation = max(_MEDIAN_TO_SD * median(np.abs(each[drives])) for each in off.values())
    if _DEVIATIONS * deviation > (1 - SLIPS) * median(fastest[drives]):
        raise NotSearchableError("noise of position and heading hides how far each side rolled")
    known = np.maximum(_FACTOR_ERROR * fastest, _DEVIATIONS * deviation)
    slips = {
        side: _is_slipping(turns[side], rolled[side], max(least, 1e-9), known) for side in turns
    }
    rolls = {side: np.abs(each) < (1 - SLIPS) * fastest for side, each in off.items()}
    for side, other in (("left", "right"), ("right", "left")):
        lost = _without_breaks(slips[side] & rolls[other], cells.starts_s, cells.lasts_s)
        for run in runs_of(lost, cells.starts_s).spans():
            end_s = run.end_s + 2 * cells.lasts_s
            if end_s - run.start_s < SLIP_S:
                continue
            rows = slice(run.start, run.stop)
            share = float(rolled[side][rows].sum() / turns[side][rows].sum())
            half_s = cells.lasts_s / 2
            found.append(SideSlip(run.start_s + half_s, end_s - half_s, side, share))
    return SideSlips(found, sense * factor)


def _is_slipping(turns: Array, rolled: Array, least: float, apart: Array) -> Flags:
    """Whether wheels that drive turn so much faster than their side rolls."""
    lost = np.abs(turns) - np.sign(turns) * rolled
    return (np.abs(turns) > least) & (lost > np.maximum((1 - SLIPS) * np.abs(turns), apart))


def _without_breaks(holds: Flags, times: Array, lasts_s: float) -> Flags:
    """The same where a single cell between two others counts like these."""
    holds = np.array(holds)
    near = np.diff(times) <= 1.5 * lasts_s
    holds[1:-1] |= holds[:-2] & holds[2:] & near[:-1] & near[1:]
    return holds


def _along(cells: _WheelCells, drives: Flags) -> tuple[Array, Array, int]:
    """How fast it went ahead, and turned, in the sense in which the position's frame turns.

    A compass counts the other way round (then the third is -1), and headings may begin anywhere.

    Raises:
        NotSearchableError: It does not go where it faces.
    """
    mean = (cells.left + cells.right) / 2
    fastest = np.maximum(np.abs(cells.left), np.abs(cells.right))
    ahead = drives & (np.abs(mean) >= ON_THE_SPOT * fastest)
    if np.count_nonzero(ahead) < _LEAST_CELLS:
        raise NotSearchableError("its wheels drove it ahead too seldom")
    best = (0.0, 1, 0.0)
    for sense in (1, -1):
        seen = cells.went * np.exp(-1j * sense * cells.course) * np.sign(mean)
        total = complex(seen[ahead].sum())
        share = abs(total) / max(float(np.abs(seen[ahead]).sum()), 1e-12)
        best = max(best, (share, sense, float(np.angle(total))))
    share, sense, angle = best
    if share < _ALONG:
        raise NotSearchableError("it does not go where its heading says that it faces")
    along: Any = cells.went * np.exp(-1j * (sense * cells.course + angle))
    return np.asarray(along.real, np.float64), sense * cells.turned, sense


def _factor_of_turns(turned: Array, left: Array, right: Array, drives: Flags) -> float:
    """How fast it turns per difference of its wheels: the factor that most cells agree with.

    Turns on the spot tell it if there are enough, since a curve may be a slip.

    Raises:
        NotSearchableError: It turned too seldom, or not as its wheels did.
    """
    apart, fastest = right - left, np.maximum(np.abs(left), np.abs(right))
    bends = drives & (np.abs(apart) > _DIFFERS * fastest)
    on_spot = bends & (np.abs(left + right) < 2 * ON_THE_SPOT * fastest)
    wanted = on_spot if np.count_nonzero(on_spot) >= _LEAST_CELLS else bends
    if np.count_nonzero(wanted) < _LEAST_CELLS:
        raise NotSearchableError("its wheels turned it too seldom")
    factors = turned[wanted] / apart[wanted]
    near = _NEAR * np.abs(factors)
    ordered: Array = np.sort(factors)  # a table of all pairs would not fit into memory
    agree = np.searchsorted(ordered, factors + near, "right")
    agree -= np.searchsorted(ordered, factors - near)
    best = int(agree.argmax())
    if agree[best] < _AGREES * len(factors) or not factors[best]:
        raise NotSearchableError("it does not turn as its wheels do")
    return median(factors[np.abs(factors - factors[best]) <= near[best]])
