"""`flat`: a signal that otherwise mostly changes had exactly the same value."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.runs import MOSTLY, runs_alike
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, EventKind
from webots_mcp.store.detection.resting import Rest, Resting
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.frame import Frame, Zones
from webots_mcp.store.signals.registry import Signal

LEAST_CHANGES: Final = 10  # of who mostly changes
FROZEN_SHARE: Final = 0.15  # of `flat_s`: who is noisy otherwise counts from so long on
FEWEST_ROWS: Final = 50  # with one value: by chance a noisy signal never comes to so many
OTHER_ROWS: Final = 15_000  # before a rest, and after it, that tell what is noise
MOST_REPEATED: Final = 0.02  # of the other rows that repeat the value before: noise hardly does
LEAST_NOISE: Final = 0.3  # of the usual step: the steps of noise alone are as large as it is
LIVELY_S: Final = 10.0  # who mostly changes for so long somewhere changes otherwise
MOST_OPENED: Final = 8  # chunks with most changes in which that is looked for


@dataclass(frozen=True)
class Rests:
    """Where a signal kept its value for long, and how it changes otherwise.

    Attributes:
        changes: Values unlike the one before, in all rows.
        present: Rows with a value.
        whole_s: From the first row to the last.
    """

    rests: list[Rest]
    changes: int
    present: int
    whole_s: float

    def changes_but_for(self, rests: Sequence[Rest]) -> bool:
        """Whether it changed in most of the rows outside of those rests, and in ten at least.

        What goes from one of them right to the next, as a counter does, has not changed otherwise.
        """
        flat_s = sum(rest.duration_s for rest in rests)
        outside = max(0.0, 1 - flat_s / self.whole_s) if self.whole_s > 0 else 0.0
        changes = self.changes - sum(a.stop == b.start for a, b in pairwise(rests))
        return changes >= max(LEAST_CHANGES, MOSTLY * self.present * outside)


def flat_events(search: Search) -> Iterator[Event]:
    """Rests of at least `flat_s` of who mostly changes otherwise.

    One of a signal that is noisy otherwise counts much sooner, unless others rest at that time; and
    so does one that a target left behind.
    """
    flat_s, signals = search.options.flat_s, search.required_quantities()
    least_s = FROZEN_SHARE * flat_s
    search.note_too_large("flat")
    resting: dict[str, list[Rest]] = {}
    frozen: list[tuple[Resting, Rest]] = []
    for index, signal in enumerate(signals):
        if search.is_over("flat", signals[index:]):
            break
        if not any(_changes(frame, signal.name) for frame in (search.frame, search.whole)):
            continue
        # Rests of others count where they cover most of one that counts.
        found = find_rests(search.frame, signal.name, MOSTLY * least_s)
        if found.changes >= LEAST_CHANGES:
            resting[signal.name] = found.rests
        if not found.rests:
            continue
        shown = Resting(search, signal)
        flat = [rest for rest in found.rests if rest.duration_s >= flat_s]
        if flat:
            if found.changes_but_for(flat) or _is_lively(search.whole, signal.name):
                yield from (_event(search, shown, rest) for rest in flat)
        elif found.changes >= LEAST_CHANGES:
            soon = [rest for rest in found.rests if rest.duration_s >= least_s]
            left = [
                each for each in soon if shown.target_went_on(each) and not shown.is_limit(each)
            ]
            yield from (_event(search, shown, rest) for rest in left)
            own = _frozen(search, signal, [rest for rest in soon if rest not in left])
            frozen += [(shown, rest) for rest in own]
            if not own and not left:
                _note_longest(search, found, signal)
    for shown, rest in frozen:
        if _rests_with_others(shown.signal, rest, resting):
            _note_near(search, shown.signal, rest)
        else:
            yield _event(search, shown, rest)


def _changes(frame: Frame, name: str) -> bool:
    return changes_in(frame.zones(name)) >= LEAST_CHANGES


def find_rests(frame: Frame, name: str, least_s: float) -> Rests:
    """Where a signal kept its value for so long.

    Opened are only the chunks with so many rows that repeat the one before, and their neighbours.
    """
    zones = frame.zones(name)
    changes, present = changes_in(zones), int(zones.value_count.sum())
    rests: list[Rest] = []
    if changes < present - 1:
        # Of a rest across a border one of both chunks has at least half.
        lasts_s = np.maximum(zones.end_s - zones.start_s, least_s)
        least_rows = np.maximum(2, least_s / 2 * zones.row_count / lasts_s)
        may_rest = zones.value_count - zones.change_count >= least_rows
        may_rest |= np.append(may_rest[1:], False) | np.append(False, may_rest[:-1])
        for start, stop in zones.spans(may_rest):
            rests += _rests_in(frame.rows(start, stop), name, least_s, start)
    whole_s = float(frame.times[-1] - frame.times[0]) if len(frame) else 0.0
    return Rests(rests, changes, present, whole_s)


def changes_in(zones: Zones) -> int:
    """Values unlike the one before, those at the borders of chunks too."""
    there = np.flatnonzero(~np.isnan(zones.first))
    over_borders = np.count_nonzero(zones.first[there[1:]] != zones.last[there[:-1]])
    return int(zones.change_count.sum() + over_borders)


def _rests_in(frame: Frame, name: str, least_s: float, first_row: int) -> Iterator[Rest]:
    numbers = frame.numbers(name)
    runs = runs_alike(numbers, frame.times)
    for run in runs.only(runs.durations_s >= least_s).each():
        value = float(numbers[run.start])
        yield Rest(first_row + run.start, first_row + run.stop, run.start_s, run.end_s, value)


def _event(search: Search, shown: Resting, rest: Rest) -> Event:
    says = shown.says(rest)
    details = {"value": rest.value} | ({"says": says} if says else {})
    return search.event("flat", rest.start_s, rest.end_s, shown.signal.name, **details)


def _frozen(search: Search, signal: Signal, rests: Sequence[Rest]) -> list[Rest]:
    """Of the rests of a signal those that noise never makes, if it is noisy but for them."""
    moved_with = (search.motion.commanded, search.motion.speed, *search.motion.wheels)
    held = [rest for rest in rests if rest.stop - rest.start >= FEWEST_ROWS]
    if signal in moved_with:
        return []
    keys = [rest.value for rest in held]
    # What it comes back to is a value by nature, and 0 is what does nothing gives.
    once = [rest for rest in held if keys.count(rest.value) == 1 and rest.value != 0]
    return [rest for rest in once if _is_frozen(search.frame, signal.name, rest, held)]


def _is_frozen(frame: Frame, name: str, rest: Rest, held: Sequence[Rest]) -> bool:
    """Whether the rows around it are noisy, and beyond its value on both sides.

    The lowest or the highest of all is where a sensor ends.
    """
    first = max(0, rest.start - OTHER_ROWS)
    numbers = frame.rows(first, rest.stop + OTHER_ROWS).numbers(name)
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
    if len(steps) < 2 * FEWEST_ROWS or np.mean(steps == 0) > MOST_REPEATED:
        return False
    return noise_of(values) >= LEAST_NOISE * float(np.median(steps))


def _is_lively(run: Frame, name: str) -> bool:
    """Whether it mostly changed for 10 s somewhere in the run."""
    zones = run.zones(name)
    for chunk in np.argsort(-zones.change_count, kind="stable")[:MOST_OPENED].tolist():
        first = int(zones.first_row[chunk])
        times, values = run.rows(first, first + int(zones.row_count[chunk])).usable(name)
        changed = np.diff(values, prepend=values[:1]) != 0
        stretch = np.floor(times / LIVELY_S)
        starts = np.flatnonzero(np.diff(stretch, prepend=-np.inf))
        rows = np.diff(np.append(starts, len(times)))
        changes = np.add.reduceat(changed, starts, dtype=np.intp) if len(starts) else rows
        if ((rows >= LEAST_CHANGES) & (changes >= MOSTLY * rows)).any():
            return True
    return False


def _rests_with_others(signal: Signal, rest: Rest, resting: dict[str, list[Rest]]) -> bool:
    """Whether something else holds one value for most of that time: then the robot rests.

    What never changes is no sign of that; and the items of an array freeze together.
    """
    branch = signal.name.partition(".")[0]
    return any(
        min(rest.end_s, other.end_s) - max(rest.start_s, other.start_s) > MOSTLY * rest.duration_s
        for name, others in resting.items()
        if name.partition(".")[0] != branch
        for other in others
    )


def _note_longest(search: Search, found: Rests, signal: Signal) -> None:
    """What came nearest, where it is not how the signal is."""
    longest = max(found.rests, key=lambda rest: rest.duration_s)
    if found.changes_but_for([longest]):
        _note_near(search, signal, longest)


def _note_near(search: Search, signal: Signal, rest: Rest) -> None:
    lasted = f"for {rest.duration_s:.3g} s from {rest.start_s:.6g} s"
    what = f"{signal.name} stayed at {rest.value:.4g} {lasted}"
    search.came_near("flat", rest.duration_s / search.options.flat_s, what)


def _alike(events: Sequence[Event], unit: str) -> str:
    said = {event.details.get("says") for event in events}
    what = said.pop() if len(said) == 1 else None
    return f"times {what}" if what else "flat stretches"


FLAT: Final = EventKind(
    "flat",
    "frozen, or at a limit",
    flat_events,
    lasts=True,
    least_s=lambda options: options.flat_s,
    of_numbers=True,
    drawn=7,
    alike=Alike(_alike, of_arrays=True),
)
