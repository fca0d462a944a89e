"""Checks of what sensors gave: nothing, the same, an extreme, or something else for a moment."""

from __future__ import annotations

import weakref
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple

from webots_mcp.analysis.arrays import MOSTLY, Array, Runs, median, np, runs_of
from webots_mcp.judging.checks.check import Examined, RunUnderCheck, times
from webots_mcp.judging.checks.silent_sensors import explained
from webots_mcp.judging.detection.degradation import DEGRADATION, TIMES
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.jump import JUMP
from webots_mcp.judging.detection.sensors import FLAT, MOST_REPEATED, OTHER_ROWS, is_noisy
from webots_mcp.judging.verdicts import Fault
from webots_mcp.signals.meaning import CAN_BE_OFF, INERT, Meaning, Quantity, words_in
from webots_mcp.signals.naming import (
    ELSEWHERE,
    REDUCTIONS,
    SOLIDS,
    WORLD,
    counted,
    find_targets,
    listed,
)
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.registered_signals import RegisteredSignal, stored_roles

MOST_NAMED: Final = 3
_FAULTY: Final = "nan"  # what a device gives that has no value; inf is a range without an end
_MANY: Final = 0.05  # of the rows that are NaN: a sensor has none in its first steps alone
_LEAST_S: Final = 1.0  # as of what is missing
_AT_LIMIT: Final = 0.05  # of the rows
_OBSERVED: Final = (f"{WORLD}.", f"{SOLIDS}.")
_SPEEDS: Final = frozenset[Quantity | None]((
    "speed", "turn rate", "wheel speed", "motor speed", "joint speed",
))  # fmt: skip
# What comes into sight and leaves it.
_THINGS: Final = ELSEWHERE | {
    "beacon", "car", "gap", "headway", "lead", "leader", "person", "tag", "vehicle",
}  # fmt: skip
_OTHER_SIDE: Final = {"left": "right", "right": "left"}
_MANY_VALUES: Final = 100  # different ones: of fewer one comes back by nature
_OFTEN_THE_SAME: Final = 3
_CUT_OFF: Final = 5  # times at one extreme to the last digit: of values that never repeat none is
_BRIEFLY: Final = 3  # rows: what is cut off comes back soon, what rests at a stop does not
_SORTED_AT_ONCE: Final = 8_192  # values at first ...
_MORE_SORTED: Final = 4  # ... and then so many times as many
_REPEATED: Final = 1.5  # times as many as may repeat are sorted first
_HASH_BITS: Final = 25
_MIXES: Final = 0x9E3779B97F4A7C15  # 2^64 by the golden ratio
_NEAR_LIMIT: Final = 0.01  # of the range
_ROUNDING: Final = 1e-9  # of a limit: a value that was calculated ends there only about
_UNIQUE: Final = 0.95  # of all values but the extreme: so many differ from all others


def sensors_speak(run: RunUnderCheck) -> Examined:
    """Fails where a signal was NaN for a second or more, warns where it was null.

    Null may be meant, of what is not seen now: it is where another measurement, or the mode, tells
    the rows without a value from the others. An infinite range is. Warns of one that was NaN in 5 %
    of the rows, never for so long or before its first value, and of 5 % of the items of a long
    array that stay NaN.
    """
    silent = [e for e in run.events("missing") if e.details.get("value") in (None, _FAULTY)]
    items = [each for each in silent if "items" in each.details]
    reasons = explained(run, silent)
    silent = [each for each in silent if each not in items and each.name not in reasons]
    shares = {
        name: run.frame.replaced(name)[_FAULTY] / max(len(run.frame), 1)
        for name, each in run.search.known.items() if each.is_number
    }  # fmt: skip
    never = [name for name, share in shares.items() if share == 1]
    if items and not (silent or never):
        return _missing_items(run, items)
    if not (silent or never):
        least = max(_MANY, _LEAST_S / run.search.length_s)
        if many := [name for name, share in shares.items() if share >= least]:
            most, up_to = 100 * max(shares.values()), "up to " * (len(many) > 1)
            evidence = f"{listed(many, MOST_NAMED)}: NaN in {up_to}{most:.3g} % of the rows"
            firm = run.firmest(many)
            return Fault("warn", evidence, None, len(many), run.shows(many[0]), signals=firm)
        says = "none that had a value was without one for a second"
        if reasons:
            why = next(iter(reasons.values()))
            says += f" but {listed([*reasons], MOST_NAMED)}, {why}"
        return run.covered(says, of="missing", limit=f"limit {100 * _MANY:g} % of the rows")
    nan = [each for each in silent if each.details.get("value") == _FAULTY]
    firm = run.firmest([*never, *(each.name or "" for each in silent)])
    silent = by_array(silent)
    longest_s = max((each.duration_s for each in silent), default=0.0)
    evidence = f"{_names(silent)} had no value for {longest_s:.4g} s"
    if len(silent) == 1:
        evidence += f" ({silent[0].start_s:.6g} to {silent[0].end_s:.6g} s)"
    elif silent:
        evidence = (
            f"{_names(silent)} had no value {times(len(silent))}, for up to {longest_s:.4g} s"
        )
    evidence = f"{listed(never, MOST_NAMED)}: NaN in every row" if never else evidence
    since_s = silent[0].start_s if silent and not never else run.search.began_s
    outcome = "fail" if nan or never else "warn"
    count, more = len(silent) + len(never), run.more("missing")
    return Fault(outcome, evidence, since_s, count, more, signals=firm)


def _missing_items(run: RunUnderCheck, silent: list[Event]) -> Fault:
    """Of long arrays: items that are NaN up to the end of the run."""
    worst = max(silent, key=lambda each: each.details["items"] / each.details["of_items"])
    count, total = worst.details["items"], worst.details["of_items"]
    since = "in every row" if worst.start_s <= run.search.began_s else "from a moment on"
    evidence = f"{worst.name}: {count} of {total} items are NaN {since}"
    others = listed([each.name or "" for each in silent if each is not worst], MOST_NAMED)
    evidence += f"; also {others}" if others else ""
    return Fault("warn", evidence, worst.start_s, count, run.shows(f"{worst.name}.count"))


def sensors_live(run: RunUnderCheck) -> Examined:
    """Fails where a signal froze that is noisy otherwise, or whose target went on.

    Warns of others that changed otherwise, and rested for 20 s while the robot moved.
    """
    judged = [(each, _frozen(run, each)) for each in run.events(FLAT.name)]
    frozen = by_array([each for each, outcome in judged if outcome])
    if not frozen:
        limit = f"limit {run.search.options.flat_s:g} s"
        return run.covered("none froze", of=FLAT.name, limit=limit)
    first, outcomes = frozen[0], [outcome for _, outcome in judged]
    says = f"; {first.details['says']}" if "says" in first.details else ""
    longest_s = max(each.duration_s for each in frozen)
    evidence = f"{_names(frozen)}: {times(len(frozen))}, up to {longest_s:.3g} s the same{says}"
    outcome = "fail" if "fail" in outcomes else "warn"
    firm = run.firmest(each.name or "" for each, said in judged if said == outcome)
    more = run.more(FLAT.name)
    return Fault(outcome, evidence, first.start_s, len(frozen), more, signals=firm)


def _frozen(run: RunUnderCheck, flat: Event) -> Literal["fail", "warn"] | None:
    name, says = flat.name or "", str(flat.details.get("says", ""))
    names = _names_in(run)
    if name not in names.sensors or says.startswith("at "):
        return "warn" if _other_side_goes_on(run, flat) else None
    if says.startswith("frozen"):  # its target went on
        return "fail"
    meaning = run.meanings[name]
    if meaning.quantity in CAN_BE_OFF and flat.details.get("value") == 0:
        return None
    frame = run.frame
    first, stop = frame.places([flat.start_s, flat.end_s]).tolist()
    before = frame.rows(max(0, first - OTHER_ROWS), first).usable(name)[1]
    after = frame.rows(stop + 1, stop + OTHER_ROWS).usable(name)[1]
    if is_noisy(np.concatenate([before, after])):
        return "fail"
    if run.search.known[name].turn or name in names.place:  # of who drives straight on
        return None
    if names.target(name) is not None:  # which rests as well
        return None
    if _is_at_rest(run, flat) or _rests_so_often(run, flat, before, after):
        return None
    others = run.events("standstill") + run.events("stuck")
    if run.motion.position is None:
        branches = run.search.branches
        flats = run.events(FLAT.name)
        others = [e for e in flats if branches.get(e.name or "") != branches.get(name)]
    rests_s = (min(flat.end_s, e.end_s) - max(flat.start_s, e.start_s) for e in others)
    return None if sum(max(0.0, each) for each in rests_s) > flat.duration_s / 2 else "warn"


def _other_side_goes_on(run: RunUnderCheck, flat: Event) -> bool:
    """Whether a counter stood still while that of the other side counted in most rows."""
    name = flat.name or ""
    if run.meanings[name].quantity != "count" or run.meanings[name].side not in _OTHER_SIDE:
        return False
    words = [_OTHER_SIDE.get(word, word) for word in words_in(name)]
    others = (each for each in run.search.numbers if list(words_in(each.name)) == words)
    part = run.frame.between(flat.start_s, flat.end_s)
    counted_on = (np.diff(part.usable(each.name)[1]) != 0 for each in others)
    return any(len(each) > 0 and float(each.mean()) > MOSTLY for each in counted_on)


def _is_at_rest(run: RunUnderCheck, flat: Event) -> bool:
    """Whether a place stays because a measured speed is exactly 0: what froze has any value."""
    if run.meanings[flat.name or ""].quantity not in ("x", "y", "height", "joint position"):
        return False
    part = run.frame.between(flat.start_s, flat.end_s)
    speeds = [
        part.usable(each)[1]
        for each in _names_in(run).sensors
        if run.meanings[each].quantity in ("speed", "joint speed", "motor speed")
    ]
    return any(np.count_nonzero(each == 0) > MOSTLY * len(each) for each in speeds)


def _rests_so_often(run: RunUnderCheck, flat: Event, before: Array, after: Array) -> bool:
    """Whether a rounded signal that repeats itself anyway rests about as long at other times."""
    others = np.concatenate([before, after])
    if len(others) < 2 or np.mean(np.diff(others) == 0) <= MOST_REPEATED:
        return False
    alike = [
        each
        for each in run.events(FLAT.name)
        if each.name == flat.name and each is not flat and 2 * each.duration_s >= flat.duration_s
    ]
    return len(alike) >= _OFTEN


class _NamesIn:
    """What the names of a run's signals tell, looked up once for all of its events."""

    def __init__(self, run: RunUnderCheck) -> None:
        self._run: RunUnderCheck = weakref.proxy(run)  # which holds this in turn
        self._targets: dict[str, str | None] = {}

    @cached_property
    def place(self) -> set[str]:
        """The signals of where it is, in each of its positions."""
        roles = stored_roles(self._run.search.known)
        places = (name for name, role in roles.items() if role[0] in "xyz")
        return {*places, *(each.name for each in self._run.motion.position or ())}

    def target(self, name: str) -> str | None:
        """What a joint shall come to, or how fast it shall be: it stays there."""
        if name not in self._targets:
            numbers = (each.name for each in self._run.search.numbers)
            self._targets[name] = find_targets(name, numbers)[0]
        return self._targets[name]

    @cached_property
    def sensors(self) -> dict[str, RegisteredSignal]:
        """The numbers that a sensor gave, as far as it is known what they mean.

        What an observer saw of a body is exact, and no sensor that may fail.
        """
        return {
            each.name: each
            for each in self._run.search.numbers
            if not each.is_index and self._run.meanings[each.name].is_sensed
            if not each.name.startswith(_OBSERVED)
        }


def _names_in(run: RunUnderCheck) -> _NamesIn:
    shared = run.search.shared
    if _NamesIn not in shared:
        shared[_NamesIn] = _NamesIn(run)
    names: _NamesIn = shared[_NamesIn]
    return names


# So many rows are at the limit, so many times. A rounded value that rests is compared with as many
# other rests: in 30 recordings of healthy temperatures of 10 minutes there was no false alarm.
_IN_A_ROW, _OFTEN = 3, 3


def sensors_within_limits(run: RunUnderCheck) -> Examined:
    """Fails where a signal left the limits that were declared of it.

    Warns where one was cut off at its least or greatest value in 5 % of the rows, or where a noisy
    one, whose values never repeat, came back to one extreme again and again. Not a range, which
    ends where nothing is in sight.
    """
    outside = list(_outside_declared_limits(run))
    if outside:
        first = min(outside, key=lambda each: each.since_s)
        others = listed([each.name for each in outside if each is not first], MOST_NAMED)
        evidence = f"{first.says}; also {others}" if others else first.says
        names = tuple(each.name for each in outside)
        return Fault(
            "fail", evidence, first.since_s, first.stretches, run.shows(first.name), signals=names
        )
    found = list(_saturated(run))
    if not found:
        names = _names_in(run).sensors
        limit = f"limit {100 * _AT_LIMIT:g} % of the rows"
        declared = any(each.limits_by == "declared" for each in run.meanings.values())
        says = "none was cut off at a limit" + ", and none left its declared limits" * declared
        return run.covered(says, signals=names, limit=limit)
    name, limit, share, since_s, count = max(found, key=lambda each: each[2])
    others = listed([each[0] for each in found if each[0] != name], MOST_NAMED)
    evidence = f"{name} was at {limit:.6g} in {100 * share:.3g} % of the rows"
    evidence += f"; also {others}" if others else ""
    return Fault("warn", evidence, since_s, count, run.shows(name), signals=(name,))


class _OutsideLimits(NamedTuple):
    """A signal that was beyond a declared limit, how often, and since when."""

    name: str
    says: str
    since_s: float
    stretches: int


def _outside_declared_limits(run: RunUnderCheck) -> Iterator[_OutsideLimits]:
    """Signals beyond limits that a person declared; those of a device leave room for its noise."""
    for name, meaning in run.meanings.items():
        if meaning.limits_by != "declared" or name not in run.frame:
            continue
        for limit, sign, which, to in (
            (meaning.low, -1, "below", "down to"),
            (meaning.high, 1, "above", "up to"),
        ):
            if limit is None:
                continue
            zones, beyond = run.frame.zone_map(name), sign * limit + _room_at(meaning, limit)
            if not (sign * (zones.max if sign > 0 else zones.min) > beyond).any():
                continue
            clock, values = run.frame.usable(name)
            out = sign * values > beyond
            stretches = runs_of(out, clock)
            farthest = sign * float((sign * values).max())
            says = (
                f"{name} was {which} its declared limit {limit:.6g} in "
                f"{np.count_nonzero(out)} of {counted(len(values), 'row')}, {to} {farthest:.6g}"
            )
            yield _OutsideLimits(name, says, float(stretches.starts_s[0]), len(stretches))


def _room_at(meaning: Meaning, limit: float) -> float:
    """Return by how much a value may be beyond a limit: a joint's stop is soft and yields."""
    if meaning.quantity == "joint position" and None not in (meaning.low, meaning.high):
        return _NEAR_LIMIT * ((meaning.high or 0.0) - (meaning.low or 0.0))
    return _ROUNDING * abs(limit)


def _saturated(run: RunUnderCheck) -> Iterator[tuple[str, float, float, float, int]]:
    names = _names_in(run)
    for name, signal in names.sensors.items():
        if run.search.deadline.passed:
            return
        quantity = run.meanings[name].quantity
        if name in names.place or signal.turn or names.target(name) or quantity == "distance":
            continue
        if quantity in _SPEEDS and run.meanings[name].role != "measured":
            continue  # it may be what a controller sets, which has a greatest value by design
        zones = run.frame.zone_map(name)
        if zones.change_count.sum() < _MANY_VALUES or not _is_often_at_an_end(run.frame, name):
            continue
        clock, values = run.frame.usable(name)
        if not _has_many_values(values):
            continue
        for limit in (float(values.min()), float(values.max())):
            if quantity == "joint position" and not _is_known_limit(run.meanings[name], limit):
                continue  # where a joint rests, again and again, is a posture
            if limit == 0 and run.meanings[name].quantity in CAN_BE_OFF:
                continue
            at = values == limit
            rests = runs_of(at, clock)
            long = rests.only(rests.stops - rests.starts >= _IN_A_ROW)
            if len(long) >= _OFTEN and at.mean() >= _AT_LIMIT:
                yield name, limit, float(at.mean()), float(long.starts_s[0]), len(long)
            elif limit != 0 and len(rests) >= _CUT_OFF and _is_cut_off(values[~at], rests):
                yield name, limit, float(at.mean()), float(rests.starts_s[0]), len(rests)


def _is_known_limit(meaning: Meaning, limit: float) -> bool:
    """Return whether a device or a person says that a signal ends there, to a hundredth."""
    if meaning.low is None or meaning.high is None:
        return False
    near = _NEAR_LIMIT * (meaning.high - meaning.low)
    return limit <= meaning.low + near or limit >= meaning.high - near


def _is_often_at_an_end(frame: Frame, name: str) -> bool:
    """Return whether enough rows have an extreme value; only chunks that reach one are opened."""
    zones = frame.zone_map(name)
    least_rows = min(_AT_LIMIT * zones.value_count.sum(), _CUT_OFF)
    for ends, limit in ((zones.min, np.nanmin(zones.min)), (zones.max, np.nanmax(zones.max))):
        opened = (numbers for _, numbers in frame.opened(name, ends == limit))
        if sum(np.count_nonzero(numbers == limit) for numbers in opened) >= least_rows:
            return True
    return False


def _is_cut_off(others: Array, hits: Runs) -> bool:
    """Return whether brief hits of one extreme are no chance: all other values are unique.

    Those of a smooth course are as well, which may have one crest again and again.
    """
    brief = median((hits.stops - hits.starts).astype(np.float64)) <= _BRIEFLY
    return brief and _are_unique(others) and is_noisy(others)


def _has_many_values(values: Array) -> bool:
    """Return whether there are so many different ones; mostly the first rows show it."""
    is_shown = len(np.unique(values[:_SORTED_AT_ONCE])) >= _MANY_VALUES
    return is_shown or len(np.unique(values)) >= _MANY_VALUES


def _are_unique(values: Array) -> bool:
    """Return whether hardly any value occurs twice.

    Values of different hashes differ, and what repeats within some rows repeats: mostly one of
    both decides without sorting all of them.
    """
    rows, most = _SORTED_AT_ONCE, (1 - _UNIQUE) * len(values)
    # Of so many values enough can repeat to say no, mostly without a look at the others.
    while rows <= _REPEATED * most:
        rows *= _MORE_SORTED
    if rows < len(values) and rows - len(np.unique(values[:rows])) > most + 1:
        return False
    whole: Any = values + 0.0  # 0 and -0 are one value
    hashes = (whole.view(np.uint64) * np.uint64(_MIXES)) >> np.uint64(64 - _HASH_BITS)
    is_there = np.zeros(2**_HASH_BITS, np.bool_)
    is_there[hashes] = True
    if np.count_nonzero(is_there) >= _UNIQUE * len(values):
        return True
    rows *= _MORE_SORTED
    while rows < len(values):
        if rows - len(np.unique(values[:rows])) > most + 1:
            return False
        rows *= _MORE_SORTED
    return len(np.unique(values)) >= _UNIQUE * len(values)


def sensors_drop_nothing(run: RunUnderCheck) -> Examined:
    """Warns where a signal went away and back at once, fails where it went to one value 3 times."""
    sensors = _names_in(run).sensors
    spikes = [each for each in run.events(JUMP.name) if "back" in each.details]
    gone = [each for each in spikes if each.name in sensors and _is_dropout(run, each)]
    gone = gone or _often_gone(run, spikes)
    if not gone:
        near = run.found.verdicts.nearest.get(JUMP.name)
        return run.covered("none dropped out" + (f" ({near})" if near else ""), of=JUMP.name)
    to = Counter((each.name, float(each.details["after"])) for each in gone)
    ((name, value), most) = to.most_common(1)[0]
    gone = by_array(gone)
    evidence = f"{_names(gone)} spiked {times(len(gone))}"
    evidence += f", {name} {times(most)} to {value:.6g}" if most > 1 else ""
    evidence += f"{'; the first' if len(gone) > 1 else ''}: {_spike(gone[0])}"
    outcome = "fail" if most >= _OFTEN_THE_SAME else "warn"
    more = run.more(JUMP.name)
    return Fault(outcome, evidence, gone[0].start_s, len(gone), more, signals=(name or "",))


def _often_gone(run: RunUnderCheck, spikes: list[Event]) -> list[Event]:
    """Return what went to 0 again and again, of signals of unknown meaning."""
    names = Counter(
        each.name
        for each in spikes
        if run.meanings[each.name or ""].source == "unknown" and float(each.details["after"]) == 0
    )
    often = {name for name, count in names.items() if count >= _OFTEN_THE_SAME}
    return [each for each in spikes if each.name in often and float(each.details["after"]) == 0]


def _spike(jump: Event) -> str:
    """Return the values before, during and after a spike, and when it was."""
    values = (float(jump.details[name]) for name in ("before", "after", "back"))
    return f"{' -> '.join(f'{value:.4g}' for value in values)} at {jump.start_s:.6g} s"


def _is_dropout(run: RunUnderCheck, jump: Event) -> bool:
    """Whether no motion and no switch explains that a reading went away and came back at once."""
    name = jump.name or ""
    quantity = run.meanings[name].quantity
    if quantity in INERT:
        return _stays_away(run.frame, name, jump)
    if quantity == "distance":  # other things may pass a sensor, but not at its very ends
        if run.search.known[name].reduction in ("min", "max"):  # whatever passes is the least
            return float(jump.details["after"]) == 0
        if float(jump.details["after"]) < 0 or not _THINGS.isdisjoint(words_in(name)):
            return False  # nothing is in sight: no distance is negative
        zones = run.frame.zone_map(name)
        ends = (0.0, float(np.nanmin(zones.min)), float(np.nanmax(zones.max)))
        return float(jump.details["after"]) in ends
    return False


def _stays_away(frame: Frame, name: str, jump: Event) -> bool:
    """Whether most values in between are nearer to where it went than to where it was.

    What swings meanwhile, or moves, measures.
    """
    before, after = float(jump.details["before"]), float(jump.details["after"])
    _, values = frame.between(jump.start_s, jump.end_s).usable(name)
    away = np.abs(values - after) < np.abs(values - before)
    return not len(values) or bool(np.mean(away) > MOSTLY)


def sensors_keep_noise(run: RunUnderCheck) -> Examined:
    """Warns where the noise of a sensor became three times as large, or more, for good."""
    found = run.events(DEGRADATION.name)
    if not found:
        limit = f"limit {TIMES:g} times the noise"
        return run.covered("none became noisier for good", of=DEGRADATION.name, limit=limit)
    worst = max(found, key=lambda each: each.details["noise_after"] / each.details["noise_before"])
    before, after = (worst.details[name] for name in ("noise_before", "noise_after"))
    evidence = f"noise of {worst.name} grew from {before:g} to {after:g} for good"
    others = listed([e.name or "" for e in found if e is not worst], MOST_NAMED)
    evidence += f"; also {others}" if others else ""
    more = run.more(DEGRADATION.name)
    firm = run.firmest(each.name or "" for each in found)
    return Fault("warn", evidence, worst.start_s, len(found), more, signals=firm)


def by_array(events: Iterable[Event]) -> list[Event]:
    """What the items of an array did at once as one."""
    found = {(_branch(each), each.start_s, each.end_s): each for each in reversed(list(events))}
    return list(reversed(found.values()))


def _names(events: Iterable[Event]) -> str:
    return listed(list(dict.fromkeys(map(_branch, events))), MOST_NAMED)


def _branch(event: Event) -> str:
    """The array, or the signal that is in none."""
    branch, _, item = (event.name or "").rpartition(".")
    return branch if item.isdigit() or item in REDUCTIONS else event.name or ""
