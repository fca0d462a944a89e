"""Writing the register of signals: every dotted name that a robot's states ever held.

The bridge enters names when it first records them, and the maintainer those that came otherwise.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from typing import Final, NamedTuple

from webots_mcp.signal_kinds import Kind, unit_of, widen
from webots_mcp.signal_roles import decide_roles

MAX_SIGNALS: Final = 2000  # of one robot: keys made of ids or times would grow without end
MOST_CHOICES: Final = 20  # that a number which names a mode has
ADDED_AT_ONCE: Final = 50  # in one statement, which holds the write lock for half a millisecond

_OF_ROBOT: Final = (
    "SELECT name, kind, unit, role, max - min FROM signal "
    "WHERE robot_id = ? AND typeof(name) = 'text' ORDER BY id"
)
_COLUMNS: Final = "robot_id, name, path, reduction, first_seen_wall_time_s, kind, unit, role"
_ADD: Final = f"INSERT OR IGNORE INTO signal ({_COLUMNS}) VALUES "
_MARKS: Final = "(?, ?, ?, ?, ?, ?, ?, ?)"
_CHANGE: Final = "UPDATE signal SET kind = ?, unit = ?, role = ? WHERE robot_id = ? AND name = ?"


class Seen(NamedTuple):
    """What some values of a signal tell of it.

    Attributes:
        path: For `json_extract(state.data, path)`.
        reduction: None, or how the long array at `path` becomes one number.
        kind: Of these values.
        is_choice: They are whole numbers, and few different ones; as far as there are any.
    """

    path: str
    reduction: str | None
    kind: Kind
    is_choice: bool
    first_wall_time_s: float


class Described(NamedTuple):
    """What the register says of a signal that may change."""

    kind: Kind
    unit: str | None
    role: str | None


class Changes(NamedTuple):
    """What is to be written into the register of a robot, by name."""

    new: dict[str, tuple[Seen, Described]]
    changed: dict[str, Described]


def find_changes(
    connection: sqlite3.Connection, robot_id: int, seen: Mapping[str, Seen]
) -> Changes:
    """What the register of a robot lacks once these values are recorded.

    Names beyond `MAX_SIGNALS` of a robot stay out. Of each name the kind is widened; which roles
    the names have is decided anew.
    """
    rows = connection.execute(_OF_ROBOT, (robot_id,)).fetchall()
    known = {name: Described(*described) for name, *described, _ in rows}
    spans = {name: span or 0.0 for name, *_, span in rows}
    fresh = [name for name in seen if name not in known][: max(0, MAX_SIGNALS - len(known))]
    kinds: dict[str, Kind] = {name: each.kind for name, each in known.items()}
    for name in (*known, *fresh):
        if name in seen:
            kinds[name] = widen(kinds.get(name, "null"), seen[name].kind)
    choices = {
        name
        for name in kinds
        if (name not in seen or seen[name].is_choice)
        if _may_be_choice(known.get(name), spans.get(name, 0.0))
    }
    roles = decide_roles(kinds, choices)
    now = {
        name: Described(
            kind,
            known[name].unit if name in known and kind == known[name].kind else unit_of(name, kind),
            roles.get(name),
        )
        for name, kind in kinds.items()
    }
    return Changes(
        {name: (seen[name], now[name]) for name in fresh},
        {name: each for name, each in now.items() if each != known.get(name, each)},
    )


def _may_be_choice(known: Described | None, span: float) -> bool:
    """By what was recorded before: who is none any more has no role."""
    return known is None or known.kind == "null" or (bool(known.role) and span <= MOST_CHOICES)


def write_changes(connection: sqlite3.Connection, robot_id: int, changes: Changes) -> None:
    """Write them; names that another process has entered meanwhile stay as they are."""
    new = [
        (robot_id, name, *seen[:2], seen.first_wall_time_s, *described)
        for name, (seen, described) in changes.new.items()
    ]
    for start in range(0, len(new), ADDED_AT_ONCE):
        some = new[start : start + ADDED_AT_ONCE]
        marks = ", ".join([_MARKS] * len(some))
        connection.execute(_ADD + marks, [value for row in some for value in row])
    changed = [(*each, robot_id, name) for name, each in changes.changed.items()]
    connection.executemany(_CHANGE, changed)
