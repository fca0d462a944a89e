"""`oscillation`: a signal that a robot moves with went to and fro regularly."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Final

from webots_mcp.analysis.arrays import (
    Array,
    Indexes,
    gap_borders,
    noise_of,
    np,
    usual_interval_s,
)
from webots_mcp.analysis.fast_oscillations import (
    LEAST_FAST_ROWS,
    LONGEST_FAST_ROWS,
    SwingCourse,
    course_of,
    find_fast_swings,
)
from webots_mcp.analysis.oscillations import (
    SLOW_HALF_SWINGS,
    EvenRows,
    Swing,
    swings_in,
)
from webots_mcp.analysis.summary import unwrap, usable_part
from webots_mcp.judging.detection.event import Alike, Event, NotSearchableError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.signals.meaning import Quantity, is_asked_for, words_in
from webots_mcp.signals.naming import counted, in_snake_case
from webots_mcp.store.reading.frame import Frame, ZoneMap
from webots_mcp.store.reading.segment import just_after
from webots_mcp.store.registered_signals import RegisteredSignal

LONGEST_PERIOD_S: Final = 5.0  # that always counts; longer ones where enough of them fit
GROWS: Final = 2.0  # times the amplitude at one end: then both are reported
_ENDS_WITHIN: Final = 1.5  # periods
_NAMED: Final = 3  # signals that were not searched
_QUICK_S: Final = 1.0  # a period: how quickly the body of a robot goes to and fro
_LEAST_HALVES: Final = 8  # half periods, of which growth is told
_MOST_HALVES: Final = 400  # of a long one parts of several half periods are compared
_GROWTH_DEVIATIONS: Final = 3.09  # of a rank trend: by chance once in 1,000 oscillations
_SWINGING_ANGLES: Final = frozenset[Quantity | None](("angle", "heading", "roll", "pitch", None))
# Sensors swing by nature while a robot drives.
_SWINGING: Final = re.compile(
    r"(^|[._])(heading|yaw|roll|pitch|theta|bearing|steer\w*|wheels?|motors?|speed|velocity|pose|pos"
    r"|position|odom|odometry|left|right|cmd|command\w*|error)([._]|$)",
    re.IGNORECASE,
)


def oscillation_events(search: Search) -> Iterator[Event]:
    """Of heading, wheels, speed, position, angles and the like, and of what is asked for."""
    signals = search.required_numbers()
    if search.options.signals == EventOptions.signals:
        signals = [each for each in signals if _may_swing(search, each)]
    if left := [each.name for each in search.numbers if each not in signals]:
        their = "its name does" if len(left) == 1 else "their names do"
        why = (
            f"{len(left)} of {counted(len(search.numbers), 'numeric signal')} "
            f"{'was' if len(left) == 1 else 'were'} not searched, because {their} not suggest "
            f"motion: pass signals={_passed(left)}"
        )
        if not signals:
            raise NotSearchableError(why)
        search.not_searched("oscillation", why)
    _note_periods(search)
    for name, (swing, at_start, at_end) in _found(search, signals):
        largest = _half_range(search, name, swing)
        at_start, at_end = min(at_start, largest), min(at_end, largest)
        details: dict[str, Any] = {
            "half_periods": swing.half_swings,
            "period_s": swing.period_s,
            "amplitude": min(swing.amplitude, largest),
        }
        if unit := search.known[name].unit:
            details["unit"] = unit
        if max(at_start, at_end) > GROWS * min(at_start, at_end):
            details |= {"amplitude_at_start": at_start, "amplitude_at_end": at_end}
        event = search.event("oscillation", swing.start_s, swing.end_s, name, **details)
        goes_on = search.ended_s - swing.end_s < _ends_within_s(event)
        yield replace(event, ongoing=goes_on)


def _may_swing(search: Search, signal: RegisteredSignal) -> bool:
    """Whether a signal tells of motion by its name, or is a measured height or angle.

    What flies or floats swings in height, what hangs swings in an angle.
    """
    if _SWINGING.search(in_snake_case(signal.name)):
        return True
    meaning = search.meanings[signal.name]
    if meaning.quantity == "height":
        return not is_asked_for(signal.name)
    is_angle = signal.turn is not None or angle_unit_of(signal) is not None
    is_angle &= meaning.quantity in _SWINGING_ANGLES
    return (is_angle or meaning.quantity == "angle") and not is_asked_for(signal.name)


def angle_unit_of(signal: RegisteredSignal) -> str | None:
    """Return `rad` or `deg` of what is stated or named to be measured in it; None of others."""
    if signal.stated_unit:
        return signal.stated_unit if signal.stated_unit in ("rad", "deg") else None
    words = words_in(signal.name)
    return words[-1] if words and words[-1] in ("rad", "deg") else None


def growth_begins_s(frame: Frame, event: Event, turn: float | None = None) -> float | None:
    """Return from when on an oscillation became larger and larger; None where it did not.

    Its half periods are compared by a rank test. One that was pushed once, and is as large ever
    since, has two amplitudes and does not grow. Of oscillations that keep their amplitude one in
    1,000 is said to grow (H. B. Mann, Nonparametric tests against trend, Econometrica 13, 1945).

    Args:
        frame: Rows that hold it.
        event: The oscillation.
        turn: A whole turn of an angle.
    """
    half_s = float(event.details["period_s"]) / 2
    part = frame.between(event.start_s, just_after(event.end_s))
    times, values = part.usable(event.name or "")
    if turn and len(values):
        values = unwrap(values, turn)
    lasts_s = float(times[-1] - times[0]) if len(times) else 0.0
    halves = min(int(lasts_s / half_s), _MOST_HALVES)
    if halves < _LEAST_HALVES:
        return None
    totals = np.concatenate(([0.0], np.cumsum(values)))
    firsts, stops = (np.searchsorted(times, times + each) for each in (-half_s, half_s))
    off = values - (totals[stops] - totals[firsts]) / np.maximum(stops - firsts, 1)
    moments: Array = times[0] + lasts_s / halves * np.arange(halves, dtype=np.float64)
    starts: Indexes = np.searchsorted(times, moments)
    rows = np.diff(starts, append=len(times))
    if (rows < 1).any():
        return None
    sizes: Array = np.add.reduceat(off**2, starts) / rows
    sizes, starts = sizes[1:-1], starts[1:-1]  # the mean of a whole period is not known at the ends
    halves = len(sizes)
    later: Array = np.sign(sizes[None, :] - sizes[:, None])
    score = float(np.triu(later, 1).sum())
    variance = halves * (halves - 1) * (2 * halves + 5) / 18
    if score - 1 <= _GROWTH_DEVIATIONS * math.sqrt(variance):
        return None
    bend = _bend_of(np.log(np.maximum(sizes, np.finfo(np.float64).tiny)))
    if bend is None:
        return None
    # A bend in the first period cannot be told from growth since the start.
    return float(times[starts[bend]]) if bend > 2 else event.start_s


def _bend_of(values: Array) -> int | None:
    """The place up to which values are constant, and from which they rise evenly (least squares).

    None where two constants explain them better: they rose at once.
    """
    places = np.arange(len(values), dtype=np.float64)
    left: list[float] = []
    for bend in range(len(values) - 2):
        rise = np.maximum(places - bend, 0.0)
        off = rise - rise.mean()
        slope = float((off * values).sum() / (off * off).sum())
        left.append(float(np.square(values - values.mean() - slope * off).sum()))
    steps = (_left_of(values[:at]) + _left_of(values[at:]) for at in range(1, len(values)))
    return int(np.argmin(left)) if min(left) < min(steps) else None


def _left_of(values: Array) -> float:
    return float(np.square(values - values.mean()).sum())


def _passed(names: Sequence[str]) -> str:
    """Return the first names as an argument is written, and how many more there are."""
    more = f", ... {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"[{', '.join(map(repr, names[:_NAMED]))}{more}]"


def _half_range(search: Search, name: str, swing: Swing) -> float:
    """Half of the range that the values had in a stretch: a fitted sine may reach farther."""
    signal = search.known[name]
    part = search.frame.between(swing.start_s, just_after(swing.end_s))
    numbers = part.usable(name)[1]
    if len(numbers) < 2:
        return math.inf
    if signal.turn is not None:
        numbers = unwrap(numbers, signal.turn)
    return float(np.ptp(numbers)) / 2


def _note_periods(search: Search) -> None:
    """Which periods are too long for the run to hold enough of them, and too short for its rows."""
    interval_s = usual_interval_s(search.frame.times) or 0.0
    if (slowest_s := LONGEST_FAST_ROWS * interval_s) > _QUICK_S:
        search.not_searched(
            "oscillation",
            f"a row each {interval_s:.3g} s shows periods under {slowest_s:.2g} s only where they "
            f"go on for {LEAST_FAST_ROWS * interval_s:.3g} s",
        )
    half_periods = search.options.min_half_periods
    fitting_s = 2 * search.length_s / half_periods
    if fitting_s < _longest_period_s(search):
        search.not_searched(
            "oscillation",
            f"run {search.segment.run_id} lasted only {search.length_s:.3g} s, too short for "
            f"{half_periods} half periods where a period is over {fitting_s:.2g} s",
        )


def _longest_period_s(search: Search) -> float:
    if (asked_s := search.options.oscillation_period_s) is not None:
        return asked_s
    times = search.frame.times
    length_s = float(times[-1] - times[0]) if len(times) else 0.0
    return max(LONGEST_PERIOD_S, 2 * length_s / SLOW_HALF_SWINGS)


def _found(
    search: Search, signals: Sequence[RegisteredSignal]
) -> Iterator[tuple[str, SwingCourse]]:
    """The swings of each signal, in the chunks in which it changes."""
    frame, least = search.frame, search.options.min_half_periods
    asked = least, _longest_period_s(search)
    shared: dict[tuple[int, int], tuple[Frame, EvenRows]] = {}  # by many signals
    for signal in search.in_time("oscillation", signals):
        for span in _changing(frame.zone_map(signal.name), least):
            if span not in shared:
                part = frame.rows(*span)
                shared[span] = part, EvenRows.of(part.times)
            part, rows = shared[span]
            times, numbers = usable_part(part.times, part.bridged(signal.name, signal.turn))
            rows = rows if len(times) == len(part) else EvenRows.of(times)
            courses = _Courses(rows, times, numbers)
            found = [courses.of(swing) for swing in swings_in(rows, numbers, *asked)]
            fast = (
                SwingCourse(swing, swing.amplitude, swing.amplitude)
                for swing in find_fast_swings(rows, numbers, least)
                if not any(_overlap(swing, each.swing) for each in found)
            )
            yield from ((signal.name, each) for each in (*found, *fast))


class _Courses:
    """The rows of a signal in which oscillations are followed to their ends."""

    def __init__(self, rows: EvenRows, times: Array, values: Array) -> None:
        self._rows, self._times, self._values = rows, times, values
        self._noises: dict[int, float] = {}

    @cached_property
    def _edges(self) -> Indexes:
        """Where stretches without a gap begin, and the number of rows."""
        is_paused = self._rows.moving is not None
        gaps = gap_borders(self._times, self._rows.interval_s) if is_paused else self._rows.borders
        return np.concatenate(([0], gaps, [len(self._times)]))

    def of(self, swing: Swing) -> SwingCourse:
        """The whole of an oscillation, in the rows around it without a gap."""
        row = int(np.searchsorted(self._times, swing.start_s))
        at = int(np.searchsorted(self._edges, row, "right")) - 1
        part = slice(int(self._edges[at]), int(self._edges[at + 1]))
        times, values = self._times[part], self._values[part]
        if swing.end_s > times[-1]:  # it goes on after a gap
            return SwingCourse(swing, swing.amplitude, swing.amplitude)
        if at not in self._noises:
            self._noises[at] = noise_of(values)
        return course_of(swing, times, values, self._noises[at])


def _overlap(one: Swing, other: Swing) -> bool:
    return one.start_s <= other.end_s and other.start_s <= one.end_s


def _changing(zones: ZoneMap, least: int) -> list[tuple[int, int]]:
    """Rows of the chunks in which the value changes, and of those next to them."""
    if int(zones.change_count.sum()) < least:
        return []
    changes = np.pad(zones.change_count > 0, 1)
    return zones.spans(changes[:-2] | changes[1:-1] | changes[2:])


def _ends_within_s(event: Event) -> float:
    return _ENDS_WITHIN * event.details["period_s"]


OSCILLATION: Final = EventKind(
    "oscillation",
    "of heading, wheels or commands",
    oscillation_events,
    lasts=True,
    around_s=lambda options: (
        options.min_half_periods * (options.oscillation_period_s or LONGEST_PERIOD_S) / 2
    ),
    ends_within_s=_ends_within_s,
    of_numbers=True,
    drawn=3,
    alike=Alike(lambda events, unit: "oscillations"),
    severity=50,
)
