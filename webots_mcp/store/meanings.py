"""What the signals of a robot mean: as declared, else as their device says, else as names tell."""

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

OF_TOOLS: Final = ("mcp", "cli")  # a person or an assistant has set it, the newest counts
OF_PROJECT: Final = "project"
_MOST_NEAR: Final = 5  # names in an error
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
        stated: What it says; its name may be a pattern.
    """

    set_by: str
    stated: StatedMeaning


def meanings_of(known: Mapping[str, RegisteredSignal]) -> dict[str, Meaning]:
    """Return the meaning of each signal of a robot, by the strongest source that there is.

    Args:
        known: All its signals, or those of a run, with what was stated of them.
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
    """Return the signals with what was declared of them, or is known from their devices."""
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
    """Return the signal with what was stated of it: its unit is the one that was stated."""
    found = replace(signal, stated=stated)
    return replace(found, unit=found.stated_unit or signal.unit)


def stored_meanings(connection: sqlite3.Connection, robot_id: int) -> list[StoredMeaning]:
    """Return all that is stored of a robot's signals, the strongest first.

    Of equally strong ones, a name comes before patterns, and of those the longer one first. What no
    version of webots-mcp writes is left out.
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
    """Store what a person or an assistant says of signals, in place of what they said before.

    Args:
        connection: In the role "writer".
        robot_id: The robot whose signals they are.
        declared: What is said of each.
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
    """Forget what was declared of signals; of each what counts most, so that the next one counts.

    First goes what a person or an assistant has set, then what the controller's code says, which
    counts again from its next start on.

    Args:
        connection: In the role "writer".
        robot_id: The robot whose signals they are.
        names: As they were declared, or patterns of such names.

    Returns:
        The names of which something was forgotten.

    Raises:
        InvalidInputError: A name has no declaration, or only one in the project's file. Then
            nothing is forgotten.
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
    """What a row says; None where it holds values that no version writes: SQLite takes any."""
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
