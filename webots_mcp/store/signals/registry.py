"""The register of signals: every dotted name that a robot's states ever held."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

from webots_mcp.naming import Value, find_mode
from webots_mcp.store.analysis.summary import Summary, summarise, usable_numbers
from webots_mcp.store.rollup.batch import BatchColumn
from webots_mcp.store.signals.flatten import (
    Kind,
    Place,
    is_reachable,
    kind_of,
    may_be_yaw,
    parse,
    places,
    turn_of,
    unit_of,
    widen,
)

MAX_SIGNALS: Final = 2000  # of one robot: keys made of ids or times would grow without end

MOST_CHOICES: Final = 20  # that a number which names a mode has

_OF_ROBOT: Final = (
    "SELECT id, robot_id, name, kind, unit, path, reduce, max - min FROM signal WHERE robot_id = ? "
    "AND typeof(name) = 'text' AND typeof(path) = 'text' ORDER BY id"
)
_TYPE_IN_NEWEST: Final = (
    "SELECT json_type(data, ?) FROM state WHERE json_valid(data) AND run_id = "
    "(SELECT max(id) FROM run WHERE robot_id = ?) ORDER BY sim_time_s DESC, id DESC LIMIT 1"
)
_ADD: Final = (
    "INSERT OR IGNORE INTO signal (robot_id, name, kind, unit, path, reduce, "
    "first_seen_wall_time_s, last_seen_wall_time_s) VALUES "
)
_ADDED_AT_ONCE: Final = 50  # in one statement, which holds the write lock for half a millisecond


@dataclass(frozen=True)
class Signal:
    """A signal of a robot, and how its value is read from a state row.

    Attributes:
        id: In the register; None for one that was seen only in rows after the watermark.
        path: For `json_extract(state.data, path)`.
        reduce: None, or how the long array at `path` becomes one number.
        decoded: Rows must be decoded to read it: its array was at times long enough to be
            reduced, or its name holds what the paths of SQLite before 3.45 do not reach.
        is_choice: Its whole numbers, of which there are few, name what a robot does.
    """

    id: int | None
    robot_id: int
    name: str
    kind: Kind
    unit: str | None
    path: str
    reduce: str | None
    decoded: bool = False
    is_choice: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether `json_extract` alone gives the same as `flatten`."""
        return self.reduce is None and not self.decoded

    @property
    def turn(self) -> float | None:
        """A whole turn of an angle, in its unit; None of what is no angle."""
        return turn_of(self.name, self.kind)

    def summarise(self, times: Sequence[float], values: Sequence[Value]) -> Summary:
        """What values of it come to; of angles in degrees as well with the sums of sines."""
        summary = summarise(times, values, angle=self.kind == "angle")
        if self.turn is None or summary.sum is None or summary.sines is not None:
            return summary
        _, numbers = usable_numbers(times, values)
        angles = [number * math.tau / self.turn for number in numbers]
        sines, cosines = (math.fsum(map(each, angles)) for each in (math.sin, math.cos))
        return summary._replace(sines=sines, cosines=cosines)

    @property
    def is_index(self) -> bool:
        """Whether it says which item of an array, not how much: it leaps and rests by nature."""
        return self.reduce == "argmin"

    @property
    def is_number(self) -> bool:
        """Whether it has a minimum and a mean; text and flags have change points instead."""
        return self.kind in ("num", "angle", "null")


def registered(connection: sqlite3.Connection, robot_id: int) -> dict[str, Signal]:
    """The signals of a robot in the register, by name."""
    rows = connection.execute(_OF_ROBOT, (robot_id,)).fetchall()
    return by_name([_as_registered(connection, Signal(*row), span) for *row, span in rows])


def _as_registered(connection: sqlite3.Connection, signal: Signal, span: float | None) -> Signal:
    if span is None or span > MOST_CHOICES or not _may_be_choice(signal.name, signal.kind):
        return signal
    asked = (signal.path, signal.robot_id)
    newest = connection.execute(_TYPE_IN_NEWEST, asked).fetchone()
    return replace(signal, is_choice=newest is not None and newest[0] == "integer")


def _may_be_choice(name: str, kind: Kind) -> bool:
    return kind == "num" and find_mode([name]) is not None


def _are_choices(column: BatchColumn) -> bool:
    """Whether the values are few whole numbers."""
    values = {point[2] for point in column.points}
    numbers = [value for value in values if type(value) is int]
    return len(numbers) == len(values) and max(numbers) - min(numbers) <= MOST_CHOICES


def by_name(signals: Sequence[Signal]) -> dict[str, Signal]:
    """The signals by name, with what they tell about each other."""
    arrays = tuple({f"{signal.path}[" for signal in signals if signal.reduce})
    return {
        signal.name: replace(signal, decoded=True)
        if signal.path.startswith(arrays) or not is_reachable(signal.name)
        else signal
        for signal in signals
    }


def _seen_in(column: BatchColumn, known: Kind = "null") -> Kind:
    """The kind of a signal, after the values of this column."""
    planar = may_be_yaw(column.name) and f"{column.name[:-1]}3" not in _places_of(column.sample)
    for value in _telling(column):
        known = widen(known, kind_of(column.name, value, planar=planar))
    return known


def _telling(column: BatchColumn) -> list[Any]:
    """One value of each type, and the extremes, tell the kind as well as all values do."""
    values = [point[2] for point in column.points]
    by_type: dict[type, Any] = {type(value): value for value in values}
    numbers = [value for value in values if type(value) is float or type(value) is int]
    return [*by_type.values(), *([min(numbers), max(numbers)] if numbers else [])]


def enter_signals(
    connection: sqlite3.Connection, robot_id: int, columns: Sequence[BatchColumn]
) -> dict[str, Signal]:
    """Enter the names of a robot that are new; return all that are registered, by name.

    Names beyond `MAX_SIGNALS` of a robot stay out.
    """
    known = registered(connection, robot_id)
    fresh = [column for column in columns if column.name not in known]
    if not fresh or len(known) >= MAX_SIGNALS:
        return known
    described = [row for column in fresh if (row := _description(column))]
    rows = described[: MAX_SIGNALS - len(known)]
    for start in range(0, len(rows), _ADDED_AT_ONCE):
        some = rows[start : start + _ADDED_AT_ONCE]
        marks = ", ".join(["(?, ?, ?, ?, ?, ?, ?, ?)"] * len(some))
        connection.execute(_ADD + marks, [value for row in some for value in row])
    return registered(connection, robot_id)


def _description(column: BatchColumn) -> tuple[object, ...] | None:
    signal = _unregistered(column)
    if signal is None:
        return None
    described = (signal.name, signal.kind, signal.unit, signal.path, signal.reduce)
    return (signal.robot_id, *described, column.first_wall_time_s, column.last_wall_time_s)


def _unregistered(column: BatchColumn) -> Signal | None:
    """A signal that is known from a column only; None where its value stands nowhere."""
    place = _places_of(column.sample).get(column.name)
    if place is None:
        return None
    kind = _seen_in(column)
    unit = unit_of(column.name, kind)
    is_choice = _may_be_choice(column.name, kind) and _are_choices(column)
    found = Signal(None, column.robot_id, column.name, kind, unit, place.path, place.reduce)
    return replace(found, is_choice=is_choice)


def seen_now(signal: Signal | None, column: BatchColumn) -> Signal | None:
    """A signal as it is known after a column of it; None where it cannot be registered."""
    if signal is None:
        return _unregistered(column)
    kind = _seen_in(column, signal.kind)
    if kind == signal.kind:
        return signal
    return replace(signal, kind=kind, unit=unit_of(signal.name, kind))


@lru_cache(maxsize=8)  # a row that brings one new name mostly brings several
def _places_of(data: str) -> dict[str, Place]:
    return places(parse(data))


class Count(NamedTuple):
    """What the rows of a batch add to a registered signal."""

    signal_id: int | None
    kind: Kind
    unit: str | None
    rows: int
    null_rows: int
    odd_rows: int
    seen_wall_time_s: float
    min: float | None
    max: float | None


def count(signal: Signal, column: BatchColumn) -> Count:
    """Count the values of a signal that is known as it is after them."""
    values = [point[2] for point in column.points]
    _, numbers = usable_numbers(range(len(values)), values)
    return Count(
        signal.id,
        signal.kind,
        signal.unit,
        len(values),
        values.count(None),
        column.odd_rows,
        column.last_wall_time_s,
        min(numbers, default=None),
        max(numbers, default=None),
    )
