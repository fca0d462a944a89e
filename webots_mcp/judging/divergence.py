"""Where two runs part: the first row in which a signal is not the same to the last digit.

A row is compared with its partner, the row of the other run at the same simulation time; the
second of several at one time has the second as its partner. What could not be read is not judged.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.errors import InvalidInputError, NothingRecordedError, UnknownRunError
from webots_mcp.judging.comparison import COMPARE_DEADLINE_S
from webots_mcp.judging.run_measures import OUT_OF_TIME
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.signals.naming import METRES, Value, counted, listed
from webots_mcp.store.chunks import FIRST_LABEL, IS_ABSENT, IS_NUMBER, Decoded, Replaced
from webots_mcp.store.reading.catalogue import held_by, resolve_signals, signals_of_frame
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline, Subject, in_one_snapshot, just_after
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.run_parameters import parameters_of
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.trial_sets import scored_runs

_MATTERS: Final = 0.001  # of metres, of radians, of the largest value where there is no scale
_SHORT_ROWS: Final = 2  # between the last row and the time up to which rows are compared
_SHOWN: Final = 5  # times at which it is said how far a signal is apart, and like trials
_LONGEST_TEXT: Final = 60  # of a value that is shown
_REDUCED: Final = "of arrays of more than 16 items count, min, max, mean and argmin are compared"


class PartedSignal(NamedTuple):
    """A signal that is not the same in both runs.

    Attributes:
        from_s: Simulation time of the first row in which it is not; `values` are those there.
        by: How far they are apart; None unless both are numbers.
        largest: How far at most, at `largest_at_s`; of an angle the shorter way round.
        tolerance: What is beyond it matters; None of what is never a number in both.
        beyond_s: The first row in which it is, or in which one of them is no number.
        row_count: In how many rows it is not the same.
        growth: How far at most until some simulation times.
    """

    signal: str
    unit: str | None
    from_s: float
    values: tuple[Value, Value]
    by: float | None
    largest: float | None
    largest_at_s: float | None
    tolerance: float | None
    beyond_s: float | None
    row_count: int
    growth: dict[str, float]

    @property
    def in_tolerances(self) -> float:
        """How far it is apart at most, in units of what matters."""
        return (self.largest or 0.0) / (self.tolerance or 1.0)

    def said(self, size: float | None, by: str) -> str:
        """Its name, and a difference with its unit; the values where they are no numbers."""
        if size is None:
            return f"{self.signal} ({self.values[0]!r}, {self.values[1]!r})"
        return f"{self.signal} {by} {size:.3g}" + (f" {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class Parting:
    """What came of two runs that were compared row by row.

    Attributes:
        unlike: What was not the same to begin with, of each run: parameters, code, world, ...
        rows: So many were compared, from `from_s` to `until_s`; of them so many `signals`.
        parted: In the order in which they part; at once, the one that is further apart first.
        is_whole: Whether all was compared: without `until_s`, until the shorter run ends.
        notes: What was not compared, and why.
    """

    run_ids: tuple[int, int]
    unlike: dict[str, tuple[Any, Any]]
    rows: int
    signals: int
    from_s: float
    until_s: float
    parted: tuple[PartedSignal, ...]
    is_whole: bool
    notes: tuple[str, ...]

    @property
    def is_equal(self) -> bool | None:
        """Whether all is the same to the last digit; None where not all could be compared."""
        return False if self.parted else self.is_whole or None

    @property
    def worst(self) -> PartedSignal | None:
        """The signal that is furthest apart, in units of its tolerance."""
        numbers = (each for each in self.parted if each.largest is not None)
        return max(numbers, key=lambda each: each.in_tolerances, default=None)

    @property
    def verdict(self) -> str:
        """Where they part, in a sentence; it says no more than was compared."""
        begun = [name for name in self.unlike if name != "began_by"]
        said = f"not alike to begin with ({listed(begun)}); " if begun else ""
        if not (self.rows and self.signals):
            return f"{said}nothing could be compared"
        what = counted(self.rows, "row"), counted(self.signals, "signal")
        rows = f"{' and '.join(what)} that were compared"
        equal = f"equal to the last digit in the {rows}, until {self.until_s:.3f} s"
        said += self._said_of_parted() if self.parted else equal
        return said + ("" if self.is_whole else "; not all was compared")

    def _said_of_parted(self) -> str:
        first, worst = self.parted[0], self.worst
        more = sum(each.from_s == first.from_s for each in self.parted) - 1
        said = f"equal to the last digit until {first.from_s:.3f} s; then "
        if first.from_s <= self.from_s:
            said = f"unlike from the first row on, at {first.from_s:.3f} s: "
        said += first.said(first.by, "by") + (f" and {more} more" if more else "")
        beyond = [e for e in self.parted if e.beyond_s is not None and e.tolerance is not None]
        for each in sorted(beyond, key=lambda each: each.beyond_s or 0.0)[:1]:
            said += f"; {each.said(each.tolerance, 'beyond')} from {each.beyond_s:.3f} s on"
        if worst and (worst is not first or first.largest != first.by):
            said += f"; {worst.said(worst.largest, 'by at most')}"
        return said


@in_one_snapshot
def compare_rows(
    connection: sqlite3.Connection,
    run_ids: Sequence[int],
    *,
    names: Sequence[str] = ("*",),
    until_s: float = math.inf,
    within: float | None = None,
    offset_s: float = 0.0,
    deadline_s: float = COMPARE_DEADLINE_S,
) -> Parting:
    """Compare two runs row by row.

    Args:
        connection: Any.
        run_ids: Two different runs, of whichever robots.
        names: Signals, with `*`.
        until_s: The last simulation time that is compared.
        within: What is beyond it matters, in the unit of each signal; None for 1 mm of lengths,
            0.001 rad of angles, and a thousandth of the largest value of all else.
        offset_s: The simulation time of the first run at which that of the second is 0. Times are
            those of the first. A signal that is apart by just this counts time, and is left out.
        deadline_s: What was not read by then is not compared, and said.

    Raises:
        InvalidInputError: Not two different runs.
        UnknownRunError, UnknownSignalError: As they say.
        NothingRecordedError: A run has no state row.
    """
    if len(run_ids) != 2 or run_ids[0] == run_ids[1]:
        raise InvalidInputError(
            f"run_ids must be two different runs, not {list(run_ids)}. "
            "webots_list_runs shows the runs."
        )
    deadline = Deadline(deadline_s)
    # Half of the time is for rows that are in no chunk yet.
    one, in_one = _read(connection, run_ids[0], until_s, deadline.part(0.25), offset_s)
    other, in_other = _read(connection, run_ids[1], until_s - offset_s, deadline.part(0.33))
    meant = resolve_signals(in_one | in_other, names)
    shared = [each for each in meant if each.name in in_one and each.name in in_other]
    pair = _aligned((one, other), offset_s)
    found: dict[str, PartedSignal | None] = {}
    for signal in shared:
        if deadline.passed:
            break
        found[signal.name] = _parted(signal, pair, within)
    parted = sorted(filter(None, found.values()), key=lambda e: (e.from_s, -e.in_tolerances))
    left_out = [f"run {each.run_id}: {part}" for each in pair.frames for part in each.unread]
    if left := len(shared) - len(found):
        left_out.append(f"{counted(left, 'signal')}: {OUT_OF_TIME}")
    for run_id, here, there in (run_ids[0], in_one, in_other), (run_ids[1], in_other, in_one):
        names = [each.name for each in meant if each.name in here and each.name not in there]
        left_out += [f"only run {run_id} has {listed(names)}"] if names else []
    left_out += pair.alone or ["no row has a partner that could be read"] * (not len(pair.times))
    from_s, until = (float(pair.times[at]) if len(pair.times) else math.nan for at in (0, -1))
    row_s = (until - from_s) / max(len(pair.times), 1)
    if until < until_s - _SHORT_ROWS * row_s - SAME_TIME_S and until_s < math.inf:
        left_out += [f"a run ends before {until_s:g} s"]
    remarks = [_REDUCED] * any(each.reduction for each in shared)
    begins_s = sorted((one.bounds_s[0], other.bounds_s[0] + offset_s))
    if not offset_s and len(pair.times) and begins_s[1] > begins_s[0] + row_s / 2:
        remarks += ["one run begins at {:.3f} s, the other at {:.3f} s".format(*begins_s)]
    last_s = max(one.bounds_s[1], other.bounds_s[1] + offset_s)
    if len(pair.times) and last_s > until + row_s / 2:
        remarks += [f"one run goes on to {last_s:.3f} s, which the other does not"]
    return Parting(
        (run_ids[0], run_ids[1]), _unlike(connection, run_ids), len(pair.times), len(found),
        from_s, until, tuple(parted), bool(len(pair.times) and found and not left_out),
        (*left_out, *remarks),
    )  # fmt: skip


def _read(
    connection: sqlite3.Connection,
    run_id: int,
    until_s: float,
    deadline: Deadline,
    after_s: float = 0.0,
) -> tuple[Frame, dict[str, RegisteredSignal]]:
    """A run after a time, by default all of it, and the signals that it has."""
    subject = Subject(fetch_run(connection, run_id).robot_id, "", run_id)
    segment = whole_run(connection, run_id)
    if segment is None:
        raise NothingRecordedError(
            f"Run {run_id} has no state row, so there is nothing to compare. Choose "
            "another run from webots_list_runs."
        )
    if until_s < segment.end_s:
        segment = segment.through(until_s)
    if after_s:
        segment = replace(segment, start_s=just_after(after_s), open_start=False)
    frame = read_frame(connection, segment, deadline)
    return frame, held_by(connection, frame, signals_of_frame(connection, subject, frame))


class _Pair(NamedTuple):
    """Two frames, the rows of each that are compared, in order, and what is said of the others."""

    frames: tuple[Frame, Frame]
    rows: tuple[Indexes | slice, Indexes | slice]
    times: Array
    alone: Sequence[str] = ()
    offset_s: float = 0.0

    def of(self, values: Sequence[Any]) -> list[Any]:
        """Of arrays with an item for each row of their frames, the rows that are compared."""
        return [each[rows] for each, rows in zip(values, self.rows, strict=True)]


def _aligned(frames: tuple[Frame, Frame], offset_s: float) -> _Pair:
    """Rows of the same simulation time, of those whose time could be read."""
    one = np.rint(frames[0].times / SAME_TIME_S)
    other = np.rint((frames[1].times + offset_s) / SAME_TIME_S)
    read = [frame.was_read() for frame in frames]
    if np.array_equal(one, other) and all(each.all() for each in read):
        return _Pair(frames, (slice(None), slice(None)), frames[0].times, (), offset_s)
    places = np.searchsorted(other, one) + np.arange(len(one)) - np.searchsorted(one, one)
    found: Flags = places < len(other)
    found[found] = (other[places[found]] == one[found]) & read[1][places[found]]
    found &= read[0]
    rows, notes = (np.flatnonzero(found), places[found]), list[str]()
    for at, (keys, others) in enumerate(((one, other), (other, one))):
        frame, is_alone = frames[at], read[at]
        is_alone[rows[at]] = False
        later_s = -offset_s if at else offset_s
        for part in frames[1 - at].unread:  # where the partner may be
            bounds = [part.start_s + later_s, just_after(part.end_s + later_s)]
            is_alone[slice(*frame.places(bounds))] = False
        first, last = others[[0, -1]].tolist() if len(others) else (1.0, 0.0)
        if count := int(np.count_nonzero(is_alone & (keys >= first) & (keys <= last))):
            first_s = frame.times[np.argmax(is_alone & (keys >= first))]
            run = f"{counted(count, 'row')} of run {frame.run_id}, the first at {first_s:.3f} s"
            notes += [f"without a partner at the same simulation time, and not compared: {run}"]
    return _Pair(frames, rows, frames[0].times[rows[0]], notes, offset_s)


def _parted(signal: RegisteredSignal, pair: _Pair, within: float | None) -> PartedSignal | None:
    """How a signal differs; None where it is the same in all rows that were read."""
    name, unit = signal.name, signal.unit
    if (signal.role or "").rstrip("23456789") in ("x", "y", "z"):
        unit = unit or "m"
    recorded = [frame.recorded(name) for frame in pair.frames]
    one, other = pair.of([each.numbers for each in recorded])
    differs: Flags = one != other
    codes, labels = list[Indexes](), dict[object, int]()
    if any(each.codes is not None for each in recorded):
        codes = pair.of([_shared_codes(each, labels) for each in recorded])
        differs = (codes[0] != codes[1]) | (differs & (codes[0] == IS_NUMBER))
    for was_read in pair.of([frame.was_read(name) for frame in pair.frames]):
        differs &= was_read
    rows = np.flatnonzero(differs)
    if not len(rows) or (pair.offset_s and _counts_time(one - other, pair.offset_s)):
        return None
    times = pair.times[rows]
    with np.errstate(invalid="ignore", over="ignore"):
        apart: Array = np.abs(one[rows] - other[rows])
        if (turn := signal.turn) is not None:
            apart = np.minimum(apart % turn, turn - apart % turn)
    for each in codes:
        apart[each[rows] != IS_NUMBER] = np.nan
    is_number = np.isfinite(apart)
    sizes = np.where(is_number, apart, 0.0)
    largest = int(np.argmax(sizes))
    tolerance = _tolerance(signal, unit, (one, other)) if within is None else within
    beyond = ~is_number | (apart > tolerance)
    places = pair.of([np.arange(len(frame)) for frame in pair.frames])
    values = [_value(each, int(at[rows[0]])) for each, at in zip(recorded, places, strict=True)]
    most: tuple[Any, Any, Any] = (float(sizes[largest]), float(times[largest]), tolerance)
    grown = {f"until {s:.3f} s": sizes[times <= s].max(initial=0.0) for s in _marks(pair.times)}
    return PartedSignal(
        name, unit, float(times[0]), (values[0], values[1]),
        float(apart[0]) if is_number[0] else None,
        *(most if is_number.any() else (None, None, None)),
        float(times[int(np.argmax(beyond))]) if beyond.any() else None, len(rows),
        {until: float(f"{size:.4g}") for until, size in grown.items()},
    )  # fmt: skip


def _counts_time(apart: Array, offset_s: float) -> bool:
    """Whether a signal is apart by the time between the runs, in seconds or milliseconds."""
    return any(bool(np.allclose(apart, by, rtol=0.0, atol=SAME_TIME_S * by / offset_s))
               for by in (offset_s, 1000.0 * offset_s))  # fmt: skip


def _shared_codes(values: Decoded, known: dict[object, int]) -> Indexes:
    """Codes that are the same of the same label in both runs; a flag is no number."""
    if values.codes is None:
        return np.full(len(values.numbers), IS_NUMBER, np.intp)
    labels = [known.setdefault((type(e), e), len(known) + FIRST_LABEL) for e in values.labels]
    return np.array([IS_NUMBER, IS_ABSENT, *labels], np.intp)[values.codes]


def _value(values: Decoded, row: int) -> Value:
    """What stands in a row, with all its digits; in brackets what is replaced or absent."""
    code = IS_NUMBER if values.codes is None else int(values.codes[row])
    if code == IS_NUMBER:
        return number if math.isfinite(number := float(values.numbers[row])) else f"({number})"
    label = Replaced("absent") if code == IS_ABSENT else values.labels[code - FIRST_LABEL]
    shown = f"({label.why})" if isinstance(label, Replaced) else label
    return shown[:_LONGEST_TEXT] if isinstance(shown, str) else shown


def _tolerance(signal: RegisteredSignal, unit: str | None, values: Sequence[Array]) -> float:
    if unit in METRES:
        return _MATTERS / METRES[unit]
    if signal.turn is not None:
        return _MATTERS * signal.turn / math.tau
    sizes = (np.max(np.abs(v), where=np.isfinite(v), initial=0.0) for v in values)
    return _MATTERS * float(max(sizes))


def _marks(times: Array) -> list[float]:
    """Times of a comparison 1, 2, 5, 10, ... seconds after its begin, and its end."""
    start_s, end_s = math.floor(times[0]), float(times[-1])
    after_s = (each * 10.0**power for power in range(-2, 9) for each in (1, 2, 5))
    before = [start_s + each for each in after_s if start_s + each < end_s - SAME_TIME_S]
    return [*before[1 - _SHOWN :], end_s]


def _unlike(connection: sqlite3.Connection, run_ids: Sequence[int]) -> dict[str, tuple[Any, Any]]:
    """What was recorded of code and world, the parameters, and versions of programs."""
    found: list[dict[str, Any]] = []
    for run_id, had in parameters_of(connection, run_ids).items():
        cursor = connection.execute(
            "SELECT b.name AS robot, substr(controller_sha256, 1, 10) AS controller_sha256, "
            "substr(git_commit, 1, 10) AS git_commit, world, basic_time_step_ms, "
            "throttle_interval, start_reason AS began_by, versions FROM run r JOIN session s ON "
            "s.id = r.session_id JOIN robot b ON b.id = r.robot_id WHERE r.id = ?",
            (run_id,),
        )
        facts = dict(zip((each[0] for each in cursor.description), cursor.fetchone(), strict=True))
        versions = json.loads(facts.pop("versions") or "{}")
        found += [facts | {f"parameter {n}": each.described for n, each in had.items()}]
        found[-1] |= {f"version of {name}": value for name, value in versions.items()}
    one, other = found
    pairs = {name: (one.get(name), other.get(name)) for name in one | other}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


# Runs that should be alike, each compared with the first of them.


def compare_repeats(
    connection: sqlite3.Connection, run_ids: Sequence[int], **options: Any
) -> list[Parting]:
    """Compare each run but the first with the first; see `compare_rows`."""
    return [compare_rows(connection, (run_ids[0], each), **options) for each in run_ids[1:]]


def verdict_on(found: Sequence[Parting]) -> str:
    """Whether runs repeat the first, and else from when on and how far they part, in a sentence."""
    parted = [each for each in found if each.parted]
    if not parted:
        return f"{len(found) + 1} runs: {min(found, key=lambda e: (e.is_whole, e.rows)).verdict}"
    one, other = (first := min(parted, key=lambda each: each.parted[0].from_s)).run_ids
    those = f"{len(parted)} of {counted(len(found), 'other')}"
    return f"run {one} and {those} part; run {other}: {first.verdict}"


def repeats_noted(connection: sqlite3.Connection, set_id: int) -> list[str]:
    """Whether the trials with the best repeated parameters of a set are the same, as a note."""
    with suppress(NothingRecordedError, UnknownRunError):  # retention has deleted one
        for name, run_ids in scored_runs(connection, set_id).items():
            if len(run_ids) > 1:
                found = compare_repeats(connection, run_ids[:_SHOWN], deadline_s=1.0)
                return [f"repeats of {name or 'the same'}: {verdict_on(found)}"]
    return []
