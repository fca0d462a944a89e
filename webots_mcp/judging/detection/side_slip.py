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

from webots_mcp.analysis.arrays import Array, Flags, Indexes, median, np, runs_of
from webots_mcp.judging.detection.event import NotSearchableError
from webots_mcp.judging.detection.search import Search, course_in, places_in
from webots_mcp.judging.detection.standstill import ON_THE_SPOT
from webots_mcp.signals.meaning import words_in
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.registered_signals import RegisteredSignal

SLIP_S: Final = 3.0  # for so long
SLIPS: Final = 0.5  # of the usual way per turn of the wheels
# Over which speeds are compared: each is twice the one before, and the noise chooses.
CELLS_S: Final = (0.25, 0.5, 1.0)
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
    sums: CellSums | None = None
    for lasts_s in CELLS_S:
        if lasts_s < 3 * search.noise.interval_s and lasts_s != CELLS_S[-1]:
            continue
        sums = sums.twice_as_long() if sums else CellSums.of(columns, lasts_s, columns[3])
        try:
            return _slips_in(_cells_of(sums), usual_m_s)
        except NotSearchableError as error:
            why = str(error)
    raise NotSearchableError(why)


def _wheel_columns(
    search: Search, left: Sequence[RegisteredSignal], right: Sequence[RegisteredSignal]
) -> tuple[Array, ...]:
    """Times, x, y, the course and the mean speeds of both sides, in rows that have all of them."""
    frame, position, heading = search.whole, search.motion.position, search.motion.heading
    assert position is not None and heading is not None
    rows, x, y = places_in(frame, position)
    columns = (
        frame.times,
        course_in(frame, heading),
        *(mean_speed(frame, e) for e in (left, right)),
    )
    if len(rows) < len(frame):
        columns = tuple(each[rows] for each in columns)
    times, course, on_left, on_right = columns
    return finite_rows((times, x, y, course, on_left, on_right))


def mean_speed(frame: Frame, wheels: Sequence[RegisteredSignal]) -> Array:
    """Return the mean of the speeds of some wheels in each row."""
    total = frame.bridged(wheels[0].name)
    for wheel in wheels[1:]:
        total = total + frame.bridged(wheel.name)
    return total / len(wheels) if len(wheels) > 1 else total


def finite_rows(columns: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return the rows in which all columns are finite."""
    known = np.isfinite(columns[0])
    for column in columns[1:]:
        known &= np.isfinite(column)
    return columns if known.all() else tuple(each[known] for each in columns)


class CellSums(NamedTuple):
    """Sums of columns over cells of equal time that have rows.

    Attributes:
        numbers: How many cells each one lies after the time 0.
        counts: The rows in each.
        sums: Of each column, in the order of the columns; the first are times.
        turns_fast: In which the course turns from row to row by more than can be resolved.
    """

    lasts_s: float
    numbers: Indexes
    counts: Indexes
    sums: tuple[Array, ...]
    turns_fast: Flags

    @classmethod
    def of(cls, columns: Sequence[Array], lasts_s: float, course: Array) -> CellSums:
        """Add up columns.

        Args:
            columns: The columns, of which the first are times.
            lasts_s: How long a cell is: a power of two.
            course: The course in the same rows.
        """
        numbers = np.floor(columns[0] / lasts_s).astype(np.intp)
        firsts = np.flatnonzero(np.diff(numbers, prepend=-1))
        if not len(firsts):
            return cls(lasts_s, numbers, numbers, (np.zeros(0),) * len(columns), numbers > 0)
        counts = np.diff(firsts, append=len(numbers))
        sums = tuple(np.add.reduceat(each, firsts) for each in columns)
        fast = np.abs(np.diff(course, append=course[-1:])) > _TURNS_RAD
        turns_fast = np.logical_or.reduceat(fast, firsts) if fast.any() else firsts < 0
        return cls(lasts_s, numbers[firsts], counts, sums, turns_fast)

    def twice_as_long(self) -> CellSums:
        """Return the sums over cells of twice the length."""
        numbers = self.numbers // 2
        firsts = np.flatnonzero(np.diff(numbers, prepend=-1))
        if not len(firsts):
            return self._replace(lasts_s=2 * self.lasts_s)
        sums = tuple(np.add.reduceat(each, firsts) for each in self.sums)
        counts = np.add.reduceat(self.counts, firsts)
        turns_fast = np.logical_or.reduceat(self.turns_fast, firsts)
        return CellSums(2 * self.lasts_s, numbers[firsts], counts, sums, turns_fast)

    @property
    def means(self) -> tuple[Array, ...]:
        """Of each column."""
        return tuple(each / self.counts for each in self.sums)


def _cells_of(sums: CellSums) -> _WheelCells:
    """Return how the robot moved from cell to cell.

    Args:
        sums: Of the columns that `_wheel_columns` gives.
    """
    lasts_s = sums.lasts_s
    if len(sums.numbers) < 2:
        return _WheelCells(np.zeros(0), lasts_s, *[np.zeros(0)] * 5)
    t, x, y, course, on_left, on_right = sums.means
    fast = sums.turns_fast
    follows = (np.diff(sums.numbers) == 1) & (np.diff(t) > 0)
    follows &= (np.abs(np.diff(course)) <= _TURNS_RAD) & ~fast[1:] & ~fast[:-1]
    steps_s = np.where(follows, np.diff(t), 1.0)
    went = (np.diff(x) + 1j * np.diff(y)) / steps_s
    turned = np.diff(course) / steps_s
    bend = np.minimum(np.abs(np.diff(course)), _TURNS_RAD) / 2  # the way along an arc is longer
    went /= np.sinc(bend / math.pi)
    moved: Any = (
        went,
        turned,
        *((each[1:] + each[:-1]) / 2 for each in (course, on_left, on_right)),
    )
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
