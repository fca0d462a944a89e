"""`slip`: the wheels drove, and the robot did not go as far or not as straight as they turned.

How far it usually goes for a turn of its wheels follows from the whole run, so that the same is
found whatever part of it is asked about. A robot that turns while the wheels of both sides turn
alike slips on the side that goes ahead less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, median, np, runs_of
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.detection.event import Alike, Event, NotSearchableError
from webots_mcp.judging.detection.search import EventKind, Search, in_metres, places_in
from webots_mcp.judging.detection.standstill import ON_THE_SPOT
from webots_mcp.signals.meaning import words_in
from webots_mcp.signals.naming import METRES, unit_in
from webots_mcp.store.registered_signals import RegisteredSignal

SLIP_S: Final = 3.0  # for so long
_ALIKE: Final = 0.05  # of the faster side: wheels that differ by less drive straight on
_TURNED_ALONE_RAD: Final = 0.3  # in 3 s, while both sides turn alike
SLIPS: Final = 0.5  # of the usual way per turn of the wheels
_CELLS_S: Final = (0.25, 0.5, 1.0, 2.0)  # over which speeds are compared; the noise chooses
_NOISE_SHARE: Final = 0.1  # of the speed that it may take
_CREEPS: Final = 0.2  # of how fast its wheels turn at their best: at less little can be said
_TURNS_RAD: Final = 1.0  # within a cell: then the straight line is shorter than the way
_LEAST_CELLS: Final = 10
_SPREAD: Final = 0.3  # of the ratios of a robot that rolls: of more they say nothing
_BY_WHEELS: Final = ("odom", "odometry")
_OFF_THE_FLOOR_M: Final = 0.3
_NOISE: Final = 6.0  # standard deviations
_OWN_HEIGHT: Final = frozenset(("altitude", "height", "m", "cm", "pressure", "gps", "position"))
_ON_THE_GROUND: Final = frozenset(("wheel", "track", "caterpillar"))
_RUDDERS: Final = frozenset(("steering", "rudder", "aileron", "elevon", "fin"))


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
            else "no position, or no speeds of its wheels, are recorded: publish them"
        )
    if _Slip not in search.shared:
        search.shared[_Slip] = _slips_of(search, search.motion.position, wheels)
    slips, rolls, kept = search.shared[_Slip]
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
        if _OWN_HEIGHT.issuperset(words_in(name))
    )
    return search.motion.height or next(others, None)


def _slips_of(
    search: Search,
    position: tuple[RegisteredSignal, RegisteredSignal],
    wheels: list[RegisteredSignal],
) -> tuple[list[_Slip], str, float]:
    """Where it slipped, how it rolls otherwise, and the least of that without a slip.

    Raises:
        NotSearchableError: It cannot be told how far it usually goes.
    """
    if position[0].name.partition(".")[0] in _BY_WHEELS:
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
    slips = list(_turns_though_straight(search, wheels))
    for run in runs.only(runs.durations_s + 2 * lasts_s >= SLIP_S).spans():
        least = float(np.nanmin(ratios[run.start : run.stop]))
        end_s = min(run.end_s + 2 * lasts_s, search.ended_s)
        slips.append(_Slip(run.start_s, end_s, None, f"{rolls}, then {least:.3g}"))
    slips.sort()
    kept = float(np.min(rolled)) / usual
    lasts_s *= np.count_nonzero(known)
    return slips, f"{rolls} for {lasts_s:.3g} s; under {100 * SLIPS:g} % of it counts", kept


def _turns_though_straight(search: Search, wheels: list[RegisteredSignal]) -> Iterator[_Slip]:
    """A robot that turned for long while the wheels of both sides turned alike: one side slips.

    A robot that steers turns so by nature, and where none of its wheels has a side nothing is said.
    Motors that are not known to drive wheels may be those of propellers.
    """
    heading = search.motion.heading
    sides = {
        side: [w for w in wheels if (search.meanings[w.name].side or "").endswith(side)]
        for side in ("left", "right")
    }
    steers = any(not _RUDDERS.isdisjoint(words_in(name)) for name in search.known)
    on_ground = all(
        not _ON_THE_GROUND.isdisjoint(words_in(each.name))
        or search.meanings[each.name].source in ("declared", "device")
        for each in wheels
    )
    if heading is None or steers or not on_ground or not all(sides.values()):
        return
    frame, turn = search.whole, heading.turn or math.tau
    course = unwrap(frame.numbers(heading.name), turn) * math.tau / turn
    left, right = (
        np.mean([frame.numbers(each.name) for each in wheels], axis=0) for wheels in sides.values()
    )
    fastest = np.maximum(np.abs(left), np.abs(right))
    alike = (np.abs(left - right) <= _ALIKE * fastest) & (fastest > 0) & np.isfinite(course)
    noise = search.noise.of(heading.name) * math.tau / turn
    for rest in runs_of(alike, frame.times).spans():
        if rest.end_s - rest.start_s < SLIP_S:
            continue
        part = course[rest.start : rest.stop]
        clock = frame.times[rest.start : rest.stop]
        cells = np.searchsorted(clock, np.arange(clock[0], clock[-1], SLIP_S))
        turned = np.diff(part[cells])
        edges = clock[cells]
        for sign in (-1, 1):
            far = sign * turned > max(_TURNED_ALONE_RAD, _NOISE * noise)
            for span in runs_of(far, edges[:-1]).spans():
                side = "left" if sign > 0 else "right"
                total = float(np.abs(turned[span.start : span.stop]).sum())
                says = (
                    f"the {side} side slipped: it turned by {total:.3g} rad while the wheels of "
                    "both sides turned alike"
                )
                yield _Slip(float(edges[span.start]), float(edges[span.stop]), side, says)


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
    rows, x, y = places_in(search.whole, position)
    clock = search.whole.times[rows]
    speeds = np.nan_to_num([search.whole.numbers(each.name)[rows] for each in wheels])
    mean, fastest = speeds.mean(axis=0), np.abs(speeds).max(axis=0)
    least = max(4 * search.noise.of(wheels[0].name), _CREEPS * float(np.quantile(fastest, 0.9)))
    ahead = (np.abs(mean) >= ON_THE_SPOT * fastest) & (fastest > least)
    course = np.zeros(len(rows))
    if (heading := search.motion.heading) is not None:
        turn = heading.turn or math.tau
        course = unwrap(search.whole.numbers(heading.name)[rows], turn) * math.tau / turn
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
    cells = (clock // lasts_s).astype(np.intp)
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
