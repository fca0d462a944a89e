"""Which signals there are, and which of them a question means."""

from __future__ import annotations

import fnmatch
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import InvalidInputError, UnknownSignalError
from webots_mcp.naming import REDUCTIONS, Value, flatten, nearest_first
from webots_mcp.signal_kinds import Kind
from webots_mcp.signal_register import MAX_SIGNALS
from webots_mcp.store.analysis.summary import Summary, summarise
from webots_mcp.store.reading.deadline import QUESTION_DEADLINE_S, Deadline
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.rows import cleaned
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.reading.subject import Subject, find_subject
from webots_mcp.store.rollup.batch import Batch, BatchColumn
from webots_mcp.store.rollup.buckets import EVER, totals
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.flatten import parse
from webots_mcp.store.signals.registry import Signal, registered, seen_with

SAMPLED_ROWS: Final = 200  # rows not yet rolled up that are searched for new names and kinds
_MOST_OFFERED: Final = 5

_NEWEST_ROWS: Final = (
    "SELECT id, sim_time_s, wall_time_s, data, replaced FROM state WHERE run_id = ? "
    "ORDER BY sim_time_s DESC, id DESC"
)
_OLDEST_AFTER: Final = (  # by ids, from the watermark on: see `reading.rollups`
    "SELECT id, sim_time_s, wall_time_s, data, replaced FROM state WHERE id > ? AND +run_id = ? "
    "ORDER BY id LIMIT ?"
)
_FIGURES: Final = {
    "rows": "sum",
    "present": "sum",
    "first_sim_time_s": "min",
    "last_sim_time_s": "max",
    "min": "min",
    "max": "max",
}


@dataclass(frozen=True)
class SignalInfo:
    """What is known of a signal in a run (or a part of it).

    Attributes:
        rows: State rows that held it.
        missing: Of the run's rows, those without a value.
        first_s: Simulation time of the first value; `last_s` of the last one.
        last: The value in the run's newest row; None where that has none.
    """

    name: str
    kind: Kind
    unit: str | None
    rows: int
    missing: int
    first_s: float | None
    last_s: float | None
    last: Value
    min: float | None
    max: float | None


@dataclass(frozen=True)
class SignalList:
    """The signals of a run.

    Attributes:
        rows: State rows of the run.
        total: How many match; `signals` are the first of them.
        notes: What the asker should know.
    """

    robot: str
    run_id: int
    rows: int
    signals: tuple[SignalInfo, ...]
    total: int
    notes: tuple[str, ...]


def catalogue(connection: sqlite3.Connection, subject: Subject) -> dict[str, Signal]:
    """Every signal of the subject's robot: the registered, and those in rows not rolled up yet."""
    return _signals_in(connection, subject.robot_id, [subject.run_id])


def known_signals(connection: sqlite3.Connection, time_range: TimeRange) -> dict[str, Signal]:
    """Every signal of a range's robot: the registered, and those in rows not rolled up yet."""
    runs = [segment.run_id for segment in time_range.segments]
    return _signals_in(connection, time_range.robot_id, runs)


def _signals_in(
    connection: sqlite3.Connection, robot_id: int, run_ids: Sequence[int]
) -> dict[str, Signal]:
    columns = [
        column
        for run_id in run_ids
        for column in _unrolled_sample(connection, robot_id, run_id).columns()
    ]
    return _without_placeholders(seen_with(registered(connection, robot_id), columns))


def _without_placeholders(known: dict[str, Signal]) -> dict[str, Signal]:
    """Without names that only ever held null and have others below them.

    `lidar: null` before the first scan is the missing value of `lidar.min` and the others.
    """
    branches = {name[:place] for name in known for place, sign in enumerate(name) if sign == "."}
    return {
        name: signal
        for name, signal in known.items()
        if signal.kind != "null" or name not in branches
    }


def other_form(known: dict[str, Signal], signal: Signal) -> Signal | None:
    """A signal that has a value where the same array is longer, or shorter; None without any.

    Of more than 16 items an array is `lidar.min` and others, of fewer `lidar.0` and so on.
    """
    branch, _, last = signal.name.rpartition(".")
    if signal.reduction is not None:
        return known.get(f"{branch}.0")
    other = known.get(f"{branch}.{REDUCTIONS[0]}")
    return other if last.isdigit() and other is not None and other.reduction is not None else None


def _unrolled_sample(connection: sqlite3.Connection, robot_id: int, run_id: int) -> Batch:
    """A run's rows after the watermark; of many the newest and the oldest."""
    mark = watermark(connection, run_id)
    batch = Batch()
    for state_id, *row in connection.execute(_NEWEST_ROWS, (run_id,)):
        if state_id <= mark:
            return batch
        if batch.rows == SAMPLED_ROWS // 2:
            break
        batch.add(state_id, robot_id, run_id, *row)
    for state_id, *row in connection.execute(_OLDEST_AFTER, (mark, run_id, SAMPLED_ROWS // 2)):
        batch.add(state_id, robot_id, run_id, *row)
    return batch


def resolve_signals(known: dict[str, Signal], names: Sequence[str]) -> list[Signal]:
    """The signals that the names mean, in the order of the names.

    A name may hold `*` (any characters, also dots). The name of a branch means all below it:
    `pose` is `pose.*`.

    Raises:
        UnknownSignalError: A name or pattern meets nothing; the text offers near ones.
        InvalidInputError: No name is given.
    """
    if not names:
        raise InvalidInputError("no signal is named; give names or patterns such as 'pose.*'")
    found: dict[str, Signal] = {}
    for name in names:
        meant = list(_meant(known, name))
        if not meant:
            raise UnknownSignalError(say_unknown(known, name))
        found.update((signal.name, signal) for signal in meant)
    return list(found.values())


def signals_of(
    connection: sqlite3.Connection, time_range: TimeRange, names: Sequence[str]
) -> list[Signal]:
    """The signals of the range's robot that the names mean.

    Raises:
        UnknownSignalError, InvalidInputError: See `resolve_signals`.
    """
    return resolve_signals(known_signals(connection, time_range), names)


def one_signal(known: dict[str, Signal], name: str) -> Signal:
    """The one signal that a name means.

    Raises:
        UnknownSignalError: There is none.
        InvalidInputError: There are several.
    """
    signal, *more = resolve_signals(known, [name])
    if more:
        raise InvalidInputError(f"{name!r} matches {len(more) + 1} signals: name one of them")
    return signal


def _meant(known: dict[str, Signal], name: str) -> Iterable[Signal]:
    if "*" not in name and name in known:
        return (known[name],)
    pattern = name if "*" in name else f"{name}.*"
    escaped = pattern.replace("[", "[[]").replace("?", "[?]")
    return (known[each] for each in known if fnmatch.fnmatchcase(each, escaped))


def say_unknown(known: dict[str, Signal], name: str) -> str:
    """That there is no such signal, and which are near."""
    if not known:
        return f"no signal {name!r}: no state row with values has been recorded yet"
    offer = ", ".join(nearest_first(name.replace("*", ""), known)[:_MOST_OFFERED])
    return f"no signal {name!r} is recorded; there is {offer} (the nearest of {len(known)})"


@in_one_snapshot
def list_signals(
    connection: sqlite3.Connection,
    *,
    robot: str | None = None,
    run_id: int | None = None,
    pattern: str = "*",
    limit: int = 100,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> SignalList:
    """List the signals of a run, by name, with what is known of their values.

    Args:
        connection: Any.
        robot: Whose; may be left out where only one is meant.
        run_id: Which run; None for the robot's newest.
        pattern: Which names, with `*`.
        limit: At most so many.
        deadline_s: After it, rows that are not rolled up yet are left out, and a note says so.

    Raises:
        UnknownSignalError: The pattern meets no name.
        UnknownRobotError, AmbiguousRobotError, UnknownRunError, NothingRecordedError: As they say.
    """
    subject = find_subject(connection, robot, run_id)
    stored = _stored(connection, subject.run_id)
    batch, notes = _late(connection, subject, deadline_s)
    late = {column.name: column for column in batch.columns()}
    known = seen_with(registered(connection, subject.robot_id), late.values())
    known = _without_placeholders(known)
    there = {name: signal for name, signal in known.items() if signal.id in stored or name in late}
    matching = resolve_signals(there, [pattern]) if pattern != "*" else list(there.values())
    matching.sort(key=lambda signal: signal.name)
    newest = _newest_values(connection, subject.run_id)
    rows = max((total.rows for total in stored.values()), default=0) + batch.rows
    infos = tuple(
        _info(signal, rows, stored.get(signal.id), late.get(signal.name), newest.get(signal.name))
        for signal in matching[:limit]
    )
    if len(known) >= MAX_SIGNALS:
        notes.append(f"only the first {MAX_SIGNALS} names of a robot are kept")
    return SignalList(subject.robot, subject.run_id, rows, infos, len(matching), tuple(notes))


def _stored(connection: sqlite3.Connection, run_id: int) -> dict[int | None, Summary]:
    """What the rollups of a run come to, by signal id, as far as a list shows it."""
    found = totals(connection, run_id, EVER, _FIGURES)
    return {
        signal_id: Summary(**dict(zip(_FIGURES, figures, strict=True)))
        for signal_id, figures in found.items()
    }


def _late(
    connection: sqlite3.Connection, subject: Subject, deadline_s: float
) -> tuple[Batch, list[str]]:
    """The run's rows after the watermark, newest first, until the deadline."""
    mark = watermark(connection, subject.run_id)
    batch = Batch()
    limit = Deadline(deadline_s)
    notes: list[str] = []
    for state_id, *row in connection.execute(_NEWEST_ROWS, (subject.run_id,)):
        if state_id <= mark:
            break
        if limit.passed:
            notes.append(f"rows up to {row[0]:g} s are not counted: they are not rolled up yet")
            break
        batch.add(state_id, subject.robot_id, subject.run_id, *row)
    return batch, notes


def _newest_values(connection: sqlite3.Connection, run_id: int) -> dict[str, Value]:
    row = connection.execute(f"{_NEWEST_ROWS} LIMIT 1", (run_id,)).fetchone()
    return flatten(parse(row[3])) if row else {}


def _info(
    signal: Signal, run_rows: int, stored: Summary | None, late: BatchColumn | None, last: Value
) -> SignalInfo:
    parts = [stored] if stored else []
    if late is not None:
        _, times, values = zip(*reversed(late.points), strict=True)
        parts.append(summarise(times, cleaned(signal, list(values))))
    held = [part for part in parts if part.present]
    numeric = () if signal.kind == "text" else held
    return SignalInfo(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        rows=sum(part.rows for part in parts),
        missing=run_rows - sum(part.present for part in parts),
        first_s=held[0].first_sim_time_s if held else None,
        last_s=held[-1].last_sim_time_s if held else None,
        last=last,
        min=min((part.min for part in numeric if part.min is not None), default=None),
        max=max((part.max for part in numeric if part.max is not None), default=None),
    )
