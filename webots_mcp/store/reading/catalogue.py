"""List the signals of a robot, and resolve the names that a question uses."""

from __future__ import annotations

import fnmatch
import math
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.analysis.arrays import Indexes, np
from webots_mcp.errors import InvalidInputError, UnknownSignalError
from webots_mcp.signals.meaning import Meaning
from webots_mcp.signals.naming import REDUCTIONS, Value, array_item, nearest_first, with_dots
from webots_mcp.signals.register import MAX_SIGNALS, Kind, unit_of
from webots_mcp.store.chunks import STATE_COLUMNS, StateColumns, reached, signals_in
from webots_mcp.store.meanings import meanings_of, with_stated
from webots_mcp.store.reading.behaviour import with_behaviour
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.observed_pose import with_observed_pose
from webots_mcp.store.reading.ranges import TimeRange, find_subject
from webots_mcp.store.reading.segment import (
    QUESTION_DEADLINE_S,
    Deadline,
    Segment,
    Subject,
    in_one_snapshot,
)
from webots_mcp.store.reading.unchunked_rows import has_few_new_rows, rows_in_no_chunk
from webots_mcp.store.registered_signals import RegisteredSignal, cleaned, registered, seen_with

SAMPLED_ROWS: Final = 200  # rows in no chunk yet that are searched for new names and kinds
_MOST_OFFERED: Final = 5
_ONLY_FIRST: Final = f"Only the first {MAX_SIGNALS} names of a robot are kept"


@dataclass(frozen=True)
class SignalInfo:
    """What is known of a signal in a run or a part of it.

    Attributes:
        rows: Number of state rows that held it.
        missing: Number of the run's rows without a value.
        first_s: Simulation time of the first value; `last_s` is that of the last one.
        last: The value in the run's newest row, or None.
        meaning: Its meaning, and the source of that.
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
    meaning: Meaning


@dataclass(frozen=True)
class SignalList:
    """The signals of a run.

    Attributes:
        rows: Number of state rows of the run.
        total: Number of matching signals; `signals` are the first of them.
        notes: What the caller should know.
    """

    robot: str
    run_id: int
    rows: int
    signals: tuple[SignalInfo, ...]
    total: int
    notes: tuple[str, ...]


def catalogue(connection: sqlite3.Connection, subject: Subject) -> dict[str, RegisteredSignal]:
    """Return every signal of the subject's robot.

    Registered ones, and those in rows in no chunk.
    """
    return _signals_in(connection, subject.robot_id, [subject.run_id])


def known_signals(
    connection: sqlite3.Connection, time_range: TimeRange
) -> dict[str, RegisteredSignal]:
    """Return every signal of a range's robot: registered ones, and those in rows in no chunk."""
    runs = [segment.run_id for segment in time_range.segments]
    return _signals_in(connection, time_range.robot_id, runs)


def _signals_in(
    connection: sqlite3.Connection, robot_id: int, run_ids: Sequence[int]
) -> dict[str, RegisteredSignal]:
    known = registered(connection, robot_id)
    samples = {run_id: _new_sample(connection, run_id) for run_id in run_ids}
    for columns in samples.values():
        known = seen_with(known, robot_id, columns)
    known = _without_placeholders(known)
    known = with_stated(connection, robot_id, known)
    return with_observed_pose(connection, robot_id, known, samples.items())


def _new_sample(connection: sqlite3.Connection, run_id: int) -> StateColumns:
    """Return a run's rows in no chunk; of many rows the oldest and newest."""
    at = reached(connection, run_id)
    if has_few_new_rows(connection, run_id, at):
        return rows_in_no_chunk(connection, run_id, (-math.inf, math.inf), at, Deadline())[0]
    asked = (run_id, at.end_s, at.last_state_id, SAMPLED_ROWS // 2)
    rows = dict[int, tuple[object, ...]]()
    query = (
        f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) "
        "ORDER BY sim_time_s {order}, id {order} LIMIT ?"
    )
    for order in ("ASC", "DESC"):
        for row in connection.execute(query.format(order=order), asked):
            rows[row[0]] = row
    columns = StateColumns()
    columns.add(list(rows.values()))
    return columns


def signals_of_frame(
    connection: sqlite3.Connection, subject: Subject, frame: Frame
) -> dict[str, RegisteredSignal]:
    """Return every signal of the subject's robot.

    Registered ones, and those in the rows of a frame.
    """
    known = registered(connection, subject.robot_id)
    known = _without_placeholders(seen_with(known, subject.robot_id, frame.new_rows))
    return with_stated(connection, subject.robot_id, known)


def held_by(
    connection: sqlite3.Connection, frame: Frame, known: dict[str, RegisteredSignal]
) -> dict[str, RegisteredSignal]:
    """Return those signals of a robot that the run of a frame holds."""
    stored, here = signals_in(connection, frame.run_id), frame.new_rows.values
    return {name: each for name, each in known.items() if each.id in stored or name in here}


def _without_placeholders(known: dict[str, RegisteredSignal]) -> dict[str, RegisteredSignal]:
    """Remove names that only ever held null and have other names below them.

    `lidar: null` before the first scan is the missing value of `lidar.min` and the others.
    """
    branches = {name[:place] for name in known for place, sign in enumerate(name) if sign == "."}
    return {
        name: signal
        for name, signal in known.items()
        if signal.kind != "null" or name not in branches
    }


def other_form(
    known: dict[str, RegisteredSignal], signal: RegisteredSignal
) -> RegisteredSignal | None:
    """Return a signal with a value from a longer or shorter version of the same array, or None.

    An array of more than 16 items is `lidar.min` and others, a shorter one `lidar.0` and so on.
    """
    branch, _, last = signal.name.rpartition(".")
    if signal.reduction is not None:
        return known.get(f"{branch}.0")
    other = known.get(f"{branch}.{REDUCTIONS[0]}")
    return other if last.isdigit() and other is not None and other.reduction is not None else None


def resolve_signals(
    known: dict[str, RegisteredSignal], names: Sequence[str]
) -> list[RegisteredSignal]:
    """Return the signals that the names mean, in the order of the names.

    A name may hold `*` (any characters, also dots). The name of a branch means all below it: `pose`
    is `pose.*`.

    Raises:
        UnknownSignalError: A name or pattern matches nothing; the text offers similar names.
        InvalidInputError: No name is given.
    """
    if not names:
        raise InvalidInputError(
            "No signal is named. Give names or patterns, for example signals=['pose.*']."
        )
    found: dict[str, RegisteredSignal] = {}
    for name in names:
        meant = list(_meant(known, name))
        if not meant:
            raise UnknownSignalError(say_unknown(known, name))
        found.update((signal.name, signal) for signal in meant)
    return list(found.values())


def signals_of(
    connection: sqlite3.Connection, time_range: TimeRange, names: Sequence[str]
) -> list[RegisteredSignal]:
    """Return the signals of the range's robot that the names mean.

    Raises:
        UnknownSignalError, InvalidInputError: See `resolve_signals`.
    """
    return resolve_signals(known_signals(connection, time_range), names)


def one_signal(known: dict[str, RegisteredSignal], name: str) -> RegisteredSignal:
    """Return the one signal that a name means.

    Raises:
        UnknownSignalError: No signal has that name.
        InvalidInputError: The name means several signals.
    """
    signal, *more = resolve_signals(known, [name])
    if more:
        names = ", ".join(each.name for each in (signal, *more[: _MOST_OFFERED - 1]))
        raise InvalidInputError(
            f"{name!r} matches {len(more) + 1} signals, but only one is possible. "
            f"Name one of them: {names}."
        )
    return signal


def item_signal(known: Mapping[str, RegisteredSignal], name: str) -> RegisteredSignal | None:
    """Return a single item of a long array, which is not registered (`scan.117`), or None.

    Its values are read from the state rows as long as those are kept.
    """
    if name in known or (item := array_item(name)) is None:
        return None
    array, place = item
    count = known.get(f"{array}.{REDUCTIONS[0]}")
    if count is None or count.reduction != REDUCTIONS[0]:
        return None
    unit = unit_of(array, "num")
    return RegisteredSignal(None, count.robot_id, name, "num", unit, f"{count.path}[{place}]", None)


def _meant(known: dict[str, RegisteredSignal], name: str) -> Iterable[RegisteredSignal]:
    name = name if name in known else with_dots(name)
    if "*" not in name and name in known:
        return (known[name],)
    if (item := item_signal(known, name)) is not None:
        return (item,)
    pattern = name if "*" in name else f"{name}.*"
    escaped = pattern.replace("[", "[[]").replace("?", "[?]")
    return (known[each] for each in known if fnmatch.fnmatchcase(each, escaped))


def say_unknown(known: dict[str, RegisteredSignal], name: str) -> str:
    """Return the sentence that no signal has that name, with similar names."""
    if not known:
        return (
            f"No signal {name!r} is recorded, because no values have been published yet. "
            "Run the simulation first"
        )
    offer = ", ".join(nearest_first(name.replace("*", ""), known)[:_MOST_OFFERED])
    said = f"No signal {name!r} is recorded. The nearest of {len(known)} signals: {offer}"
    return f"{said}. {_ONLY_FIRST}" if len(known) >= MAX_SIGNALS else said


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
    """List the signals of a run by name, with what is known of their values.

    Args:
        connection: An open database.
        robot: The robot; may be omitted if only one is possible.
        run_id: The run; None for the robot's newest.
        pattern: Pattern of names, with `*`.
        limit: Maximum number of signals.
        deadline_s: Time after which rows that are in no chunk yet are left out, which a note says.

    Raises:
        UnknownSignalError: The pattern matches no name.
        UnknownRobotError, AmbiguousRobotError, UnknownRunError, NothingRecordedError: As they say.
    """
    subject = find_subject(connection, robot, run_id)
    whole = Segment(subject.run_id, -math.inf, math.inf)
    frame = read_frame(connection, whole, Deadline(deadline_s))
    own = [(subject.run_id, frame.new_rows)]
    known = signals_of_frame(connection, subject, frame)
    there = held_by(connection, frame, known)
    there = with_observed_pose(connection, subject.robot_id, there, own)
    matching = resolve_signals(there, [pattern]) if pattern != "*" else list(there.values())
    matching.sort(key=lambda signal: signal.name)
    meanings = with_behaviour(meanings_of(there), there, frame)
    infos = tuple(_info(frame, signal, meanings[signal.name]) for signal in matching[:limit])
    notes = [str(each) for each in frame.unread]
    if len(known) >= MAX_SIGNALS:
        notes.append(_ONLY_FIRST)
    return SignalList(subject.robot, subject.run_id, len(frame), infos, len(matching), tuple(notes))


def _info(frame: Frame, signal: RegisteredSignal, meaning: Meaning) -> SignalInfo:
    zones = frame.zone_map(signal.name)
    counts, is_usable = zones.value_count, bool(zones.value_count.any())
    if not is_usable and signal.is_number:  # all beyond 1e100, or null
        counts = np.add.reduceat(~np.isnan(frame.numbers(signal.name)), zones.first_row, dtype=int)
    held = np.flatnonzero(counts)
    first, last = (_bound(frame, signal.name, held, at) for at in (0, -1))
    (newest,) = frame.rows(len(frame) - 1, len(frame)).values(signal.name)
    has_numbers = signal.kind != "text" and not np.isnan(zones.sum).all()
    return SignalInfo(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        rows=int(zones.held_count.sum()),
        missing=len(frame) - int(counts.sum()),
        first_s=first,
        last_s=last,
        last=cleaned(signal, [newest])[0],
        min=float(np.nanmin(zones.min)) if has_numbers else None,
        max=float(np.nanmax(zones.max)) if has_numbers else None,
        meaning=meaning,
    )


def _bound(frame: Frame, name: str, held: Indexes, at: int) -> float | None:
    """Return when a signal first or last had a value; open a chunk only if values are missing."""
    if not len(held):
        return None
    zones, place = frame.zone_map(name), int(held[at])
    start, rows = int(zones.first_row[place]), int(zones.row_count[place])
    if zones.value_count[place] == rows:
        return float((zones.start_s if at == 0 else zones.end_s)[place])
    part = frame.rows(start, start + rows)
    codes, _ = part.coded(name)
    return float(part.times[np.flatnonzero(codes)[at]])
