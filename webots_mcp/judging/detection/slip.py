"""`slip`: the wheels drove, and the robot did not go as far or not as straight as they turned.

How far it usually goes for a turn of its wheels follows from the whole run, so that the same is
found whatever part of it is asked about. Which side slips follows from how far each one rolled. A
robot that turns while the wheels of both sides turn alike slips on the side that goes ahead less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, median, np, runs_of
from webots_mcp.judging.detection.event import Alike, Event, NotSearchableError
from webots_mcp.judging.detection.search import (
    EventKind,
    Search,
    course_in,
    in_metres,
    is_counted_by_wheels,
    places_in,
)
from webots_mcp.judging.detection.side_slip import (
    SLIP_S,
    SLIPS,
    CellSums,
    SideSlip,
    finite_rows,
    mean_speed,
    side_slips,
    wheels_by_side,
)
from webots_mcp.judging.detection.standstill import ON_THE_SPOT
from webots_mcp.signals.meaning import words_in
from webots_mcp.signals.naming import METRES, unit_in
from webots_mcp.store.registered_signals import RegisteredSignal

_ALIKE: Final = 0.05  # of the faster side: wheels that differ by less drive straight on
_TURNED_ALONE_RAD: Final = 0.3  # in 3 s beyond what is usual, while both sides turn alike
_CELL_S: Final = 1.0  # over which headings and speeds are averaged for that
_WINDOW: Final = 3  # such cells
_CELLS_S: Final = (0.25, 0.5, 1.0, 2.0)  # over which speeds are compared; the noise chooses
_NOISE_SHARE: Final = 0.1  # of the speed that it may take
_CREEPS: Final = 0.2  # of how fast its wheels turn at their best: at less little can be said
_TURNS_RAD: Final = 1.0  # within a cell: then the straight line is shorter than the way
_LEAST_CELLS: Final = 10
_SPREAD: Final = 0.3  # of the ratios of a robot that rolls: of more they say nothing
_OFF_THE_FLOOR_M: Final = 0.3
_NOISE: Final = 6.0  # standard deviations
_OWN_HEIGHT: Final = frozenset(("altitude", "height", "m", "cm", "pressure", "gps", "position"))


class _Slip(NamedTuple):
    """Where the wheels did not carry the robot as they turned.

    Attributes:
        side: `left` or `right`; None where both sides slipped, or no side is known.
        says: What shows it, for a person.
    """

    start_s: float
    end_s: float
    side: str | None
    says: str


def slip_events(search: Search) -> Iterator[Event]:
    """Where it went less than half as far as usual for 3 s, or one side alone did."""
    wheels = [
        each
        for each in search.motion.wheels or search.motion.wheel_commands
        if each.name in search.whole
    ]
    if search.motion.position is None or not wheels or flies(search):
        raise NotSearchableError(
            "its motors lift it"
            if wheels and flies(search)
            else "publish the position and the speeds of its wheels"
        )
    if _Slip not in search.shared:
        search.shared[_Slip] = _slips_of(search, search.motion.position, wheels)
    slips, rolls, kept, no_side = search.shared[_Slip]
    search.not_searched("slip", *no_side)
    search.judged("slip", [*search.motion.position, *wheels], [search.whole.bounds_s])
    segment = search.segment
    for slip in slips:
        if slip.start_s < segment.end_s and slip.end_s >= segment.start_s:
            side = {"side": slip.side} if slip.side else {}
            yield search.event("slip", slip.start_s, slip.end_s, None, says=slip.says, **side)
    search.note_nearest("slip", SLIPS / max(kept, SLIPS), rolls)


def flies(search: Search) -> bool:
    """Whether its motors are those of propellers: none is called a wheel, and it is off the floor.

    The motors of what flies turn all the time.
    """
    motors, height = search.motion.wheels or search.motion.wheel_commands, _own_height(search)
    if height is None or any("wheel" in each.name.lower() for each in motors):
        return False
    heights = in_metres(height, search.whole.usable(height.name)[1])
    return len(heights) > 0 and median(heights) > _OFF_THE_FLOOR_M


def _own_height(search: Search) -> RegisteredSignal | None:
    """The height of the robot itself, not that of something that it lifts."""
    others = (
        search.known[name]
        for name, meaning in search.meanings.items()
        if meaning.quantity == "height" and meaning.is_sensed and name in search.whole
        if _OWN_HEIGHT.issuperset(words_in(search.own_names[name]))
    )
    return search.motion.height or next(others, None)


def _slips_of(
    search: Search,
    position: tuple[RegisteredSignal, RegisteredSignal],
    wheels: list[RegisteredSignal],
) -> tuple[list[_Slip], str, float, list[str]]:
    """Where it slipped, how it rolls otherwise, the least of that without a slip; why no side is.

    Raises:
        NotSearchableError: Its usual distance per turn is unknown.
    """
    if is_counted_by_wheels(position[0]):
        raise NotSearchableError(f"{position[0].name} is counted by the wheels themselves")
    starts_s, lasts_s, ratios = _ratios(search, position, wheels)
    known = np.isfinite(ratios)
    if np.count_nonzero(known) < _LEAST_CELLS:
        raise NotSearchableError("its wheels drove it ahead too seldom")
    usual = median(ratios[ratios >= np.nanquantile(ratios, 0.5)])
    rolled = ratios[ratios >= SLIPS * usual]
    usual = median(rolled)
    if usual <= 0 or median(np.abs(rolled - usual)) > _SPREAD * usual:
        raise NotSearchableError("its speed and that of its wheels have no fixed ratio")
    unit = "" if unit_in(wheels[0].name) in METRES else " per unit of wheel speed"
    rolls = f"rolls {usual:.3g} m/s{unit}"
    runs = runs_of(ratios < SLIPS * usual, starts_s)
    no_side = list[str]()
    of_sides, factor = list[SideSlip](), 0.0
    try:
        of_sides, factor = side_slips(search, wheels, usual)
    except NotSearchableError as error:
        if all(wheels_by_side(search, wheels)):
            no_side.append(f"not by side: {error}")
    turns = _turns_though_straight(search, wheels, factor)
    slips = [each for each in turns if not _is_within(each, of_sides)]
    slips += [_Slip(e.start_s, e.end_s, e.side, _says(e)) for e in of_sides]
    for run in runs.only(runs.durations_s + 2 * lasts_s >= SLIP_S).spans():
        least = float(np.nanmin(ratios[run.start : run.stop]))
        end_s = min(run.end_s + 2 * lasts_s, search.ended_s)
        whole = _Slip(run.start_s, end_s, None, f"{rolls}, then {least:.3g}")
        slips += [] if _is_within(whole, of_sides) else [whole]
    slips.sort(key=lambda each: each.start_s)
    kept = float(np.min(rolled)) / usual
    lasts_s *= np.count_nonzero(known)
    rolls = f"{rolls} for {lasts_s:.3g} s; under {100 * SLIPS:g} % of it counts"
    return slips, rolls, kept, no_side


def _says(slip: SideSlip) -> str:
    return (
        f"the {slip.side} side slipped: it rolled {100 * max(slip.share, 0.0):.0f} % of what its "
        "wheels turned, while the other side rolled"
    )


def _is_within(slip: _Slip, others: Sequence[SideSlip]) -> bool:
    """Whether most of a slip lies in one whose side is known."""
    shared_s = (min(slip.end_s, e.end_s) - max(slip.start_s, e.start_s) for e in others)
    return any(2 * each > slip.end_s - slip.start_s for each in shared_s)


def _turns_though_straight(
    search: Search, wheels: list[RegisteredSignal], factor: float
) -> Iterator[_Slip]:
    """A robot that turned for long while the wheels of both sides turned alike: one side slips.

    Where none of its wheels has a side nothing is said.

    Args:
        search: In which run.
        wheels: Of both sides.
        factor: How fast it turns per difference of its wheels; 0 where that is not known.
    """
    heading, sides = search.motion.heading, wheels_by_side(search, wheels)
    if heading is None or not all(sides):
        return
    frame, turn = search.whole, heading.turn or math.tau
    speeds = (mean_speed(frame, each) for each in sides)
    columns = finite_rows((frame.times, course_in(frame, heading), *speeds))
    cells = CellSums.of(columns, _CELL_S, columns[1])
    if len(cells.numbers) < 2:
        return
    t, course, left, right = cells.means
    fastest, mean = np.maximum(np.abs(left), np.abs(right)), (left + right) / 2
    alike = (np.abs(left - right) <= _ALIKE * fastest) & (fastest > _CREEPS * fastest.max())
    alike = alike[1:] & alike[:-1] & (mean[1:] * mean[:-1] > 0) & (np.diff(cells.numbers) == 1)
    if not alike.any():
        return
    steps_s, apart = np.diff(t), right - left
    turned, driven = np.diff(course), (mean[1:] + mean[:-1]) / 2 * steps_s
    turned = turned - factor * (apart[1:] + apart[:-1]) / 2 * steps_s  # what wheels explain
    # Wheels of unlike radius make it turn all the time: what it does in a tenth of it is usual.
    ratios = turned[alike] / driven[alike]
    usual = float(ratios[np.argsort(np.abs(ratios))[len(ratios) // 10]])
    excess = (turned - usual * driven) * np.sign(mean[1:])
    noise = search.noise.of(heading.name) * math.tau / turn
    for sign, side in ((1, "left"), (-1, "right")):
        total = np.convolve(np.where(alike, sign * excess, -math.inf), np.ones(_WINDOW), "valid")
        far = np.flatnonzero(total > max(_TURNED_ALONE_RAD, _NOISE * noise))
        slips = np.zeros(len(alike), np.bool_)
        for at in range(_WINDOW):
            slips[far + at] = True
        for span in runs_of(slips, t[:-1]).spans():
            by = float(np.abs(turned[span.start : span.stop]).sum())
            says = (
                f"the {side} side slipped: it turned by {by:.3g} rad while the wheels of both "
                "sides turned alike"
            )
            yield _Slip(float(t[span.start]), float(t[span.stop]), side, says)


def _ratios(
    search: Search,
    position: tuple[RegisteredSignal, RegisteredSignal],
    wheels: list[RegisteredSignal],
) -> tuple[Array, float, Array]:
    """From cell to cell how far it went per turn of its wheels; NaN where these do not drive it.

    Returns:
        When each cell begins, how long cells are, and the ratios.

    Raises:
        NotSearchableError: The position is too noisy to tell how far it went.
    """
    frame = search.whole
    rows, x, y = places_in(frame, position)
    is_all = len(rows) == len(frame)
    total, fastest = np.zeros(len(rows)), np.zeros(len(rows))
    for wheel in wheels:
        speed = frame.bridged(wheel.name)
        speed = np.nan_to_num(speed if is_all else speed[rows])
        total += speed
        np.maximum(fastest, np.abs(speed), out=fastest)
    mean = total / len(wheels)
    least = max(4 * search.noise.of(wheels[0].name), _CREEPS * float(np.quantile(fastest, 0.9)))
    ahead = (np.abs(mean) >= ON_THE_SPOT * fastest) & (fastest > least)
    clock, course = frame.times, np.zeros(len(frame))
    if search.motion.heading is not None:
        course = course_in(frame, search.motion.heading)
    if not is_all:
        clock, course = clock[rows], course[rows]
    per_row_s = max(search.noise.interval_s, 1e-6)
    columns = (clock, x, y, mean, course, np.sign(mean) * ahead)
    for lasts_s in [each for each in _CELLS_S if each >= 3 * per_row_s] or _CELLS_S[-1:]:
        starts_s, ratios, went_m_s = _ratios_in(columns, lasts_s)
        noise_m_s = 1.5 * search.noise.position_m * (per_row_s / lasts_s) ** 0.5 / lasts_s
        if not len(went_m_s) or noise_m_s <= _NOISE_SHARE * median(went_m_s):
            return starts_s, lasts_s, ratios
    raise NotSearchableError(
        f"position noise of {search.noise.position_m:.2g} m at a row each {per_row_s:.3g} s hides "
        "how far it went"
    )


def _ratios_in(columns: Sequence[Array], lasts_s: float) -> tuple[Array, Array, Array]:
    """The same in cells of one length, and how fast it went in those that count.

    Args:
        columns: Times, x, y, the mean speed of the wheels, the course, and 1 or -1 where these
            drive it ahead or back; in rows with a position.
        lasts_s: How long cells are.
    """
    clock = columns[0]
    cells = np.floor(clock / lasts_s).astype(np.intp)
    starts = np.flatnonzero(np.diff(cells, prepend=-1))
    if len(starts) < 2:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    counts = np.diff(starts, append=len(clock))
    t, x, y, turned, course, driven = (np.add.reduceat(each, starts) / counts for each in columns)
    whole = (np.abs(driven) == 1) & (counts >= 2)
    both = whole[1:] & whole[:-1] & (driven[1:] == driven[:-1]) & (np.diff(cells[starts]) == 1)
    both &= np.abs(np.diff(course)) <= _TURNS_RAD
    rates = np.abs(turned[1:] + turned[:-1]) / 2 * np.diff(t)
    went_m = np.hypot(np.diff(x), np.diff(y))
    ratios = np.full(len(both), math.nan)
    ratios[both] = went_m[both] / rates[both]
    return clock[starts[:-1]], ratios, went_m[both] / np.diff(t)[both]


SLIP: Final = EventKind(
    "slip",
    "wheels turn, it goes less far",
    slip_events,
    lasts=True,
    least_s=lambda options: SLIP_S,
    ends_within_s=lambda event: 2 * _CELLS_S[-1],
    drawn=0,
    alike=Alike(lambda events, unit: "slips", sort=lambda event: event.details.get("side")),
    severity=55,
)
