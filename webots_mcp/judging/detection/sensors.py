"""`flat`: a signal that otherwise mostly changes had exactly the same value."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import (
    MOSTLY,
    Array,
    Flags,
    RowSpan,
    Runs,
    constant_runs,
    median,
    no_runs,
    noise_of,
    np,
    runs_of,
)
from webots_mcp.judging.detection.event import Alike, Event
from webots_mcp.judging.detection.missing_array_items import missing_item_events
from webots_mcp.judging.detection.search import MOST_NAMED, EventKind, Search
from webots_mcp.signals.naming import find_targets, listed
from webots_mcp.store.reading.catalogue import other_form
from webots_mcp.store.reading.frame import Frame, ZoneMap
from webots_mcp.store.reading.segment import just_after
from webots_mcp.store.registered_signals import RegisteredSignal

LEAST_CHANGES: Final = 10  # of who mostly changes
FROZEN_SHARE: Final = 0.15  # of `flat_s`: who is noisy otherwise counts from so long on
FEWEST_ROWS: Final = 50  # with one value: by chance a noisy signal never comes to so many
OTHER_ROWS: Final = 15_000  # before a rest, and after it, that tell what is noise
MOST_REPEATED: Final = 0.02  # of the other rows that repeat the value before: noise hardly does
LEAST_NOISE: Final = 0.3  # of the usual step: the steps of noise alone are as large as it is
LIVELY_S: Final = 10.0  # who mostly changes for so long somewhere changes otherwise
MOST_OPENED: Final = 8  # chunks with most changes in which that is looked for
HABITUAL_ROWS: Final = 10  # with the same value at other times: it comes back to it
TARGET_WENT: Final = 0.1  # of the whole range of a target: so far it goes on, to show something
LONGEST_READ_S: Final = 120.0  # of a rest: longer ones show it in their first part
FEW_VALUES: Final = 32  # whose rows are counted one by one; for more, sorting is faster
MANY_SILENCES: Final = 10  # of a signal that mostly has no value: it comes so by nature
_INDEX: Final = re.compile(r"\.\d+$")  # items that go missing at once are reported as the array


def flat_events(search: Search) -> Iterator[Event]:
    """Rests of at least `flat_s` of who mostly changes otherwise.

    One of a signal that is noisy otherwise counts much sooner, unless others rest at that time; and
    so does one that a target left behind.
    """
    flat_s, signals = search.options.flat_s, search.required_quantities()
    least_s = FROZEN_SHARE * flat_s
    resting: dict[str, _Resting] = {}
    frozen: list[tuple[_Resting, RowSpan]] = []
    for signal in search.in_time("flat", signals):
        zones = (frame.zone_map(signal.name) for frame in (search.frame, search.whole))
        if not any(changes_in(each) >= LEAST_CHANGES for each in zones):
            continue
        # Rests of others count where they cover most of one that counts.
        shown = _Resting(search, signal, MOSTLY * least_s)
        changes_here = shown.changes >= LEAST_CHANGES
        if changes_here:
            resting[signal.name] = shown
        if flat := [rest for rest in shown.rests if rest.duration_s >= flat_s]:
            if shown.changes_but_for(flat) or is_lively(search.whole, signal.name):
                yield from map(shown.event, flat)
        elif shown.rests and changes_here:
            soon = [rest for rest in shown.rests if rest.duration_s >= least_s]
            left = [e for e in soon if shown.target_went_on(e) and not shown.is_limit(e)]
            yield from map(shown.event, left)
            own = shown.frozen([rest for rest in soon if rest not in left])
            frozen += [(shown, rest) for rest in own]
            longest = max(shown.rests, key=lambda rest: rest.duration_s)
            if not own and not left and shown.changes_but_for([longest]):
                shown.note_near(longest)
    for shown, rest in frozen:
        if _rests_with_others(shown.signal, rest, resting, search.branches):
            shown.note_near(rest)
        else:
            yield shown.event(rest)


def changes_in(zones: ZoneMap) -> int:
    """Values unlike the one before, those at the borders of chunks too."""
    there = np.flatnonzero(~np.isnan(zones.first))
    over_borders = np.count_nonzero(zones.first[there[1:]] != zones.last[there[:-1]])
    return int(zones.change_count.sum() + over_borders)


def find_rests(frame: Frame, name: str, least_s: float) -> Iterator[RowSpan]:
    """Where a signal kept its value for at least that time, also across short dropouts.

    Opened are only the chunks with so many rows that repeat the one before, and their neighbours.
    """
    zones = frame.zone_map(name)
    # Of a rest across a border one of both chunks has at least half.
    lasts_s = np.maximum(zones.end_s - zones.start_s, least_s)
    least_rows = np.maximum(2, least_s / 2 * zones.value_count / lasts_s)
    may_rest = zones.value_count - zones.change_count >= least_rows
    may_rest |= np.append(may_rest[1:], False) | np.append(False, may_rest[:-1])
    for first, stop in zones.spans(may_rest):
        part = frame.rows(first, stop)
        numbers = part.bridged(name)
        runs = constant_runs(numbers, part.times)
        for run in runs.only(runs.durations_s >= least_s).spans():
            rows = {"start": first + run.start, "stop": first + run.stop}
            yield run._replace(**rows, value=float(numbers[run.start]))


class _RowCount(NamedTuple):
    """How many rows have a value, or at least so many."""

    rows: int
    is_all: bool


@dataclass
class _Resting:
    """A signal that rests at times: what its rests show, and how it changes otherwise.

    Attributes:
        least_s: Shorter rests are none.
    """

    search: Search
    signal: RegisteredSignal
    least_s: float
    _counts: dict[float, _RowCount] = field(default_factory=dict[float, _RowCount])

    @cached_property
    def rests(self) -> list[RowSpan]:
        """All of them."""
        return list(find_rests(self.search.frame, self.signal.name, self.least_s))

    @cached_property
    def changes(self) -> int:
        """Values unlike the one before, in all rows."""
        return changes_in(self.search.frame.zone_map(self.signal.name))

    def changes_but_for(self, rests: Sequence[RowSpan]) -> bool:
        """Whether it changed in most of the rows outside of those rests, and in ten at least.

        What goes from one of them right to the next, as a counter does, has not changed otherwise.
        """
        frame = self.search.frame
        present = int(frame.zone_map(self.signal.name).value_count.sum())
        first_s, last_s = frame.bounds_s
        flat_s = sum(rest.duration_s for rest in rests)
        outside = max(0.0, 1 - flat_s / (last_s - first_s)) if last_s > first_s else 0.0
        changes = self.changes - sum(a.stop == b.start for a, b in pairwise(rests))
        return changes >= max(LEAST_CHANGES, MOSTLY * present * outside)

    def event(self, rest: RowSpan) -> Event:
        """One of its rests, and what there is to say of it, but that it is frozen."""
        value, why = f"{rest.value:.6g}", self.target_went_on(rest)
        value += f" {self.signal.unit}" if self.signal.unit else ""
        says = ""
        if self.is_limit(rest):
            says = f"at its limit of {value}" + (f", though {why}" if why else "")
        elif why:
            says = f"frozen: {why}"
        elif self._is_elsewhere(rest, HABITUAL_ROWS):
            says = f"at {value}, as at other times"
        details = {"value": rest.value} | ({"says": says} if says else {})
        return self.search.event("flat", rest.start_s, rest.end_s, self.signal.name, **details)

    def note_near(self, rest: RowSpan) -> None:
        """It came near to an event."""
        lasted = f"for {rest.duration_s:.3g} s from {rest.start_s:.6g} s"
        least = f"{self.search.options.flat_s:g} s count"
        what = f"{self.signal.name} stayed at {rest.value:.4g} {lasted}; {least}"
        self.search.note_nearest("flat", rest.duration_s / self.search.options.flat_s, what)

    def is_limit(self, rest: RowSpan) -> bool:
        """Whether it was never beyond the value that it kept, and was there at other times too.

        Only then it is where a sensor ends, or what a gate lets through: what counts or creeps is
        at its extreme wherever it stops.
        """
        return rest.value in self._extremes(self.signal) and self._is_elsewhere(rest, 1)

    def target_went_on(self, rest: RowSpan) -> str | None:
        """Whether its target moved, or it was commanded to move, while it stayed; None if neither.

        For a position in the plane `stuck` reports that.
        """
        target, speed = self._targets
        values = self._values(target, rest)
        far = np.abs(values - values[:1])
        low, high = self._extremes(target) if len(values) and target else (0.0, 0.0)
        if target and len(far) and far.max() > TARGET_WENT * (high - low):
            span = f"{values[0]:.4g} to {values[far.argmax()]:.4g}"
            return f"its target {target.name} went from {span}"
        values = self._values(speed, rest)
        nonzero = values[values != 0]
        if speed and len(nonzero) and len(nonzero) >= MOSTLY * len(values):
            return f"{speed.name} was {float(np.median(nonzero)):.4g}"
        return None

    def _is_elsewhere(self, rest: RowSpan, least: int) -> bool:
        """Whether so many other rows of the run have the same value."""
        wanted = rest.stop - rest.start + least
        known = self._counts.get(rest.value)
        if known is None or (known.rows < wanted and not known.is_all):
            known = self._counts[rest.value] = self._rows_with(rest.value, wanted)
        return known.rows >= wanted

    def _rows_with(self, value: float, wanted: int) -> _RowCount:
        """Count the rows of the run that have a value, no further than so many.

        Once many values are asked for, the sorted ones tell.
        """
        if len(self._counts) >= FEW_VALUES:
            ends = (np.searchsorted(self._sorted, value, side) for side in ("left", "right"))
            first, stop = map(int, ends)
            return _RowCount(stop - first, is_all=True)
        whole = self.search.whole
        zones = whole.zone_map(self.signal.name)
        may_have = (zones.min <= value) & (value <= zones.max)
        constant = may_have & (zones.min == zones.max)
        rows = int(zones.value_count[constant].sum())
        if rows < wanted:
            for _, numbers in whole.opened(self.signal.name, may_have & ~constant):
                rows += int(np.count_nonzero(numbers == value))
                if rows >= wanted:
                    break
            else:
                return _RowCount(rows, is_all=True)
        return _RowCount(rows, is_all=False)

    @cached_property
    def _sorted(self) -> Array:
        """All values of the run."""
        values: Array = np.array(self.search.whole.numbers(self.signal.name))
        values.sort()
        return values

    @cached_property
    def _targets(self) -> tuple[RegisteredSignal | None, RegisteredSignal | None]:
        """Its target, and its commanded speed; of a position in the plane none."""
        known = self.search.known
        if self.signal in (self.search.motion.position or ()):
            return None, None
        numbers = [name for name, each in known.items() if each.kind in ("num", "angle")]
        target, speed = find_targets(self.signal.name, numbers)
        return known.get(target or ""), known.get(speed or "")

    def _values(self, signal: RegisteredSignal | None, rest: RowSpan) -> Array:
        """The numbers of a signal in a rest, which may be none of those that are looked at."""
        if signal is None:
            return np.zeros(0)
        end_s = min(just_after(rest.end_s), rest.start_s + LONGEST_READ_S)
        return self.search.frame.between(rest.start_s, end_s).usable(signal.name)[1]

    def _extremes(self, signal: RegisteredSignal) -> tuple[float, float]:
        """Of the whole run."""
        zones = self.search.whole.zone_map(signal.name)
        low, high = (each[~np.isnan(each)] for each in (zones.min, zones.max))
        return float(low.min(initial=np.inf)), float(high.max(initial=-np.inf))

    def frozen(self, rests: Sequence[RowSpan]) -> list[RowSpan]:
        """Of some rests those that noise never makes, if it is noisy but for them."""
        motion = self.search.motion
        if self.signal in (motion.commanded, motion.speed, *motion.wheels):
            return []
        held = [rest for rest in rests if (rest.stop - rest.start) >= FEWEST_ROWS]
        keys = [rest.value for rest in held]
        # What it comes back to is a value by nature, and 0 is what does nothing gives.
        once = [rest for rest in held if keys.count(rest.value) == 1 and rest.value != 0]
        return [rest for rest in once if self._is_frozen(rest, held)]

    def _is_frozen(self, rest: RowSpan, held: Sequence[RowSpan]) -> bool:
        """Whether the rows around it are noisy, and beyond its value on both sides.

        The lowest or the highest of all is where a sensor ends.
        """
        first = max(0, rest.start - OTHER_ROWS)
        around = self.search.frame.rows(first, rest.stop + OTHER_ROWS)
        numbers = around.numbers(self.signal.name)
        outside = ~np.isnan(numbers)
        for each in held:
            outside[max(0, each.start - first) : max(0, each.stop - first)] = False
        others = numbers[outside]
        return is_noisy(others) and bool(others.min() < rest.value < others.max())


def is_noisy(values: Array) -> bool:
    """Whether it changes by noise in about every row: then one that repeats itself is frozen.

    A smooth course, such as the exact position of a simulated robot, rests when the robot does.
    """
    steps = np.abs(np.diff(values))
    repeated = len(steps) - int(np.count_nonzero(steps))
    if len(steps) < 2 * FEWEST_ROWS or repeated / len(steps) > MOST_REPEATED:
        return False
    return noise_of(values) >= LEAST_NOISE * median(steps)


def is_lively(run: Frame, name: str) -> bool:
    """Whether it mostly changed for 10 s somewhere in the run."""
    zones = run.zone_map(name)
    for chunk in np.argsort(-zones.change_count, kind="stable")[:MOST_OPENED].tolist():
        first = int(zones.first_row[chunk])
        times, values = run.rows(first, first + int(zones.row_count[chunk])).usable(name)
        _, stretch, rows = np.unique(times // LIVELY_S, return_inverse=True, return_counts=True)
        changed = np.diff(values, prepend=values[:1]) != 0
        changes = np.bincount(stretch, changed)
        if ((rows >= LEAST_CHANGES) & (changes >= MOSTLY * rows)).any():
            return True
    return False


def _rests_with_others(
    signal: RegisteredSignal,
    rest: RowSpan,
    resting: dict[str, _Resting],
    branches: Mapping[str, str],
) -> bool:
    """Whether something else holds one value for most of that time: then the robot rests.

    What never changes, or is at its limit, is no sign of that; and the items of an array freeze
    together.
    """
    branch = branches[signal.name]
    return any(
        min(rest.end_s, other.end_s) - max(rest.start_s, other.start_s) > MOSTLY * rest.duration_s
        and not shown.is_limit(other)
        for name, shown in resting.items()
        if branches[name] != branch
        for other in shown.rests
    )


def _alike(events: Sequence[Event], unit: str) -> str:
    said = {event.details.get("says") for event in events}
    what = said.pop() if len(said) == 1 else None
    return f"times {what}" if what else "flat stretches"


FLAT: Final = EventKind(
    "flat",
    "frozen or at a limit",
    flat_events,
    lasts=True,
    least_s=lambda options: options.flat_s,
    of_numbers=True,
    drawn=7,
    alike=Alike(_alike, of_arrays=True),
    severity=30,
)


# -- `missing`: a signal that had a value has none -------------------------------------------------


def missing_events(search: Search) -> Iterator[Event]:
    """It has begun, and lasts to the signal's next value, if any."""
    shorter: Counter[str] = Counter()
    for signal in search.in_time("missing", search.required_numbers(), judged=False):
        runs = _silences(search, signal)
        if not len(runs):
            continue
        least_s = _least_silence_s(search, signal, runs)
        for run in runs.only(runs.durations_s >= least_s).spans():
            replaced = search.frame.rows(run.start, run.start + 1).replaced(signal.name)
            details = {"value": next(iter(replaced))} if replaced else {}
            yield search.event("missing", run.start_s, run.end_s, signal.name, **details)
        short = runs.only((runs.durations_s > 0) & (runs.durations_s < least_s))
        if len(short):
            longest = max(short.spans(), key=lambda run: run.duration_s)
            span = f"for {longest.duration_s:.3g} s from {longest.start_s:.6g} s"
            share = longest.duration_s / least_s
            what = f"{signal.name} had no value {span}; {least_s:.3g} s count"
            search.note_nearest("missing", share, what)
        if least_s == search.options.missing_s:
            asked, array = search.asked or search.segment, _INDEX.sub(".*", signal.name)
            inside = (short.starts_s < asked.end_s) & (short.ends_s >= asked.start_s)
            shorter[array] = max(int(np.count_nonzero(inside)), shorter[array])
    if counts := (+shorter).most_common():
        times = [f"{name} {count} time{'s' * (count > 1)}" for name, count in counts]
        limit = f"for less than missing_s={search.options.missing_s:g} s"
        note = f"without a value {limit}, so not counted as missing: {listed(times, MOST_NAMED)}"
        search.coverage.note_of_run(search.segment.run_id, note)
    yield from missing_item_events(search, "missing")


def _silences(search: Search, signal: RegisteredSignal) -> Runs:
    """Where neither the signal has a value nor its array in its other form, long or short."""
    frame, lacking = search.frame, list[Flags]()
    signals = [each for each in (signal, other_form(search.known, signal)) if each]
    for each in signals:
        if (missing := rows_without_value(frame, each.name)) is None:
            return no_runs()
        lacking.append(missing)
    runs = runs_of(np.all(lacking, axis=0), frame.times)
    return runs.only(_have_begun(search, signals, runs) & ~_are_shorter(search, signal, runs))


def rows_without_value(frame: Frame, name: str) -> Flags | None:
    """The rows that have no value of a signal; None where all have one, by the statistics."""
    zones = frame.zone_map(name)
    is_lacking = zones.value_count < zones.row_count
    if not is_lacking.any():
        return None
    lacks = np.repeat(zones.held_count == 0, zones.row_count)
    for start, stop in zones.spans(is_lacking & (zones.held_count > 0)):
        part = frame.rows(start, stop)
        lacks[start:stop] = np.isnan(part.numbers(name)) & (part.texts(name).codes == 0)
    return lacks


def _have_begun(search: Search, signals: Sequence[RegisteredSignal], runs: Runs) -> Flags:
    """What had no value before its first one was not there yet; that is no silence."""
    begun = (runs.starts_s > search.began_s) & (signals[0].kind != "null")
    if len(runs) and begun[0] and runs.starts[0] == 0:
        before = search.whole.between(search.began_s, float(runs.starts_s[0]))
        begun[0] = any(before.zone_map(each.name).value_count.any() for each in signals)
    return begun


def _are_shorter(search: Search, signal: RegisteredSignal, runs: Runs) -> Flags:
    """Whether the array was there when it began, but so short or long that it has no such item.

    A long one is reduced; whose items are all replaced (a lidar that sees nothing) has no number.
    """
    if not len(runs) or not (signal.reduction or signal.path.endswith("]")):
        return np.zeros(len(runs), np.bool_)
    frame, array = search.frame, signal.name.rpartition(".")[0]
    others = np.zeros(len(frame), np.bool_)
    for name in (f"{array}.0", f"{array}.count"):
        if name in search.known:  # a frame also reads items of long arrays, which are no signals
            others |= frame.held(name)
    return others[runs.starts] & ~frame.held(signal.name)[runs.starts]


def _least_silence_s(search: Search, signal: RegisteredSignal, runs: Runs) -> float:
    """Longer for an intermittent signal: three times its usual interval between values."""
    least_s = search.options.missing_s
    zones = search.frame.zone_map(signal.name)
    is_usual = zones.value_count.sum() >= MOSTLY * zones.row_count.sum()
    if is_usual or len(runs) < MANY_SILENCES:
        return least_s
    usual_s = float(np.sort(runs.durations_s)[len(runs) // 2])
    if 3 * usual_s <= least_s:
        return least_s
    rarely = f"{signal.name} is intermittent (a value about every {usual_s:.3g} s)"
    search.coverage.notes.append(f"{rarely}: it counts as missing after {3 * usual_s:.3g} s")
    return 3 * usual_s


MISSING: Final = EventKind(
    "missing",
    "no value",
    missing_events,
    lasts=True,
    least_s=lambda options: options.missing_s,
    of_numbers=True,
    drawn=2,
    alike=Alike(lambda events, unit: "stretches without a value", of_arrays=True),
    severity=45,
)
