"""Determine what a robot's signals mean: as declared, as known from devices, or by their names."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

from webots_mcp.database.transactions import transaction
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.meaning import (
    MEANING_FIELDS,
    QUANTITIES,
    ROLES,
    DeclaredMeaning,
    Meaning,
    StatedMeaning,
    fits_pattern,
    meaning_stated,
    meanings_by_name,
)
from webots_mcp.signals.naming import nearest_first
from webots_mcp.store.registered_signals import RegisteredSignal, stored_roles

OF_TOOLS: Final = ("mcp", "cli")  # set by a person or an assistant; the newest counts
OF_PROJECT: Final = "project"
_MOST_NEAR: Final = 5  # names that an error lists
OF_CODE: Final = "controller"
OF_DEVICE: Final = "bridge"
_STRENGTH: Final = {**dict.fromkeys(OF_TOOLS, 0), OF_PROJECT: 1, OF_CODE: 2, OF_DEVICE: 3}
_BY_WHOM: Final = {
    "mcp": "declared with webots_describe_signals",
    "cli": "declared with webots-mcp signals --describe",
    OF_PROJECT: "declared in webots-mcp.toml",
    OF_CODE: "declared by the controller's code",
}
_FORGET: Final = (
    "DELETE FROM meaning WHERE robot_id = ? AND name = ? AND source = 'declared' AND {}"
)
_BY_TOOL: Final = "set_by IN ('mcp', 'cli')"


class StoredMeaning(NamedTuple):
    """A row of the table `meaning`.

    Attributes:
        set_by: `mcp`, `cli`, `project`, `controller` or `bridge`.
        stated: The statement; its name may be a pattern.
    """

    set_by: str
    stated: StatedMeaning


def meanings_of(known: Mapping[str, RegisteredSignal]) -> dict[str, Meaning]:
    """Return the meaning of each signal of a robot, from the strongest available source.

    Args:
        known: All its signals, or those of a run, with the statements about them.
    """
    kinds = {name: signal.kind for name, signal in known.items()}
    found = meanings_by_name(kinds, stored_roles(dict(known)))
    for name, signal in known.items():
        if signal.stated:
            found[name] = meaning_stated(name, signal.stated, found[name])
    return found


def with_stated(
    connection: sqlite3.Connection, robot_id: int, known: dict[str, RegisteredSignal]
) -> dict[str, RegisteredSignal]:
    """Return the signals with what was declared about them or is known from their devices."""
    stored = stored_meanings(connection, robot_id)
    if not stored:
        return known
    plain: dict[str, list[int]] = {}
    patterns: list[tuple[int, str]] = []
    for at, each in enumerate(stored):
        if "*" in (name := each.stated.said.name):
            patterns.append((at, name))
        else:
            plain.setdefault(name, []).append(at)
    found: dict[str, RegisteredSignal] = {}
    for name, signal in known.items():
        places = [at for at, pattern in patterns if fits_pattern(pattern, name)]
        if name in plain:
            places = sorted([*plain[name], *places])  # the strongest first
        stated = tuple(stored[at].stated for at in places)
        found[name] = _stated(signal, stated) if stated else signal
    return found


def _stated(signal: RegisteredSignal, stated: tuple[StatedMeaning, ...]) -> RegisteredSignal:
    """Return the signal with the unit that was stated."""
    found = replace(signal, stated=stated)
    return replace(found, unit=found.stated_unit or signal.unit)


def stored_meanings(connection: sqlite3.Connection, robot_id: int) -> list[StoredMeaning]:
    """Return all stored meanings of a robot's signals, the strongest first.

    Among equally strong ones, names come before patterns, and longer patterns before shorter ones.
    Rows that no version of webots-mcp writes are left out.
    """
    rows = connection.execute(
        f"SELECT set_by, source, why, name, {', '.join(MEANING_FIELDS)} FROM meaning WHERE "
        "robot_id = :robot OR (robot_id IS NULL AND robot_name IN ('*', (SELECT name FROM robot "
        "WHERE id = :robot))) ORDER BY robot_name IS NULL DESC, robot_name = '*', "
        "set_wall_time_s DESC, id DESC",
        {"robot": robot_id},
    ).fetchall()
    found = [
        StoredMeaning(set_by, StatedMeaning(said, source, why or _BY_WHOM.get(set_by, source)))
        for set_by, source, why, *values in rows
        if (said := _said(values)) is not None
        if set_by in _STRENGTH and source in ("declared", "device")
    ]
    found.sort(key=_place)  # stable: the newest of equal ones comes first
    return found


def set_meanings(
    connection: sqlite3.Connection, robot_id: int, declared: Iterable[DeclaredMeaning], set_by: str
) -> None:
    """Store what a person or an assistant declares, replacing their earlier declaration.

    Args:
        connection: A connection in the role "writer".
        robot_id: The robot whose signals they are.
        declared: The declaration of each signal.
        set_by: `mcp` or `cli`.
    """
    now_s = time.time()
    with transaction(connection):
        for each in declared:
            connection.execute(_FORGET.format(_BY_TOOL), (robot_id, each.name))
            connection.execute(
                f"INSERT INTO meaning (robot_id, name, {', '.join(MEANING_FIELDS)}, source, "
                f"set_wall_time_s, set_by) VALUES (?, ?, {', '.join('?' * len(MEANING_FIELDS))}, "
                "'declared', ?, ?)",
                (robot_id, *each, now_s, set_by),
            )


def undo_meanings(connection: sqlite3.Connection, robot_id: int, names: Iterable[str]) -> list[str]:
    """Remove the strongest declaration of each signal, so that the next one counts.

    What a person or an assistant has set goes first, then what the controller's code declares,
    which counts again from its next start on.

    Args:
        connection: A connection in the role "writer".
        robot_id: The robot whose signals they are.
        names: The names as declared, or patterns of such names.

    Returns:
        The names of which a declaration was removed.

    Raises:
        InvalidInputError: A name has no declaration, or only one in the project's file. Then
            nothing is removed.
    """
    with transaction(connection):
        known = [
            name
            for (name,) in connection.execute(
                "SELECT DISTINCT name FROM meaning WHERE (robot_id = :robot OR (robot_id IS NULL "
                "AND robot_name IN ('*', (SELECT name FROM robot WHERE id = :robot)))) "
                "AND source = 'declared' ORDER BY name",
                {"robot": robot_id},
            ).fetchall()
        ]
        wanted: dict[str, None] = {}
        for asked in names:
            found = [name for name in known if name == asked or fits_pattern(asked, name)]
            if not found:
                near = ", ".join(nearest_first(asked, known)[:_MOST_NEAR]) or "none"
                raise InvalidInputError(
                    f"No meaning is declared for signal {asked!r:.80}. Declared signals: {near}"
                )
            wanted |= dict.fromkeys(found)
        for name in wanted:
            _forget(connection, robot_id, name)
    return list(wanted)


def _forget(connection: sqlite3.Connection, robot_id: int, name: str) -> None:
    for whose in (_BY_TOOL, f"set_by = '{OF_CODE}'"):
        if connection.execute(_FORGET.format(whose), (robot_id, name)).rowcount:
            return
    raise InvalidInputError(
        f"Signal {name!r:.80} is declared in webots-mcp.toml, which this tool "
        "does not change. Edit its table [signals]."
    )


def _place(stored: StoredMeaning) -> tuple[int, bool, int]:
    name = stored.stated.said.name
    return _STRENGTH[stored.set_by], "*" in name, -len(name)


def _said(values: Sequence[Any]) -> DeclaredMeaning | None:
    """Return the statement of a row; None if it holds values that no version writes."""
    name, quantity, role, unit, target_of, same_as, side, low, high = values
    texts, numbers = (unit, target_of, same_as, side), (low, high)
    is_ours = (
        isinstance(name, str)
        and quantity in (None, *QUANTITIES)
        and role in (None, *ROLES)
        and all(each is None or isinstance(each, str) for each in texts)
        and all(each is None or isinstance(each, (int, float)) for each in numbers)
    )
    return DeclaredMeaning(*values) if is_ours else None
