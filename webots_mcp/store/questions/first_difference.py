"""Where two runs part: the first row in which a signal is not the same to the last digit.

A row is compared with its partner, the row of the other run at the same simulation time; the
second of several at one time has the second as its partner. What could not be read is not judged.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from webots_mcp.conditions.signal_values import SAME_TIME_S
from webots_mcp.errors import InvalidInputError, NothingRecordedError, UnknownRunError
from webots_mcp.naming import METRES, Value, listed
from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.chunks import FIRST_LABEL, IS_ABSENT, IS_NUMBER, MAX_TEXT, Decoded, Replaced
from webots_mcp.store.parameters import Trial, parameters_of, spelled
from webots_mcp.store.questions.compare import COMPARE_DEADLINE_S
from webots_mcp.store.questions.runs import OUT_OF_TIME
from webots_mcp.store.reading.catalogue import held_by, resolve_signals, signals_of_frame
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline, Subject, in_one_snapshot, just_after
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.signals import Signal

_MATTERS_M: Final = 0.001
_MATTERS_RAD: Final = 0.001
_MATTERS_SHARE: Final = 0.001  # of the largest value, where there is no better scale
_SHORT_ROWS: Final = 2  # between the last row and the time up to which rows are compared
_MARKS: Final = 5  # times at which it is said how far a signal is apart
_OF_READING: Final = 0.5  # of the time: for rows that are in no chunk yet
_ABSENT: Final = "(absent)"
_BEGAN_BY: Final = "began_by"
_IN_PART: Final = (
    f"of arrays of more than 16 items and of texts only what is kept of them was compared: count, "
    f"min, max, mean and argmin, and the first {MAX_TEXT} characters"
)
_FACTS: Final = (
    "SELECT b.name, s.controller_sha256, s.git_commit, r.world, r.basic_time_step_ms, "
    "s.throttle_interval, r.start_reason, s.versions FROM run r JOIN session s "
    "ON s.id = r.session_id JOIN robot b ON b.id = r.robot_id WHERE r.id = ?"
)
_NAMES: Final = (
    "robot", "controller_sha256", "git_commit", "world", "basic_time_step_ms", "throttle_interval",
    _BEGAN_BY,
)  # fmt: skip


@dataclass(frozen=True)
class PartedSignal:
    """A signal that is not the same in both runs.

    Attributes:
        from_s: Simulation time of the first row in which it is not; `values` are those there.
        by: How far they are apart; None unless both are numbers.
        largest: How far at most, at `largest_at_s`; of an angle the shorter way round.
        tolerance: What is beyond it matters; None of what is no number.
        beyond_s: The first row in which it is, or in which one of them is no number.
        rows: In how many rows it is not the same.
        growth: How far at most up to each of the marks.
    """

    name: str
    unit: str | None
    from_s: float
    values: tuple[Value, Value]
    by: float | None
    largest: float | None
    largest_at_s: float | None
    tolerance: float | None
    beyond_s: float | None
    rows: int
    growth: tuple[float, ...]

    def __str__(self) -> str:
        if self.by is None:
            return f"{self.name} ({self.values[0]!r}, {self.values[1]!r})"
        return f"{self.name} by {self._measured(self.by)}"

    @property
    def at_most(self) -> str:
        """How far it is apart at most, in words."""
        assert self.largest is not None
        return f"{self.name} up to {self._measured(self.largest)} at {self.largest_at_s:.3f} s"

    @property
    def beyond(self) -> str:
        """From when on it matters, in words."""
        what = "without a number in one run" if self.tolerance is None else "beyond "
        limit = "" if self.tolerance is None else self._measured(self.tolerance)
        return f"{self.name} {what}{limit} from {self.beyond_s:.3f} s on"

    def _measured(self, number: float) -> str:
        return f"{number:.3g}" + (f" {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class Parting:
    """What came of two runs that were compared row by row.

    Attributes:
        unlike: What was not the same to begin with, of each run: parameters, code, world, ...
        rows: So many were compared, from `from_s` to `until_s`; of them so many `signals`.
        parted: In the order in which they part; at once, the one that is further apart first.
        marks_s: Simulation times of `PartedSignal.growth`.
        alone: Of each run that has rows without a partner, how many and when the first is.
        only_in: Of each run the signals that the other does not have.
        unread: What was not compared, and why.
        is_short: A run ends clearly before the time up to which they were to be compared.
    """

    run_ids: tuple[int, int]
    unlike: dict[str, tuple[Any, Any]]
    rows: int
    signals: int
    from_s: float
    until_s: float
    parted: tuple[PartedSignal, ...]
    marks_s: tuple[float, ...]
    alone: dict[int, tuple[int, float]]
    only_in: dict[int, tuple[str, ...]]
    unread: tuple[str, ...]
    is_short: bool
    notes: tuple[str, ...]

    @property
    def is_equal(self) -> bool | None:
        """Whether all is the same to the last digit; None where not all could be compared."""
        return False if self.parted else True if self.is_whole else None

    @property
    def is_whole(self) -> bool:
        """Whether all that was to be compared was; without a time, until the shorter run ends."""
        is_left_out = self.unread or self.alone or self.only_in or self.is_short
        return bool(self.rows and self.signals and not is_left_out)

    @property
    def worst(self) -> PartedSignal | None:
        """The signal that is furthest apart, in units of its tolerance."""
        numbers = [each for each in self.parted if each.largest is not None]
        return max(numbers, key=_in_tolerances, default=None)

    @property
    def verdict(self) -> str:
        """Where they part, in a sentence; it says no more than was compared."""
        begun = [name for name in self.unlike if name != _BEGAN_BY]
        said = f"not alike to begin with ({listed(begun)}); " if begun else ""
        said += self._said_of_values()
        return said + ("; not all of them could be read" if self.unread else "")

    def _said_of_values(self) -> str:
        one, other = self.run_ids
        if self.unread and not (self.rows and self.signals):
            return "nothing was compared"
        if not self.rows:
            return f"nothing to compare: no row of run {one} has a partner in run {other}"
        if not self.signals:
            return f"nothing to compare: no signal is in both run {one} and run {other}"
        if not self.parted:
            return (
                f"equal to the last digit in the {self.rows} rows and {self.signals} signals that "
                f"were compared, until {self.until_s:.3f} s"
            )
        first, worst = self.parted[0], self.worst
        more = sum(each.from_s == first.from_s for each in self.parted) - 1
        said = f"equal to the last digit until {first.from_s:.3f} s; then "
        if first.from_s <= self.from_s:
            said = f"unlike from the first row on, at {first.from_s:.3f} s: "
        said += f"{first}" + (f" and {more} more" if more else "")
        beyond = [each for each in self.parted if each.beyond_s is not None and each.by is not None]
        if beyond:
            return f"{said}; {min(beyond, key=lambda each: each.beyond_s or 0.0).beyond}"
        return f"{said}; at most {worst.at_most}" if worst else said


def _in_tolerances(each: PartedSignal) -> float:
    return (each.largest or 0.0) / (each.tolerance or 1.0)


@in_one_snapshot
def first_difference(
    connection: sqlite3.Connection,
    run_ids: Sequence[int],
    *,
    names: Sequence[str] = ("*",),
    until_s: float | None = None,
    within: float | None = None,
    deadline_s: float = COMPARE_DEADLINE_S,
) -> Parting:
    """Compare two runs row by row.

    Args:
        connection: Any.
        run_ids: Two different runs, of whichever robots.
        names: Signals, with `*`.
        until_s: The last simulation time that is compared; None for all.
        within: What is beyond it matters, in the unit of each signal; None for 1 mm of lengths,
            0.001 rad of angles, and a thousandth of the largest value of all else.
        deadline_s: What was not read by then is not compared, and said.

    Raises:
        InvalidInputError: Not two different runs.
        UnknownRunError, UnknownSignalError: As they say.
        NothingRecordedError: A run has no state row.
    """
    if len(run_ids) != 2 or run_ids[0] == run_ids[1]:
        raise InvalidInputError(f"give two different runs, not {list(run_ids)}")
    deadline = Deadline(deadline_s)
    first = _read(connection, run_ids[0], until_s, deadline.part(_OF_READING / 2))
    sides = (first, _read(connection, run_ids[1], until_s, deadline.part(_OF_READING)))
    pair = _aligned([side.frame for side in sides])
    known = sides[0].known | sides[1].known
    meant = resolve_signals(known, names) if names != ("*",) else list(known.values())
    shared = [each for each in meant if all(each.name in side.known for side in sides)]
    marks_s, parted, done, reduced = _marks(pair.times), list[PartedSignal](), 0, False
    for signal in shared if len(pair.times) else ():
        if deadline.passed:
            break
        found = _parted(signal, pair, marks_s, within)
        parted += [found] if found else []
        done += 1
        reduced = reduced or signal.reduction is not None or pair.has_long_text(signal.name)
    parted.sort(key=lambda each: (each.from_s, -_in_tolerances(each)))
    unread = [f"run {side.frame.run_id}: {part}" for side in sides for part in side.frame.unread]
    if len(pair.times) and done < len(shared):
        unread += [f"{len(shared) - done} of {len(shared)} signals: {OUT_OF_TIME}"]
    only_in = {
        one.frame.run_id: tuple(e.name for e in meant if e.name in one.known.keys() - other.known)
        for one, other in (sides, sides[::-1])
    }
    notes, is_short = [*_of_rows(sides, pair), *[_IN_PART] * reduced], False
    if until_s is not None and len(pair.times):
        row_s = float(pair.times[-1] - pair.times[0]) / max(len(pair.times) - 1, 1)
        is_short = bool(pair.times[-1] < until_s - _SHORT_ROWS * row_s - SAME_TIME_S)
        notes += [f"it was to be compared until {until_s:g} s: a run is too short"] * is_short
    return Parting(
        run_ids=(run_ids[0], run_ids[1]),
        unlike=_unlike(connection, *run_ids),
        rows=len(pair.times),
        signals=done,
        from_s=float(pair.times[0]) if len(pair.times) else math.nan,
        until_s=float(pair.times[-1]) if len(pair.times) else math.nan,
        parted=tuple(parted),
        marks_s=marks_s,
        alone=pair.alone,
        only_in={run_id: found for run_id, found in only_in.items() if found},
        unread=tuple(unread),
        is_short=is_short,
        notes=tuple(notes),
    )


class _Side(NamedTuple):
    """One of the runs, and the signals that it has."""

    frame: Frame
    known: dict[str, Signal]


def _read(
    connection: sqlite3.Connection, run_id: int, until_s: float | None, deadline: Deadline
) -> _Side:
    subject = Subject(fetch_run(connection, run_id).robot_id, "", run_id)
    segment = whole_run(connection, run_id)
    if segment is None:
        raise NothingRecordedError(f"run {run_id} has no state row: there is nothing to compare")
    if until_s is not None and until_s < segment.end_s:
        segment = segment.through(until_s)
    frame = read_frame(connection, segment, deadline)
    return _Side(frame, held_by(connection, frame, signals_of_frame(connection, subject, frame)))


class _Pair(NamedTuple):
    """Two frames, and the rows of each that are compared, in order; see `Parting.alone`."""

    frames: Sequence[Frame]
    rows: tuple[Indexes, Indexes] | None
    times: Array
    alone: dict[int, tuple[int, float]]

    def of(self, values: Sequence[Any]) -> list[Any]:
        """Of arrays with an item for each row of their frames, the rows that are compared."""
        if self.rows is None:
            return list(values)
        return [each[rows] for each, rows in zip(values, self.rows, strict=True)]

    def has_long_text(self, name: str) -> bool:
        """Whether a text of the signal may have been cut."""
        labels = (label for frame in self.frames for label in frame.recorded(name).labels)
        return any(isinstance(label, str) and len(label) >= MAX_TEXT for label in labels)


def _aligned(frames: Sequence[Frame]) -> _Pair:
    """Rows of the same simulation time, of those whose time could be read."""
    one, other = (np.rint(frame.times / SAME_TIME_S) for frame in frames)
    read = [frame.was_read() for frame in frames]
    if np.array_equal(one, other) and all(each.all() for each in read):
        return _Pair(frames, None, frames[0].times, {})
    places = np.searchsorted(other, one) + np.arange(len(one)) - np.searchsorted(one, one)
    found: Flags = places < len(other)
    found[found] = (other[places[found]] == one[found]) & read[1][places[found]]
    found &= read[0]
    rows = (np.flatnonzero(found), places[found])
    alone: dict[int, tuple[int, float]] = {}
    for at, (keys, others) in enumerate(((one, other), (other, one))):
        frame, is_read = frames[at], read[at]
        is_read[rows[at]] = False
        for part in frames[1 - at].unread:  # where the partner may be
            is_read[slice(*frame.places([part.start_s, just_after(part.end_s)]))] = False
        if len(keys) and len(others):
            is_read &= (keys >= others[0]) & (keys <= others[-1])
            if count := int(np.count_nonzero(is_read)):
                alone[frame.run_id] = (count, float(frame.times[int(np.argmax(is_read))]))
    return _Pair(frames, rows, frames[0].times[rows[0]], alone)


def _parted(
    signal: Signal, pair: _Pair, marks_s: Sequence[float], within: float | None
) -> PartedSignal | None:
    """How a signal differs; None where it is the same in all rows that were read."""
    name = signal.name
    recorded = [frame.recorded(name) for frame in pair.frames]
    one, other = pair.of([each.numbers for each in recorded])
    differs: Flags = one != other
    both: Flags | None = None  # hold a number; None where all do
    if any(each.codes is not None for each in recorded):
        known: dict[object, int] = {}
        codes: list[Indexes] = pair.of([_shared_codes(each, known) for each in recorded])
        numbers: Flags = (codes[0] == IS_NUMBER) & (codes[1] == IS_NUMBER)
        differs = (codes[0] != codes[1]) | (numbers & differs)
        both = numbers
    if any(frame.unread_of(name) for frame in pair.frames):
        for read in pair.of([frame.was_read(name) for frame in pair.frames]):
            differs &= read
    if not differs.any():
        return None
    rows = np.flatnonzero(differs)
    times = pair.times[rows]
    with np.errstate(invalid="ignore", over="ignore"):
        apart: Array = np.abs(one[rows] - other[rows])
        if (turn := signal.turn) is not None:
            apart = np.minimum(apart % turn, turn - apart % turn)
    if both is not None:
        apart[~both[rows]] = np.nan
    is_number = ~np.isnan(apart)
    tolerance = _tolerance(signal, (one, other), within) if is_number.any() else None
    beyond = ~is_number if tolerance is None else ~is_number | (apart > tolerance)
    sizes = np.where(is_number, apart, 0.0)
    largest = int(np.argmax(sizes))
    places = [int(rows[0] if each is None else each[rows[0]]) for each in pair.rows or (None, None)]
    values = [_value(each, place) for each, place in zip(recorded, places, strict=True)]
    ends = np.searchsorted(times, np.array(marks_s) + SAME_TIME_S).tolist()
    return PartedSignal(
        name=name,
        unit=_unit(signal),
        from_s=float(times[0]),
        values=(values[0], values[1]),
        by=float(apart[0]) if is_number[0] else None,
        largest=float(sizes[largest]) if is_number.any() else None,
        largest_at_s=float(times[largest]) if is_number.any() else None,
        tolerance=tolerance,
        beyond_s=float(times[int(np.argmax(beyond))]) if beyond.any() else None,
        rows=len(rows),
        growth=tuple(float(sizes[:end].max(initial=0.0)) for end in ends),
    )


def _shared_codes(values: Decoded, known: dict[object, int]) -> Indexes:
    """Codes that are the same of the same label in both runs; a flag is no number."""
    if values.codes is None:
        return np.full(len(values.numbers), IS_NUMBER, np.intp)
    labels = [known.setdefault((type(each), each), len(known)) for each in values.labels]
    shared = [IS_NUMBER, IS_ABSENT, *(FIRST_LABEL + label for label in labels)]
    return np.array(shared, np.intp)[values.codes]


def _value(values: Decoded, row: int) -> Value:
    """What stands in a row, with all its digits; in brackets what is replaced or absent."""
    code = IS_NUMBER if values.codes is None else int(values.codes[row])
    if code in (IS_NUMBER, IS_ABSENT):
        return float(values.numbers[row]) if code == IS_NUMBER else _ABSENT
    label = values.labels[code - FIRST_LABEL]
    return f"({label.why})" if isinstance(label, Replaced) else label


def _unit(signal: Signal) -> str | None:
    """A position whose name has no unit is in metres."""
    is_place = (signal.role or "").rstrip("23456789") in ("x", "y", "z")
    return signal.unit or ("m" if is_place else None)


def _tolerance(signal: Signal, values: Sequence[Array], within: float | None) -> float:
    if within is not None:
        return within
    unit = _unit(signal)
    if unit in METRES:
        return _MATTERS_M / METRES[unit]
    if signal.turn is not None:
        return _MATTERS_RAD * signal.turn / math.tau
    sizes = [np.max(np.abs(v), where=np.isfinite(v), initial=0.0) for v in values]
    return _MATTERS_SHARE * float(max(sizes))


def _marks(times: Array) -> tuple[float, ...]:
    """Times of a comparison 1, 2, 5, 10, ... seconds after its first row, and its end."""
    if not len(times):
        return ()
    start_s, lasted_s = float(times[0]), float(times[-1] - times[0])
    after_s = [each * 10.0**power for power in range(-2, 9) for each in (1, 2, 5)]
    before = [each for each in after_s if each < lasted_s * (1 - _MATTERS_SHARE)]
    return (*(start_s + each for each in before[1 - _MARKS :]), float(times[-1]))


def _of_rows(sides: Sequence[_Side], pair: _Pair) -> Iterator[str]:
    """Rows that have no partner, and those behind the end of the shorter run."""
    for run_id, (count, first_s) in pair.alone.items():
        yield (
            f"{count} rows of run {run_id}, the first at {first_s:.3f} s, have no partner at the "
            "same simulation time: they are not compared"
        )
    ends = {side.frame.run_id: side.frame.bounds_s[1] for side in sides if len(side.frame)}
    longer = max(ends, key=lambda run_id: ends[run_id], default=None)
    if longer is not None and len(pair.times) and ends[longer] > pair.times[-1] + SAME_TIME_S:
        yield f"run {longer} goes on to {ends[longer]:.3f} s, which the other does not reach"


def _unlike(connection: sqlite3.Connection, one: int, other: int) -> dict[str, tuple[Any, Any]]:
    """Parameters first, then what was recorded of code, world and programs."""
    had = parameters_of(connection, [one, other])
    values: list[dict[str, Any]] = [
        {f"parameter {n}": each.described for n, each in had[run].items()} for run in (one, other)
    ]
    for run_id, known in zip((one, other), values, strict=True):
        *facts, versions = connection.execute(_FACTS, (run_id,)).fetchone()
        known |= dict(zip(_NAMES, facts, strict=True))
        known |= {f"version of {n}": v for n, v in json.loads(versions or "{}").items()}
    names = dict.fromkeys([*values[0], *values[1]])
    pairs = {name: (values[0].get(name), values[1].get(name)) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


# Runs that should be alike, each compared with the first of them.


_MOST_SETTINGS: Final = 5  # of a trial set that are looked at, and as many runs of each
_TRIALS_DEADLINE_S: Final = 2.0


class Repeats(NamedTuple):
    """What came of runs that repeat each other.

    Attributes:
        run_ids: The first is the reference.
        partings: Of each other run with it.
    """

    run_ids: tuple[int, ...]
    partings: tuple[Parting, ...]

    @property
    def are_equal(self) -> bool | None:
        """Whether all are the same to the last digit; None where not all could be compared."""
        found = {each.is_equal for each in self.partings}
        return False if False in found else None if None in found else True

    @property
    def verdict(self) -> str:
        """Whether they repeat, and else from when on and how far they part, in a sentence."""
        parted = [each for each in self.partings if each.parted]
        if not parted:
            least = min(self.partings, key=lambda each: (each.is_whole, each.rows))
            said = f"{len(self.run_ids)} runs: {least.verdict}"
            return said if self.are_equal else f"{said}; not all of them was compared"
        first = min(parted, key=lambda each: each.parted[0].from_s)
        said = f"{len(parted)} of {len(self.partings)} repeats part from run {self.run_ids[0]}"
        said += f"; run {first.run_ids[1]} first: {first.verdict}"
        worst = max((each.worst for each in parted if each.worst), key=_in_tolerances, default=None)
        return f"{said}; of all runs at most {worst.at_most}" if worst else said


def compare_repeats(
    connection: sqlite3.Connection, run_ids: Sequence[int], **options: Any
) -> Repeats:
    """Compare runs that should be alike with the first of them; see `first_difference`."""
    first, *others = run_ids
    found = (first_difference(connection, (first, other), **options) for other in others)
    return Repeats(tuple(run_ids), tuple(found))


def repeats_of_trials(connection: sqlite3.Connection, trials: Sequence[Trial]) -> list[str]:
    """Whether the trials of a set that have the same parameters repeat each other, as notes.

    Of the first five settings that have two scores or more, the first five runs are compared, up
    to where the first of them ended.
    """
    settings: dict[str, list[Trial]] = {}
    for each in trials:
        if each.score is not None and each.run_id is not None:
            settings.setdefault(spelled(each.values), []).append(each)
    repeated = {name: each[:_MOST_SETTINGS] for name, each in settings.items() if len(each) > 1}
    found, deadline = dict[str, Repeats](), Deadline(_TRIALS_DEADLINE_S)
    for name, each in list(repeated.items())[:_MOST_SETTINGS]:
        ends = [trial.ended_sim_time_s for trial in each if trial.ended_sim_time_s is not None]
        run_ids = [trial.run_id for trial in each if trial.run_id is not None]
        until_s = min(ends, default=None)
        with suppress(NothingRecordedError, UnknownRunError):  # retention has deleted one
            found[name] = compare_repeats(
                connection, run_ids, until_s=until_s, deadline_s=deadline.left_s
            )
    if not found:
        return []
    left = len(repeated) - len(found)
    more = f"; {left} more repeated settings were not compared" if left else ""
    parted = {name: each for name, each in found.items() if each.are_equal is False}
    for name, each in parted.items():
        said = f"repeats part in {len(parted)} of the {len(found)} settings that were compared"
        return [f"{said}; {name or 'as they are'}: {each.verdict}{more}"]
    for each in found.values():
        if each.are_equal is None:
            return [f"whether repeats are the same to the last digit is unknown; {each.verdict}"]
    said = f"repeats are the same to the last digit ({len(found)} of the settings were compared)"
    return [f"{said}: more of them show nothing new{more}"]
