"""Register signals: every dotted name that a robot's states ever held."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.signals.meaning import ANGLES, StatedMeaning
from webots_mcp.signals.naming import METRES, Value, find_mode, metres_in
from webots_mcp.signals.register import (
    MOST_CHOICES,
    Kind,
    Place,
    Seen,
    decide_roles,
    ends_pose,
    find_changes,
    kind_of,
    places,
    turn_of,
    unit_of,
    widen,
    write_changes,
)
from webots_mcp.store.chunks import ABSENT, Absent, Replaced, parse, shown

if TYPE_CHECKING:
    from webots_mcp.store.chunks import StateColumns


_TURNING: Final = ("heading", "roll", "pitch")  # unit of angles if none is known: radians
_ANGLES: Final = (*_TURNING, "joint position")
_NO_VALUES: Final = frozenset((type(None), Absent, Replaced))
_TYPES: Final[dict[Kind, frozenset[type]]] = {  # number of values that can leave a kind unchanged
    "null": _NO_VALUES,
    "bool": _NO_VALUES | {bool},
    "num": _NO_VALUES | {int, float, bool},
}


@dataclass(frozen=True)
class RegisteredSignal:
    """A signal of a robot, and the place of its value in a state row.

    Attributes:
        id: Its id in the register; None if it was seen only in rows after the watermark.
        path: For `json_extract(state.data, path)`.
        reduction: How the long array at `path` becomes one number; None for other signals.
        role: What it describes of the robot's motion, as `signal_register` decides; mostly None.
        is_choice: Whether its values are few whole numbers that name what the robot does.
        wraps_at: A full turn, if its values show that it is an angle: see `as_angle`.
        stated: What was declared of its meaning or is known from its device, the strongest first;
            filled in by `meanings.with_stated`.
    """

    id: int | None
    robot_id: int
    name: str
    kind: Kind
    unit: str | None
    path: str
    reduction: str | None
    role: str | None = None
    is_choice: bool = False
    stated: tuple[StatedMeaning, ...] = ()
    wraps_at: float | None = None

    @property
    def turn(self) -> float | None:
        """A full turn of an angle in its unit; None if the signal is no angle.

        What was declared or is known from the device counts first, then the name, then the values.
        """
        if self.wraps_at is not None:
            return self.wraps_at
        if not self.stated or not self.is_number:
            return turn_of(self.name, self.kind)
        quantity = next(filter(None, (each.said.quantity for each in self.stated)), None)
        unit = self.stated_unit
        if quantity is not None and quantity not in ANGLES:
            return None
        if unit in ("rad", "deg"):
            return math.tau if unit == "rad" else 360.0
        named = turn_of(self.name, self.kind)
        return named if quantity is None or named else math.tau if quantity in _TURNING else None

    @property
    def stated_unit(self) -> str | None:
        """The unit that was declared or belongs to its device; None without one."""
        return next(filter(None, (each.said.unit for each in self.stated)), None)

    @property
    def metres(self) -> float:
        """Metres per unit of the signal: 1 for a length without a unit."""
        return METRES.get(self.stated_unit or "") or metres_in(self.name)

    @property
    def may_be_angle(self) -> bool:
        """Whether only its values can show that it is an angle."""
        said = any(each.said.quantity not in (None, *_ANGLES) for each in self.stated)
        is_plain = self.kind == "num" and not (self.is_index or self.is_choice or said)
        return is_plain and self.wraps_at is None and self.turn is None

    @property
    def is_index(self) -> bool:
        """Whether it is the index of an array's item: such a value jumps and rests by nature."""
        return self.reduction == "argmin"

    @property
    def is_number(self) -> bool:
        """Whether it has a minimum and a mean; text and flags have change points instead."""
        return self.kind in ("num", "angle", "null")


def registered(connection: sqlite3.Connection, robot_id: int) -> dict[str, RegisteredSignal]:
    """Return the registered signals of a robot by name."""
    rows = connection.execute(
        "SELECT id, robot_id, name, kind, unit, path, reduction, role FROM signal "
        "WHERE robot_id = ? AND typeof(name) = 'text' AND typeof(path) = 'text' ORDER BY id",
        (robot_id,),
    ).fetchall()
    signals = (_registered(RegisteredSignal(*row)) for row in rows)
    return {signal.name: signal for signal in signals}


def _registered(signal: RegisteredSignal) -> RegisteredSignal:
    is_choice = signal.kind == "num" and (signal.role or "").startswith("mode")
    return replace(signal, is_choice=True) if is_choice else signal


def stored_roles(known: dict[str, RegisteredSignal]) -> dict[str, str]:
    """Return the roles of signals that have one, by their names."""
    return {name: signal.role for name, signal in known.items() if signal.role is not None}


def roles_of(
    known: dict[str, RegisteredSignal], position: tuple[str, str] | None = None
) -> dict[str, str]:
    """Return the roles that these signals have among each other; see `decide_roles`."""
    kinds: dict[str, Kind] = {name: signal.kind for name, signal in known.items()}
    choices = {name for name, signal in known.items() if signal.is_choice}
    return decide_roles(kinds, choices, position)


def with_roles(known: dict[str, RegisteredSignal]) -> dict[str, RegisteredSignal]:
    """Return these signals with the roles that they have among each other."""
    roles = roles_of(known)
    return {
        name: signal if signal.role == roles.get(name) else replace(signal, role=roles.get(name))
        for name, signal in known.items()
    }


def enter_signals(
    connection: sqlite3.Connection, robot_id: int, seen: Mapping[str, Seen]
) -> dict[str, RegisteredSignal]:
    """Register the signals of some values. Return all registered signals by name.

    Names beyond `MAX_SIGNALS` of a robot are left out.
    """
    write_changes(connection, robot_id, find_changes(connection, robot_id, seen))
    return registered(connection, robot_id)


def may_widen(signal: RegisteredSignal | None, values: Iterable[object]) -> bool:
    """Return whether values may widen the kind of a signal, judged by their types first."""
    if signal is None or signal.kind == "angle" or signal.is_choice:
        return True
    return signal.kind != "text" and not _TYPES[signal.kind].issuperset(map(type, values))


def seen_in(columns: StateColumns, names: Iterable[str]) -> dict[str, Seen]:
    """Return the signals of some rows, without those whose values have no place."""
    found: dict[str, Seen] = {}
    for name in names:
        row = next(row for row, value in enumerate(columns.values[name]) if value is not ABSENT)
        known = _places_of(columns.texts[row])
        if name in known:
            values = [value for value in columns.values[name] if type(value) not in _NO_VALUES]
            kind = _kind_of(name, values, ends_pose=ends_pose(name, known))
            found[name] = Seen(
                *known[name], kind, _are_choices(name, values), columns.wall_times[row]
            )
    return found


@lru_cache(maxsize=8)  # a row with one new name usually has several
def _places_of(data: str) -> dict[str, Place]:
    return places(parse(data))


def _kind_of(name: str, values: Sequence[Any], *, ends_pose: bool) -> Kind:
    """Return the kind, derived from one value of each type and the extremes."""
    by_type: dict[type, Any] = {type(value): value for value in values}
    numbers = [value for value in values if type(value) is float or type(value) is int]
    found: Kind = "null"
    for value in [*by_type.values(), *([min(numbers), max(numbers)] if numbers else [])]:
        found = widen(found, kind_of(name, value, ends_pose=ends_pose))
    return found


def _are_choices(name: str, values: Sequence[Any]) -> bool:
    """Return whether the known values of a possible mode are few whole numbers."""
    if not find_mode([name]):
        return False
    numbers = [value for value in values if type(value) is int]
    return len(numbers) == len(values) and (
        not numbers or max(numbers) - min(numbers) <= MOST_CHOICES
    )


def seen_with(
    known: dict[str, RegisteredSignal], robot_id: int, columns: StateColumns
) -> dict[str, RegisteredSignal]:
    """Return signals as known after these rows, including those that are not registered."""
    fresh = [name for name, each in columns.values.items() if may_widen(known.get(name), each)]
    found = dict(known)
    for name, seen in seen_in(columns, fresh).items():
        before = known.get(name) or RegisteredSignal(None, robot_id, name, "null", None, *seen[:2])
        kind = widen(before.kind, seen.kind)
        is_choice = seen.is_choice and kind == "num" and (before.is_choice or before.kind == "null")
        if name not in known or (kind, is_choice) != (before.kind, before.is_choice):
            unit = unit_of(name, kind)
            found[name] = replace(before, kind=kind, unit=unit, is_choice=is_choice)
    changed = any(signal is not known.get(name) for name, signal in found.items())
    return with_roles(found) if changed else found


def cleaned(signal: RegisteredSignal, values: Sequence[Any]) -> list[Value]:
    """Return values converted to the type of the signal's kind."""
    if signal.kind == "bool":
        return [None if value is None else value in (1, True) for value in values]
    if signal.kind == "text":
        return [shown(value) for value in values]
    return [None if isinstance(value, str) else value for value in values]


# -- a state row's JSON text, and how values of it are reduced and shown ---------------------------
