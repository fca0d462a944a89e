"""`jump`: a value, or the position, changed at once by much more than it usually does."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.analysis.arrays import (
    Array,
    Flags,
    Indexes,
    gap_borders,
    in_order,
    median,
    np,
    usual_interval_s,
)
from webots_mcp.analysis.oscillations import (
    LEAST_HALF_SWINGS,
    Swing,
    find_swings,
)
from webots_mcp.judging.detection.event import (
    Alike,
    Event,
)
from webots_mcp.judging.detection.search import EventKind, Search, were_not_searched
from webots_mcp.signals.meaning import ANGLES, INERT, Meaning
from webots_mcp.signals.naming import metres_in
from webots_mcp.store.reading.frame import Frame, ZoneMap

REACH_S: Final = 2.0  # before and after a range: whether a value comes back shows there
MOST_JUMPS_SHARE: Final = 0.1  # of the rows: more of them are how the signal is
LEAST_STEPS: Final = 10
SAMPLED_CHUNKS: Final = 16  # that tell what is usual
CERTAINLY_LESS: Final = 0.5  # of what one chunk says is large: with less a signal has no jump
MARGIN_ROWS: Final = 10  # around steps: what an excursion takes, and the motion next to it
LONGEST_EXCURSION: Final = 5  # rows that a value which otherwise rests may be elsewhere
RESTING_SHARE: Final = 1e-4  # of the largest step: a smaller usual one is that of who rests
LONGEST_LOSS: Final = 8  # rows that are lost one after the other
BACK_SHARE: Final = 0.2  # of a step: who comes back to so near where it began is back
BACK_HALF: Final = 0.5  # of a step: a step so large back to where it usually is, too
MOTION_SHARE: Final = 0.5  # of a step: the smallest neighbouring one of the same motion
POSITION_STEPS: Final = 5.0  # a position jumps by so many times its 99th percentile step
WHOLE_TURNS: Final = (math.tau, 360.0)
COUNTERS: Final = tuple(float(2**bits) for bits in (8, 10, 12, 14, 15, 16, 24, 32))
NEARLY_A_TURN: Final = 0.9
LEAST_UNITS: Final = 1.5  # of the last digit: a single one is its rounding
MOST_DIGITS: Final = 9
SAME_END: Final = 0.9  # of the pulses of a signal: so many go to one end of its range
SWING_PERIOD_S: Final = 5.0  # of a longer one no single step is as a jump
BESIDE_SWINGS_S: Final = 20.0  # before and after jumps: so long six half swings of it last
SWING_HEIGHTS: Final = 2.6  # amplitudes: from one turn to the other it is 2, and noise adds some
SWING_STEP: Final = 1.3  # of the largest step of a sine
SWING_STEPS: Final = 3  # of one swing there are at least so many, none of them much smaller
MUCH_SMALLER: Final = 0.25  # between two turns of a swing the largest steps are at least half alike
SWITCHED_SHARE: Final = 0.5  # of the half swings: so many have a jump where a swing is switched
_ALIKE_SHARE: Final = 0.05  # of a dropout's size: so near each other they go to the same value


def jump_events(search: Search) -> Iterator[Event]:
    """Dropouts and spikes that come back, steps that stay, and leaps of the position."""
    position, frame = search.motion.position or (), search.frame
    numbers = search.numbers if position else search.required_quantities()
    signals = [
        each
        for each in numbers
        if each.kind != "angle" and not each.is_index and each not in position
    ]
    seldom = list[str]()
    for signal in search.in_time("jump", signals):
        meaning = search.meanings[signal.name]
        turns = _turns_of(meaning)
        may_step = meaning.sets or meaning.quantity not in INERT
        jumps, largest, least = find_jumps(
            frame, signal.name, search.options.jump_min_score, turns, may_step=may_step
        )
        jumps = [each for each in jumps if not _is_wrap(each, meaning)]
        jumps = _above_resolution(jumps, frame, signal.name)
        if not jumps and largest < least < math.inf:
            unit = f" {signal.unit}" if signal.unit else ""
            near = f"{signal.name}: largest step was {largest:.2g}{unit}, one over {least:.2g}"
            search.note_nearest("jump", largest / least, f"{near}{unit} counts")
        rows = int(frame.zone_map(signal.name).value_count.sum())
        if len(jumps) > max(3, MOST_JUMPS_SHARE * rows):
            dropouts = _to_one_end(jumps, frame, signal.name)
            yield from (_event(search, signal.name, each) for each in dropouts)
            if dropouts:
                continue
            many = f"{were_not_searched([signal.name])}: its {len(jumps)} large steps are normal"
            search.not_searched("jump", many)
            continue
        if not jumps and largest and least == math.inf and not (meaning.sets or _steps(meaning)):
            seldom.append(signal.name)
        yield from (_event(search, signal.name, each) for each in jumps)
    if seldom:
        few = f"{were_not_searched(seldom)}: changed too seldom to tell what is usual"
        search.not_searched("jump", few)
    if position:
        x, y = (each.name for each in position)
        scale = position[0].metres / metres_in(x)  # other than 1 where a unit was declared
        for time_s, length_m in find_leaps(frame, x, y, search.options.jump_m / scale):
            yield search.event("jump", time_s, time_s, "position", distance_m=scale * length_m)


def _event(search: Search, name: str, jump: Jump) -> Event:
    details = {"before": jump.before, "after": jump.after}
    details |= {} if jump.back is None else {"back": jump.back}
    return search.event("jump", jump.start_s, jump.end_s, name, **details)


def _steps(meaning: Meaning) -> bool:
    """Whether it changes in steps by nature."""
    return meaning.quantity in ("count", "flag", "mode")


def _turns_of(meaning: Meaning) -> tuple[float, ...]:
    """At which values it may begin again at 0: whole turns, and the ends of counters."""
    return (*WHOLE_TURNS, *COUNTERS) if meaning.quantity == "count" else WHOLE_TURNS


def _is_wrap(jump: Jump, meaning: Meaning) -> bool:
    """Whether an angle crossed the end of its scale; what leaps by a whole turn is an angle."""
    if meaning.quantity is not None and meaning.quantity not in ANGLES:
        return False
    largest = max(abs(jump.before), abs(jump.after), jump.size)
    return any(largest <= turn and jump.size >= NEARLY_A_TURN * turn for turn in WHOLE_TURNS)


def _above_resolution(jumps: Sequence[Jump], frame: Frame, name: str) -> Sequence[Jump]:
    """Those of more than a few units of the last digit that the signal has."""
    if not jumps:
        return jumps
    spans = _sampled(frame.zone_map(name), frame.zone_map(name).value_count, 1)
    values = np.concatenate([np.zeros(0), *(frame.rows(*span).usable(name)[1] for span in spans)])
    unit = resolution_of(values)
    return [each for each in jumps if each.size > LEAST_UNITS * unit]


def resolution_of(values: Array) -> float:
    """The unit of the last decimal digit of some values; 0 of those that are not rounded."""
    for digits in range(MOST_DIGITS + 1):
        scaled: Array = values * 10.0**digits
        off: Array = np.abs(scaled - np.rint(scaled))
        if np.all(off <= 1e-6 * np.maximum(1.0, np.abs(scaled) * 1e-6)):
            return float(10**-digits)
    return 0.0


def _to_one_end(jumps: Sequence[Jump], frame: Frame, name: str) -> Sequence[Jump]:
    """Those that all went to the same end of the signal's range and came back, however many."""
    pulses = [each for each in jumps if each.back is not None]
    if not pulses:
        return []
    zones = frame.zone_map(name)
    ends = (float(np.nanmin(zones.min)), float(np.nanmax(zones.max)))
    found: list[Jump] = []
    for end in ends:
        own = [each for each in pulses if each.after == end]
        if len(own) >= SAME_END * len(pulses):
            found = own
    return found


@dataclass(frozen=True)
class Jump:
    """The value changed between two rows by much more than it usually does.

    Attributes:
        start_s: Of the row with another value.
        end_s: When the next row or so was back where it had been; the same of a jump that stayed.
        after: Of an excursion the value that is farthest from the one before.
        back: The value when it was back.
    """

    start_s: float
    end_s: float
    before: float
    after: float
    back: float | None = None

    @property
    def size(self) -> float:
        """How far it is from the one value to the other."""
        return abs(self.after - self.before)


def find_jumps(
    frame: Frame,
    name: str,
    score: float,
    turns: tuple[float, ...] = WHOLE_TURNS,
    *,
    may_step: bool = False,
) -> tuple[list[Jump], float, float]:
    """Steps whose modified z-score (see `find_spikes`) is above the score; the largest step of all;
    and what a step has to be larger than.

    The usual step is that of all steps that are not zero and do not come back at once. There have
    to be ten of them: counters and commanded values change by steps all the time. Of a value that
    otherwise rests only what comes back at once counts. A value that may step also rests if its
    steps are ten thousand times its noise: in a physics engine nothing is quite still. A step next
    to one that has the same direction and is at least half as large is part of a motion, however
    quick, and no jump. After a gap a step may be larger by as many times as the gap is longer than
    the usual interval. The step of an angle over the end of its scale (pi, 180 degrees, 360
    degrees) is as large as what is left of a whole turn. The steps of a swing are no jumps.

    What is usual is estimated from at most 16 chunks, at equal shares of all changes; one is enough
    if no step is nearly as large. Other chunks are opened only if their statistics show a step that
    is large enough.

    Args:
        frame: The rows.
        name: Of the signal.
        score: How much larger than usual a step has to be.
        turns: Where its values may begin again at 0.
        may_step: Neither mass nor capacity forbids it to step.
    """
    zones = frame.zone_map(name)
    changes, largest = _steps_of(zones)
    changing = np.count_nonzero(changes)
    if not changing:
        return [], float(largest.max(initial=0.0)), math.inf
    for most in (1, SAMPLED_CHUNKS):
        parts = [frame.rows(*span).usable(name) for span in _sampled(zones, changes, most)]
        interval_s = _interval_s([times for times, _ in parts])
        staying = (_staying(*part, interval_s, turns) for part in parts)
        sizes = np.concatenate([np.zeros(0), *staying])
        is_known = len(sizes) >= LEAST_STEPS
        middle = in_order(sizes, len(sizes) // 2) if is_known else 0.0
        limit = middle + score * middle / 0.6745
        if is_known and largest.max() < CERTAINLY_LESS * limit:
            return [], float(largest.max()), limit
        if changing == 1:
            break
    rests = may_step and middle < RESTING_SHARE * largest.max()
    wanted = zones.spans(largest > limit if is_known else changes > 0)
    found: dict[float, Jump] = {}
    for start, stop in wanted:
        part = frame.rows(start - MARGIN_ROWS, stop + MARGIN_ROWS).usable(name)
        jumps = (
            _wide(*part, limit, interval_s, turns)
            if is_known and not rests
            else _excursions(*part, interval_s, turns, limit if is_known else 0.0)
        )
        found |= {jump.start_s: jump for jump in jumps}
    jumps = _without_swings(list(found.values()), frame, name)
    sizes = float(largest.max(initial=0.0)), limit if is_known else math.inf
    if len(jumps) < 2 or not is_known or rests:
        return jumps, *sizes
    spans = _sampled(zones, zones.value_count, SAMPLED_CHUNKS)
    levels = [frame.rows(*span).usable(name)[1] for span in spans]
    return list(_with_return(jumps, float(np.median(np.concatenate(levels))))), *sizes


def _interval_s(parts: Sequence[Array]) -> float:
    """The usual one between the times of several stretches."""
    return usual_interval_s(max(parts, key=len, default=np.zeros(0))) or math.inf


def _steps_of(zones: ZoneMap) -> tuple[Indexes, Array]:
    """How often a signal changes in each chunk, and its largest step, with those into the chunk."""
    changes: Indexes = np.array(zones.change_count)
    largest = np.nan_to_num(zones.largest_step)
    there = np.flatnonzero(~np.isnan(zones.first))
    into = np.abs(zones.first[there[1:]] - zones.last[there[:-1]])
    changes[there[1:]] += into > 0
    largest[there[1:]] = np.maximum(largest[there[1:]], into)
    return changes, largest


def _sampled(zones: ZoneMap, weights: Indexes, most: int) -> list[tuple[int, int]]:
    """Rows of some chunks, at equal shares of all weights; all that have one, if these are few."""
    sampled = weights > 0
    if np.count_nonzero(sampled) > most:
        reached = np.cumsum(weights)
        sampled = np.zeros(len(weights), np.bool_)
        sampled[np.searchsorted(reached, (np.arange(most) + 0.5) / most * reached[-1])] = True
    return zones.spans(sampled)


def _wide(
    times: Array, values: Array, limit: float, interval_s: float, turns: tuple[float, ...]
) -> Iterator[Jump]:
    """The steps above a limit that are no part of a motion."""
    steps = np.pad(np.diff(values), 1)
    wide = np.flatnonzero(np.abs(steps[1:-1]) > limit)
    intervals = _intervals(times, wide, interval_s)
    far = _step(values[wide], values[wide + 1], turns) > limit * intervals
    here, sign = np.abs(steps[wide + 1]), np.sign(steps[wide + 1])
    beside = np.maximum(steps[wide] * sign, steps[wide + 2] * sign)
    sudden = far & (beside * intervals < MOTION_SHARE * here)
    sudden &= ~_is_usual_motion(values, wide, intervals)
    for row in wide[sudden].tolist():
        time_s = float(times[row + 1])
        yield Jump(time_s, time_s, float(values[row]), float(values[row + 1]))


def _staying(times: Array, values: Array, interval_s: float, turns: tuple[float, ...]) -> Array:
    """The sizes of the steps that are not zero and are no part of an excursion."""
    steps = np.abs(np.diff(values))
    stays = steps > 0
    if stays.all():
        return steps
    for left, back in zip(*_come_back(times, values, steps, interval_s, turns), strict=True):
        stays[left:back] = False
    return steps[stays]


def _excursions(
    times: Array, values: Array, interval_s: float, turns: tuple[float, ...], noise: float
) -> Iterator[Jump]:
    """The values that left one that had rested, but for noise, and came back soon."""
    lefts, backs = _come_back(times, values, np.abs(np.diff(values)), interval_s, turns, noise)
    for row, back in zip(lefts.tolist(), backs.tolist(), strict=True):
        away = values[row + 1 : back]
        farthest = float(away[np.abs(away - values[row]).argmax()])
        span = float(times[row + 1]), float(times[back])
        yield Jump(*span, float(values[row]), farthest, float(values[back]))


def _come_back(
    times: Array,
    values: Array,
    steps: Array,
    interval_s: float,
    turns: tuple[float, ...],
    noise: float = 0.0,
) -> tuple[Indexes, Indexes]:
    """Rows after which a value that had rested left, and rows in which it was back soon after.

    What was recorded on the other side of a gap is not soon after.
    """
    # At the turn of a swing two rows may meet the same value; three are a rest.
    rests = steps[1:-1] <= noise
    if not rests.any():
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    left = np.flatnonzero((steps[2:] > noise) & rests & (steps[:-2] <= noise)) + 2
    left = left[_step(values[left], values[left + 1], turns) > noise]
    backs = np.zeros(len(left), np.intp)
    for later in range(LONGEST_EXCURSION + 1, 1, -1):
        after = np.minimum(left + later, len(values) - 1)
        is_back = (np.abs(values[after] - values[left]) <= noise) & (after == left + later)
        backs[is_back] = after[is_back]
    gaps = gap_borders(times, interval_s)
    is_soon = np.searchsorted(gaps, left, "right") == np.searchsorted(gaps, backs, "right")
    return left[is_soon & (backs > 0)], backs[is_soon & (backs > 0)]


def _without_swings(jumps: Sequence[Jump], frame: Frame, name: str) -> list[Jump]:
    """Those that are no steps of a swing: fast for its rows, or switched from side to side."""
    left: list[Jump] = []
    times_s = np.array([jump.start_s for jump in jumps])
    # No swing reaches over so much time from one jump to the next.
    ends = np.flatnonzero(np.diff(times_s) > 2 * BESIDE_SWINGS_S) + 1
    for start, stop in pairwise([0, *ends.tolist(), len(jumps)] if jumps else ()):
        ends_s = times_s[start] - BESIDE_SWINGS_S, times_s[stop - 1] + BESIDE_SWINGS_S
        left += _none_of_swings(jumps[start:stop], *frame.between(*ends_s).usable(name))
    return left


def _none_of_swings(jumps: Sequence[Jump], times: Array, values: Array) -> Sequence[Jump]:
    # A swing has at least three steps that are about as large as this one.
    steps = np.sort(np.abs(np.diff(values)))[-SWING_STEPS:]
    least = MUCH_SMALLER * min(jump.size for jump in jumps)
    if len(steps) < SWING_STEPS or steps[0] < least:
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
            own = [jump for jump in own if jump.size < limit]
        left = [jump for jump in left if jump not in own]
    return left


def _may_be_of(swing: Swing, jump: Jump) -> bool:
    """Whether it lies in the swing, whose ends are known to half a period, and is no higher."""
    about_s = swing.period_s / 2
    inside = swing.start_s - about_s <= jump.start_s <= swing.end_s + about_s
    return inside and jump.size < SWING_HEIGHTS * swing.amplitude


def _is_usual_motion(values: Array, rows: Indexes, intervals: Array) -> Flags:
    """Return which steps over lost rows are no larger than what the value does in as many rows."""
    usual = np.zeros(len(rows), np.bool_)
    over = np.rint(intervals).astype(np.intp)
    for count in np.unique(over[(over > 1) & (over <= LONGEST_LOSS)]).tolist():
        changes = np.abs(values[count:] - values[:-count])
        for row in rows[over > 1].tolist():
            changes[max(0, row - count + 1) : row + 1] = 0.0
        here = over == count
        steps = np.abs(values[rows[here] + 1] - values[rows[here]])
        usual[here] = steps <= changes.max(initial=0.0)
    return usual


def _intervals(times: Array, rows: Indexes, interval_s: float) -> Array:
    """How many usual intervals, at least one, lie between each of those rows and the next."""
    return np.maximum(1.0, (times[rows + 1] - times[rows]) / interval_s)


def _step(before: Array, after: Array, turns: tuple[float, ...]) -> Array:
    """How far it is from one to the other; the short way round where they may be angles."""
    far = np.abs(after - before)
    largest = np.maximum(np.maximum(np.abs(before), np.abs(after)), far)
    return np.min([far, *(np.where(largest <= turn, turn - far, far) for turn in turns)], 0)


def _with_return(jumps: Sequence[Jump], usual: float) -> Iterator[Jump]:
    """A jump away from where it usually is and the next one back are one.

    Usual is the median: the level at which it is for the greater share of the time. Back is also
    who comes to where it usually is, in one step of at least half the size.

    Args:
        jumps: In order.
        usual: Jumps towards it begin nothing.
    """
    left = list(reversed(jumps))
    while left:
        away = left.pop()
        if left and _is_back(away, left[-1], usual):
            back, before = left.pop(), away.before
            farthest = max(away.after, back.before, key=lambda each: abs(each - before))
            away = Jump(away.start_s, back.start_s, before, farthest, back.after)
        yield away


def _is_back(jump: Jump, following: Jump, usual: float) -> bool:
    """Whether one leads away from where it usually is, and the other from there back."""
    if abs(jump.after - usual) < abs(jump.before - usual):
        return False
    near = BACK_SHARE * jump.size
    if abs(following.after - jump.before) < near:
        return True
    way_back = (following.before - following.after) / (jump.after - jump.before)
    nearer = abs(following.after - usual) < abs(following.before - usual)
    return abs(following.before - jump.after) < near and nearer and way_back >= BACK_HALF


def find_leaps(frame: Frame, x: str, y: str, at_least_m: float) -> list[tuple[float, float]]:
    """Times and lengths of steps of a position that no driving explains.

    They are longer than `at_least_m` and than five times the 99th percentile of all steps. Each
    step counts there as at most the longer one next to it, so that leaps do not tell what is usual.
    After a gap, a leap is longer by as many times as the gap is than the usual interval.

    Args:
        frame: The rows.
        x: The name of one direction, whose unit it tells.
        y: That of the other.
        at_least_m: Shorter ones are none.
    """
    zones, of_y = frame.zone_map(x), frame.zone_map(y)
    along = _steps_of(zones)[1] * metres_in(x), _steps_of(of_y)[1] * metres_in(y)
    has_gaps: Flags = zones.value_count + of_y.value_count < 2 * zones.row_count
    # After a row that lacks one of them, the step is that of several rows.
    has_gaps |= np.append(False, has_gaps[:-1])
    long = zones.spans((np.hypot(*along) > at_least_m) | has_gaps)
    if not long:
        return []
    spans = _sampled(zones, zones.value_count, SAMPLED_CHUNKS)
    sample = [_way(frame.rows(*span), x, y) for span in spans]
    interval_s = _interval_s([times for times, _ in sample])
    steps = np.sort(np.concatenate([np.zeros(0), *(_of_motion(steps) for _, steps in sample)]))
    usual_m = float(steps[int(0.99 * len(steps))]) if len(steps) > LEAST_STEPS else 0.0
    limit_m = max(at_least_m, POSITION_STEPS * usual_m)
    leaps: dict[float, float] = {}
    for start, stop in long:
        times, steps = _way(frame.rows(start - MARGIN_ROWS, stop), x, y)
        rows = np.flatnonzero(steps > limit_m)
        far = rows[steps[rows] > limit_m * _intervals(times, rows, interval_s)]
        leaps |= zip(times[far + 1].tolist(), steps[far].tolist(), strict=True)
    return sorted(leaps.items())


def _of_motion(steps: Array) -> Array:
    """Each step that is one, or the longer of those next to it where that is less."""
    steps = steps[steps > 0]  # a position may come more seldom than rows
    beside = np.pad(steps, 1)
    return np.minimum(steps, np.maximum(beside[:-2], beside[2:]))


def _way(frame: Frame, x: str, y: str) -> tuple[Array, Array]:
    """Times of the rows that have a position, and the steps between them in metres."""
    along_x, along_y = (frame.numbers(name) * metres_in(name) for name in (x, y))
    there = np.isfinite(along_x) & np.isfinite(along_y)
    return frame.times[there], np.hypot(np.diff(along_x[there]), np.diff(along_y[there]))


def _alike(events: Sequence[Event], unit: str) -> str:
    """Dropouts, spikes or steps, and to where."""
    if "distance_m" in events[0].details:
        lengths = [event.details["distance_m"] for event in events]
        return f"position jumps of {min(lengths):.3g} to {max(lengths):.3g} m"
    after = [float(event.details["after"]) for event in events]
    sizes = [abs(event.details["after"] - event.details["before"]) for event in events]
    if events[0].end_s == events[0].start_s:
        return f"steps of {min(sizes):.4g} to {max(sizes):.4g}{unit}"
    if max(after) - min(after) > _ALIKE_SHARE * max(sizes):
        return f"spikes to values from {min(after):.4g} to {max(after):.4g}{unit}"
    name = "dropouts" if after[0] < events[0].details["before"] else "spikes"
    return f"{name} to {median(np.array(after)):.4g}{unit}"


JUMP: Final = EventKind(
    "jump",
    "step, spike or dropout",
    jump_events,
    least_s=lambda options: REACH_S,
    of_numbers=True,
    drawn=1,
    alike=Alike(_alike, sort=lambda event: event.end_s > event.start_s),  # who came back or stayed
    severity=40,
)
